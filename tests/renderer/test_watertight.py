"""Watertight ray tracing across shared edges: symmetric views of solids, silhouettes, and light under plates."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from mitsplat.frames.scene_builder import NO_SPLATS
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers, render_silhouettes
from mitsplat.renderer.rays.device_arrays import plain_mesh
from mitsplat.runtime.variant import ensure_variant

SKY = {"type": "constant"}
SOLIDS = {
    "table": trimesh.creation.box((0.6, 0.6, 0.04)),
    "fine box": trimesh.creation.box((0.5, 0.5, 0.25)).subdivide().subdivide(),
    "ball": trimesh.creation.icosphere(2, 0.2),
    "drum": trimesh.creation.cylinder(0.2, 0.1, sections=64),
}
"""Convex solids with edges on the rays of symmetric cameras."""

PLATE = trimesh.Trimesh(
    [(-0.2, -0.2, 0), (0.2, -0.2, 0), (0.2, 0.2, 0), (-0.2, 0.2, 0)], [(2, 0, 1), (0, 2, 3)], process=False
)
"""Two triangles that list their common edge in opposite order: thousands of rays used to pass there."""


def cameras(top: float) -> list[Camera]:
    """Return cameras straight above the middle, above a point on a diagonal, and oblique over a corner."""
    views = [((0, 0, 0.5), (0, 1, 0), 60.0), ((0.125, 0.125, 0.25), (1, 0, 0), 50.0), ((0, 0, 1), (1, 1, 0), 53.0)]
    above = [
        Camera.look_at(np.add(eye, (0, 0, top)), (*eye[:2], top), up=up, width=width, height=height, fov_x=fov)
        for eye, up, fov in views
        for width, height in [(160, 120), (121, 121)]
    ]
    return [*above, Camera.look_at((0.5, 0.5, 0.5), (0, 0, 0), width=121, height=97, fov_x=50)]


def true_depth(mesh: trimesh.Trimesh, camera: Camera) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return the depth at which each ray enters a convex solid (H, W), and the pixels decidable in float32.

    The depth is 0 for a miss. A ray enters at the last plane that it crosses from outside, unless it left through
    another plane before.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slopes = camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    along = np.column_stack([slopes, np.ones(len(slopes))]) @ camera.world_from_camera[:3, :3].T
    height = np.einsum("pi,pi->p", camera.centre - mesh.triangles_center, mesh.face_normals)
    rate = along @ mesh.face_normals.T
    at = -height / np.where(rate == 0, 1e-300, rate)
    enter, leave = np.where(rate < 0, at, -np.inf).max(axis=1), np.where(rate > 0, at, np.inf).min(axis=1)
    shape = camera.height, camera.width
    return np.where(enter < leave, enter, 0).reshape(shape), (np.abs(leave - enter) > 1e-5).reshape(shape)


def render(camera: Camera, shapes: dict[str, Any], **properties: Any) -> Layers:
    return render_layers(make_integrator(**properties), mi.load_dict({"type": "scene", **shapes}), camera)


@pytest.mark.parametrize("name", SOLIDS)
def test_cameras_see_the_front_of_solids_in_every_pixel(name: str) -> None:
    ensure_variant()
    mesh = SOLIDS[name]
    shapes = {"visible": plain_mesh(mesh), "proxy": make_splats_shape(NO_SPLATS, proxy=mesh, instance=1)}
    for camera in cameras(mesh.bounds[1, 2]):
        expected, sure = true_depth(mesh, camera)
        assert sure.mean() > 0.99 and (expected > 0).sum() > 500
        for kind, shape in shapes.items():
            layers = render(camera, {"shape": shape}, shadow="none")
            found = [layers.proxy_depth, layers.depth] if kind == "visible" else [layers.proxy_depth]
            assert [np.count_nonzero(sure & (np.abs(depth - expected) > 1e-4)) for depth in found] == [0] * len(found)


@pytest.mark.parametrize("up", [(0, 1, 0), (1, 0, 0)])
def test_every_pixel_of_a_table_seen_from_above_is_lit(up: tuple[float, float, float]) -> None:
    """Typical pose of bin picking: rays between the two triangles used to hit the dark underside."""
    ensure_variant()
    camera = Camera.look_at((0, 0, 0.52), (0, 0, 0.02), up=up, width=320, height=240, fov_x=50)
    layers = render(camera, {"table": plain_mesh(SOLIDS["table"]), "sky": SKY}, shadow_error=0.3)
    np.testing.assert_allclose(layers.depth, 0.5, atol=1e-4)
    assert layers.light.min() > 0.9


@pytest.mark.parametrize("lamp", ["point", "square"])
@pytest.mark.parametrize("kind", ["visible", "static", "dynamic"])
def test_no_light_passes_through_a_plate(kind: str, lamp: str) -> None:
    """Pixels lie on the plate's diagonals: rays from the floor to a lamp hit the plate's edges."""
    ensure_variant()
    mesh = PLATE.copy().apply_translation((0, 0, 0.5))
    instance = 1 if kind == "dynamic" else 0
    plate = plain_mesh(mesh) if kind == "visible" else make_splats_shape(NO_SPLATS, proxy=mesh, instance=instance)
    bright = {"type": "rgb", "value": 1.0}
    emitter = {"type": "point", "position": [0, 0, 1], "intensity": bright}
    if lamp == "square":
        place = mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.02)
        emitter = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": bright}}
    rays = 1 if lamp == "point" else 16
    for width, height in [(96, 96), (65, 65), (128, 72)]:
        camera = Camera.look_at((0, 0, 0.4), (0, 0, 0), up=(0, 1, 0), width=width, height=height, fov_x=48)
        scene = {"floor": plain_mesh(SOLIDS["table"]), "plate": plate, "lamp": emitter}
        assert render(camera, scene, shadow_error=0.0, shadow_samples=rays).light.max() == 0
    scene.pop("plate")
    assert render(camera, scene, shadow_error=0.0, shadow_samples=rays).light.min() > 0


def test_the_silhouette_of_a_plate_has_no_holes() -> None:
    ensure_variant()
    scene = mi.load_dict({"type": "scene", "plate": make_splats_shape(NO_SPLATS, proxy=PLATE, instance=1)})
    for eye in [(0, 0, 0.5), (0.1, 0.1, 0.25), (0, 0, 1)]:
        for up in [(0, 1, 0), (1, 0, 0)]:
            camera = Camera.look_at(eye, (*eye[:2], 0), up=up, width=120, height=90, fov_x=50)
            mask = render_silhouettes(make_integrator(), scene, camera, source="proxies")[1].mask
            assert mask.sum() > 100 and mask.all()


def test_the_shape_of_a_lamp_hides_nothing() -> None:
    ensure_variant()
    camera = Camera.look_at((0, 0, 0.52), (0, 0, 0.02), up=(0, 1, 0), width=32, height=24, fov_x=50)
    place = mi.ScalarTransform4f().translate([0, 0, 0.3]).rotate([1, 0, 0], 180).scale(0.02)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    lamp = {"type": "rectangle", "to_world": place, "emitter": light}
    layers = render(camera, {"table": plain_mesh(SOLIDS["table"]), "lamp": lamp}, hide_emitters=True)
    np.testing.assert_allclose(layers.depth, 0.5, atol=1e-4)
    assert (layers.alpha == 1).all()
