"""Radiance of meshes by Mitsuba's path tracer: along single rays, and as pictures to compare splats with."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.camera import Camera
from mitsplat.colour import decode_srgb, encode_srgb

FloatArray = npt.NDArray[np.float64]

RAYS_PER_LAUNCH = 1 << 21
"""Paths that are traced at once: bounds the memory, and changes no result but by its seeds."""


def trace_radiance(
    scene: mi.Scene,
    origins: FloatArray,
    directions: FloatArray,
    *,
    samples: int,
    bounces: int,
    seed: int,
    group: int = 1,
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Mean radiance (R, 3) that arrives at ``origins`` (R, 3) [m] from ``directions`` (R, 3), and where a surface is.

    Every ray is traced ``samples`` times by Mitsuba's path tracer. The paths of ``group`` consecutive rays share one
    multi-jittered pattern (Kensler 2013), so that their mean has several times less noise than of independent paths.
    """
    integrator = mi.load_dict({"type": "path", "max_depth": bounces + 1, "rr_depth": 64, "hide_emitters": True})
    radiance, hit = np.empty((len(origins), 3)), np.empty(len(origins), dtype=bool)
    step = max(1, RAYS_PER_LAUNCH // (samples * group)) * group
    for launch, start in enumerate(range(0, len(origins), step)):
        chunk = slice(start, start + step)
        rays = mi.RayDifferential3f(
            mi.Point3f(np.repeat(origins[chunk], samples, axis=0).T.astype(np.float32)),
            mi.Vector3f(np.repeat(directions[chunk], samples, axis=0).T.astype(np.float32)),
        )
        count = len(origins[chunk]) * samples
        sampler = mi.load_dict({"type": "multijitter", "sample_count": samples * group})
        if sampler.sample_count() == samples * group:
            sampler.set_samples_per_wavefront(samples * group)
        else:  # a number that has no grid
            sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed + launch, count)
        spectrum, valid, _ = integrator.sample(scene, sampler, rays)
        radiance[chunk] = np.asarray(mi.Color3f(spectrum)).T.reshape(-1, samples, 3).mean(axis=1)
        hit[chunk] = np.asarray(valid).reshape(-1, samples)[:, 0]
    return radiance, hit


def render_mesh(
    scene: mi.Scene, camera: Camera, *, samples: int, bounces: int = 6, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Path-traced radiance (H, W, 3) of a pinhole ``camera``, black where nothing is, and coverage (H, W) in [0, 1].

    ``samples`` is rounded to a square: the rays of a pixel are on a regular grid. Their radiance is averaged before it
    is encoded, because the mean of encoded noise is too dark. Only the background counts encoded, as splats blend.
    """
    side = max(1, round(samples**0.5))
    fine = camera.resized(camera.width * side, camera.height * side)
    x, y = np.meshgrid(np.arange(fine.width) + 0.5, np.arange(fine.height) + 0.5)
    by_pixel = (camera.height, side, camera.width, side)
    x, y = (v.reshape(by_pixel).transpose(0, 2, 1, 3) for v in (x, y))
    slopes = fine.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    directions = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ camera.world_from_camera[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.centre, directions.shape)
    radiance, hit = trace_radiance(scene, origins, directions, samples=1, bounces=bounces, seed=seed, group=side * side)
    pixels = camera.height, camera.width, side * side
    cover = hit.reshape(pixels).mean(axis=2)
    total = np.where(hit[:, None], radiance, 0.0).reshape(*pixels, 3).mean(axis=2)
    mean = total / np.maximum(cover, 1e-9)[..., None]
    return decode_srgb(encode_srgb(mean) * cover[..., None]), cover
