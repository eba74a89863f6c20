"""Convex decompositions: few convex pieces close to the solid."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh

from mitsplat.asset import Asset
from mitsplat.geometry import decomposition
from mitsplat.geometry.decomposition import convex_pieces, denoise_solid, max_gap
from mitsplat.geometry.mesh_distance import DistanceSurface, standoff
from mitsplat.geometry.solids import simplify_solid

PARTS = Path(__file__).parents[2] / "scenes/assets"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mitsplat/pieces"


@pytest.fixture(scope="module")
def bracket():
    """Return an L of two plates, 40 x 20 x 4 and 4 x 20 x 30 mm."""
    floor, wall = trimesh.creation.box((0.04, 0.02, 0.004)), trimesh.creation.box((0.004, 0.02, 0.03))
    wall.apply_translation((-0.018, 0, 0.013))
    return trimesh.boolean.union([floor, wall])


def _inside(hull, point):
    return bool((np.einsum("ij,ij->i", hull.face_normals, point - hull.triangles[:, 0]) < 0).all())


def test_a_convex_solid_is_one_piece():
    box = trimesh.creation.box((0.01, 0.02, 0.03))
    (piece,) = convex_pieces(box)
    assert piece.volume == pytest.approx(box.volume, rel=1e-9)


def test_pieces_fill_a_concave_solid_and_nothing_else(bracket):
    pieces = convex_pieces(bracket)
    assert len(pieces) >= 2
    assert all(piece.is_convex for piece in pieces)
    assert sum(piece.volume for piece in pieces) == pytest.approx(bracket.volume, rel=0.03)
    # The hull has three times the volume; the space inside of the L must stay free.
    middle = np.array([0.0, 0.0, 0.005])
    assert _inside(bracket.convex_hull, middle)
    assert not any(_inside(piece, middle) for piece in pieces)


def test_separate_parts_are_split_apart():
    apart = trimesh.util.concatenate([trimesh.creation.box((0.01,) * 3), trimesh.creation.icosphere(2, 0.01)])
    apart.vertices[:8] += 0.05
    assert len(convex_pieces(apart)) == 2


@pytest.mark.parametrize("place", [(0.05, 0.04, 0), (0, 0, 0.03)], ids=["edge", "face"])
def test_parts_that_touch_are_split_apart(place: tuple[float, float, float]) -> None:
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    other = box.copy().apply_translation(place)
    joint = trimesh.Trimesh(*trimesh.util.append_faces([box.vertices, other.vertices], [box.faces, other.faces]))
    assert not joint.is_watertight
    pieces = convex_pieces(joint)
    bounds = np.array([piece.bounds for piece in pieces])
    np.testing.assert_allclose([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)], joint.bounds, atol=1e-6)
    assert sum(piece.volume for piece in pieces) == pytest.approx(2 * box.volume, rel=1e-5)


def test_a_solid_whose_faces_are_also_listed_turned_keeps_its_pieces() -> None:
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    both_sides = np.concatenate([box.faces, box.faces[:, ::-1]])
    other = box.copy().apply_translation((0.2, 0, 0))
    joint = trimesh.Trimesh(*trimesh.util.append_faces([box.vertices, other.vertices], [both_sides, other.faces]))
    bounds = np.array([piece.bounds for piece in convex_pieces(joint)])
    assert (bounds[:, 0].min(axis=0) < box.bounds[0] + 1e-4).all()


def test_pieces_are_cached_and_damaged_cache_files_replaced(cache, bracket, caplog):
    shifted = bracket.copy().apply_translation((0.001, 0, 0))  # not in the cache
    first = convex_pieces(shifted)
    (path,) = cache.iterdir()
    again = np.load(path)
    assert len(again.files) == 2 * len(first)
    np.testing.assert_array_equal(again["vertices_0"], first[0].vertices)

    from mitsplat.geometry.decomposition import _cached_pieces

    _cached_pieces.cache_clear()
    path.write_bytes(path.read_bytes()[:100])
    assert [piece.volume for piece in convex_pieces(shifted)] == [piece.volume for piece in first]
    assert "computed again" in caplog.text


@pytest.mark.parametrize("library", ["coacd", "manifold3d"])
def test_pieces_of_another_version_of_a_library_are_not_read(cache, bracket, monkeypatch, library):
    decomposition._cached_pieces.cache_clear()
    convex_pieces(bracket)
    decomposition._cached_pieces.cache_clear()
    version = decomposition.version
    monkeypatch.setattr(decomposition, "version", lambda name: "other" if name == library else version(name))
    convex_pieces(bracket)
    assert len(list(cache.iterdir())) == 2


def test_a_scan_without_a_triangle_is_closed_first():
    """CoACD would remesh an open mesh through voxels, which is slow and thickens the mesh."""
    ball = trimesh.creation.icosphere(3, 0.05)
    torn = trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False)
    (piece,) = convex_pieces(torn)
    assert piece.volume == pytest.approx(ball.volume, rel=1e-6)


def scanned_angle() -> trimesh.Trimesh:
    """Return an L of two plates as a scan: 7168 triangles, 0.02 mm of noise."""
    outline = shapely.box(0, 0, 0.06, 0.01).union(shapely.box(0, 0, 0.01, 0.05))
    solid = trimesh.creation.extrude_polygon(outline, 0.03)
    for _ in range(4):
        solid = solid.subdivide()
    noise = np.random.default_rng(0).normal(size=solid.vertices.shape) * 2e-5
    return trimesh.Trimesh(solid.vertices + noise, solid.faces, process=False)


def test_faces_with_columns_in_another_order_in_memory_are_simplified():
    ball = trimesh.creation.icosphere(3)
    reordered = trimesh.Trimesh(ball.vertices, ball.faces[:, [0, 1, 2]], process=False)
    assert not reordered.faces.flags.c_contiguous
    thin, expected = (simplify_solid(solid, 1e-2) for solid in (reordered, ball))
    assert len(thin.faces) < len(ball.faces)
    assert np.array_equal(thin.triangles, expected.triangles)


def test_a_scan_is_simplified_before_it_is_split():
    scan = scanned_angle()
    assert scan.is_volume
    assert len(scan.faces) > 5000
    thin = simplify_solid(scan, 1e-4)
    assert thin.is_volume
    assert len(thin.faces) < 0.1 * len(scan.faces)
    truth = DistanceSurface(scan)
    assert np.abs(truth.signed_distances(np.concatenate([thin.vertices, thin.sample(2000, seed=0)]))).max() < 2e-4
    pieces = convex_pieces(scan)
    assert standoff(truth, pieces) < 6.4e-4
    # The scan protrudes from its pieces by no more than the allowed penetration of a table.
    outside = [
        np.einsum("fvd,fd->vf", scan.vertices - piece.triangles[:, :1], piece.face_normals).max(axis=1)
        for piece in pieces
    ]
    assert np.min(outside, axis=0).max() < 3e-4


def test_a_ragged_mesh_is_split_into_few_pieces(caplog):
    """A fine decomposition has more than 300 pieces and takes minutes."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    factors = 1 + np.random.default_rng(1).uniform(-0.2, 0.2, (len(ball.vertices), 1))
    pieces = convex_pieces(trimesh.Trimesh(ball.vertices * factors, ball.faces, process=False))
    assert 8 < len(pieces) < 64
    assert "a mesh of 320 faces is noisy" in caplog.text


@pytest.mark.parametrize("name", ["hex_bolt", "proximity_sensor", "spur_gear"])
def test_shipped_parts_do_not_count_as_ragged(name):
    assert decomposition._concave_edge_share(trimesh.load_mesh(PARTS / name / "mesh.ply")) < 0.15


@pytest.mark.parametrize("name", ["bearing_6204", "bearing_6206", "washer"])
def test_round_shipped_parts_rest_on_edge_as_their_mesh_does(name):
    """The pieces are as wide as the mesh within 0.02 mm in every direction of the plane of the ring."""
    asset = Asset.load(PARTS / name)
    angle = np.radians(np.arange(0, 360, 0.5))
    directions = np.stack([np.cos(angle), np.sin(angle), 0 * angle])
    pieces = np.concatenate([piece.vertices for piece in asset.pieces])
    deviation = (pieces @ directions).max(axis=0) - (asset.mesh.vertices @ directions).max(axis=0)
    assert np.abs(deviation).max() < 2e-5


def scanned_can(noise: float = 2e-5) -> trimesh.Trimesh:
    """Return a can of 66 x 84 mm with more than 3000 triangles, whose lid is 4 mm below its rim."""
    outline = [(0, 0), (0.033, 0), (0.033, 0.084), (0.029, 0.084), (0.028, 0.08), (0, 0.08)]
    dense = [
        (1 - t) * np.array(start) + t * np.array(end)
        for start, end in pairwise(outline)
        for t in np.linspace(0, 1, max(1, round(np.hypot(*np.subtract(end, start)) / 4e-3)), endpoint=False)
    ]
    can = trimesh.creation.revolve([*dense, outline[-1]], sections=48)
    return trimesh.Trimesh(
        can.vertices + noise * np.random.default_rng(0).normal(size=can.vertices.shape), can.faces, process=False
    )


def test_pieces_of_a_scan_are_few_and_within_the_allowed_standoff():
    can = scanned_can()
    assert can.is_volume
    assert len(can.faces) > 3000
    pieces = convex_pieces(can)
    assert len(pieces) <= decomposition.MAX_PIECES
    assert all(piece.is_convex for piece in pieces)
    assert standoff(DistanceSurface(can), pieces) < max_gap(0.1)
    assert standoff(DistanceSurface(can), [can.convex_hull]) > 3 * max_gap(0.1)


def test_the_number_of_pieces_is_bounded_for_rough_scans():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    rough = 1 + np.random.default_rng(1).uniform(-0.2, 0.2, (len(ball.vertices), 1))
    pieces = convex_pieces(trimesh.Trimesh(ball.vertices * rough, ball.faces, process=False), max_pieces=5)
    assert 1 < len(pieces) <= 5


@pytest.mark.parametrize("normal", [(1.0, 0, 0), (0.6, 0, 0.8)])
@pytest.mark.parametrize("offset", [-0.013, 0.0, 0.004])
def test_the_empty_volume_of_a_cut_agrees_with_manifold(bracket, normal, offset):
    emptiness = decomposition._weighted_empty_volume(
        bracket, bracket.vertices @ normal - offset, offset * np.array(normal)
    )
    sides = decomposition._manifold(bracket).split_by_plane(normal, offset)
    hulls = [side.hull().volume() for side in sides]
    expected = sum(hull * (hull - side.volume()) for hull, side in zip(hulls, sides, strict=True))
    assert emptiness == pytest.approx(expected, rel=1e-9, abs=1e-18)


def test_a_scan_is_simplified_to_5000_faces_within_its_tolerance():
    ball = trimesh.creation.icosphere(5, 0.05)
    assert len(ball.faces) == 20480
    thin = denoise_solid(ball)
    assert thin.is_volume
    assert len(thin.faces) <= 5000
    points = np.concatenate([thin.vertices, thin.sample(2000, seed=0)])
    # The radius of a sphere is the reference; the chords of both meshes lie inside.
    assert np.abs(np.linalg.norm(points, axis=1) - 0.05).max() < 0.003 * ball.scale
    rough = ball.vertices * (1 + np.random.default_rng(1).uniform(-0.02, 0.02, (len(ball.vertices), 1)))
    kept = denoise_solid(trimesh.Trimesh(rough, ball.faces, process=False))
    assert len(kept.faces) > 5000
    assert np.abs(DistanceSurface(kept).signed_distances(rough)).max() < 0.003 * ball.scale * 1.01


def test_pieces_of_a_finely_meshed_tube_of_five_millimetres_leave_its_bore_open():
    tube = trimesh.creation.annulus(r_min=0.0008, r_max=0.0025, height=0.002, sections=800)
    assert len(tube.faces) > 3000
    pieces = convex_pieces(tube)
    assert standoff(DistanceSurface(tube), pieces) < max_gap(0.005) == pytest.approx(5e-4)
    assert not any(piece.contains([[0, 0, 0]])[0] for piece in pieces)


def test_a_small_dent_of_a_large_face_gets_its_own_pieces():
    plate, drill = trimesh.creation.box((0.16, 0.12, 0.012)), trimesh.creation.cylinder(0.004, 0.008, sections=32)
    drill.apply_translation((0.031, 0.017, 0.006))
    dented = trimesh.boolean.difference([plate.subdivide().subdivide().subdivide(), drill]).subdivide().subdivide()
    assert len(dented.faces) > 3000
    pieces = convex_pieces(dented)
    assert len(pieces) > 1
    assert standoff(DistanceSurface(dented), pieces) < max_gap(0.1)
