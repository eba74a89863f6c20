"""Reproducibility of structure from motion: ``python -m benchmarks.assets.sfm PHOTOS --runs 30``.

Every run starts without the previous database. Results are valid with and without load on the machine. Each run prints
the SHA-256 of COLMAP's result and its CPU time. The exit status is 1 if two results differ.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.record import figure, recording
from mitsplat.capture.photos import find_photos, prepare_photos
from mitsplat.capture.structure_from_motion import find_cameras

PHOTOS = Path(__file__).resolve().parents[3] / "shared" / "data" / "photos" / "buddha"


def main() -> None:
    """Run, print and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="?", default=PHOTOS)
    parser.add_argument("--count", type=int, default=20, help="number of first photos")
    parser.add_argument("--runs", type=int, default=30)
    options = parser.parse_args()
    with recording("assets.sfm", parser, options):
        found = results(options)
    sys.exit(found > 1)


def results(options: argparse.Namespace) -> int:
    """Return the number of different results."""
    found = set()
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "given").mkdir()
        for path in find_photos(options.photos)[: options.count]:
            (folder / "given" / path.name).symlink_to(path.resolve())
        photos, _ = prepare_photos(folder / "given", folder / "images", max_size=1600)
        for run in range(options.runs):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            model = find_cameras(photos, folder / f"run{run}")
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            with np.load(folder / f"run{run}" / "model.npz", allow_pickle=False) as arrays:
                digest = hashlib.sha256(b"".join(arrays[name].tobytes() for name in sorted(arrays))).hexdigest()
            found.add(digest)
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            print(
                f"run {run}: {len(model.cameras)} of {len(photos)} cameras, {len(model.points)} points, "
                f"{seconds:.1f} CPU s, {digest[:16]}",
                flush=True,
            )
    figure(options.count, "", "photos")
    figure(options.runs, "", "runs")
    figure(len(found), "", "results")
    print(f"{len(found)} different results of {options.runs} runs")
    return len(found)


if __name__ == "__main__":
    main()
