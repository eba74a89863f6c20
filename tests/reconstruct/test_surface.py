"""Surfaces extracted from splats on a known solid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from benchmarks.assets.known import chamfer
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.geometry.mesh import prepare_mesh
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.mesh_files.mesh_reading import read_mesh
from mitsplat.reconstruct.registration import invert_transform, measure_offset, register_mesh, surface_points
from mitsplat.reconstruct.simplification import simplify_surface
from mitsplat.reconstruct.surface import SurfaceSettings, _close_voids, _Grid, reconstruct_surface
from mitsplat.runtime.variant import ensure_variant
from tests.conftest import KnownObject


def views_of(known: KnownObject) -> tuple[list[Camera], list[np.ndarray]]:
    sized = [photo.fitted(160) for photo in known.capture.training]
    return [camera for camera, *_ in sized], [mask for _, _, mask, _ in sized if mask is not None]


@pytest.fixture(scope="module")
def surface(known_object: KnownObject) -> trimesh.Trimesh:
    return reconstruct_surface(known_object.splats, *views_of(known_object), SurfaceSettings(voxels=96, faces=6000))


@pytest.mark.parametrize(
    ("lens", "distortion"),
    [("opencv", ()), ("opencv", (-0.1, 0, 0, 0)), ("opencv", (-0.3, 0.05, 1e-3, 0)), ("fisheye", (-0.05, -0.01, 0, 0))],
)
def test_cells_in_a_picture_are_those_that_its_camera_projects(lens: Any, distortion: tuple[float, ...]) -> None:
    """The polynomial of a barrel distortion also folds cells beside the view into the picture."""
    ensure_variant()
    pose = look_at_pose((0, 0, 0), (1, 0, 0))
    camera = Camera(320, 240, 240.0, 250.0, 165.0, 118.0, pose, distortion=distortion, lens=lens)
    grid = _Grid(np.array([0.0513, -2.017, -1.983]), 0.1, (20, 40, 40), 0.3)
    cells = grid.low + (np.stack(np.unravel_index(np.arange(grid.count), grid.shape), axis=1) + 0.5) * grid.cell
    shown = np.flatnonzero(np.array(grid._seen_from(camera)[2]))
    np.testing.assert_array_equal(shown, camera.visible_pixels(cells)[0])


def test_the_surface_agrees_with_the_solid(known_object: KnownObject, surface: trimesh.Trimesh) -> None:
    assert surface.is_volume
    assert 5000 < len(surface.faces) <= 6000
    assert chamfer(surface, known_object.mesh) < 0.003
    assert surface.volume == pytest.approx(known_object.mesh.volume, rel=0.03)


def test_depth_carves_a_pocket_that_no_silhouette_shows(known_object: KnownObject, surface: trimesh.Trimesh) -> None:
    middle = np.array([[-0.01, 0.0, 0.035]])
    assert DistanceSurface(known_object.mesh.convex_hull).signed_distances(middle)[0] < -0.005
    depth = float(DistanceSurface(known_object.mesh).signed_distances(middle)[0])
    assert depth > 0.009
    assert DistanceSurface(surface).signed_distances(middle)[0] == pytest.approx(depth, abs=0.001)


def test_the_surface_ends_at_the_table(known_object: KnownObject) -> None:
    """All photos are from above: the visual hull extends below the table that the ball stands on, z = -0.05."""
    cameras, masks = views_of(known_object)
    above = [number for number, camera in enumerate(cameras) if camera.centre[2] > 0.05]
    views = [cameras[number] for number in above], [masks[number] for number in above]
    settings = SurfaceSettings(voxels=64, faces=4000)
    hanging = reconstruct_surface(known_object.splats, *views, settings)
    standing = reconstruct_surface(known_object.splats, *views, settings, floor=-0.05)
    assert hanging.bounds[0, 2] < -0.054
    assert standing.is_volume
    assert standing.bounds[0, 2] == pytest.approx(-0.05, abs=2e-4)
    assert chamfer(standing, known_object.mesh) < chamfer(hanging, known_object.mesh)


def test_the_surface_of_surroundings_needs_no_masks(known_object: KnownObject) -> None:
    cameras, _ = views_of(known_object)
    found = reconstruct_surface(known_object.splats, cameras, settings=SurfaceSettings(voxels=64))
    assert np.abs(DistanceSurface(known_object.mesh).signed_distances(np.asarray(found.vertices))).mean() < 0.002


def test_simplified_surfaces_stay_watertight() -> None:
    """Two balls are joined by a thin neck, which plain quadric decimation may pinch."""
    solid = trimesh.boolean.union(
        [
            trimesh.creation.icosphere(4, 1.0),
            trimesh.creation.cylinder(0.01, 3.0, transform=trimesh.transformations.rotation_matrix(1.57, (0, 1, 0))),
        ],
        engine="manifold",
    )
    for faces in (2000, 400):
        simple = simplify_surface(solid, faces)
        assert len(simple.faces) <= faces
        assert simple.is_volume


@pytest.mark.parametrize("seed", [0, 2])
def test_simplified_surfaces_are_watertight_after_reloading(tmp_path: Path, seed: int) -> None:
    """A simplified sponge touches itself at vertices and edges; it is one closed solid also after reloading."""
    noise = np.pad(gaussian_filter(np.random.default_rng(seed).normal(size=(14, 14, 14)), 1.2), 1, constant_values=-1)
    vertices, faces, _, _ = marching_cubes(noise.astype(np.float32), 0.0, gradient_direction="ascent")
    sponge = max(trimesh.Trimesh(vertices, faces).split(only_watertight=True), key=lambda part: float(part.volume))
    simple = simplify_surface(sponge, len(sponge.faces) // 8)
    assert simple.is_volume and len(simple.faces) <= len(sponge.faces) // 8
    simple.export(tmp_path / "sponge.ply")
    stored = read_mesh(tmp_path / "sponge.ply")
    assert stored.is_watertight and stored.euler_number == simple.euler_number
    solid = prepare_mesh(simple, "sponge")
    assert solid.is_watertight and solid.volume == pytest.approx(simple.volume, rel=1e-6)


def test_masks_without_a_common_solid_are_refused(known_object: KnownObject) -> None:
    cameras, masks = views_of(known_object)
    with pytest.raises(InputError, match="do masks, cameras and splats belong together"):
        reconstruct_surface(known_object.splats, cameras, [0 * mask for mask in masks], SurfaceSettings(voxels=32))


@pytest.mark.parametrize(("field", "value"), [("voxels", 5), ("faces", 3), ("dissent", 9), ("voxels", "96")])
def test_settings_out_of_range_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=field):
        SurfaceSettings(**{field: value})


def similarity(scale: float, seed: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    matrix[:3, 3] = (0.3, -2.0, 5.0)
    return matrix


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.extended) for seed in (1, 2))])
def test_a_drawing_is_registered_with_its_scale(known_object: KnownObject, seed: int) -> None:
    """The drawing is in another frame, 1000 times as large, with a third of the surface unseen."""
    points = surface_points(known_object.splats, [photo.camera for photo in known_object.capture.training])
    points = points[points[:, 2] > -0.02]
    drawing = known_object.mesh.copy()
    drawing.apply_transform(similarity(1000.0, seed))
    found = register_mesh(drawing, points)
    assert found.scale == pytest.approx(1e-3, rel=3e-3)
    drawing.apply_transform(found.splats_from_mesh)
    distance = np.linalg.norm(drawing.vertices - known_object.mesh.vertices, axis=1).max()
    assert distance < 0.004 * known_object.mesh.scale
    assert measure_offset(drawing, points).shift < 0.002


def test_a_drawing_of_known_units_keeps_its_size(known_object: KnownObject) -> None:
    """The surface of splats is 4 % too small, as on polished metal; wrong units are refused."""
    points = np.asarray(trimesh.sample.sample_surface(known_object.mesh, 1000, seed=0)[0])
    points = points.mean(axis=0) + 0.96 * (points - points.mean(axis=0))
    drawing = known_object.mesh.copy()
    drawing.apply_transform(similarity(1000.0, 1))
    assert register_mesh(drawing, points).scale == pytest.approx(0.96e-3, rel=5e-3)
    found = register_mesh(drawing, points, 1e-3)
    assert found.scale == pytest.approx(1e-3, rel=1e-6)
    drawing.apply_transform(found.splats_from_mesh)
    distance = np.linalg.norm(drawing.vertices - known_object.mesh.vertices, axis=1).max()
    assert distance < 0.03 * known_object.mesh.scale
    with pytest.raises(InputError, match="times as large as the photographed object: check its units"):
        register_mesh(drawing, points, 0.0254)


@pytest.mark.parametrize("seed", [1, 4, 6])
def test_a_nearly_round_drawing_is_rotated_by_its_edges(known_object: KnownObject, seed: int) -> None:
    """Nine of ten points are on a ball and do not depend on its rotation.

    The rest of a box and a pocket determines the rotation.
    """
    points = np.asarray(trimesh.sample.sample_surface(known_object.mesh, 1000, seed=seed)[0])
    points += np.random.default_rng(seed).normal(0, 1e-4, points.shape)
    drawing = known_object.mesh.copy()
    drawing.apply_transform(similarity(1000.0, seed))
    drawing.apply_transform(register_mesh(drawing, points).splats_from_mesh)
    distance = np.linalg.norm(drawing.vertices - known_object.mesh.vertices, axis=1).max()
    assert distance < 0.001 * known_object.mesh.scale


def test_offset_equals_the_applied_shift(known_object: KnownObject) -> None:
    points = surface_points(known_object.splats, [photo.camera for photo in known_object.capture.held_out])
    assert measure_offset(known_object.mesh, points).shift < 5e-4
    moved = known_object.mesh.copy()
    moved.apply_translation((0.001, 0.0, 0.0005))
    assert measure_offset(moved, points).shift * moved.scale == pytest.approx(np.hypot(0.001, 0.0005), rel=0.1)


def test_the_inverse_normalisation_restores_a_mesh(tmp_path: Path, known_object: KnownObject) -> None:
    matrix = similarity(7.0, 4)
    np.savetxt(tmp_path / "normalisation.txt", matrix[:3])
    mesh = known_object.mesh.copy()
    mesh.apply_transform(matrix)
    mesh.apply_transform(invert_transform(tmp_path / "normalisation.txt"))
    np.testing.assert_allclose(mesh.vertices, known_object.mesh.vertices, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "rule"),
    [("1 2 3", "3 x 4 or 4 x 4"), ("a b", "3 or 4 rows"), ("1 0 0 0\n0 2 0 0\n0 0 1 0", "scale")],
)
def test_files_without_a_similarity_are_refused(tmp_path: Path, text: str, rule: str) -> None:
    (tmp_path / "matrix.txt").write_text(text)
    with pytest.raises(InputError, match=rule):
        invert_transform(tmp_path / "matrix.txt")
    with pytest.raises(InputError, match="cannot be read"):
        invert_transform(tmp_path / "none.txt")


def test_narrow_passages_are_closed_and_hollows_are_kept() -> None:
    """A block has a pocket, and a void that a thin channel connects to the outside."""
    solid = np.zeros((40, 40, 40), dtype=bool)
    solid[4:36, 4:36, 4:36] = True
    solid[10:20, 10:20, 10:20] = False
    solid[13:16, 13:16, :10] = False
    solid[24:33, 24:33, 20:] = False
    sealed = _close_voids(np.where(solid, 1.0, -1.0).astype(np.float32), 3.0) > 0
    assert sealed[10:20, 10:20, 10:20].all()
    assert not sealed[24:33, 24:33, 20:].any()
    assert not sealed[:4].any() and not sealed[36:].any()
    assert not (_close_voids(np.full((4, 4, 4), -1.0, np.float32), 3.0) > 0).any()
