"""Material of the detector experiment: assets of scanned objects, packages without a class, and labelled photographs.

    python -m benchmarks.detector.material HOPE WORK [--gaussians 50000] [--packages 120] [--bags 12] [--device cuda]
        [--jobs 8]

HOPE holds ``meshes/*.glb`` (textured scans [m], y up), ``photos/*.jpg`` named ``scene_NNNN_LLLL``, and ``labels.json``
(COCO). WORK gets ``groceries/``, ``packages/``, ``bags/`` and ``brands/`` (the scans with prints of other brands),
folders of assets, and ``photos/``, a COCO folder. Existing files are not made again, so that interrupted runs resume.
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
import numpy as np
import trimesh
from scipy.cluster.vq import kmeans2

# isort: on
from benchmarks.detector.packages import make_bag, make_package, relabel, shape_of
from benchmarks.record import figure, recording
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.bake.mesh_parts import read_model
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.device import use_device

PACKAGE = BakeSettings(gaussians=30000, verify_views=2)
"""Bake settings of packages, which are many."""

UP: dict[str, Literal["y", "z"]] = {"bbq_sauce": "z"}
"""Up axes of scans other than y: this one lies on its label."""

BRANDS = {"box": 4, "bottle": 10, "can": 8}
"""Number of other brands per scan, by its shape: most cans and bottles are shapes of several brands.

Every second one has the scan's colours. Otherwise, on photographs, a detector took objects with a class's colours for
that class, whatever their print.
"""
PRINTED = 5
"""Number of bottles per scan with print all around; others have a label and a cap of any colour."""

PACKAGES = 120
"""Number of packages: 90 boxes, cans and bottles; the others are kinds that were confused with a class."""

BAGS = 12

DENSITY = 600.0
"""Density of packed food including air [kg/m^3]."""


def share_cores(processes: int) -> None:
    """Limit Dr.Jit, which starts a thread per core, to the share of cores of one of several processes."""
    dr.set_thread_count(max(1, usable_cores() // processes))


def parts_hull(mesh: Path | trimesh.Trimesh, up: Literal["y", "z"]) -> trimesh.Trimesh:
    """Return the convex hull of all parts of a mesh [m], z up."""
    parts = read_model(mesh, metres_per_unit=1.0, up=up, finish=None).parts
    return trimesh.util.concatenate([part.mesh for part in parts]).convex_hull


def hulls_of(mesh: trimesh.Trimesh, count: int = 12) -> list[trimesh.Trimesh]:
    """Return convex hulls [m] of a number of patches of a mesh that is too ragged for a convex decomposition."""
    _, patch = kmeans2(mesh.triangles_center, count, seed=0, minit="++")
    return [trimesh.convex.convex_hull(mesh.triangles[patch == one].reshape(-1, 3)) for one in np.unique(patch)]


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hope", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--gaussians", type=int, default=50000, help="Gaussians per scan")
    parser.add_argument("--packages", type=int, default=PACKAGES)
    parser.add_argument("--bags", type=int, default=BAGS)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel bakes")
    options = parser.parse_args()
    with recording("detector.material", parser, options, ignore=("hope", "work", "jobs"), gpu=options.device != "cpu"):
        make(options)


@dataclass(frozen=True)
class Wanted:
    """An asset to make: a scan, a scan with another brand's print, or, without a scan, a package or bag of a seed."""

    kind: Literal["groceries", "brands", "packages", "bags"]
    name: str
    scan: Path = Path()
    seed: int = 0

    def out(self, work: Path) -> Path:
        """Return its folder."""
        return work / self.kind / self.name

    def mesh(self) -> tuple[Path | trimesh.Trimesh, Literal["y", "z"]]:
        """Return the textured mesh, and its up axis."""
        if self.kind == "packages":
            return make_package(self.seed), "z"
        if self.kind == "bags":
            return make_bag(self.seed), "z"
        up = UP.get(self.scan.stem, "y")
        if self.kind == "groceries":
            return self.scan, up
        scan = trimesh.load(self.scan, force="mesh")
        own, plain = self.seed % 2 == 0, self.seed % 1000 >= PRINTED
        return relabel(scan, self.seed, "xyz".index(up), own_colours=own, plain=plain), up

    def bake(self, work: Path, gaussians: int, device: str) -> float:
        """Bake an asset with small files; return its PSNR [dB].

        Its collision shape is the hull, which is close to the shape of all but bags.
        """
        use_device(device)
        mesh, up = self.mesh()
        settings = BakeSettings(gaussians=gaussians) if self.kind == "groceries" else PACKAGE
        pieces = hulls_of(mesh) if self.kind == "bags" else [parts_hull(mesh, up)]
        result = bake_asset(
            mesh,
            name=self.name,
            class_name=self.name if self.kind == "groceries" else "package",
            settings=settings,
            up=up,
            density=DENSITY,
            pieces=pieces,
        )
        asset = result.asset if self.kind == "bags" else replace(result.asset, mesh=pieces[0])
        asset.save(self.out(work), splats="splats.spz")
        notes = "".join(f"; {warning}" for warning in result.warnings)
        print(f"{self.name}: {len(asset.splats)} Gaussians, {result.psnr:.1f} dB{notes}", flush=True)
        return result.psnr


def wanted_assets(hope: Path, packages: int = PACKAGES, bags: int = BAGS) -> list[Wanted]:
    """Return all assets of the experiment."""
    wanted = []
    for number, path in enumerate(sorted((hope / "meshes").glob("*.glb"))):
        wanted.append(Wanted("groceries", path.stem, path))
        count = BRANDS[shape_of(trimesh.load(path, force="mesh"))]
        wanted += [Wanted("brands", f"{path.stem}_{k}", path, 1000 * number + k) for k in range(count)]
    wanted += [Wanted("packages", f"package_{seed:02d}", seed=seed) for seed in range(packages)]
    return wanted + [Wanted("bags", f"bag_{seed:02d}", seed=seed) for seed in range(bags)]


def make(options: argparse.Namespace) -> None:
    """Bake and copy what is missing."""
    photos = options.work / "photos"
    if not photos.exists():
        shutil.copytree(options.hope / "photos", photos)
        shutil.copy(options.hope / "labels.json", photos / "labels.json")
    wanted = wanted_assets(options.hope, options.packages, options.bags)
    wanted = [one for one in wanted if not (one.out(options.work) / "asset.yaml").exists()]
    # concurrent.futures is not used: with processes limited to a number of tasks, its executor never returns.
    with get_context("spawn").Pool(options.jobs, share_cores, (options.jobs,), maxtasksperchild=8) as pool:
        baked = [pool.apply_async(one.bake, (options.work, options.gaussians, options.device)) for one in wanted]
        for one, psnr in zip(wanted, baked, strict=True):
            figure(psnr.get(), "dB", one.name)


if __name__ == "__main__":
    main()
