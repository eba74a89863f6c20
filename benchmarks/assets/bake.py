"""What a bake costs, how close it comes to its mesh, and how closely its convex pieces follow it.

    python -m benchmarks.assets.bake MESH... [--gaussians 20000] [--subdivide 0]

MESH is a mesh file, whose triangles are each divided into four as often as is said, or the name of a part of the
shipped scene. Pieces are found anew, not taken from the cache. In CPU
seconds of this process, so that other programs on the machine hardly count.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
from pathlib import Path

import trimesh

import mitsplat
from benchmarks.record import figure, recording
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.mesh_distance import Surface, standoff
from scenes.build.parts import PARTS, build_part


def cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def divided(path: Path, times: int, folder: Path) -> Path:
    """A file of the same mesh and texture in smaller triangles."""
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
    arguments = parser.parse_args()
    with recording("assets.bake", parser, arguments):
        measure(arguments)


def measure(arguments: argparse.Namespace) -> None:
    for name in arguments.meshes:
        mesh = build_part(name, 0)[0] if name in PARTS else Path(name)
        stages: dict[str, float] = {}
        start = cpu_seconds()

        def note(done: int, total: int, stage: str, stages: dict[str, float] = stages) -> None:
            stages.setdefault(stage, cpu_seconds())

        with tempfile.TemporaryDirectory() as cache:
            os.environ["XDG_CACHE_HOME"] = cache
            if arguments.subdivide and isinstance(mesh, Path):
                mesh = divided(mesh, arguments.subdivide, Path(cache))
                start = cpu_seconds()
            result = bake_asset(
                mesh,
                name=Path(name).stem,
                light="studio" if name in PARTS else "uniform",
                settings=BakeSettings(gaussians=arguments.gaussians),
                progress=note,
            )
        seconds = cpu_seconds() - start
        truth = result.asset.mesh if result.surface is None else result.surface
        gap = 1e3 * standoff(Surface(truth), result.asset.pieces)
        print(
            f"{name}: {len(result.asset.splats)} Gaussians, {seconds:.1f} CPU s, {result.psnr:.2f} dB (object "
            f"{result.psnr_object:.2f} dB), {len(result.asset.pieces)} pieces within {gap:.2f} mm, "
            f"mitsplat {mitsplat.__version__}"
        )
        for value, unit, key in (
            (len(truth.faces), "", "faces"),
            (len(result.asset.splats), "", "gaussians"),
            (seconds, "s", "cpu"),
            (result.psnr, "dB", "psnr"),
            (result.psnr_object, "dB", "psnr object"),
            (len(result.asset.pieces), "", "pieces"),
            (gap, "mm", "pieces outside"),
        ):
            figure(value, unit, Path(name).stem, key)
        times = list(stages.values())
        for stage, begin, end in zip(stages, times, times[1:], strict=False):
            figure(end - begin, "s", Path(name).stem, "stages", stage)
            print(f"    {stage}: {end - begin:.1f} s")


if __name__ == "__main__":
    main()
