"""Labels sample the pixel centres, for any number of colour samples per pixel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import Quality
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers, render_silhouettes
from mitsplat.renderer.rays.device_arrays import plain_mesh
from mitsplat.runtime.variant import ensure_variant

PINHOLE = Camera(96, 72, 300.0, 300.0, 48.3, 36.4, np.eye(4), focus_distance=1.0)
THIN = replace(PINHOLE, aperture_radius=0.02)
DISTORTED = replace(PINHOLE, distortion=(-0.1, 0.02, 0.0, 0.0, 0.0))
RADIUS, DEPTH = 0.06, 1.0
"""Radius and depth of a disc before the camera [m]; its width is 18 pixels."""


def disc() -> Any:
    """Return a disc of one wide, opaque Gaussian, whose edge transmits half of the light."""
    sigma = RADIUS / np.sqrt(2 * np.log(0.9 / 0.5))
    return make_splats_shape(
        Splats([(0, 0, DEPTH)], [(0, 0, 0, 1)], [(sigma, sigma, 1e-4)], [0.9], np.zeros((1, 1, 3))), instance=1
    )


def centroid(mask: npt.NDArray[np.bool_], x: int = 0, y: int = 0) -> npt.NDArray[np.float64]:
    """Return the centroid [px] of a mask whose first pixel is at (x, y)."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean() + 0.5 + x, rows.mean() + 0.5 + y])


def expected(camera: Camera) -> npt.NDArray[np.bool_]:
    """Return the pixels whose centre ray hits the disc."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slopes = camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    return (np.linalg.norm(slopes, axis=1) < RADIUS / DEPTH).reshape(camera.height, camera.width)


@pytest.mark.parametrize("camera", [PINHOLE, THIN, DISTORTED], ids=["pinhole", "thin lens", "distorted"])
@pytest.mark.parametrize("samples", [1, 2, 3, 4, 8])
def test_discs_cover_the_pixels_whose_centres_see_them(samples: int, camera: Camera) -> None:
    ensure_variant()
    integrator = make_integrator(quality=Quality(samples=samples, lens_rings=1), shadow="none")
    scene = mi.load_dict({"type": "scene", "disc": disc()})
    layers = render_layers(integrator, scene, camera)
    silhouette = render_silhouettes(integrator, scene, camera)[1]
    truth = expected(camera)
    half = (layers.depth > 0) & (layers.instance == 1)
    np.testing.assert_array_equal(layers.instance == 1, truth)
    np.testing.assert_array_equal(silhouette.image_mask(camera.width, camera.height), truth)
    np.testing.assert_allclose(layers.depth[truth], DEPTH, atol=1e-3)
    middle, _ = camera.project([(0.0, 0.0, DEPTH)])
    for mask in (half, silhouette.image_mask(camera.width, camera.height)):
        assert np.abs(centroid(mask) - middle).max() < 0.05


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_a_mesh_behind_splats_has_the_id_where_pixel_centres_see_it(samples: int) -> None:
    """Id and depth are those of the visible mesh behind if less than half of the centre ray is blocked."""
    ensure_variant()
    import trimesh

    wall = trimesh.creation.box((4, 4, 0.1)).apply_translation((0, 0, 2))
    scene = mi.load_dict({"type": "scene", "disc": disc(), "wall": plain_mesh(wall)})
    layers = render_layers(make_integrator(quality=Quality(samples=samples), shadow="none"), scene, PINHOLE)
    truth = expected(PINHOLE)
    np.testing.assert_array_equal(layers.instance == 1, truth)
    np.testing.assert_allclose(layers.depth, np.where(truth, DEPTH, 1.95), atol=1e-3)
