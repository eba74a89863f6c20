"""Seconds per stage of a frame of the default scene, peak memory, and time relative to Mitsuba's splat renderer.

    python -m benchmarks.render.frame [--scene scenes/workcell.yaml] [--frames 8] [--ten] [--no-volprim]

Timings are medians of frames after the first, which compiles kernels. Quote the ratios, and the load, which is printed
too.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

import mitsplat as ms
from benchmarks.record import figure, recording
from benchmarks.render.captures import CAMERA, crowd
from benchmarks.render.volprim import render_volprim, volprim_scene
from mitsplat.scene.planning.frame_plan import layout_index_of

ROOT = Path(__file__).resolve().parents[2]


def ten_objects(path: Path) -> dict[str, Any]:
    """Return changes for a scene of ten objects of its first entry, under its first light and its environment."""
    scene = YAML(typ="safe").load(path)
    objects = [{**scene["objects"][0], "count": 10}]
    lights = [scene["lights"][0], *(light for light in scene["lights"][1:] if light["kind"] == "environment")]
    return {"objects": objects, "lights": lights}


def time_frames(path: Path, frames: int, overrides: dict[str, Any]) -> None:
    """Print medians per stage over frames of one layout."""
    scene = ms.load_scene(path, overrides=overrides)
    start = time.perf_counter()
    layout = ms.settle_layout(scene, layout_index_of(scene, 0))
    seconds = time.perf_counter() - start
    figure(seconds, "s", "settle first")
    figure(len(layout.instances), "", "objects")
    print(f"settle one layout ({len(layout.instances)} objects): {seconds:.2f} s")
    rows = []
    for index in range(frames + 1):
        start = time.perf_counter()
        frame = ms.render_frame(scene, index % scene.spec.output.views, layout=layout)
        rows.append({**frame.seconds, "whole frame": time.perf_counter() - start})
    figure(rows[0]["whole frame"], "s", "first frame")
    print(f"first frame (compiles or loads kernels): {rows[0]['whole frame']:.2f} s")
    size = scene.spec.output
    print(f"median of {frames} frames, {size.width}x{size.height}, seconds:")
    for stage in rows[1]:
        median = statistics.median(row[stage] for row in rows[1:])
        figure(median, "s", stage)
        print(f"  {stage:12s} {median:.3f}")


def time_light(path: Path, overrides: dict[str, Any], repeats: int = 8) -> None:
    """Print the cost of shadows and highlights: the same frames with and without, in alternation."""
    scenes = [ms.load_scene(path, overrides={**overrides, "composite.shadow": kind}) for kind in ("none", "traced")]
    layout = ms.settle_layout(scenes[0], layout_index_of(scenes[0], 0))
    wall, processor = [], []
    for index in range(repeats + 1):
        for scene in scenes:
            start = time.perf_counter(), time.process_time()
            ms.render_frame(scene, index % scene.spec.output.views, layout=layout)
            wall.append(time.perf_counter() - start[0])
            processor.append(time.process_time() - start[1])
    for name, times in (("seconds", wall), ("processor seconds of all threads", processor)):
        clock = "light" if times is wall else "light cpu"
        plain, lit = (statistics.median(times[2 + k :: 2]) for k in (0, 1))
        figure(lit - plain, "s", clock)
        print(f"frame without light {plain:.3f}, with {lit:.3f}: light takes {lit - plain:.3f} {name}")


def compare_with_volprim(repeats: int = 5) -> None:
    """Print the time of `render_splats` against ellipsoids + volprim_rf_basic on the same splats."""
    splats, name = crowd()
    scene = volprim_scene(splats, CAMERA)
    render_volprim(scene)
    start = time.perf_counter()
    render_volprim(scene)
    theirs = time.perf_counter() - start
    figure(theirs, "s", "volprim")
    print(f"{name}, {CAMERA.width}x{CAMERA.height}: ellipsoids + volprim_rf_basic {theirs:.2f} s")
    for preset in ("fast", "balanced"):
        ours = []
        for _ in range(repeats + 1):
            start = time.perf_counter()
            ms.render_splats(splats, CAMERA, quality=preset)
            ours.append(time.perf_counter() - start)
        mine = statistics.median(ours[1:])
        figure(mine, "s", "captures", preset)
        figure(theirs / mine, "", "captures", preset, "ratio")
        print(f"  render_splats, {preset}: {mine:.3f} s, ratio {theirs / mine:.0f}")


def main() -> None:
    """Parse the command line and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--ten", action="store_true", help="ten objects, one light, and the environment")
    parser.add_argument("--no-volprim", action="store_true")
    options = parser.parse_args()
    print(f"load before the run: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    overrides = ten_objects(options.scene) if options.ten else {}
    with recording("render.frame", parser, options, ignore=("no_volprim",)):
        time_frames(options.scene, options.frames, overrides)
        time_light(options.scene, overrides)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        figure(peak, "GiB", "peak")
        print(f"peak memory of the frames: {peak:.2f} GiB")
        if not options.no_volprim:
            compare_with_volprim()


if __name__ == "__main__":
    main()
