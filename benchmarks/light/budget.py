"""Time against error on objects: splats with and without materials at several ray budgets, and path-traced meshes.

    python -m benchmarks.light.budget [--out FOLDER] [--lights lamp interior] [--picture chart.png]

The setup ``parts`` of ``benchmarks.light.shadows`` is rendered by ``splat_proxy`` with several target errors of light,
by the same Gaussians as captured assets (base colour times light ratio), and by Mitsuba's ``path`` with several numbers
of paths per pixel. The error is that of display-encoded pixels that objects cover completely, in dB. CPU seconds of all
threads are the least of two images; kernels are compiled before.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mitsplat.arrays import Float64Array

# isort: off
from benchmarks.light.shadows import LIGHTS, ROOT, SETUPS, Setup, SplatScene, lights_of, placed, psnr, take_truth

import drjit as dr
import numpy as np

# isort: on
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_parts import bake_lights, mitsuba_scene, read_parts
from mitsplat.renderer.path_tracing import render_mesh
from mitsplat.runtime.variant import ensure_variant

ERRORS = (0.1, 0.06, 0.03, 0.015)
"""Target errors of light of the splats; 0.03 is the default."""
PATHS = (1, 4, 16, 64)
"""Paths per pixel of the meshes."""


def timed(render: Callable[[], Float64Array]) -> tuple[Float64Array, float]:
    """Return an image and its CPU seconds."""
    render()
    seconds = []
    for _ in range(2):
        start = time.process_time()
        picture = render()
        dr.sync_thread()
        seconds.append(time.process_time() - start)
    return picture, min(seconds)


def captured(setup: Setup) -> Setup:
    """Return the setup with assets without materials, whose base colour is their captured colour."""

    def without(asset: Any) -> Any:
        return replace(asset, splats=replace(asset.splats, materials=None))

    things = [replace(thing, asset=lambda out, load=thing.asset: without(load(out))) for thing in setup.things]
    return replace(setup, things=things)


def steps(setup: Setup, light: str, out: Path) -> Iterator[tuple[str, Callable[[], Float64Array]]]:
    """Yield the name of every step, and a function that renders its linear image."""
    for kind, of in (("materials", setup), ("captured", captured(setup))):
        scene = SplatScene.of(of, "parts", light, out)
        for error in ERRORS:
            # Bound now, because the loop changes both.
            yield (
                f"{kind}, shadow_error {error}",
                lambda scene=scene, error=error: scene.render(white=scene.white, shadow_error=error).rgb.astype(float),
            )
    parts = [*read_parts(setup.room), *(part for thing in setup.things for part in placed(thing))]
    meshes = mitsuba_scene(parts, bake_lights(lights_of(light, out)))
    for paths in PATHS:
        yield f"meshes, {paths} paths", lambda paths=paths: render_mesh(meshes, setup.camera, samples=paths)[0]


def measure(light: str, options: argparse.Namespace) -> dict[str, tuple[float, float]]:
    """Print and return CPU seconds and PSNR on objects of all steps under one light."""
    setup, rows = SETUPS["parts"](), {}
    truth = take_truth(setup, "parts", light, options.out, options.samples)
    for name, render in steps(setup, light, options.out):
        picture, seconds = timed(render)
        rows[name] = seconds, psnr(picture, truth.photo, truth.objects)
        print(f"{light:10s}{name:32s}{seconds:8.2f} CPU s{rows[name][1]:8.1f} dB", flush=True)
        figure(seconds, "s", light, name, "cpu")
        figure(rows[name][1], "dB", light, name, "psnr")
    return rows


def draw(rows: dict[str, dict[str, tuple[float, float]]], file: Path) -> None:
    """Plot PSNR on objects over CPU seconds, a panel for each light."""
    from matplotlib.figure import Figure

    chart = Figure(figsize=(5 * len(rows), 4.5), layout="constrained")
    panels = np.atleast_1d(chart.subplots(1, len(rows), sharey=True))
    for axes, (light, found) in zip(panels, rows.items(), strict=True):
        for kind in ("materials", "captured", "meshes"):
            points = [(name.split(", ")[1], *row) for name, row in found.items() if name.startswith(kind)]
            axes.plot([p[1] for p in points], [p[2] for p in points], "o-", label=kind)
            for label, seconds, error in points:
                axes.annotate(label.removeprefix("shadow_error "), (seconds, error), fontsize=7)
        axes.set(xscale="log", xlabel="CPU seconds per image", title=light)
    panels[0].set_ylabel("PSNR on objects [dB]")
    panels[0].legend()
    chart.savefig(file, dpi=110)


def main() -> None:
    """Parse the command line, print the tables, and draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "shadows")
    parser.add_argument("--lights", nargs="*", choices=LIGHTS, default=["lamp", "interior"])
    parser.add_argument("--samples", type=int, default=768, help="paths per pixel of the reference")
    parser.add_argument("--picture", type=Path, help="file of the chart")
    options = parser.parse_args()
    ensure_variant()
    with recording("light.budget", parser, options, ignore=("out", "picture")):
        rows = {light: measure(light, options) for light in options.lights}
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
