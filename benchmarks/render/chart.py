"""Speed against accuracy, as measured by ``mitsplat chart``, recorded for the documentation.

    python -m benchmarks.render.chart FILE [--frames 2] [--size 1280x720] [--order-tolerance 0.03 ...]
        [--picture chart.png]

FILE is a scene, or a file of splats.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.record import figure, recording
from mitsplat.frames.accuracy.accuracy_chart import draw_chart
from mitsplat.frames.accuracy.speed_accuracy import measure_steps

UNITS = {"seconds": "s", "psnr": "dB", "objects": "dB", "memory": "GiB"}


def main() -> None:
    """Print a line for every step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--size", help="size of the images, such as 640x480; default: the scene's")
    parser.add_argument(
        "--order-tolerance", nargs="*", type=float, default=[], help="additional tolerances of the blending order"
    )
    parser.add_argument("--picture", type=Path, help="file of the chart")
    options = parser.parse_args()
    overrides: dict[str, Any] = {}
    if options.size:
        overrides = dict(zip(("output.width", "output.height"), map(int, options.size.split("x")), strict=True))
    with recording("render.chart", parser, options, ignore=("order_tolerance", "picture")):
        rows = measure_steps(
            options.file, tolerances=options.order_tolerance, frames=options.frames, overrides=overrides
        )
        for row in rows:
            values = {key: value for key, value in asdict(row).items() if key != "name"}
            print(f"{row.name:30s}" + "".join(f"{key} {value:.4g}  " for key, value in values.items()), flush=True)
            for key, value in values.items():
                figure(value, UNITS.get(key, ""), row.name, key)
    if options.picture:
        title = f"{options.file.name}: {options.frames} images"
        draw_chart(rows, options.picture, title=title, tolerance=0.004)


if __name__ == "__main__":
    main()
