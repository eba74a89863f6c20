"""Cost of a bake, its accuracy relative to the mesh, and the accuracy of its convex pieces.

    python -m benchmarks.assets.bake MESH... [--gaussians 20000] [--subdivide 0]
    python -m benchmarks.assets.bake relay_box --device cuda --ready-pieces --runs 2

MESH is a mesh file, or the name of a part of the shipped scene. ``--subdivide`` divides each triangle of a file into
four, as many times as given. Pieces are computed without the cache, except with ``--ready-pieces``. Times are CPU
seconds of this process, which other programs hardly affect, and for a GPU wall-clock seconds as well. Of several runs
the last one counts, because the first one compiles kernels.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

# isort: off
import mitsplat  # which must be imported before Dr.Jit

import drjit as dr
import trimesh

# isort: on
from benchmarks.record import figure, recording
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.geometry.mesh_distance import DistanceSurface, standoff
from mitsplat.runtime.device import use_device
from scenes.build.parts import PARTS, build_part


def cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def divided(path: Path, times: int, folder: Path) -> Path:
    """Return a file of the same mesh and texture with smaller triangles."""
    mesh = trimesh.load(path, force="mesh")
    for _ in range(times):
        mesh = mesh.subdivide()
    mesh.export(folder / f"{path.stem}.glb")
    return folder / f"{path.stem}.glb"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", metavar="MESH")
    parser.add_argument("--gaussians", type=int, default=20000)
    parser.add_argument("--subdivide", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--ready-pieces", action="store_true", help="use a part's own pieces, or a file's hull")
    parser.add_argument("--runs", type=int, default=1)
    arguments = parser.parse_args()
    device = use_device(arguments.device)
    with recording("assets.bake", parser, arguments, gpu=device.kind == "cuda"):
        for _ in range(arguments.runs):
            measure(arguments)


def measure(arguments: argparse.Namespace) -> None:
    for name in arguments.meshes:
        mesh, pieces = build_part(name, 0) if name in PARTS else (Path(name), ())
        stages: dict[str, tuple[float, float]] = {}

        def note(done: int, total: int, stage: str, stages: dict[str, tuple[float, float]] = stages) -> None:
            if stage not in stages:
                dr.sync_thread()
                stages[stage] = cpu_seconds(), time.monotonic()

        with tempfile.TemporaryDirectory() as cache:
            os.environ["XDG_CACHE_HOME"] = cache
            if arguments.subdivide and isinstance(mesh, Path):
                mesh = divided(mesh, arguments.subdivide, Path(cache))
            if arguments.ready_pieces and isinstance(mesh, Path):
                pieces = [trimesh.load(mesh, force="mesh").convex_hull]
            start, began = cpu_seconds(), time.monotonic()
            result = bake_asset(
                mesh,
                name=Path(name).stem,
                settings=BakeSettings(gaussians=arguments.gaussians),
                pieces=pieces if arguments.ready_pieces else (),
                progress=note,
            )
        seconds, passed = cpu_seconds() - start, time.monotonic() - began
        truth = result.asset.mesh if result.surface is None else result.surface
        gap = 1e3 * standoff(DistanceSurface(truth), result.asset.pieces)
        print(
            f"{name}: {len(result.asset.splats)} Gaussians, {seconds:.1f} CPU s, {passed:.1f} s, "
            f"{result.psnr:.2f} dB (object "
            f"{result.psnr_object:.2f} dB), {len(result.asset.pieces)} pieces within {gap:.2f} mm, "
            f"mitsplat {mitsplat.__version__}"
        )
        for value, unit, key in (
            (len(truth.faces), "", "faces"),
            (len(result.asset.splats), "", "gaussians"),
            (seconds, "s", "cpu"),
            (passed, "s", "passed"),
            (result.psnr, "dB", "psnr"),
            (result.psnr_object, "dB", "psnr object"),
            (len(result.asset.pieces), "", "pieces"),
            (gap, "mm", "pieces outside"),
        ):
            figure(value, unit, Path(name).stem, key)
        times = list(stages.values())
        for stage, begin, end in zip(stages, times, times[1:], strict=False):
            cpu, wall = (last - first for first, last in zip(begin, end, strict=True))
            figure(cpu, "s", Path(name).stem, "stages", stage)
            figure(wall, "s", Path(name).stem, "passed", stage)
            print(f"    {stage}: {cpu:.1f} CPU s, {wall:.1f} s")


if __name__ == "__main__":
    main()
