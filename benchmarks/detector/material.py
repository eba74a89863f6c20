"""Material of the experiment on detectors: assets of scanned objects, packages that no class is, labelled photographs.

    python -m benchmarks.detector.material HOPE WORK [--gaussians 50000] [--packages 90] [--device cuda] [--jobs 8]

HOPE holds ``meshes/*.glb`` (textured scans [m], y up), ``photos/*.jpg`` named ``scene_NNNN_LLLL``, and ``labels.json``
(COCO). WORK gets ``groceries/``, ``packages/`` and ``brands/`` (the scans as other brands print them), folders of
assets, and ``photos/``, a COCO folder. What is there already is kept, so that it goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

# isort: off
import mitsplat  # noqa: F401  # which must come before Dr.Jit

import drjit as dr
import trimesh

# isort: on
from benchmarks.detector.packages import make_package, relabel, shape_of
from benchmarks.record import figure, recording
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.bake.parts import read_parts
from mitsplat.cores import usable_cores
from mitsplat.device import use_device

PACKAGE = BakeSettings(
    gaussians=30000, sh_degree=1, directions=8, samples=8, fit_views=12, fit_steps=50, verify_views=2
)
"""Packages are many and diffuse: a third of the time of a scan, 2 dB less."""

UP: dict[str, Literal["y", "z"]] = {"bbq_sauce": "z"}
"""Axes of scans that stand along another than y: this one lies on its label."""

BRANDS = {"box": 4, "bottle": 10, "can": 8}
"""How many other brands of each scan there are, by its shape: most goods in cans and bottles come in these.

Every second one has the scan's colours: on photographs what shares a class's colours was taken for it, whatever was
printed on it."""
PRINTED = 5
"""Bottles of each scan that are printed all around; others have a label and a cap of any colour."""

PACKAGES = 130
"""Of which 90 are boxes, cans and bottles, and the rest what was taken for a class beside them."""

DENSITY = 600.0
"""Of packed food with air around it [kg/m^3]."""


def bake(
    mesh: Path | trimesh.Trimesh, out: Path, class_name: str, settings: BakeSettings, up: Literal["y", "z"]
) -> float:
    """An asset of small files, whose PSNR [dB] this is; its body is its hull, which cartons and cans all but fill."""
    hull = parts_hull(mesh, up)
    result = bake_asset(
        mesh, name=out.name, class_name=class_name, settings=settings, up=up, density=DENSITY, pieces=[hull]
    )
    replace(result.asset, mesh=hull).save(out, splats="splats.spz")
    notes = "".join(f"; {warning}" for warning in result.warnings)
    print(f"{out.name}: {len(result.asset.splats)} Gaussians, {result.psnr:.1f} dB{notes}", flush=True)
    return result.psnr


def share_cores(processes: int) -> None:
    """Leave Dr.Jit, which has a thread for every core, those of one of so many processes."""
    dr.set_thread_count(max(1, usable_cores() // processes))


def parts_hull(mesh: Path | trimesh.Trimesh, up: Literal["y", "z"]) -> trimesh.Trimesh:
    """The convex hull of all parts of a mesh [m], z up."""
    parts = read_parts(mesh, metres_per_unit=1.0, up=up, finish=None)
    return trimesh.util.concatenate([part.mesh for part in parts]).convex_hull


def main() -> None:
    """Read what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hope", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--gaussians", type=int, default=50000, help="of each scan")
    parser.add_argument("--packages", type=int, default=PACKAGES)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--jobs", type=int, default=1, help="assets that are baked at once")
    options = parser.parse_args()
    with recording("detector.material", parser, options, ignore=("hope", "work", "jobs"), gpu=options.device != "cpu"):
        make(options)


@dataclass(frozen=True)
class Wanted:
    """An asset: a scan, a scan as another brand prints it (its number), or a package (without a scan)."""

    out: Path
    scan: Path | None = None
    seed: int = 0
    brand: bool = False

    def mesh(self) -> tuple[Path | trimesh.Trimesh, Literal["y", "z"]]:
        """Textured, and which of its axes points up."""
        if self.scan is None:
            return make_package(self.seed), "z"
        up = UP.get(self.scan.stem, "y")
        if not self.brand:
            return self.scan, up
        scan = trimesh.load(self.scan, force="mesh")
        own, plain = self.seed % 2 == 0, self.seed % 1000 >= PRINTED
        return relabel(scan, self.seed, "xyz".index(up), own_colours=own, plain=plain), up

    def bake(self, gaussians: int, device: str) -> float:
        """Its PSNR [dB]."""
        use_device(device)
        mesh, up = self.mesh()
        if isinstance(mesh, Path):
            return bake(mesh, self.out, mesh.stem, BakeSettings(gaussians=gaussians), up)
        return bake(mesh, self.out, "package", PACKAGE, up)


def wanted_assets(hope: Path, work: Path, packages: int) -> list[Wanted]:
    """All of the experiment's."""
    wanted = []
    for number, path in enumerate(sorted((hope / "meshes").glob("*.glb"))):
        wanted.append(Wanted(work / "groceries" / path.stem, path))
        count = BRANDS[shape_of(trimesh.load(path, force="mesh"))]
        wanted += [Wanted(work / "brands" / f"{path.stem}_{k}", path, 1000 * number + k, True) for k in range(count)]
    return wanted + [Wanted(work / "packages" / f"package_{seed:02d}", seed=seed) for seed in range(packages)]


def make(options: argparse.Namespace) -> None:
    """Bake and copy what is not there."""
    photos = options.work / "photos"
    if not photos.exists():
        shutil.copytree(options.hope / "photos", photos)
        shutil.copy(options.hope / "labels.json", photos / "labels.json")
    wanted = wanted_assets(options.hope, options.work, options.packages)
    wanted = [one for one in wanted if not (one.out / "asset.yaml").exists()]
    # Not an executor of concurrent.futures: with processes of so many tasks it waits for ever once all have ended.
    with get_context("spawn").Pool(options.jobs, share_cores, (options.jobs,), maxtasksperchild=8) as pool:
        baked = [pool.apply_async(one.bake, (options.gaussians, options.device)) for one in wanted]
        for one, psnr in zip(wanted, baked, strict=True):
            figure(psnr.get(), "dB", one.out.name)


if __name__ == "__main__":
    main()
