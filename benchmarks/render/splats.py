"""Growth of the splat renderer's time, its march relative to the machine's peak, and Mitsuba's splat renderer.

    python -m benchmarks.render.splats [--volprim] [--captures FOLDER] [--names plant boot_100k ...]

Times are CPU seconds of all threads, which other load hardly affects. They are the faster of two runs, for single
captures the median of five, and one run for calls that take seconds. The peak is that of fused multiply-adds in a loop
without memory access, compiled by the same compiler.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

# isort: off
from benchmarks.render.captures import CAMERA, CAPTURES, crowd, synthetic  # imports mitsplat before Dr.Jit

import drjit as dr
import mitsuba as mi
import numpy as np

# isort: on
from benchmarks.record import figure, recording
from benchmarks.render.volprim import render_volprim, volprim_scene
from mitsplat.frames.accuracy.speed_accuracy import look_around, picture_of
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import make_sensor, render_splats
from mitsplat.runtime.variant import ensure_variant

FMA_PER_EVALUATION = 20
"""Fused multiply-adds, or operations of equal cost, of one Gaussian on one ray: response, blending, ids."""


VIEWS = 3
"""Views per capture, evenly around it."""


def fastest(run: Callable[[], object], repeats: int = 2) -> float:
    """Return the CPU seconds of the fastest of ``repeats`` calls, after one to warm up."""
    return min([timed(run) for _ in range(repeats + 1)][1:])


def timed(run: Callable[[], object]) -> float:
    """Return the CPU seconds of a call."""
    start = time.process_time()
    run()
    dr.sync_thread()
    return time.process_time() - start


def stages(splats: Splats, camera: Camera, quality: Quality) -> tuple[float, float, int]:
    """Return seconds of projecting, binning and sorting, seconds of the march, and pairs of Gaussian and tile."""
    from mitsplat.renderer.projection.clouds import Placement, merge_clouds, upload_cloud
    from mitsplat.renderer.rays.sensors import view_of
    from mitsplat.renderer.splatting.march import march
    from mitsplat.renderer.splatting.tiles import bin_gaussians

    clouds = merge_clouds([upload_cloud(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)])
    view = view_of(make_sensor(camera)).sampled(quality.samples)
    placements = [Placement(0, np.eye(4), 1)]
    lists = bin_gaussians(clouds, placements, view, quality)

    def run_march() -> None:
        image = march(lists, view, quality)
        dr.eval(image.rgb, image.alpha)

    return fastest(lambda: bin_gaussians(clouds, placements, view, quality)), fastest(run_march), lists.pairs


def fma_peak() -> float:
    """Return fused multiply-adds per CPU second."""
    lanes, steps, chains = 1 << 16, 4096, 12

    def run() -> None:
        values = [mi.Float(dr.arange(mi.Float, lanes) * (k + 1)) for k in range(chains)]
        factor = dr.opaque(mi.Float, 0.999)

        def body(i: Any, values: list[Any]) -> tuple[Any, list[Any]]:
            return i + 1, [dr.fma(v, factor, factor) for v in values]

        _, values = dr.while_loop((mi.UInt32(0), values), lambda i, values: i < steps, body)
        dr.eval(values)

    return lanes * steps * chains / fastest(run)


def print_growth() -> None:
    """Print a line per number of Gaussians, per image size and per overlap."""
    print(f"{'':44s}{'bin':>8s}{'march':>8s}{'pairs':>8s}")

    def show(label: str, splats: Splats, camera: Camera, quality: Quality) -> None:
        binning, marching, pairs = stages(splats, camera, quality)
        for part, value, unit in (("bin", binning, "s"), ("march", marching, "s"), ("pairs", pairs / 1e6, "M")):
            figure(value, unit, label, part)
        print(f"{label:44s}{binning:8.3f}{marching:8.3f}{pairs / 1e6:7.1f}M")

    fast, balanced = PRESETS["fast"], PRESETS["balanced"]
    for count in (10_000, 100_000, 1_000_000, 5_000_000):
        splats = synthetic(count)
        show(f"fast, {count} Gaussians, 1280x720", splats, CAMERA, fast)
        if count <= 1_000_000:
            show(f"balanced, {count} Gaussians, 1280x720", splats, CAMERA, balanced)
    splats = synthetic(200_000)
    for width, height in ((320, 180), (640, 360), (1280, 720), (2560, 1440)):
        show(f"fast, 200000 Gaussians, {width}x{height}", splats, CAMERA.resized(width, height), fast)
    for factor in (0.5, 1.0, 2.0):
        wider = replace(splats, scales=splats.scales * factor)
        show(f"fast, 200000 Gaussians, {factor:g} times as wide", wider, CAMERA, fast)


def print_peak() -> None:
    """Print evaluations per second of a march without early ray termination, relative to the FMA peak."""
    from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH

    splats = synthetic(200_000)
    endless = replace(PRESETS["fast"], transmittance_min=0.0)
    _, seconds, pairs = stages(
        replace(splats, opacities=splats.opacities * 0.02), CAMERA, replace(endless, alpha_min=1e-5)
    )
    rate, peak = pairs * TILE_WIDTH * TILE_HEIGHT / seconds, fma_peak()
    figure(rate / 1e9, "G/s", "evaluations")
    figure(peak / 1e9, "G/s", "multiply adds")
    figure(rate * FMA_PER_EVALUATION / peak, "", "share of peak")
    print(
        f"march: {rate / 1e9:.2f} G evaluations per CPU second; at {FMA_PER_EVALUATION} multiply-adds each "
        f"{rate * FMA_PER_EVALUATION / peak:.0%} of the peak of {peak / 1e9:.0f} G"
    )


def print_volprim(captures: Path) -> None:
    """Time whole images of the captures, compared with Mitsuba's ellipsoids + volprim_rf_basic."""
    splats, name = crowd(captures)
    scene = volprim_scene(splats, CAMERA)
    theirs = fastest(lambda: render_volprim(scene), repeats=1)
    figure(len(splats), "", "gaussians")
    figure(theirs, "s", "volprim")
    print(f"{name}, {CAMERA.width}x{CAMERA.height}: ellipsoids + volprim_rf_basic {theirs:.1f} s")
    for preset in PRESETS:
        ours = fastest(lambda preset=preset: render_splats(splats, CAMERA, quality=preset))  # type: ignore[misc]
        figure(ours, "s", preset)
        figure(theirs / ours, "", preset, "ratio")
        print(f"  render_splats {preset:10s}{ours:7.2f} s, ratio {theirs / ours:.0f}")


def print_captures(captures: Path, names: list[str]) -> None:
    """Print the speed of every view of every capture relative to Mitsuba's renderer, and errors against ``exact``."""
    for file in sorted(captures.glob("*.splat")):
        if names and file.stem not in names:
            continue
        splats = Splats.load(file)
        found: dict[str, list[tuple[float, float, float]]] = {preset: [] for preset in PRESETS}
        for i in range(VIEWS):
            camera = look_around(splats, i, VIEWS, width=CAMERA.width, height=CAMERA.height)
            theirs = timed(partial(render_volprim, volprim_scene(splats, camera)))
            exact = picture_of(render_splats(splats, camera, quality="exact"))
            for preset, rows in found.items():
                show = partial(render_splats, splats, camera, quality=preset)
                difference = (picture_of(show()) - exact).astype(np.float64)
                ours = statistics.median(timed(show) for _ in range(1 if preset == "exact" else 5))
                psnr = -10 * np.log10(max(float(np.mean(difference**2)), 1e-30))
                rows.append((theirs / ours, psnr, float(np.abs(difference).max())))
        print(f"{file.stem}, {len(splats)} Gaussians, {VIEWS} views of {CAMERA.width}x{CAMERA.height}", flush=True)
        for preset, rows in found.items():
            ratio, psnr, largest = zip(*rows, strict=True)
            figure([min(ratio), max(ratio)], "", file.stem, preset, "ratio")
            line = f"  {preset:10s}{min(ratio):5.0f} to {max(ratio):3.0f} times as fast"
            if preset != "exact":
                figure([min(psnr), max(psnr)], "dB", file.stem, preset, "psnr")
                figure(max(largest), "", file.stem, preset, "largest")
                line += f", {min(psnr):.1f} to {max(psnr):.1f} dB, largest error {max(largest):.3f}"
            print(line, flush=True)


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--volprim", action="store_true", help="only the comparison with Mitsuba's splat renderer")
    parser.add_argument("--captures", type=Path, default=CAPTURES)
    parser.add_argument("--names", nargs="*", default=[], help="names of single captures; all by default")
    options = parser.parse_args()
    ensure_variant()
    print(f"load before the run: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; CPU seconds")
    with recording("render.splats", parser, options, ignore=("captures",)):
        if options.volprim:
            print_volprim(options.captures)
            print_captures(options.captures, options.names)
            return
        print_growth()
        print_peak()


if __name__ == "__main__":
    main()
