"""The slow, readable twin of the renderer: float64 NumPy, every Gaussian on every ray, exact order, no cut-off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.camera import Camera
from mitsplat.splats import Splats, evaluate_sh

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Reference:
    """Display-encoded colour times alpha (H, W, 3), alpha (H, W), and mean depth of what was blended (H, W) [m]."""

    rgb: Array
    alpha: Array
    depth: Array


def render_reference(splats: Splats, camera: Camera) -> Reference:
    """Blend the peak response of every Gaussian along each ray, sorted by the depth of the peaks."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slopes = camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    rgb, alpha, depth = [], [], []
    colours = reference_colours(splats, camera)
    for u, v in slopes:
        opacity, z = responses(splats, camera, u, v)
        order = np.argsort(z, kind="stable")
        opacity, z = opacity[order], z[order]
        transmittance = np.concatenate([[1.0], np.cumprod(1.0 - opacity)])
        weights = transmittance[:-1] * opacity
        rgb.append(weights @ colours[order])
        alpha.append(1.0 - transmittance[-1])
        depth.append(weights @ z / max(weights.sum(), 1e-300))
    shape = camera.height, camera.width
    return Reference(np.reshape(rgb, (*shape, 3)), np.reshape(alpha, shape), np.reshape(depth, shape))


def responses(splats: Splats, camera: Camera, u: float, v: float) -> tuple[Array, Array]:
    """Opacity along the ray of slopes (u, v), and depth of the peak, of every Gaussian (N,); 0 if it is not ahead."""
    pose = camera.camera_from_world
    means = splats.means.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    axes = pose[:3, :3] @ Rotation.from_quat(splats.quats.astype(np.float64)).as_matrix()
    scales = splats.scales.astype(np.float64)
    scales = np.maximum(scales, 1e-6 * scales.max(axis=1, keepdims=True))  # as the renderer states
    direction = np.array([u, v, 1.0])
    whitened_mean = np.einsum("nij,ni->nj", axes, means) / scales
    whitened_ray = np.einsum("nij,i->nj", axes, direction) / scales
    length2 = (whitened_ray**2).sum(axis=1)
    z = (whitened_mean * whitened_ray).sum(axis=1) / length2
    # |m x d|^2 / |d|^2 rather than a difference of two large numbers.
    distance2 = (np.cross(whitened_mean, whitened_ray) ** 2).sum(axis=1) / length2
    opacity = splats.opacities * np.exp(-0.5 * distance2)
    return np.where(z > camera.near, opacity, 0.0), z


def reference_colours(splats: Splats, camera: Camera) -> Array:
    """Display-encoded colours (N, 3) as seen from the camera's centre."""
    directions = splats.means.astype(np.float64) - camera.centre
    # A Gaussian centred on the camera is seen along no direction: only its constant band counts.
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-30)
    return evaluate_sh(splats.sh, directions)
