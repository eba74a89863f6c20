"""Refinement of the pose of a registered mesh by masks, against known poses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.assets.refine_mesh import masked
from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.reconstruct.pipeline.asset_pipeline import make_asset
from mitsplat.reconstruct.pose_refinement import refine_pose
from mitsplat.reconstruct.reconstruct import AssetJob, ImportedMesh
from mitsplat.reconstruct.segment_splats import MaskedView
from scenes.build.parts import build_part
from tests.conftest import KnownObject, orbit
from tests.reconstruct.test_reconstruct import SETTINGS

WIDTH, HEIGHT = 128, 96


def part(name: str) -> trimesh.Trimesh:
    """Return a shipped part, scaled so that it fills the views of :func:`orbit`."""
    mesh = build_part(name, 0)[0].to_geometry()
    mesh = trimesh.Trimesh(mesh.vertices - mesh.bounds.mean(axis=0), mesh.faces, process=False)
    mesh.apply_scale(0.12 / mesh.scale)
    return mesh


@pytest.fixture(scope="module")
def bracket() -> trimesh.Trimesh:
    return part("l_bracket")


@pytest.fixture(scope="module")
def views(bracket: trimesh.Trimesh) -> list[MaskedView]:
    return masked(bracket, orbit(12, width=WIDTH, height=HEIGHT))


def displacement(size: float = 1.0) -> Float64Array:
    """Return the transform by a turn of 5.4 degrees, a shift of 3.5 mm and a growth by ``size``."""
    matrix = np.eye(4)
    matrix[:3, :3] = size * Rotation.from_rotvec(np.radians((3.0, -4.0, 2.0))).as_matrix()
    matrix[:3, 3] = (2e-3, -2.5e-3, 1.5e-3)
    return matrix


def moved(mesh: trimesh.Trimesh, matrix: Float64Array) -> trimesh.Trimesh:
    result = mesh.copy()
    result.apply_transform(matrix)
    return result


def error(mesh: trimesh.Trimesh, matrix: Float64Array, width: int = WIDTH) -> float:
    """Return the mean distance of the moved vertices from their true positions [px at the distance of the object]."""
    focal = orbit(1, width=width)[0].fx
    distance = np.linalg.norm(moved(mesh, matrix).vertices - mesh.vertices, axis=1).mean()
    return float(distance * focal / 0.35)


@pytest.mark.parametrize("size", [1.0, 1.03], ids=["rigid", "free scale"])
@pytest.mark.parametrize("finer", [1, 4], ids=["binary", "antialiased"])
def test_a_displaced_part_returns_to_its_pose(bracket: trimesh.Trimesh, size: float, finer: int) -> None:
    views = masked(bracket, orbit(12, width=WIDTH, height=HEIGHT), finer)
    start = displacement(size)
    told: list[tuple[int, int, str]] = []
    found = refine_pose(moved(bracket, start), views, rigid=size == 1, progress=lambda *step: told.append(step))
    result = found.motion @ start
    assert found.kept and found.validation_views == 4
    assert error(bracket, start) > 3
    assert error(bracket, result) < (0.15 if finer == 1 else 0.05)
    assert np.cbrt(np.linalg.det(result[:3, :3])) == pytest.approx(1, abs=1e-9 if size == 1 else 1e-3)
    assert found.after > 0.95 and found.after > found.before + 0.1
    assert told and told[0][2] == "refining the pose of the mesh"
    assert str(found).startswith("accepted (IoU with the masks of 4 validation photos: 0.")


def test_a_ring_returns_to_its_surface_at_any_angle() -> None:
    """Turns about the axis of a washer change no mask, so only the surface is compared."""
    washer = part("washer")
    start = displacement()
    found = refine_pose(moved(washer, start), masked(washer, orbit(12, width=WIDTH, height=HEIGHT)), rigid=True)
    result = moved(washer, found.motion @ start)
    distance = DistanceSurface(washer).nearest(np.asarray(trimesh.sample.sample_surface(result, 2000, seed=0)[0]))[2]
    focal = orbit(1, width=WIDTH)[0].fx
    assert found.kept
    assert distance.mean() * focal / 0.35 < 0.1
    assert found.motion[:3, :3] @ start[:3, :3] @ (0, 0, 1) == pytest.approx((0, 0, 1), abs=3e-3)


@pytest.mark.parametrize("angle", [60, pytest.param(180, marks=pytest.mark.extended)])
def test_a_nearly_symmetric_part_turns_to_its_true_pose(angle: float) -> None:
    """A hexagon has six equal poses, but the threads of the fitting have one."""
    fitting = part("brass_fitting")
    extents = fitting.extents
    axis = np.eye(3)[int(np.argmax(extents))] if angle == 60 else np.eye(3)[int(np.argmin(extents))]
    start = displacement() @ trimesh.transformations.rotation_matrix(np.radians(angle), axis)
    found = refine_pose(moved(fitting, start), masked(fitting, orbit(24, width=WIDTH, height=HEIGHT)), rigid=True)
    assert found.kept
    assert error(fitting, found.motion @ start) < 0.1


def test_wrong_masks_in_some_views_do_not_move_a_part(bracket: trimesh.Trimesh) -> None:
    """One mask is displaced, one shows another part, one includes a shadow, and one is empty."""
    views = masked(bracket, orbit(18, width=WIDTH, height=HEIGHT))
    washer = masked(part("washer"), [view.camera for view in views])
    for number, mask in (
        (2, np.roll(views[2].mask, 14, axis=1)),
        (4, washer[4].mask),
        (9, np.maximum(views[9].mask, np.roll(views[9].mask, 10, axis=0))),
        (12, np.zeros_like(views[12].mask)),
    ):
        views[number] = replace(views[number], mask=mask)
    start = displacement()
    found = refine_pose(moved(bracket, start), views, rigid=True)
    assert found.kept
    assert error(bracket, found.motion @ start) < 0.15


def test_parts_that_the_border_cuts_or_an_object_hides_return_to_their_pose(bracket: trimesh.Trimesh) -> None:
    """Half of the part is outside of every second image, and a bar hides it in all others."""
    views = masked(bracket, orbit(12, width=WIDTH, height=HEIGHT))
    cut = []
    for number, view in enumerate(views):
        if number % 2:
            camera = view.camera.cropped(WIDTH // 2, 0, WIDTH // 2, HEIGHT)
            cut.append(MaskedView(camera, np.ascontiguousarray(view.mask[:, WIDTH // 2 :])))
        else:
            hidden = np.zeros_like(view.mask)
            hidden[30:50] = 1
            cut.append(MaskedView(view.camera, view.mask * (1 - hidden), hidden))
    start = displacement()
    found = refine_pose(moved(bracket, start), cut, rigid=True)
    assert found.kept
    assert error(bracket, found.motion @ start) < 0.15


@pytest.mark.parametrize(
    "distortion, lens", [((-0.3, 0.1, 0.004, -0.006), "opencv"), ((0.05, -0.01, 0.0, 0.0), "fisheye")]
)
def test_lenses_with_distortion(bracket: trimesh.Trimesh, distortion: tuple[float, ...], lens: str) -> None:
    cameras = [replace(camera, distortion=distortion, lens=lens) for camera in orbit(9, width=WIDTH, height=HEIGHT)]
    start = displacement()
    found = refine_pose(moved(bracket, start), masked(bracket, cameras), rigid=True)
    assert error(bracket, found.motion @ start) < 0.1


def test_the_registered_pose_is_kept_if_validation_photos_contradict(
    bracket: trimesh.Trimesh, views: list[MaskedView]
) -> None:
    """The masks of the fitted views are those of a displaced part."""
    wrong = masked(moved(bracket, displacement()), [view.camera for view in views])
    mixed = [view if number % 3 == 1 else wrong[number] for number, view in enumerate(views)]
    found = refine_pose(bracket, mixed, rigid=True)
    assert not found.kept and found.after < found.before
    np.testing.assert_array_equal(found.motion, np.eye(4))
    assert "rejected, as not significantly better (IoU with the masks of 4 validation photos: 0." in str(found)


def test_a_true_pose_is_not_made_worse(bracket: trimesh.Trimesh, views: list[MaskedView]) -> None:
    assert (
        error(bracket, refine_pose(bracket, masked(bracket, [view.camera for view in views], 1), rigid=True).motion)
        < 0.1
    )


def test_few_or_useless_views_refine_nothing(bracket: trimesh.Trimesh, views: list[MaskedView]) -> None:
    inside = Camera.look_at((0, 0, 0.001), (0.01, 0, 0), width=WIDTH, height=HEIGHT, fov_x=60)
    useless = [*views[:5], MaskedView(inside, views[0].mask), replace(views[5], mask=np.zeros_like(views[5].mask))]
    found = refine_pose(bracket, useless, rigid=True)
    assert (found.kept, found.validation_views) == (False, 0)
    assert str(found) == "rejected (a refinement needs masks from 6 positions outside the mesh)"


def test_an_open_mesh_with_separate_triangles_has_an_outline(views: list[MaskedView], bracket: trimesh.Trimesh) -> None:
    """STL files store separate triangles, and their winding may differ."""
    faces = np.asarray(bracket.faces).copy()
    faces[::2] = faces[::2, ::-1]
    loose = trimesh.Trimesh(
        bracket.vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3), process=False
    )
    start = displacement()
    found = refine_pose(moved(loose, start), views, rigid=True)
    assert error(loose, found.motion @ start) < 0.1


@pytest.fixture(scope="module")
def job(known_object: KnownObject) -> AssetJob:
    drawing = known_object.mesh.copy()
    drawing.apply_transform(trimesh.transformations.rotation_matrix(2.0, (1, 2, 3)))
    drawing.apply_scale(1000.0)
    return AssetJob("part", settings=SETTINGS, imported=ImportedMesh(drawing, metres_per_unit=1e-3))


def test_assets_have_the_refined_pose(
    known_object: KnownObject, job: AssetJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The splats are displaced, as those of metal can be, and the masks show the true pose."""
    monkeypatch.setattr("mitsplat.reconstruct.reconstruct.convex_pieces", lambda mesh: (mesh.convex_hull,))
    start = np.eye(4)
    start[:3, 3] = (1.5e-3, -1e-3, 1e-3)
    known_object.splats.transformed(start).save(tmp_path / "splats.ply")
    done = make_asset(known_object.capture, tmp_path / "splats.ply", tmp_path / "asset", job)
    assert done.verdict.rows["Pose of the mesh"].startswith("accepted (IoU with the masks of 9 validation")
    assert "Pose of the mesh" in (tmp_path / "asset/report.html").read_text()
    alignment = json.loads((tmp_path / "asset/verdict.json").read_text())["alignment"]
    assert job.imported is not None
    mesh = moved(job.imported.mesh, np.array(alignment["splats_from_mesh"]))
    distance = np.linalg.norm(mesh.vertices - known_object.mesh.vertices, axis=1).mean()
    assert distance < 0.1 * np.linalg.norm(start[:3, 3])
    assert alignment["scale"] == pytest.approx(1e-3)
    assert done.verdict.mesh_iou is not None and done.verdict.mesh_iou > 0.98
    assert 0.002 < alignment["residual"] < 0.02


def test_a_given_transform_is_not_refined(
    known_object: KnownObject, job: AssetJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mitsplat.reconstruct.reconstruct.convex_pieces", lambda mesh: (mesh.convex_hull,))
    monkeypatch.setattr(
        "mitsplat.reconstruct.reconstruct.refine_pose", lambda *given, **options: pytest.fail("refined")
    )
    known_object.splats.save(tmp_path / "splats.ply")
    given = replace(job, imported=ImportedMesh(known_object.mesh, np.eye(4)))
    done = make_asset(known_object.capture, tmp_path / "splats.ply", tmp_path / "asset", given)
    assert "Pose of the mesh" not in done.verdict.rows
