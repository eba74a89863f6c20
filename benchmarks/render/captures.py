"""Scenes of the benchmarks: the real captures side by side, or a synthetic cloud if they are absent."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "data" / "splats"


def crowd(folder: Path = CAPTURES, count: int = 887_026) -> tuple[Splats, str]:
    """Return about 0.9 M Gaussians and their description: eleven captures side by side, or random spheres."""
    files = sorted(folder.glob("*.splat"))
    if not files:
        return synthetic(count), f"{count} synthetic Gaussians"
    files += [file for file in files if file.stem in ("plant", "academic_tarot_cards")]
    parts = []
    for i, file in enumerate(files):
        pose = np.eye(4)
        pose[:3, :3] = 0.9 * np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # up is -y in the files
        pose[:3, 3] = (i % 4 - 1.5) * 0.8, (i // 4 - 1) * 0.9, 0.0
        parts.append(Splats.load(file).transformed(pose))
    splats = Splats.concatenate(parts)
    return splats, f"{len(files)} captures, {len(splats)} Gaussians"


def synthetic(count: int, seed: int = 0) -> Splats:
    """Return flat Gaussians on random spheres, similar to captures of solid objects."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centres = rng.uniform(-1.2, 1.2, (40, 3)) * (1, 1, 0.2)
    quats = rng.normal(size=(count, 4))
    size = 1.5 * 0.25 * np.sqrt(4 * np.pi * 40 / count)
    return Splats(
        means=centres[rng.integers(0, 40, count)] + 0.25 * normals,
        quats=quats,
        scales=size * rng.uniform(0.5, 1.0, (count, 3)) * (1, 1, 0.2),
        opacities=rng.uniform(0.3, 1.0, count),
        sh=rng.normal(0, 0.6, (count, 1, 3)),
    )


CAMERA = Camera.look_at((0.2, -3.2, 1.6), (0, 0, 0), width=1280, height=720, fov_x=50)
