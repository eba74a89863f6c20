"""Cost of an image of the experiment's scenes, as rendered for its arms.

    python -m benchmarks.detector.cost WORK [--scene stood] [--layout 1] [--views 4] [--hope ../shared/data/hope]

WORK is the output of ``benchmarks.detector.material``. Views of one layout are rendered one after the other on the CPU.
Times are CPU seconds of all threads from a placed layout to a labelled image: medians without the first view, which
compiles kernels. ``meshes`` is the time of the images of ``benchmarks.detector.meshes``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import mitsplat as ms
from benchmarks.detector.experiment import VIEWS, read_arms, write_scene
from benchmarks.detector.meshes import frames, textured
from benchmarks.record import figure, recording

ARMS = ("traced_shadow", "balanced", "exact", "aliased", "no_camera", "image_shadow", "no_shadow", "meshes")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--scene", default="stood")
    parser.add_argument("--layout", type=int, default=1)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--hope", type=Path, default=Path("../shared/data/hope"))
    options = parser.parse_args()
    with recording("detector.cost", parser, options, ignore=("work", "hope")):
        for arm in ARMS:
            change = read_arms()["arms"][arm].get("change")
            scene = ms.load_scene(write_scene(options.work, "+".join(filter(None, [options.scene, change]))))
            views = range(options.layout * VIEWS, options.layout * VIEWS + options.views)
            seconds = list(traced(scene, views, options) if arm == "meshes" else rendered(scene, views))
            print(f"{arm:14s} {np.median(seconds[1:]):6.2f} s", flush=True)
            figure(float(np.median(seconds[1:])), "s CPU", arm)


def rendered(scene: ms.Scene, views: range) -> Iterator[float]:
    """Return the seconds of each view with the splat renderer."""
    layout = ms.settle_layout(scene, views[0] // VIEWS)
    with ms.Renderer(scene) as renderer:
        for view in views:
            start = time.process_time()
            renderer.render(view, layout=layout)
            yield time.process_time() - start


def traced(scene: ms.Scene, views: range, options: argparse.Namespace) -> Iterator[float]:
    """Return the seconds of each path-traced image, without labels."""
    for frame in frames(scene, textured(options.hope), views, samples=64):
        yield frame.seconds["path"]


if __name__ == "__main__":
    main()
