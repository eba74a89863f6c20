"""Assets from splat captures: ``python -m scenes.build.real FOLDER`` for the objects of ``scenes/real.yaml``.

FOLDER holds the ``.splat`` files. The assets go to ``scenes/assets/real``, which is not part of the repository.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from mitsplat.asset import Asset
from mitsplat.decomposition import convex_pieces
from mitsplat.splats import Splats

OUT = Path(__file__).resolve().parents[1] / "assets" / "real"
Z_UP_FROM_Y_DOWN = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Capture:
    """What a file does not say about the object in it: its longest extent [m], mass [kg] and gloss."""

    file: str
    size: float
    mass: float
    specular: float = 0.04
    roughness: float = 0.5


CAPTURES = {
    "plant": Capture("plant.splat", 0.30, 0.6, specular=0.0),
    "teapot": Capture("teapot_100k.splat", 0.20, 0.8, specular=0.04, roughness=0.3),
    "hammer": Capture("hammer_100k.splat", 0.25, 0.7),
    "boot": Capture("boot_100k.splat", 0.24, 0.5, specular=0.02),
    "wingnut": Capture("wingnut_100k.splat", 0.06, 0.08, specular=0.2, roughness=0.4),
    "spot": Capture("spot_10k.splat", 0.14, 0.3),
    "torus": Capture("torus_10k.splat", 0.09, 0.1),
}


def build_capture(name: str, folder: Path) -> Asset:
    """One capture in metres, z up, centred on its opaque part, with a watertight proxy around that."""
    capture = CAPTURES[name]
    splats = Splats.load(folder / capture.file)
    extent = np.ptp(splats.means[splats.opacities > 0.5], axis=0).max()
    to_metres = Z_UP_FROM_Y_DOWN @ np.diag([*[capture.size / extent] * 3, 1.0])
    splats = splats.transformed(to_metres)
    core = splats.means[splats.opacities > 0.5]
    splats = splats.transformed(trimesh.transformations.translation_matrix(-(core.min(axis=0) + core.max(axis=0)) / 2))
    proxy = proxy_from_splats(splats)
    return Asset(
        name=name,
        class_name=name,
        splats=splats,
        mesh=proxy,
        pieces=convex_pieces(proxy, threshold=0.05),
        mass=capture.mass,
        friction=0.5,
        specular=capture.specular,
        roughness=capture.roughness,
    )


def proxy_from_splats(splats: Splats, *, cells: int = 72, faces: int = 6000) -> trimesh.Trimesh:
    """Watertight surface of the solid that opaque Gaussians enclose, on a grid of ``cells`` along the longest side."""
    core = splats.select(splats.opacities > 0.5)
    step = float(np.ptp(core.bounds, axis=0).max()) / cells
    draws = np.random.default_rng(0).normal(size=(12, len(core), 3)) * core.scales
    spread = np.einsum("nij,snj->sni", Rotation.from_quat(core.quats).as_matrix(), draws)
    points = (core.means + spread).reshape(-1, 3)
    origin = points.min(axis=0) - 4 * step
    index = ((points - origin) / step).astype(int)
    shell = np.zeros(index.max(axis=0) + 6, dtype=bool)
    shell[tuple(index.T)] = True
    ball = ndimage.generate_binary_structure(3, 1)
    solid = ndimage.binary_fill_holes(ndimage.binary_closing(shell, ball, iterations=3))
    labels, count = ndimage.label(solid, np.ones((3, 3, 3)))
    if count > 1:
        solid = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    vertices, triangles, _, _ = marching_cubes(ndimage.gaussian_filter(solid.astype(float), 0.7), 0.5)
    mesh = trimesh.Trimesh(vertices * step + origin + 0.5 * step, triangles[:, ::-1])
    if mesh.volume < 0:
        mesh.invert()
    return mesh.simplify_quadric_decimation(face_count=faces) if len(mesh.faces) > faces else mesh


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    for name in CAPTURES:
        asset = build_capture(name, arguments.folder)
        asset.save(arguments.out / name)
        print(f"{name}: {len(asset.splats)} Gaussians, {len(asset.pieces)} pieces", flush=True)


if __name__ == "__main__":
    main()
