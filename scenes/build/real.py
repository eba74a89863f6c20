"""Assets from splat captures: ``python -m scenes.build.real FOLDER`` for the objects of ``scenes/real.yaml``.

FOLDER holds the ``.splat`` files. The assets go to ``scenes/assets/real``, which is not part of the repository.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from mitsplat.asset import Asset
from mitsplat.importing.splat_import import ImportSettings, import_splats

OUT = Path(__file__).resolve().parents[1] / "assets" / "real"


@dataclass(frozen=True)
class Capture:
    """Properties that a splat file does not state: longest extent [m], mass [kg], gloss, and the shape of its base."""

    file: str
    size: float
    mass: float
    specular: float = 0.04
    roughness: float = 0.5
    flat_base: bool = False


CAPTURES = {
    "plant": Capture("plant.splat", 0.30, 0.6, specular=0.0, flat_base=True),
    "teapot": Capture("teapot_100k.splat", 0.20, 0.8, specular=0.04, roughness=0.3),
    "hammer": Capture("hammer_100k.splat", 0.25, 0.7),
    "boot": Capture("boot_100k.splat", 0.24, 0.5, specular=0.02),
    "wingnut": Capture("wingnut_100k.splat", 0.06, 0.08, specular=0.2, roughness=0.4),
    "spot": Capture("spot_10k.splat", 0.14, 0.3),
    "torus": Capture("torus_10k.splat", 0.09, 0.1),
}


def build_capture(name: str, folder: Path) -> Asset:
    """Import one capture: cleaned, in metres, z up, on its base, with a closed mesh."""
    capture = CAPTURES[name]
    settings = ImportSettings(size=capture.size, flat_base=capture.flat_base)
    imported = import_splats(folder / capture.file, name=name, settings=settings, mass=capture.mass)
    return replace(imported.asset, specular=capture.specular, roughness=capture.roughness)


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
