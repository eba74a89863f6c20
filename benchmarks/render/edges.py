"""Cost and remaining error of antialiased silhouettes: frames of a scene at several `rendering.samples`.

    python -m benchmarks.render.edges [--scene scenes/workcell.yaml] [--size 640x360] [--frames 2] [--repeats 3]

The error is that of display-encoded colours at the pixels that `samples: edges` changes, against images four times as
wide and high, averaged in linear light. The cost is CPU seconds of all threads; the settings alternate frame by frame.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.arrays import Float32Array
from mitsplat.images.colour import encode_srgb
from mitsplat.scene.planning.frame_plan import layout_index_of

ROOT = Path(__file__).resolve().parents[2]
TRUTH = 4
"""Size of the reference images relative to the compared ones, in width and height."""
SETTINGS = (1, "edges", 2, 4)


def renderer(path: Path, width: int, height: int, samples: Any) -> ms.Renderer:
    """Return a renderer of the scene without sensor noise."""
    size = {"output.width": width, "output.height": height, "rendering.samples": samples, "randomise.iso": None}
    return ms.Renderer(ms.load_scene(path, overrides=size))


def shown(frame: ms.Frame, fold: int = 1) -> Float32Array:
    """Return display-encoded colours of a frame, averaged over ``fold`` x ``fold`` pixels in linear light."""
    height, width = frame.rgb.shape[:2]
    linear = frame.rgb.reshape(height // fold, fold, width // fold, fold, 3).mean(axis=(1, 3))
    return np.asarray(encode_srgb(np.clip(linear, 0, 1)), dtype=np.float32)


def main() -> None:
    """Parse the command line, measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    print(f"load before the run: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    with recording("render.edges", parser, options):
        renderers = {samples: renderer(options.scene, width, height, samples) for samples in SETTINGS}
        scene = renderers[1].scene
        layout = ms.settle_layout(scene, layout_index_of(scene, 0))
        seconds: dict[Any, list[float]] = {samples: [] for samples in SETTINGS}
        errors: dict[Any, list[Float32Array]] = {samples: [] for samples in SETTINGS}
        with renderer(options.scene, TRUTH * width, TRUTH * height, 1) as large:
            truths = [shown(large.render(index, layout=layout), TRUTH) for index in range(options.frames)]
        for turn in range(options.repeats + 1):
            for index, truth in enumerate(truths):
                pictures = {}
                for samples, own in renderers.items():
                    start = time.process_time()
                    frame = own.render(index, layout=layout)
                    seconds[samples] += [time.process_time() - start] if turn else []
                    pictures[samples] = shown(frame)
                if turn == 0:
                    borders = (pictures["edges"] != pictures[1]).any(axis=-1)
                    for samples, picture in pictures.items():
                        errors[samples].append(np.abs(picture - truth)[borders].max(axis=-1))
        plain = statistics.median(seconds[1])
        for samples in SETTINGS:
            error, cost = np.concatenate(errors[samples]), statistics.median(seconds[samples]) / plain
            rmse, high = float(np.sqrt(np.mean(error**2))), float(np.percentile(error, 90))
            for value, name in ((cost, "cost"), (rmse, "rmse"), (float(np.median(error)), "median"), (high, "90 %")):
                figure(value, "", f"samples {samples}", name)
            told = f"RMSE {rmse:.4f}, median {np.median(error):.4f}, 90 % {high:.4f}"
            print(f"samples: {samples!s:5} cost {cost:.3f}, {told}")


if __name__ == "__main__":
    main()
