"""Give the shipped parts their convex pieces: ``python -m scenes.build.refit [NAME ...] [--out FOLDER]``.

Only ``pieces.ply`` changes, so that Gaussians and meshes stay the same.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mitsplat.asset import Asset
from mitsplat.geometry.hull_fit import fit_to_hull
from scenes.build.parts import PARTS, build_part

ASSETS = Path(__file__).resolve().parents[1] / "assets"


def refit(name: str, folder: Path) -> None:
    asset = Asset.load(folder)
    if asset.mesh is None:
        raise ValueError(f"asset {name!r} must have a mesh (got none)")
    pieces = fit_to_hull(build_part(name, 0)[1], asset.mesh)
    with TemporaryDirectory() as work:
        replace(asset, pieces=pieces).save(work, splats="splats.spz")
        (folder / "pieces.ply").write_bytes((Path(work) / "pieces.ply").read_bytes())
    vertices = sum(len(piece.vertices) for piece in pieces)
    print(f"{name}: {len(pieces)} pieces of {vertices} vertices")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *PARTS], metavar="NAME")
    parser.add_argument("--out", type=Path, default=ASSETS, help="folder of the assets, which are changed")
    arguments = parser.parse_args()
    for name in arguments.names or PARTS:
        refit(name, arguments.out / name)


if __name__ == "__main__":
    main()
