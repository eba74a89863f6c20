"""Radiance of surfels under the lights of a scene, as view-dependent colours: environments that keep their light.

Radiance is path-traced in directions all over the hemisphere of each surfel, display-encoded, and fitted with spherical
harmonics.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.gaussians.spherical_harmonics import SH_C0, sh_basis
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import Surfels
from mitsplat.geometry.camera_poses import spiral
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.progress import Progress
from mitsplat.renderer.path_tracing import RAYS_PER_LAUNCH, trace_radiance

BOUNCES = 4
"""Maximum length of a light path."""
_SH_DEGREE = 1
_DIRECTIONS = 20
"""Traced directions per surfel."""
_SAMPLES = 16
"""Light paths per direction."""
_SHARPENING = 4
"""Iterations that compensate the blur of overlapping Gaussians."""
_RIDGE_WEIGHT = 0.02
"""Weight of the penalty on view dependence, relative to the data; it determines directions without rays."""


def bake_radiance(scene: mi.Scene, surfels: Surfels, rng: np.random.Generator, progress: Progress) -> Splats:
    """Return splats with the radiance that leaves the surfels."""
    return surfels.splats(_sharpen_colours(surfels, _fit_radiance(scene, surfels, rng, progress)))


def hemisphere(count: int) -> Float64Array:
    """Return directions (M, 3), evenly over the hemisphere around z, at least 3 degrees above the horizon."""
    return spiral(1.0 - 0.95 * (np.arange(count) + 0.5) / count)


def rotate_directions(frames: Float64Array, directions: Float64Array, rng: np.random.Generator) -> Float64Array:
    """Return ``directions`` (M, 3) in each of ``frames`` (N, 3, 3), rotated by a random angle, shape (N, M, 3)."""
    angle = rng.uniform(0.0, 2.0 * np.pi, (len(frames), 1))
    cos, sin = np.cos(angle), np.sin(angle)
    local = np.empty((len(frames), len(directions), 3))
    local[..., 0] = cos * directions[:, 0] - sin * directions[:, 1]
    local[..., 1] = sin * directions[:, 0] + cos * directions[:, 1]
    local[..., 2] = directions[:, 2]
    return np.asarray(np.einsum("nij,nmj->nmi", frames, local))


def ray_offset(scene: mi.Scene) -> float:
    """Return the distance above a surface [m] at which rays towards it start, just above the rounding of float32."""
    box = scene.bbox()
    return 1e-5 * float(max(abs(v) for v in (*box.min, *box.max)))


def _hits_nearby(
    scene: mi.Scene, origins: Float64Array, directions: Float64Array, normals: Float64Array, reach: Float64Array
) -> BoolArray:
    """Return a mask (N, M) of the rays that hit a nearby surface of similar orientation.

    The hit is within ``reach`` (N,) [m], and its normal is close to ``normals`` (N, 3).
    """
    rays = mi.Ray3f(
        mi.Point3f(origins.reshape(-1, 3).T.astype(np.float32)),
        mi.Vector3f(directions.reshape(-1, 3).T.astype(np.float32)),
    )
    hit = scene.ray_intersect_preliminary(rays)
    facing = hit.compute_surface_interaction(rays).n
    dr.eval(facing, hit.t)  # evaluated together, because a later evaluation would trace the rays again
    normal = np.asarray(facing).T.reshape(origins.shape)
    distance = np.asarray(hit.t).reshape(origins.shape[:2])
    alike = np.einsum("nmd,nd->nm", normal, normals) > 0.8
    return np.asarray((distance < reach[:, None]) & alike)


def _fit_radiance(scene: mi.Scene, surfels: Surfels, rng: np.random.Generator, progress: Progress) -> Float64Array:
    """Fit spherical harmonics (N, K, 3) to the display-encoded radiance that leaves every surfel."""
    local = hemisphere(_DIRECTIONS)
    weights = 0.2 + local[:, 2]
    terms = (_SH_DEGREE + 1) ** 2
    penalty = _RIDGE_WEIGHT * weights.sum() * np.diag([1e-6] + [1.0] * (terms - 1)) / (4.0 * np.pi)
    coefficients = np.empty((len(surfels), terms, 3))
    step = max(1, RAYS_PER_LAUNCH // (_DIRECTIONS * _SAMPLES))
    for start in range(0, len(surfels), step):
        progress(start, len(surfels), "tracing their radiance")
        chunk = slice(start, start + step)
        frames, scales = surfels.frames[chunk], surfels.scales[chunk]
        towards = rotate_directions(frames, local, rng)
        # Samples over the footprint average the texture over the Gaussian instead of aliasing it.
        offset = np.clip(rng.normal(size=(*towards.shape[:2], 2)), -1.5, 1.5) * 0.5 * scales[:, None, :2]
        origins = surfels.points[chunk, None] + np.einsum("nij,nmj->nmi", frames[:, :, :2], offset)
        origins += (0.3 * scales[:, None, :1] + ray_offset(scene)) * towards
        on_surface = _hits_nearby(scene, origins, -towards, frames[:, :, 2], 1.2 * scales[:, 0])
        origins = np.where(on_surface[..., None], origins, surfels.points[chunk, None] + ray_offset(scene) * towards)
        radiance, _ = trace_radiance(
            scene,
            origins.reshape(-1, 3),
            -towards.reshape(-1, 3),
            samples=_SAMPLES,
            bounces=BOUNCES,
            seed=int(rng.integers(1 << 30)),
        )
        basis = sh_basis(-towards.reshape(-1, 3), _SH_DEGREE).reshape(*towards.shape[:2], terms)
        weighted = weights[:, None] * basis
        target = encode_srgb(radiance).reshape(*towards.shape) - 0.5
        fitted = np.linalg.solve(
            np.einsum("nmk,nml->nkl", weighted, basis) + penalty, np.einsum("nmk,nmc->nkc", weighted, target)
        )
        # The mean of encoded values is darker than the mean radiance, which a texture shows from afar.
        shown, share = decode_srgb(np.clip(basis @ fitted + 0.5, 0.0, None)), weights / weights.sum()
        means = (np.einsum("m,nmc->nc", share, one) for one in (radiance.reshape(*towards.shape), shown))
        traced, blended = map(encode_srgb, means)
        fitted[:, 0] += (traced - blended) / SH_C0
        coefficients[chunk] = fitted
    return coefficients


def _sharpen_colours(surfels: Surfels, target: Float64Array) -> Float64Array:
    """Return colours (N, K, 3) whose blend at every surfel approximates ``target`` (N, K, 3).

    Van Cittert's iteration. Colours are clamped to the range of their neighbours, which prevents ringing.
    """
    if len(surfels) < 2:
        return target
    neighbours = min(16, len(surfels))
    _, index = KDTree(surfels.points).query(surfels.points, k=neighbours, workers=-1)
    offset = surfels.points[:, None] - surfels.points[index]
    local = np.einsum("nkj,nkji->nki", offset, surfels.frames[index]) / surfels.scales[index]
    facing = np.einsum("nkd,nd->nk", surfels.normals[index], surfels.normals) > 0.8
    blend = np.exp(-0.5 * (local[..., :2] ** 2).sum(axis=2)) * facing
    blend /= blend.sum(axis=1, keepdims=True)
    colour = target.copy()
    for band in range(target.shape[1]):
        goal, now = target[:, band], colour[:, band]
        around = goal[index]
        low, high = around.min(axis=1), around.max(axis=1)
        for _ in range(_SHARPENING):
            now = np.clip(now + 0.7 * (goal - np.einsum("nk,nkc->nc", blend, now[index])), low, high)
        colour[:, band] = now
    return colour
