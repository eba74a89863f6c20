"""Upper estimate of the memory of a worker process, which limits the number of workers.

``python -m benchmarks.scale.workers budget`` measured the coefficients and compares the estimate with measured peaks.
The coefficients hold for the variant ``llvm_ad_rgb``, where the device's memory is the process's own. They have not
been measured on a GPU. A GPU worker is therefore assumed to need this amount of GPU memory and the same amount of the
machine's memory.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from mitsplat.engine.resources import WorkerMemory
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import KERNELS, Quality, resolve_quality
from mitsplat.renderer.instances.silhouettes import canvas_margin
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

PER_RAY = 750
"""Memory per camera ray, with all layers of a pixel and its lighting [bytes].

Measured with an object of 40 wide Gaussians: 3.2 GiB at 2000x1500 and 10.3 GiB at 4000x3000, of which pairs of tiles
take 1.3 and 2.5 GiB.
"""

PER_OBJECT = 12 * 2**20
"""Memory per object of a layout, for simulation and ray intersection [bytes]."""

PER_SILHOUETTE_PIXEL = 2.25
"""Memory per pixel and instance for silhouettes, rendered in tiles up to one image size beyond each border [bytes]."""

_CAMERAS = 5
_TILE = np.array([TILE_WIDTH, TILE_HEIGHT])
_MAX_SAMPLES = 50_000
"""Maximum number of Gaussians of an asset that are sampled; the sample represents the others."""


def worker_memory(scene: Scene) -> WorkerMemory:
    """Estimate the maximum memory of workers for frames of a scene.

    The estimate is a sum of terms in: Gaussians of assets, Gaussians of all instances, covered tiles, rays, objects,
    and objects times pixels. Covered tiles are counted from some of the scene's cameras, with dropped objects in the
    middle of the region, in the image and on the canvas of silhouettes.
    """
    spec = scene.spec
    max_counts = [entry.max_count for entry in spec.objects]
    pools = [[scene.assets[asset].splats for asset in pool] for pool in scene.pools]
    placed = [(max(pool, key=len), count) for pool, count in zip(pools, max_counts, strict=True)]
    middle = np.add(spec.region.min, spec.region.max) / 2
    environments = [environment.splats for environment in scene.environments]
    static = [max(environments, key=len)] if environments else []
    all_splats = {id(splats): splats for splats in itertools.chain(environments, *pools)}.values()
    stored = sum(getattr(splats, name).nbytes for splats in all_splats for name in SplatArrays._fields)
    num_gaussians = sum(map(len, static)) + sum(count * len(splats) for splats, count in placed)
    quality = replace(resolve_quality(spec.quality), **scene.splat_options)
    pixels = spec.output.width * spec.output.height
    cameras = [plan_frame(scene, int(index)).camera for index in np.linspace(0, scene.num_frames - 1, _CAMERAS)]

    def placed_pairs(camera: Camera, margin: float) -> float:
        return sum(count * _pairs(splats, camera, quality, position=middle, margin=margin) for splats, count in placed)

    pairs = max(
        max(
            sum(_pairs(splats, camera, quality) for splats in static) + placed_pairs(camera, 0),
            placed_pairs(camera, canvas_margin(camera)),
        )
        for camera in cameras
    )
    own = (
        BASE
        + COPIES * stored
        + PER_PLACED * num_gaussians
        + PER_PAIR * min(pairs, PAIRS_MAX)
        + PER_RAY * pixels * quality.rays_per_axis**2
        + (PER_OBJECT + PER_SILHOUETTE_PIXEL * pixels) * sum(max_counts)
    )
    return WorkerMemory(own, shared=stored, gpu=max(own, WorkerMemory.gpu))


def _pairs(
    splats: Splats, camera: Camera, quality: Quality, *, position: npt.ArrayLike = (0.0, 0.0, 0.0), margin: float = 0
) -> float:
    """Estimate an upper bound of the (Gaussian, tile) pairs of an asset at a position [m]; a tile has 8 x 4 pixels.

    The footprint of a Gaussian ends where its opacity falls below the quality's cut. The kernel's variance widens it.
    The canvas extends by ``margin`` image sizes beyond each border of the image, as that of silhouettes.
    """
    step = 1 + len(splats) // _MAX_SAMPLES
    means = splats.means[::step] + np.asarray(position, dtype=np.float32)
    pixel, depth = camera.project(means)
    excess = splats.opacities[::step] / quality.alpha_min
    visible = (depth > camera.near) & (excess > 1)
    slope = max(camera.fx, camera.fy) / np.maximum(depth[visible], 1e-6)
    axes = np.sort(splats.scales[::step][visible], axis=1)[:, 1:] * slope[:, None]  # of the widest possible outline
    radii = np.sqrt(2 * np.log(excess[visible]))[:, None] * np.sqrt(axes**2 + KERNELS[quality.kernel].variance)  # [px]
    tiles = np.prod(2 * radii / _TILE + 1, axis=1)
    size, largest = np.array(camera.size), radii[:, 1:]
    beyond = largest + margin * size
    inside = ((pixel[visible] > -beyond) & (pixel[visible] < size + beyond)).all(axis=1)
    return step * float(np.minimum(tiles, np.prod((1 + 2 * margin) * size / _TILE + 1))[inside].sum())
