"""Number of convex pieces of meshes, their standoff, and the cost of the decomposition.

    python -m benchmarks.assets.pieces FOLDER [--proxy-faces 10000]

FOLDER holds mesh files in metres. Pieces are those of the proxy mesh of `mitsplat bake`, computed without the cache.
Times are CPU seconds of this process, without a first decomposition, which compiles kernels.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.assets.bake import cpu_seconds
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_parts import read_model
from mitsplat.bake.proxy_mesh import make_proxy
from mitsplat.geometry.decomposition import convex_pieces, denoise_solid, max_gap
from mitsplat.geometry.mesh_distance import DistanceSurface, standoff
from mitsplat.runtime.variant import ensure_variant


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--proxy-faces", type=int, default=10000)
    arguments = parser.parse_args()
    ensure_variant()
    names = sorted(path for path in arguments.folder.iterdir() if path.suffix in (".glb", ".obj", ".ply", ".stl"))
    with recording("assets.pieces", parser, arguments), tempfile.TemporaryDirectory() as cache:
        rows = []
        for path in (names[0], *names):
            os.environ["XDG_CACHE_HOME"] = f"{cache}/{len(rows)}"
            mesh = make_proxy(read_model(path, metres_per_unit=1.0, up="z", finish=None).parts, arguments.proxy_faces)
            mesh.vertices += 1e-9 * (not rows)  # a mesh other than the measured ones
            start = cpu_seconds()
            pieces = convex_pieces(mesh)
            seconds = cpu_seconds() - start
            thin = denoise_solid(mesh)
            points = np.concatenate([thin.vertices, thin.sample(4000, seed=0)])
            back = np.concatenate([mesh.vertices, mesh.sample(4000, seed=0)])
            surface = DistanceSurface(mesh)
            error = max(surface.nearest(points)[2].max(), DistanceSurface(thin).nearest(back)[2].max()) / mesh.scale
            limit = max_gap(float(mesh.extents.max()))
            rows.append((len(thin.faces), 100 * error, len(pieces), seconds, 1e3 * standoff(surface, pieces), limit))
            print(f"{path.stem}: {len(mesh.faces)} faces, thinned to %d within %.2f %% of the diagonal, %d pieces in "
                  "%.1f CPU s that stand off by %.2f mm" % rows[-1][:-1], flush=True)  # fmt: skip
        faces, errors, counts, seconds_each, gaps, limits = map(np.array, zip(*rows[1:], strict=True))
        figure(len(names), "", "meshes")
        figure(int(faces.max()), "", "faces")
        figure(float(errors.max()), "%", "error")
        figure(int(counts.max()), "", "pieces")
        figure(float(np.median(counts)), "", "pieces", "median")
        figure(float(seconds_each.max()), "s", "cpu")
        figure(float(np.median(seconds_each)), "s", "cpu", "median")
        figure(float(gaps.max()), "mm", "standoff")
        figure(float(np.median(gaps)), "mm", "standoff", "median")
        figure(int((gaps <= 1e3 * limits).sum()), "", "within")


if __name__ == "__main__":
    main()
