"""Material patterns: seamless repetition, colours, and physical size on surfaces."""

from __future__ import annotations

from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.meshes.visible_meshes import VisibleMeshes
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.renderer.textures import (
    SIZE,
    bitmap_texture,
    box_projection,
    finished_mesh,
    material,
    repeat_width,
    texture_image,
)
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.layout_surroundings import MaterialDraw
from mitsplat.scene.spec.shape_spec import Box, Shape
from mitsplat.scene.walls import pose_matrix

COLOURS = ((0.8, 0.6, 0.4), (0.4, 0.3, 0.2))


def finish(kind: str, **values: object) -> MaterialDraw:
    made = {"kind": kind, "colours": COLOURS, "scale": 0.05, "seed": 3, **values}
    return MaterialDraw(**made)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["noise", "wood", "checker", "stripes"])
def test_patterns_are_between_their_colours_without_seams(kind: str) -> None:
    image = texture_image(finish(kind), {})
    assert image is not None and image.shape == (SIZE, SIZE, 3)
    assert image.min(axis=(0, 1)).tolist() >= [102, 76, 51] and image.max(axis=(0, 1)).tolist() <= [204, 153, 102]
    assert image[..., 0].std() > 8
    assert not np.array_equal(image, texture_image(finish(kind, seed=4), {})) or kind in ("checker", "stripes")
    values = image[..., 0].astype(float)
    for axis in (0, 1):
        steps = np.abs(np.diff(values, axis=axis)).mean(axis=1 - axis)
        seam = np.abs(values.take(0, axis) - values.take(-1, axis)).mean()
        assert seam <= steps.max() + 1


def test_a_pattern_has_its_size_on_every_face() -> None:
    """Lengths on a face equal lengths in its image: the projection follows the faces of a rotated box."""
    shape = Shape(name="a", box=Box(size=(0.4, 0.3, 0.2), rotate=(20, 30, 40)), visible=True)
    assert shape.box is not None
    pose = pose_matrix(shape.box)
    mesh = trimesh.creation.box(extents=shape.box.size, transform=pose)
    wood = finish("wood", rotate=25.0, offset=(0.3, 0.1))
    uv = box_projection(mesh, pose[:3, :3], wood, 1.0).reshape(-1, 3, 2)
    for corners, at in zip(np.asarray(mesh.triangles), uv, strict=True):
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        np.testing.assert_allclose(np.linalg.norm(at - np.roll(at, 1, axis=0), axis=1) * repeat_width(wood), lengths)
        # Image rows go down: corners that are counterclockwise from outside are clockwise in (u, v).
        (a, b), (c, d) = at[1] - at[0], at[2] - at[0]
        assert a * d - b * c < 0


@pytest.mark.parametrize("distance", [0.5, 4.0])
def test_a_pixel_is_the_mean_of_its_footprint(tmp_path: Path, distance: float) -> None:
    """Compares with the mean of many rays through each pixel, near and far from an image of fine squares."""
    ensure_variant()
    cells = np.indices((64, 64)).sum(axis=0) % 2
    cv2.imwrite(str(tmp_path / "a.png"), (np.stack([cells] * 3, axis=2) * 200 + 20).astype(np.uint8))
    tiles = MaterialDraw(kind="image", scale=0.64, rotate=20.0, image="a")
    image = texture_image(tiles, {"a": tmp_path / "a.png"})
    assert image is not None
    shape = Shape(name="a", box=Box(size=(20, 20, 1), position=(0, 0, -0.5)), visible=True)
    assert shape.box is not None
    mesh = trimesh.creation.box(
        extents=shape.box.size, transform=trimesh.transformations.translation_matrix((0, 0, -0.5))
    )
    made = finished_mesh(mesh, shape, tiles, image, mi.load_dict(material(tiles, bitmap_texture(image))))
    pose = look_at_pose((0.0, -0.3 * distance, distance), (0, 0, 0))

    def seen(times: int) -> np.ndarray:
        size, f = 24 * times, 160.0 * times
        camera = Camera(width=size, height=size, fx=f, fy=f, cx=size / 2, cy=size / 2, world_from_camera=pose)
        view = view_of(make_sensor(camera))
        meshes = VisibleMeshes.build([made])
        assert meshes is not None and meshes.textured
        red = np.array(meshes.trace(view, view.rays()).reflectance.x).reshape(24, times, 24, times)
        return np.asarray(red.mean(axis=(1, 3)))

    own, fine = seen(1), seen(16)
    assert np.sqrt(np.mean((own - fine) ** 2)) < 0.03
    mean = decode_srgb(np.array([20, 220]) / 255).mean()
    assert (own.mean(), fine.mean()) == (pytest.approx(mean, rel=0.03), pytest.approx(mean, rel=0.03))
