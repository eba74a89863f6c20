"""Seconds per stage of a frame of the default scene, peak memory, and the renderer against Mitsuba's own splat path.

    python -m benchmarks.frame [--scene scenes/workcell.yaml] [--frames 8] [--no-volprim]

Timings are medians of frames after the first (which compiles); quote the ratios, and the load, which is printed too.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from pathlib import Path

import mitsplat as ms  # before Mitsuba

# isort: split
import mitsuba as mi

from benchmarks.captures import CAMERA, crowd
from benchmarks.volprim import render_volprim, volprim_scene
from mitsplat.frame import _Studio
from mitsplat.render import render_layers
from mitsplat.scene import layout_of, plan_frame

ROOT = Path(__file__).resolve().parents[1]


def time_frames(path: Path, frames: int) -> None:
    """Print medians per stage over frames of one layout."""
    scene = ms.load_scene(path)
    start = time.perf_counter()
    layout = ms.settle_layout(scene, layout_of(scene, 0))
    print(f"settle one layout ({len(layout.instances)} objects): {time.perf_counter() - start:.2f} s")
    rows = []
    for index in range(frames + 1):
        start = time.perf_counter()
        frame = ms.render_frame(scene, index % scene.spec.output.views, layout=layout)
        rows.append({**frame.seconds, "whole frame": time.perf_counter() - start})
    print(f"first frame (compiles or loads kernels): {rows[0]['whole frame']:.2f} s")
    size = scene.spec.output
    print(f"median of {frames} frames, {size.width}x{size.height}, seconds:")
    for stage in rows[1]:
        print(f"  {stage:12s} {statistics.median(row[stage] for row in rows[1:]):.3f}")


def time_light(path: Path, repeats: int = 8) -> None:
    """Print what shadows and highlights add to the time of a frame's layers, in frames that take turns."""
    scene = ms.load_scene(path)
    layout = ms.settle_layout(scene, layout_of(scene, 0))
    studio = _Studio.of(scene, scene.spec.quality)
    seconds: dict[str, list[float]] = {"none": [], "traced": []}
    for index in range(repeats + 1):
        plan = plan_frame(scene, index % scene.spec.output.views)
        for shadow, times in seconds.items():
            studio.integrator.shadow = shadow
            placed = mi.load_dict(studio.describe(layout, plan.lights))
            start = time.perf_counter()
            render_layers(studio.integrator, placed, plan.camera, seed=plan.seed)
            times.append(time.perf_counter() - start)
    plain, lit = (statistics.median(times[1:]) for times in seconds.values())
    print(f"layers without light {plain:.3f} s, with {lit:.3f} s: light takes {lit / plain - 1:.2f} of the rest")


def compare_with_volprim(repeats: int = 5) -> None:
    """Print the time of `render_splats` against ellipsoids + volprim_rf_basic on the same splats."""
    splats, name = crowd()
    ours = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        ms.render_splats(splats, CAMERA)
        ours.append(time.perf_counter() - start)
    scene = volprim_scene(splats, CAMERA)
    render_volprim(scene)
    start = time.perf_counter()
    render_volprim(scene)
    theirs = time.perf_counter() - start
    mine = statistics.median(ours[1:])
    print(f"{name}, {CAMERA.width}x{CAMERA.height}:")
    print(
        f"  render_splats, upload included {mine:.3f} s, "
        f"ellipsoids + volprim_rf_basic {theirs:.2f} s, ratio {theirs / mine:.0f}"
    )


def main() -> None:
    """Parse the command line and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--no-volprim", action="store_true")
    options = parser.parse_args()
    print(f"load before the run: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    time_frames(options.scene, options.frames)
    time_light(options.scene)
    print(f"peak memory of the frames: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    if not options.no_volprim:
        compare_with_volprim()


if __name__ == "__main__":
    main()
