"""Shading normals of Gaussians, as normal maps give them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.composition.scene_contents import ContentsReader
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from tests.renderer.test_reflected_edges import box_of_metal

PLATE = trimesh.creation.box(bounds=[(-1, -1, -0.1), (1, 1, 0)])
TURN = Rotation.from_euler("z", 90, degrees=True).as_matrix()


def _plate(normal: tuple[float, float, float] | None) -> Splats:
    """Return flat matt Gaussians of base colour 0.5 on top of the plate, with the same shading normal."""
    along = np.arange(-0.98, 1, 0.04)
    x, y = (part.ravel() for part in np.meshgrid(along, along))
    count = len(x)
    normals = None if normal is None else np.tile(np.array(normal) / np.linalg.norm(normal), (count, 1))
    return Splats(
        np.stack([x, y, np.zeros(count)], axis=1),
        np.tile([0, 0, 0, 1.0], (count, 1)),
        np.tile([0.03, 0.03, 0.001], (count, 1)),
        np.full(count, 0.98),
        np.full((count, 1, 3), (float(encode_srgb(np.array(0.5))) - 0.5) / SH_C0),
        materials=SplatMaterials(np.zeros(count), np.ones(count), np.zeros(count), normals),
    )


def _middle(normal: tuple[float, float, float] | None, *, turned: bool = False) -> Float64Array:
    """Return the mean colour (3,) of the middle of the plate under a lamp at 45 degrees, in the direction of +x."""
    pose = np.eye(4)
    if turned:
        pose[:3, :3] = TURN
    shape = make_splats_shape(_plate(normal), pose, PLATE, instance=1)
    far = 200.0
    lamp = mi.ScalarTransform4f().look_at([far, 0, far], [0, 0, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale(4.0)
    light = {
        "type": "rectangle",
        "to_world": lamp,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1000.0}},
    }
    scene = mi.load_dict({"type": "scene", "plate": shape, "light": light})
    camera = Camera.look_at((0, -0.5, 3), (0, 0, 0), width=40, height=32, fov_x=20)
    rgb = render_layers(make_integrator(white=float(np.pi), bounce=False, hide_emitters=True), scene, camera).rgb
    return np.asarray(rgb[12:20, 14:26].mean(axis=(0, 1)), dtype=np.float64)


def test_light_follows_the_cosine_of_the_shading_normal() -> None:
    """The irradiance of a far lamp at 45 degrees is proportional to the cosine between it and the normal."""
    flat = _middle(None)
    np.testing.assert_allclose(_middle((0, 0, 1)), flat, rtol=0.01)
    for tilt in (-30.0, 20.0):
        angle = np.radians(tilt)
        expected = np.cos(np.radians(45) - angle) / np.cos(np.radians(45))
        tilted = float(np.sin(angle)), 0.0, float(np.cos(angle))
        np.testing.assert_allclose(_middle(tilted) / flat, expected, rtol=0.02)


def test_shading_normals_turn_with_their_object() -> None:
    tilted = 0.5, 0.0, 1.0
    along_y = tuple((TURN.T @ tilted).tolist())
    np.testing.assert_allclose(_middle(along_y, turned=True), _middle(tilted), rtol=0.02)


@pytest.mark.parametrize("present", [True, False])
def test_only_shapes_with_shading_normals_are_rendered_again(present: bool) -> None:
    make_integrator()
    shape = make_splats_shape(_plate((0, 0, 1) if present else None), proxy=PLATE, instance=1)
    contents = ContentsReader().read(mi.load_dict({"type": "scene", "plate": shape}), splat_shadows=False)
    assert (contents.normal_mapped is not None) == present


def test_shading_normals_of_plane_faces_leave_their_edges_as_they_are() -> None:
    """Metal mirrors a lamp at an edge of a box only if one of its faces does, and not if their mean normal does."""
    flat, shown = box_of_metal(50.0, mapped=False), box_of_metal(50.0, mapped=True)
    np.testing.assert_allclose(shown.rgb, flat.rgb, atol=0.1)
