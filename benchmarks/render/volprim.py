"""Reference renderer: Mitsuba's own ``ellipsoids`` and ``volprim_rf_basic`` with the same splats and camera."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.runtime.variant import ensure_variant


def volprim_scene(splats: Splats, camera: Camera) -> Any:
    """Build a Mitsuba scene with the splats as ``ellipsoids``, one sample per pixel and a box filter."""
    ensure_variant()
    count, bands = len(splats), splats.sh.shape[1]
    data = np.concatenate([splats.means, splats.scales, splats.quats], axis=1).astype(np.float32)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic"},
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx))),
                "to_world": mi.ScalarTransform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "splats": {
                "type": "ellipsoids",
                "data": mi.TensorXf(data),
                "opacities": mi.TensorXf(splats.opacities.reshape(count, 1).astype(np.float32)),
                "sh_coeffs": mi.TensorXf(splats.sh.reshape(count, 3 * bands).astype(np.float32)),
            },
        }
    )


def render_volprim(scene: Any) -> np.ndarray:
    """Render one linear image (H, W, 3)."""
    return np.array(mi.render(scene, spp=1))
