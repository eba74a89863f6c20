"""Radiance of meshes by Mitsuba's path tracer: along rays, and as reference pictures for splats."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.rays.sensors import view_of

RAYS_PER_LAUNCH = 1 << 21
"""Number of paths that are traced at once. It limits the memory, and affects results only through the random seeds."""


def trace_radiance(
    scene: mi.Scene, origins: Float64Array, directions: Float64Array, *, samples: int, bounces: int, seed: int
) -> tuple[Float64Array, BoolArray]:
    """Compute the mean radiance that arrives at points from given directions, by Mitsuba's path tracer.

    Args:
        scene: Mitsuba scene.
        origins: The points [m], shape (R, 3).
        directions: Unit vectors from the points to the surfaces, shape (R, 3).
        samples: Number of paths per direction.
        bounces: Maximum number of surfaces along a path.
        seed: Seed of the paths.

    Returns:
        Radiance, shape (R, 3), and True for the directions that meet a surface, shape (R,).
    """
    radiance, hit = np.empty((len(origins), 3)), np.empty(len(origins), dtype=bool)
    step = max(1, RAYS_PER_LAUNCH // samples)
    for launch, start in enumerate(range(0, len(origins), step)):
        chunk = slice(start, start + step)
        from_points = mi.Point3f(origins[chunk].T.astype(np.float32))
        along = mi.Vector3f(directions[chunk].T.astype(np.float32))
        ray = dr.arange(mi.UInt32, len(origins[chunk]) * samples) // dr.opaque(mi.UInt32, samples)
        total, hits = _mean_radiance(
            scene,
            dr.gather(mi.Point3f, from_points, ray),
            dr.gather(mi.Vector3f, along, ray),
            samples=samples,
            bounces=bounces,
            seed=seed + launch,
        )
        radiance[chunk], hit[chunk] = total, hits > 0
    return radiance, hit


def _mean_radiance(
    scene: mi.Scene, origins: mi.Point3f, directions: mi.Vector3f, *, samples: int, bounces: int, seed: int
) -> tuple[Float64Array, Float64Array]:
    """Return mean radiance (N, 3) of every ``samples`` consecutive rays, black for misses, and hit share (N,).

    The paths of one mean share a multi-jittered pattern (Kensler 2013), which has several times less noise than
    independent paths.
    """
    integrator, sampler = _path_tracer(bounces, samples, mi.variant())
    sampler.seed(seed, dr.width(directions))
    spectrum, valid, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(origins, directions))
    # A path that hits a sliver triangle may yield NaN (a few of ten million in CAD meshes); such paths are excluded.
    finite = dr.all(dr.isfinite(spectrum))
    radiance = mi.Color3f(dr.select(valid & finite, spectrum, 0.0))
    hit, number = (dr.select(which, mi.Float(1), 0) for which in (valid, finite))
    # Evaluated together, because a later evaluation would trace all paths again.
    dr.eval(radiance, hit, number)
    *sums, hits, numbers = (
        np.asarray(dr.block_sum(channel, samples), dtype=np.float64) for channel in (*radiance, hit, number)
    )
    return np.stack(sums, axis=1) / np.maximum(numbers, 1.0)[:, None], hits / samples


@lru_cache(maxsize=4)
def _path_tracer(bounces: int, samples: int, variant: str) -> tuple[mi.Integrator, mi.Sampler]:
    """Return cached integrator and sampler; seeding resets the sampler.

    Loading them would delay the next launch on a GPU.
    """
    integrator = mi.load_dict({"type": "path", "max_depth": bounces + 1, "rr_depth": 64, "hide_emitters": True})
    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    if sampler.sample_count() == samples:
        sampler.set_samples_per_wavefront(samples)
    else:  # the sampler has no grid for this number
        sampler = mi.load_dict({"type": "independent"})
    return integrator, sampler


def render_mesh(
    scene: mi.Scene, camera: Camera, *, samples: int, bounces: int = 6, seed: int = 0
) -> tuple[Float64Array, Float64Array]:
    """Render path-traced radiance (H, W, 3) of a pinhole ``camera`` and coverage (H, W) in [0, 1].

    The radiance is black for background, and ``samples`` is rounded to a square, see :func:`antialiased_picture`.
    """

    def trace(rays: mi.Ray3f, samples: int, launch: int) -> tuple[Float64Array, Float64Array]:
        return _mean_radiance(scene, rays.o, rays.d, samples=samples, bounces=bounces, seed=seed + launch)

    return antialiased_picture(camera, samples, trace)


def antialiased_picture(
    camera: Camera, samples: int, trace: Callable[[mi.Ray3f, int, int], tuple[Float64Array, Float64Array]]
) -> tuple[Float64Array, Float64Array]:
    """Return mean radiance (H, W, 3), black for background, and coverage (H, W) of a pinhole ``camera``.

    Radiance is averaged before it is encoded, because the mean of encoded noise is too dark. Only the background is
    blended with encoded values, as splats are.

    Args:
        camera: The camera.
        samples: Rays per pixel, rounded to a square, because they form a regular grid.
        trace: Function of rays, their number per pixel and the number of the call. It returns the mean radiance (N, 3)
            and the share of hits (N,) of every pixel; the rays of one pixel are consecutive.
    """
    view, side = view_of(make_sensor(camera)), max(1, round(samples**0.5))
    samples, pixels = side * side, camera.width * camera.height
    across, width = dr.opaque(mi.UInt32, side), dr.opaque(mi.UInt32, camera.width)
    mean, cover = np.empty((pixels, 3)), np.empty(pixels)
    step = max(1, RAYS_PER_LAUNCH // samples)
    for launch, start in enumerate(range(0, pixels, step)):
        count = min(step, pixels - start)
        ray = dr.arange(mi.UInt32, count * samples)
        pixel, within = ray // (across * across), ray % (across * across)
        pixel += dr.opaque(mi.UInt32, start)
        x = mi.Float(pixel % width) + (mi.Float(within % across) + 0.5) / mi.Float(across)
        y = mi.Float(pixel // width) + (mi.Float(within // across) + 0.5) / mi.Float(across)
        rays, chunk = view.rays_through(x, y), slice(start, start + count)
        mean[chunk], cover[chunk] = trace(rays, samples, launch)
    blended = decode_srgb(encode_srgb(mean / np.maximum(cover, 1e-9)[:, None]) * cover[:, None])
    return blended.reshape(camera.height, camera.width, 3), cover.reshape(camera.height, camera.width)
