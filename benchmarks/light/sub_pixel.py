"""Errors of single pixels of objects, whose bends and threads can be finer than a pixel, against larger images.

    python -m benchmarks.light.sub_pixel [--scene scenes/workcell.yaml] [--size 640x360] [--frames 4]

The references are six times as wide and high, averaged in linear light. Errors are those of display-encoded colours,
the largest of the three channels, without sensor noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import mitsplat as ms
from benchmarks.record import figure, recording
from benchmarks.render.edges import ROOT, renderer, shown
from mitsplat.scene.planning.frame_plan import layout_index_of

TRUTH = 6
"""Size of the reference images relative to the compared ones, in width and height."""
LARGE = 0.25
"""Error that a viewer sees as a wrong pixel."""


def main() -> None:
    """Parse the command line, measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--frames", type=int, default=4)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    errors = []
    with recording("light.sub_pixel", parser, options):
        with (
            renderer(options.scene, width, height, "edges") as usual,
            renderer(options.scene, TRUTH * width, TRUTH * height, 1) as large,
        ):
            for index in range(options.frames):
                layout = ms.settle_layout(usual.scene, layout_index_of(usual.scene, index))
                frame = usual.render(index, layout=layout)
                truth = shown(large.render(index, layout=layout), TRUTH)
                error = np.abs(shown(frame) - truth)[frame.instance > 0].max(axis=-1)
                print(f"image {index}: {len(error)} pixels of objects, {np.count_nonzero(error > LARGE)} wrong")
                errors.append(error)
        error = np.concatenate(errors)
        wrong, rms = np.count_nonzero(error > LARGE), float(np.sqrt(np.mean(error**2)))
        figure(len(error), "", "pixels")
        figure(wrong, "", "wrong pixels")
        figure(wrong / len(error), "", "wrong share")
        figure(rms, "", "rms")
        print(f"{wrong} of {len(error)} pixels are wrong by more than {LARGE}, RMS {rms:.4f}")


if __name__ == "__main__":
    main()
