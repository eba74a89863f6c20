"""Instance image: pixels that differ from the float64 twin, and the cost of separate instances.

    python -m benchmarks.render.instances [--scenes 50] [--scene scenes/workcell.yaml]

Seconds are CPU seconds of all threads, the minimum of several; quote the ratios.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

# isort: off
import mitsplat as ms  # before Dr.Jit

import drjit as dr
import mitsuba as mi
import numpy as np

# isort: on
from benchmarks.record import figure, recording
from mitsplat.frames.frame import Renderer
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.quality import PRESETS
from mitsplat.renderer.layers import make_integrator, make_sensor, make_splats_shape
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.frame_plan import layout_index_of, plan_frame

ROOT = Path(__file__).resolve().parents[2]


def print_differences(scenes: int) -> None:
    """Compare random scenes of 3 to 8 porous instances in one place with the twin."""
    sys.path.insert(0, str(ROOT / "tests"))
    from reference import reference_shares

    from tests.renderer.test_instances import CAMERA, EXACT, differences, layered, porous, shown

    totals = np.zeros(3, dtype=int)
    for seed in range(scenes):
        for make in (porous, layered):
            splats, ids = make(3 + seed % 6, 1000 + seed)
            shares = reference_shares(splats, ids, CAMERA)
            totals += (shares[..., 0].size, *differences(shown(splats, ids, EXACT), shares))
    for what, count in zip(("pixels", "lesser", "undecided"), totals, strict=True):
        figure(count, "", "twin", what)
    print(f"{2 * scenes} scenes, {totals[0]} pixels: {totals[1]} with a lesser instance; {totals[2]} undecided ones")


def crowd(count: int = 8, each: int = 4000) -> dict[str, Any]:
    """Return instances of half-transparent Gaussians in the same ball: nearly every ray meets all of them."""
    rng, shapes = np.random.default_rng(0), {}
    for number in range(1, count + 1):
        quats = rng.normal(size=(each, 4))
        splats = Splats(
            means=rng.normal(0, 0.3, (each, 3)),
            quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            scales=np.exp(rng.uniform(np.log(0.004), np.log(0.03), (each, 3))),
            opacities=rng.uniform(0.05, 0.6, each),
            sh=np.zeros((each, 1, 3)),
        )
        shapes[f"instance_{number}"] = make_splats_shape(splats, instance=number)
    return shapes


def print_costs(name: str, integrator: Any, scene: Any, camera: ms.Camera, repeats: int = 7) -> None:
    """Print the time of the march with all instances, with the first walk alone, and with a single instance."""
    from mitsplat.renderer.rays.sensors import view_of
    from mitsplat.renderer.splatting import march
    from mitsplat.renderer.splatting.instance_votes import resolve_instances
    from mitsplat.renderer.splatting.tiles import bin_gaussians

    contents = integrator.renderer._contents.read(scene, splat_shadows=False)
    view = view_of(make_sensor(camera))
    unsure: list[float] = []

    def count(instance: Any, doubt: Any, *rest: Any) -> Any:
        unsure.append(float(np.array(doubt).mean()))
        return instance

    for preset in ("fast", "balanced"):
        quality = PRESETS[preset]
        lists = bin_gaussians(contents.clouds, contents.placements, view, quality)
        cases = {
            "all": (lists, resolve_instances),
            "first walk": (lists, count),
            "one": (replace(lists, instance=1), resolve_instances),
        }
        times: dict[str, list[float]] = {case: [] for case in cases}
        for _ in range(repeats + 1):
            for case, (own, second) in cases.items():
                march.resolve_instances = second  # type: ignore[attr-defined]
                start = time.process_time()
                dr.eval(march.march(own, view, quality))
                dr.sync_thread()
                times[case].append(time.process_time() - start)
        march.resolve_instances = resolve_instances  # type: ignore[attr-defined]
        least = {case: min(seconds[1:]) for case, seconds in times.items()}
        share = unsure[-1] if unsure else 0.0
        told = ", ".join(f"{case} {least[case] / least['one']:.2f}" for case in ("first walk", "all"))
        figure(least["one"], "s", name, preset, "one")
        figure(share, "", name, preset, "again")
        for case in ("first walk", "all"):
            figure(least[case] / least["one"], "", name, preset, case)
        print(
            f"{name}, {preset}: march of one instance {least['one']:.3f} s; relative: {told}; second walk: {share:.1%}"
        )
        unsure.clear()


def main() -> None:
    """Parse the command line and print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    options = parser.parse_args()
    ensure_variant()
    print(f"load before the run: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; CPU seconds")
    with recording("render.instances", parser, options):
        measure(options.scene, options.scenes)


def measure(path: Path, scenes: int) -> None:
    """Print and record both."""
    scene = ms.load_scene(path)
    layout, plan = ms.settle_layout(scene, layout_index_of(scene, 0)), plan_frame(scene, 3)
    renderer = Renderer(scene, quality=PRESETS["fast"])
    placed = mi.load_dict(renderer.scene_builder.describe(layout, plan.lights))
    print_costs(path.name, renderer.integrator, placed, plan.camera)
    camera = ms.Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=1280, height=720, fov_x=50)
    crowded = mi.load_dict({"type": "scene", **crowd()})
    print_costs("eight in one place", make_integrator(shadow="none"), crowded, camera)
    print_differences(scenes)


if __name__ == "__main__":
    main()
