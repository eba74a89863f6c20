"""Mitsuba's sensors in the splat renderer: rays, crop windows, and clipping distances."""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.renderer.rays.sensors import view_of
from mitsplat.runtime.variant import ensure_variant

WIDTH, HEIGHT = 60, 40
CROP = {"crop_offset_x": 11, "crop_offset_y": 7, "crop_width": 30, "crop_height": 20}
OPENCV = {"type": "opencv_camera", "fx": 70.0, "fy": 65.0, "cx": 21.3, "cy": 24.6}


def sensor_of(crop: bool, **parameters: Any) -> Any:
    ensure_variant()
    pose = mi.ScalarTransform4f().look_at(origin=[0.3, -1.2, 0.8], target=[0, 0.1, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    return mi.load_dict({"to_world": pose, "film": film | (CROP if crop else {}), **parameters})


@pytest.mark.parametrize("crop", [False, True], ids=["whole", "crop"])
@pytest.mark.parametrize(
    "parameters",
    [
        {"type": "perspective", "fov": 40.0, "principal_point_offset_x": 0.15, "principal_point_offset_y": -0.2},
        {"type": "perspective", "fov": 40.0, "fov_axis": "y"},
        {"type": "perspective", "focal_length": "50mm"},
        {"type": "thinlens", "fov": 40.0, "aperture_radius": 1e-9, "focus_distance": 1.0},
        OPENCV,
        {**OPENCV, "distortion": "-0.1 0.02 0.001 0"},
    ],
    ids=["principal point", "fov y", "focal length", "thinlens", "opencv", "distorted"],
)
def test_pixels_have_the_rays_of_other_integrators(parameters: dict[str, Any], crop: bool) -> None:
    sensor = sensor_of(crop, **parameters)
    view = view_of(sensor)
    x, y = view.centres()
    position = mi.Point2f(x / view.width, y / view.height)
    ray, _ = sensor.sample_ray(0, 0.5, position, mi.Point2f(0.5, 0.5))
    cosine = np.array(dr.dot(ray.d, view.rays().d))
    assert cosine.min() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(np.array(ray.d), np.array(view.rays().d), atol=1e-5)


def test_other_integrators_compile_no_new_kernels_for_a_moved_camera() -> None:
    """Materials of earlier tests are freed first, because kernels cover all kinds of materials that exist."""
    gc.collect()
    sensor = sensor_of(False, **OPENCV)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "cube": {"type": "cube"}})
    parameters = mi.traverse(sensor)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for number in range(3):
            parameters["to_world"] = mi.Transform4f().look_at([0.1 * number, -3, 1.5], [0, 0, 0], [0, 0, 1])
            parameters.update()
            dr.kernel_history_clear()
            dr.eval(mi.render(scene, sensor=sensor, spp=2))
            run = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
            new = sum(not entry["cache_hit"] or entry["cache_disk"] for entry in run)
            assert run
            assert number == 0 or new == 0
