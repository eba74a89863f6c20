"""Convex pieces with the convex hull of their mesh."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from mitsplat.asset import Asset
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.geometry.hull_fit import HULL_TOLERANCE, fit_to_hull

ASSETS = Path(__file__).parents[2] / "scenes/assets"
PARTS = sorted(path.parent.name for path in ASSETS.glob("*/pieces.ply"))
ROUNDING = 1e-7  # of pieces and meshes in single precision [m]


def table_gaps(pieces, mesh, count=4000):
    """Return the gaps [m] of a mesh on a table on which its pieces rest, with ``count`` directions downwards.

    The lowest point of a body above a plane of normal -d is that with the largest projection on d.
    """
    random = np.random.default_rng(0).normal(size=(count, 3))
    random /= np.linalg.norm(random, axis=1)[:, None]
    down = np.concatenate([random, mesh.convex_hull.face_normals, np.eye(3), -np.eye(3)]).T
    vertices = np.concatenate([piece.vertices for piece in pieces])
    return (vertices @ down).max(axis=0) - (mesh.vertices @ down).max(axis=0)


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.01)


def halves(ball, scale):
    """Return the convex pieces of the two halves of a ball, scaled about its centre."""
    sides = [ball.slice_plane((0, 0, 0), (0, 0, sign)).convex_hull for sign in (1, -1)]
    return [side.apply_scale(scale) for side in sides]


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_pieces_that_are_too_small_or_too_large_get_the_hull_of_the_mesh(ball, scale):
    pieces = halves(ball, scale)
    assert np.abs(table_gaps(pieces, ball)).max() > 2e-4
    fitted = fit_to_hull(pieces, ball)
    assert all(piece.is_convex for piece in fitted)
    assert np.abs(table_gaps(fitted, ball)).max() < HULL_TOLERANCE + ROUNDING


def test_pieces_grow_by_no_more_than_the_distance_of_their_new_vertices(ball):
    """Each half stays on its own side."""
    upper, lower = fit_to_hull(halves(ball, 0.97), ball)
    assert upper.bounds[0, 2] == lower.bounds[1, 2] == 0
    assert np.linalg.norm(upper.vertices, axis=1).max() == pytest.approx(0.01, abs=ROUNDING)


def test_pieces_that_meet_at_a_vertex_of_the_hull_both_get_it(ball):
    """Otherwise, a facet beside a seam is skewed, and a wheel of such pieces rolls on differently than its hull."""
    fitted = fit_to_hull(halves(ball, 0.97), ball)
    upper, lower = ({tuple(one) for one in piece.vertices if one[2] == 0} for piece in fitted)
    assert upper == lower
    assert len(upper) > 8


def test_pieces_with_the_hull_of_the_mesh_stay_as_they_are(ball):
    pieces = halves(ball, 1.0)
    assert all(new is old for new, old in zip(fit_to_hull(pieces, ball), pieces, strict=True))


def test_only_the_pieces_that_differ_change(ball):
    upper, lower = halves(ball, 1.0)
    small = lower.copy().apply_scale(0.95)
    fitted = fit_to_hull([upper, small], ball)
    assert fitted[0] is upper
    assert np.abs(table_gaps(fitted, ball)).max() < HULL_TOLERANCE + ROUNDING


def test_a_larger_tolerance_adds_fewer_vertices(ball):
    fine, coarse = (fit_to_hull(halves(ball, 0.97), ball, tolerance=tolerance) for tolerance in (1e-5, 2e-4))
    assert sum(len(piece.vertices) for piece in coarse) < 0.7 * sum(len(piece.vertices) for piece in fine)
    assert np.abs(table_gaps(coarse, ball)).max() < 2e-4 + ROUNDING


def test_debris_beyond_reach_is_not_added(ball):
    debris = trimesh.creation.icosphere(subdivisions=1, radius=1e-4).apply_translation((0.02, 0, 0))
    pieces = halves(ball, 0.97)
    fitted = fit_to_hull(pieces, trimesh.util.concatenate([ball, debris]), reach=1e-3)
    assert np.concatenate([piece.vertices for piece in fitted]).max() < 0.0101
    joined = fit_to_hull(pieces, trimesh.util.concatenate([ball, debris]))
    assert np.concatenate([piece.vertices for piece in joined]).max() > 0.02


@pytest.mark.parametrize("name", PARTS)
def test_shipped_parts_touch_a_table_on_which_their_pieces_rest(name):
    asset = Asset.load(ASSETS / name)
    assert np.abs(table_gaps(asset.pieces, asset.mesh)).max() < HULL_TOLERANCE + ROUNDING


@pytest.mark.parametrize("name", ["hex_bolt", "proximity_sensor"])
def test_pieces_of_finely_meshed_threads_have_their_hull(name, tmp_path, monkeypatch):
    """Removing the noise of a scan lowers the crests of a thread by up to 0.13 mm."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh = Asset.load(ASSETS / name).mesh
    assert len(mesh.faces) > 3000
    assert np.abs(table_gaps(convex_pieces(mesh), mesh)).max() < HULL_TOLERANCE + ROUNDING
