"""Slow reference renderer: float64 NumPy, every Gaussian on every ray, exact order, no cut-off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.gaussians.spherical_harmonics import evaluate_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import KERNELS, PRESETS, Quality

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Reference:
    """Reference image: display-encoded colour times alpha (H, W, 3), alpha (H, W), mean blended depth (H, W) [m]."""

    rgb: Array
    alpha: Array
    depth: Array


def render_reference(splats: Splats, camera: Camera, quality: Quality = PRESETS["exact"]) -> Reference:
    """Blend the peak response of every Gaussian along each ray, sorted by the depth of the peaks."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slopes = camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    rgb, alpha, depth = [], [], []
    colours = reference_colours(splats, camera)
    plain = (quality.response, quality.kernel) == ("perspective", "exact")
    if plain:
        along_rays = [responses(splats, camera, u, v) for u, v in slopes]
    else:
        along_rays = list(zip(*widened_responses(splats, camera, slopes, quality), strict=True))
    for opacity, z in along_rays:
        order = np.argsort(z, kind="stable")
        opacity, z = opacity[order], z[order]
        transmittance = np.concatenate([[1.0], np.cumprod(1.0 - opacity)])
        weights = transmittance[:-1] * opacity
        rgb.append(weights @ colours[order])
        alpha.append(1.0 - transmittance[-1])
        depth.append(weights @ z / max(weights.sum(), 1e-300))
    shape = camera.height, camera.width
    return Reference(np.reshape(rgb, (*shape, 3)), np.reshape(alpha, shape), np.reshape(depth, shape))


def reference_shares(splats: Splats, instances: npt.NDArray[np.integer], camera: Camera) -> Array:
    """Compute the share of each instance in each ray, shape (H, W, max id + 1). ``instances`` has the id of each
    Gaussian.

    The remaining transmittance of a ray belongs to the environment, id 0.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    shares = np.zeros((camera.height * camera.width, int(instances.max()) + 1))
    for row, (u, v) in zip(shares, camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1)), strict=True):
        opacity, z = responses(splats, camera, u, v)
        order = np.argsort(z, kind="stable")
        transmittance = np.concatenate([[1.0], np.cumprod(1.0 - opacity[order])])
        np.add.at(row, instances[order], transmittance[:-1] * opacity[order])
        row[0] += transmittance[-1]
    return shares.reshape(camera.height, camera.width, -1)


def responses(splats: Splats, camera: Camera, u: float, v: float) -> tuple[Array, Array]:
    """Compute opacity along the ray of slopes (u, v) and peak depth of every Gaussian (N,).

    The opacity is 0 if the peak is not in front of the near plane.
    """
    pose = camera.camera_from_world
    means = splats.means.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    axes = pose[:3, :3] @ Rotation.from_quat(splats.quats.astype(np.float64)).as_matrix()
    scales = splats.scales.astype(np.float64)
    scales = np.maximum(scales, 1e-6 * scales.max(axis=1, keepdims=True))  # same lower bound as in the renderer
    direction = np.array([u, v, 1.0])
    whitened_mean = np.einsum("nij,ni->nj", axes, means) / scales
    whitened_ray = np.einsum("nij,i->nj", axes, direction) / scales
    length2 = (whitened_ray**2).sum(axis=1)
    z = (whitened_mean * whitened_ray).sum(axis=1) / length2
    # |m x d|^2 / |d|^2 avoids the difference of two large numbers.
    distance2 = (np.cross(whitened_mean, whitened_ray) ** 2).sum(axis=1) / length2
    opacity = splats.opacities * np.exp(-0.5 * distance2)
    return np.where(z > camera.near, opacity, 0.0), z


def widened_responses(splats: Splats, camera: Camera, slopes: Array, quality: Quality) -> tuple[Array, Array]:
    """Compute opacity and depth, (M, N), along rays (M, 2), with a kernel or parallel rays, by EWA (Zwicker et al.
    2002).

    Depth and ray length are those of a joint Gaussian whose image position has the additional covariance K.
    """
    kernel = KERNELS[quality.kernel]
    pose = camera.camera_from_world
    added = kernel.variance * np.diag([1 / camera.fx**2, 1 / camera.fy**2])
    opacities, depths = [], []
    for mean, quat, scales, opacity in zip(splats.means, splats.quats, splats.scales, splats.opacities, strict=True):
        x, y, depth = pose[:3, :3] @ mean.astype(np.float64) + pose[:3, 3]
        rotation = pose[:3, :3] @ Rotation.from_quat(quat.astype(np.float64)).as_matrix()
        scales = scales.astype(np.float64)
        jacobian = np.array([[1, 0, -x / depth], [0, 1, -y / depth]]) / depth
        footprint = jacobian @ rotation @ np.diag(scales**2) @ rotation.T @ jacobian.T
        widened = footprint + added
        if kernel.conserves_light:
            opacity = opacity * np.sqrt(np.linalg.det(footprint) / np.linalg.det(widened))
        offset = slopes - np.array([x, y]) / depth
        whiten = np.diag(1 / scales) @ rotation.T
        centre, step = whiten @ np.array([x / depth, y / depth, 1.0]), np.zeros((len(slopes), 3))
        if quality.response == "perspective":
            step = offset @ (whiten[:, :2] @ np.linalg.solve(widened, footprint).T).T
        length2 = np.sum((centre + step) ** 2, axis=1) / np.sum(centre**2)
        exponent = np.sum(offset * np.linalg.solve(widened, offset.T).T, axis=1) / length2
        opacities.append(np.minimum(opacity * np.exp(-0.5 * exponent), kernel.alpha_max))
        depths.append(depth * (1 + step @ centre / np.sum(centre**2)) / length2)
    z = np.transpose(depths)
    return np.where(z > camera.near, np.transpose(opacities), 0.0), z


def reference_colours(splats: Splats, camera: Camera) -> Array:
    """Compute display-encoded colours (N, 3) as seen from the camera's centre."""
    directions = splats.means.astype(np.float64) - camera.centre
    # A Gaussian centred on the camera has no view direction. Only its constant band contributes.
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-30)
    return evaluate_sh(splats.sh, directions)
