"""Shipped assets in glTF: round trips with ``KHR_gaussian_splatting``, uncompressed and as SPZ.

    python -m benchmarks.assets.gltf_splats

The splats of each asset of ``scenes/assets`` are exported to ``.glb`` and read again. Original and copy are rendered
in the same scene, with the mesh of the original, because glTF holds neither meshes of splats nor their materials.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import mitsplat as ms
from benchmarks.assets.stages import SCENES, asset_names, render
from benchmarks.record import figure, recording
from mitsplat.gltf_splats import export_asset_gltf, read_gltf_splats


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", help="Names of the assets.")
    arguments = parser.parse_args()
    with recording("assets.gltf_splats", parser, arguments), tempfile.TemporaryDirectory() as folder:
        names = arguments.only or asset_names()
        rows = np.array([errors_of(name, Path(folder) / "splats.glb") for name in names])
        figure(len(names), "", "assets")
        for kind, errors, sizes in (("plain", rows[:, 0], rows[:, 2]), ("spz", rows[:, 1], rows[:, 3])):
            figure(decibels(errors.max()), "dB", kind, "worst")
            figure(decibels(errors.mean()), "dB", kind, "mean")
            figure(int((errors == 0).sum()), "", kind, "equal")
            figure(float(sizes.mean()), "bytes", kind, "size")


def errors_of(name: str, path: Path) -> tuple[float, float, float, float]:
    """Return the mean squared errors of the uncompressed and the SPZ file, and their bytes per Gaussian."""
    asset = ms.Asset.load(SCENES / "assets" / name)
    asset = replace(asset, splats=replace(asset.splats, materials=None))
    seen = render(asset, name)
    errors, sizes = [], []
    for spz in (False, True):
        export_asset_gltf(asset, path, spz=spz)
        copy = render(replace(asset, splats=read_gltf_splats(path)), name)
        errors.append(float(np.mean((seen - copy) ** 2)))
        sizes.append(path.stat().st_size / len(asset.splats))
    print(f"{name}: {decibels(errors[0]):.1f} dB, as SPZ {decibels(errors[1]):.1f} dB", flush=True)
    return errors[0], errors[1], sizes[0], sizes[1]


def decibels(error: float) -> float:
    """Return the PSNR of a mean squared error [dB]."""
    return math.inf if error == 0 else -10 * math.log10(error)


if __name__ == "__main__":
    main()
