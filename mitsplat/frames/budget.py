"""Upper estimate of the memory of a worker process, which limits the number of workers.

``python -m benchmarks.scale.workers budget`` measured the coefficients and compares the estimate with measured peaks.
The coefficients hold for the variant ``llvm_ad_rgb``, where the device's memory is the process's own. They have not
been measured on a GPU. A GPU worker is therefore assumed to need this amount of GPU memory and the same amount of the
machine's memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace

import numpy as np

from mitsplat.engine.resources import WorkerMemory
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import KERNELS, Quality, resolve_quality
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH
from mitsplat.renderer.splatting.pairs import PAIRS_MAX
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene

BASE = 2**30
"""Memory of Python, libraries, compiled kernels and the simulation of a layout [bytes]."""

PER_PLACED = 160
"""Memory per Gaussian of every instance: its visible data and its entry in the tile lists [bytes]."""

COPIES = 2
"""Copies of a Gaussian's data on the device: the upload, and the concatenation of all splats."""

PER_PAIR = 40
"""Memory per pair of a Gaussian and a tile that it covers [bytes]."""

PER_RAY = 400
"""Memory per camera ray, with all layers of a pixel and its lighting [bytes]."""

PER_OBJECT = 12 * 2**20
"""Memory per object of a layout, for simulation and ray intersection [bytes]."""

PER_SEEN = 2.25
"""Memory per pixel and instance for silhouettes, rendered in tiles up to one image size beyond each border [bytes]."""

_CAMERAS = 5
_TILE = np.array([TILE_WIDTH, TILE_HEIGHT])
_MAX_SAMPLES = 50_000
"""Maximum number of Gaussians of an asset that are sampled; the sample represents the others."""


def worker_memory(scene: Scene) -> WorkerMemory:
    """Estimate the maximum memory of workers for frames of a scene.

    The estimate is a sum of terms in: Gaussians of assets, Gaussians of all instances, covered tiles, rays, objects,
    and objects times pixels. Covered tiles are counted from some of the scene's cameras, with dropped objects in the
    middle of the region.
    """
    spec = scene.spec
    most = [entry.max_count for entry in spec.objects]
    pools = [[scene.assets[i].splats for i in pool] for pool in scene.pools]
    placed = [(max(pool, key=len), count) for pool, count in zip(pools, most, strict=True)]
    middle = np.add(spec.region.min, spec.region.max) / 2
    around = [environment.splats for environment in scene.environments]
    static = [max(around, key=len)] if around else []
    splats = {id(one): one for one in (*around, *(one for pool in pools for one in pool))}.values()
    stored = sum(getattr(one, f.name).nbytes for one in splats for f in fields(one))
    count = sum(map(len, static)) + sum(number * len(one) for one, number in placed)
    quality = replace(resolve_quality(spec.quality), **spec.rendering.model_dump())
    pixels = spec.output.width * spec.output.height
    cameras = [plan_frame(scene, int(i)).camera for i in np.linspace(0, scene.num_frames - 1, _CAMERAS)]
    pairs = max(
        sum(_pairs(one, camera, quality) for one in static)
        + sum(number * _pairs(one, camera, quality, at=middle) for one, number in placed)
        for camera in cameras
    )
    own = (
        BASE
        + COPIES * stored
        + PER_PLACED * count
        + PER_PAIR * min(pairs, PAIRS_MAX)
        + PER_RAY * pixels * quality.grid**2
        + (PER_OBJECT + PER_SEEN * pixels) * sum(most)
    )
    return WorkerMemory(own, shared=stored, gpu=max(own, WorkerMemory.gpu))


def _pairs(splats: Splats, camera: Camera, quality: Quality, *, at: Iterable[float] = (0.0, 0.0, 0.0)) -> float:
    """Estimate an upper bound of the (Gaussian, tile) pairs of an asset at a position [m]; a tile has 8 x 4 pixels.

    The footprint of a Gaussian ends where its opacity falls below the quality's cut. The kernel's variance widens it.
    """
    step = 1 + len(splats) // _MAX_SAMPLES
    means = splats.means[::step] + np.asarray(tuple(at), dtype=np.float32)
    pixel, depth = camera.project(means)
    above = splats.opacities[::step] / quality.alpha_min
    seen = (depth > camera.near) & (above > 1)
    slope = max(camera.fx, camera.fy) / np.maximum(depth[seen], 1e-6)
    axes = np.sort(splats.scales[::step][seen], axis=1)[:, 1:] * slope[:, None]  # of the widest possible outline
    reach = np.sqrt(2 * np.log(above[seen]))[:, None] * np.sqrt(axes**2 + KERNELS[quality.kernel].variance)  # [px]
    tiles = np.prod(2 * reach / _TILE + 1, axis=1)
    image = np.array([camera.width, camera.height])
    across, widest = image / _TILE, reach[:, 1:]
    inside = ((pixel[seen] > -widest) & (pixel[seen] < image + widest)).all(axis=1)
    return step * float(np.minimum(tiles, np.prod(across + 1))[inside].sum())
