"""Synthetic captures: renderings of an asset's splats from all around, and noisy surface points.

They need no path tracing and no photographs, so that a fit can be timed wherever the package runs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.layers import render_splats

VIEWS, POINTS = 72, 6000
_NOISE = 0.002
"""Standard deviation of points relative to the asset's size; points deeper than three of these are hidden."""
_BUSY = 0.3


def photograph_asset(folder: Path, out: Path, edge: int, *, seed: int = 0) -> Capture:
    """Render noise-free photos of an asset with masks, and sample noisy points on it.

    Args:
        folder: The asset.
        out: Folder for the photos.
        edge: Width and height of the photos [px].
        seed: Seed of the noise.
    """
    rng, splats = np.random.default_rng(seed), Asset.load(folder).splats
    centre = np.median(splats.means, axis=0)
    size = float(np.linalg.norm(np.ptp(splats.means, axis=0)))
    weight = splats.opacities.astype(np.float64)
    row = rng.choice(len(splats), POINTS, p=weight / weight.sum())
    points = splats.means[row] + rng.normal(0, _NOISE * size, (POINTS, 3))
    colours = np.clip(255 * (0.5 + SH_C0 * splats.sh[row, 0]), 0, 255).astype(np.uint8)
    photos = []
    for number, direction in enumerate(_directions(VIEWS)):
        camera = Camera.look_at(
            centre + 1.6 * size * direction, centre, up=(0, 0, 1), width=edge, height=edge, fov_x=42, near=0.01 * size
        )
        layers = render_splats(splats, camera, quality="balanced")
        alpha = layers.alpha[..., None]
        picture = encode_srgb(layers.rgb / np.maximum(alpha, 1e-6)) * alpha
        picture = picture + _BUSY * rng.random(picture.shape) * (1 - alpha)
        files = out / f"{number:03}.png", out / f"mask_{number:03}.png"
        for file, values in zip(files, (picture, layers.alpha), strict=True):
            Image.fromarray(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)).save(file, compress_level=1)
        pixels, depth = camera.project(points)
        column, line = np.clip(pixels.astype(int), 0, edge - 1).T
        seen = (layers.alpha[line, column] > 0.9) & (depth < layers.depth[line, column] + 3 * _NOISE * size)
        photos.append(Photo(files[0].name, files[0], camera, files[1], np.flatnonzero(seen).astype(np.int32)))
    return Capture(tuple(photos), points.astype(np.float64), colours, "metre", "z")


def _directions(count: int) -> np.ndarray:
    """Return unit vectors evenly spread over the sphere without its poles, where a camera's x axis is undefined."""
    index = np.arange(count) + 0.5
    z, azimuth = 0.95 * (1 - 2 * index / count), index * np.pi * (1 + np.sqrt(5))
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
