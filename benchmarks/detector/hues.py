"""Hue rotation of each class on photographs, compared with rendered images with and without hue errors of the camera.

    python -m benchmarks.detector.hues WORK

WORK is the output of ``benchmarks.detector.material``, with the datasets of the arms ``synthetic`` and ``no_hue`` in
``data/``. The second dataset shows the first layouts and views of the first one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.detector.experiment import read_arms
from benchmarks.record import figure, recording
from mitsplat.detector.likeness import compare_with_photographs


def main() -> None:
    """Compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    options = parser.parse_args()
    with recording("detector.hues", parser, options, ignore=("work",)):
        scenes = read_arms()["arms"]["synthetic"]["scenes"]
        for camera, change in (("as scanned", "+no_hue"), ("as drawn", "")):
            datasets = [options.work / "data" / f"{scene}{change}" for scene in scenes]
            found = compare_with_photographs(datasets, options.work / "photos")
            turns = list(found.hues.values())
            figure(found.images, "", camera, "images")
            figure(float(np.median(turns)), "degrees", camera, "median")
            figure(float(np.median(np.abs(turns))), "degrees", camera, "median size")
            figure([min(turns), max(turns)], "degrees", camera, "range")
            print(f"{camera}: {np.median(turns):.0f} degrees, {min(turns):.0f} to {max(turns):.0f}")
            for name, turn in found.hues.items():
                figure(turn, "degrees", camera, name)
                print(f"  {name:24s}{turn:6.0f}")


if __name__ == "__main__":
    main()
