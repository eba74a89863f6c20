"""Mesh refinement by masks: convergence to the true solid, and rejection without improvement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from benchmarks.assets.known import chamfer
from benchmarks.assets.refine_mesh import masked
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import iou
from mitsplat.reconstruct.asset_report import write_asset_report
from mitsplat.reconstruct.fold_repair import edges_through_faces, limit_motion
from mitsplat.reconstruct.reconstruct import AssetJob, ImportedMesh, reconstruct_asset
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings, Silhouettes, SquareMask, refine_mesh
from mitsplat.reconstruct.surface import SurfaceSettings
from tests.conftest import KnownObject, orbit
from tests.reconstruct.test_reconstruct import SETTINGS

SIZE = 72
QUICK = MeshRefineSettings(steps=40, size=SIZE, rate=5e-3)
DETAIL = replace(QUICK, rate=1e-2, smoothness=1.0)


def bumpy(bumps: float = 0.1, scale: float = 1.0) -> trimesh.Trimesh:
    """Return a dented ellipsoid of 1280 faces, 0.11 m long."""
    ball = trimesh.creation.icosphere(3)
    x, y, z = ball.vertices.T
    radius = 1 + bumps * np.sin(4 * x + 1) * np.sin(5 * y) * np.cos(3 * z)
    return trimesh.Trimesh(0.05 * scale * ball.vertices * radius[:, None] * (1.2, 1, 0.8), ball.faces, process=False)


def overlap(mesh: trimesh.Trimesh, truth: trimesh.Trimesh) -> float:
    """Return the mean IoU of the silhouettes from positions between those of the photos."""
    cameras = orbit(11, width=SIZE, height=SIZE)
    pairs = zip(masked(mesh, cameras, 1), masked(truth, cameras, 1), strict=True)
    return float(np.mean([iou(one.mask > 0, other.mask > 0) for one, other in pairs]))


@pytest.fixture(scope="module")
def truth() -> trimesh.Trimesh:
    return bumpy()


@pytest.fixture(scope="module")
def views(truth: trimesh.Trimesh) -> list[MaskedView]:
    return masked(truth, orbit(24, width=SIZE, height=SIZE))


@pytest.mark.parametrize(
    "bumps, scale, settings, factor",
    [
        pytest.param(0.1, 1.03, QUICK, 5.0, id="swollen"),
        pytest.param(0.05, 1.0, DETAIL, 1.8, id="smoothed", marks=pytest.mark.extended),
    ],
)
def test_a_disturbed_mesh_is_refined_to_the_solid(
    truth: trimesh.Trimesh,
    views: list[MaskedView],
    bumps: float,
    scale: float,
    settings: MeshRefineSettings,
    factor: float,
) -> None:
    start = bumpy(bumps, scale)
    told: list[tuple[int, int, str]] = []
    found = refine_mesh(start, views, settings, progress=lambda *step: told.append(step))
    assert found.kept and found.after > found.before
    assert (found.validation_views, told[-1]) == (4, (40, 40, "refining the mesh"))
    assert chamfer(start, truth) > factor * chamfer(found.mesh, truth)
    assert overlap(found.mesh, truth) > overlap(start, truth)
    assert found.mesh.is_volume
    np.testing.assert_array_equal(found.mesh.faces, start.faces)
    assert ((found.mesh.face_normals * start.face_normals).sum(axis=1) > 0).all()
    assert not len(edges_through_faces(found.mesh, found.mesh.vertices))


@pytest.mark.extended
def test_refining_a_true_mesh_keeps_its_shape(truth: trimesh.Trimesh, views: list[MaskedView]) -> None:
    found = refine_mesh(truth, views, QUICK)
    assert found.kept == (found.mesh is not truth)
    assert chamfer(found.mesh, truth) < 5e-4
    assert overlap(found.mesh, truth) > 0.99


def test_a_refinement_that_held_out_photos_contradict_is_rejected(
    truth: trimesh.Trimesh, views: list[MaskedView]
) -> None:
    """All masks but the held-out ones are of a solid 6 % larger."""
    larger = masked(bumpy(scale=1.06), [view.camera for view in views])
    conflicting = [views[number] if number % 6 == 3 else view for number, view in enumerate(larger)]
    found = refine_mesh(truth, conflicting, replace(QUICK, steps=20))
    assert not found.kept
    assert found.mesh is truth
    assert found.after < found.before
    assert str(found).startswith("rejected, as not significantly better (IoU with the masks of 4 validation photos: 0.")


def test_refinement_keeps_the_base_on_the_table() -> None:
    """The box is too large on all sides but its base."""
    box = trimesh.creation.box((0.06, 0.05, 0.04)).subdivide().subdivide().subdivide()
    box.apply_translation((0, 0, 0.02))
    above = [camera for camera in orbit(40, width=SIZE, height=SIZE) if camera.centre[2] > 0.1]
    start = box.copy()
    start.apply_scale(1.04)
    found = refine_mesh(start, masked(box, above), QUICK, floor=0.0)
    standing = start.vertices[:, 2] < 1e-6
    assert found.kept
    assert standing.sum() > 50
    np.testing.assert_allclose(found.mesh.vertices[standing, 2], 0, atol=1e-8)
    assert found.mesh.vertices[:, 2].min() > -1e-8
    assert abs(found.mesh.volume - box.volume) < 0.4 * abs(start.volume - box.volume)


def test_motion_that_breaks_a_mesh_is_limited() -> None:
    """One vertex moves through the opposite side, and the others outwards by a tenth."""
    ball = trimesh.creation.icosphere(3)
    wanted = 1.1 * ball.vertices
    wanted[7] = -2 * ball.vertices[7]
    broken = trimesh.Trimesh(wanted, ball.faces, process=False)
    assert len(edges_through_faces(broken, broken.vertices))
    found = limit_motion(ball, wanted)
    assert found is not None
    whole = trimesh.Trimesh(found, ball.faces, process=False)
    assert ((whole.face_normals * ball.face_normals).sum(axis=1) > 0).all()
    assert not len(edges_through_faces(whole, whole.vertices))
    assert (np.linalg.norm(found - wanted, axis=1) < 1e-9).mean() > 0.9


def test_motion_without_finite_vertices_is_refused() -> None:
    ball = trimesh.creation.icosphere(2)
    assert limit_motion(ball, np.full_like(ball.vertices, np.nan)) is None


def test_the_gradient_of_a_silhouette_area_equals_its_closed_form() -> None:
    """A ball of radius r at distance d covers a disc of area A = pi f^2 r^2 / (d^2 - r^2), in pixels."""
    ball = trimesh.creation.icosphere(4)
    camera = Camera.look_at((4, 0, 0), (0, 0, 0), width=96, height=96, fov_x=40)
    outline = SquareMask(masked(ball, [camera])[0], np.zeros(3), 1.0, 96)
    scene = Silhouettes(ball)
    radius = mi.Float(1)
    dr.enable_grad(radius)
    scene.set_vertices(mi.Float(scene.params["mesh.vertex_positions"]) * radius)
    area = dr.sum(scene.render(outline, 4, 0, scene.params))
    dr.backward(area)
    focal, distance = outline.focal, 4.0
    assert area[0] == pytest.approx(np.pi * focal**2 / (distance**2 - 1), rel=5e-3)
    slope = 2 * np.pi * focal**2 * distance**2 / (distance**2 - 1) ** 2
    assert dr.grad(radius)[0] == pytest.approx(slope, rel=5e-3)


@pytest.mark.parametrize(
    "distortion, lens",
    [
        pytest.param((-0.35, 0.12, 0.004, -0.006), "opencv", marks=pytest.mark.extended),
        ((0.05, -0.01, 0.0, 0.0), "fisheye"),
    ],
)
def test_masks_of_a_distorted_lens_are_undistorted(
    truth: trimesh.Trimesh, distortion: tuple[float, ...], lens: str
) -> None:
    """The object is off-axis, where distortion is largest: a pinhole model would make the error ten times as large."""
    aside = Camera.look_at((0.3, 0, 0.1), (0, 0.05, 0), width=480, height=480, fov_x=50)
    cameras = [aside, replace(aside, distortion=distortion, lens=lens)]
    pinhole, bent = (SquareMask(view, np.zeros(3), 0.07, SIZE) for view in masked(truth, cameras, 2))
    known = np.array(pinhole.known) * np.array(bent.known)
    straight = SquareMask(replace(masked(truth, cameras[1:], 2)[0], camera=aside), np.zeros(3), 0.07, SIZE)
    error, taken = (np.abs((np.array(pinhole.mask) - np.array(o.mask)) * known).mean() for o in (bent, straight))
    assert known.mean() > 0.9
    assert error < 0.1 * taken


@pytest.mark.parametrize(
    ("field", "value"), [("steps", 0), ("size", 8), ("rate", 0.0), ("rate", "fast"), ("smoothness", np.nan)]
)
def test_settings_out_of_range_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=field):
        MeshRefineSettings(**{field: value})


def test_at_least_two_views_judge_and_fewer_than_four_are_refused(
    truth: trimesh.Trimesh, views: list[MaskedView]
) -> None:
    found = refine_mesh(truth, views[:3], QUICK)
    assert found.mesh is truth and str(found) == "rejected (a refinement needs masks from 4 positions outside the mesh)"
    for count, judges in ((4, 2), (9, 3)):
        assert refine_mesh(truth, views[:count], replace(QUICK, steps=1)).validation_views == judges


def test_assets_record_the_result_of_the_refinement(
    known_object: KnownObject, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mitsplat.reconstruct.reconstruct.convex_pieces", lambda mesh: (mesh.convex_hull,))
    surface = SurfaceSettings(voxels=48, faces=1000)
    settings = replace(SETTINGS, surface=surface, view_size=64, verdict_size=64, refine=replace(QUICK, steps=1))
    found = reconstruct_asset(known_object.capture, known_object.splats, AssetJob("part", settings=settings))
    assert found.refinement is not None
    assert found.verdict.rows == {"Refinement of the mesh": str(found.refinement)}
    page = write_asset_report(tmp_path_factory.mktemp("page"), known_object.capture, found).read_text()
    assert "Refinement of the mesh" in page and str(found.refinement) in page
    for other in ({"kind": "environment"}, {"imported": ImportedMesh(known_object.mesh)}):
        with pytest.raises(InputError, match="reconstructed from masks"):
            AssetJob("part", settings=settings, **other)
