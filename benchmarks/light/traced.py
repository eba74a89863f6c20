"""Time against error of traced light: rays where they are needed and a filter, beside as many rays everywhere.

    python -m benchmarks.light.traced [--scene scenes/workcell.yaml] [--frames 4] [--truth 2048]

The truth is the ratio of ``--truth`` rays per pixel without a filter. Errors are the standard deviation of the light
factor (mean of RGB) from it, where it matters: at objects that are lit anew, and where a shadow takes 1 % or more of
the light. The PSNR [dB] is that of pictures as each frame's camera develops them, noise and all, to those of the truth:
what highlights miss counts as well. Processor seconds of all threads are medians over frames, less those of the same
frames without light.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.arrays import Float32Array
from mitsplat.frames.camera_response import develop, light_image
from mitsplat.frames.frame import Renderer, light_properties, plan_frame
from mitsplat.quality import resolve_quality
from mitsplat.render.layers import Layers, ensure_variant, make_integrator, render_layers
from mitsplat.scene.scene import FramePlan, layout_of

ensure_variant()
import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mitsplat.plugins.light_filter import Estimate, LightFilter  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]


def means(_: LightFilter, estimate: Estimate) -> tuple[Any, Any, Any, Any]:
    """What a filter of one pixel would give."""
    count = dr.rcp(dr.maximum(estimate.rays, 1))
    return estimate.lit * count, estimate.base * count, estimate.shine * count, estimate.glare * count


@contextmanager
def filtered(by_neighbours: bool) -> Iterator[None]:
    """Light as it is filtered, or as every pixel has it alone."""
    if by_neighbours:
        yield
        return
    with patch.object(LightFilter, "smooth", means):
        yield


class Pictures:
    """The frames of a scene's first layout, under integrators of the same splats."""

    def __init__(self, path: Path, frames: int) -> None:
        self.scene = ms.load_scene(path)
        quality = resolve_quality("fast")
        self.renderer = Renderer(self.scene, quality=quality)
        layout = ms.settle_layout(self.scene, layout_of(self.scene, 0))
        print(f"{len(layout.instances)} objects, {len(self.scene.spec.lights)} lights, {frames} frames")
        self.frames: list[tuple[Any, Any]] = []
        self.plans: list[FramePlan] = []
        for index in range(frames):
            plan = plan_frame(self.scene, index)
            self.frames.append((mi.load_dict(self.renderer.describe(layout, plan.lights)), plan.camera))
            self.plans.append(plan)

    def integrator(self, **properties: Any) -> Any:
        """The scene's own, with some properties changed."""
        return make_integrator(quality=resolve_quality("fast"), **{**light_properties(self.scene), **properties})

    def developed(self, number: int, layers: Layers) -> Float32Array:
        """The picture of a frame, 0 to 255."""
        plan, composite = self.plans[number], self.scene.spec.composite
        linear = light_image(layers, composite)
        image = develop(linear, plan.draws, tone=composite.tone, sensor=composite.sensor, seed=plan.seed)
        return image.astype(np.float32)

    def render(self, integrator: Any, seed: int) -> tuple[list[Layers], list[float]]:
        """Layers and processor seconds of each frame, after one that compiles."""
        render_layers(integrator, *self.frames[0], seed=seed)
        layers, seconds = [], []
        for frame in self.frames:
            start = time.process_time()
            layers.append(render_layers(integrator, *frame, seed=seed))
            dr.sync_thread()
            seconds.append(time.process_time() - start)
        return layers, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--truth", type=int, default=2048)
    args = parser.parse_args()
    with recording("light.traced", parser, args):
        measure(args)


def measure(args: argparse.Namespace) -> None:
    """Print and keep the rows."""
    pictures = Pictures(args.scene, args.frames)
    with filtered(False):
        exact, _ = pictures.render(pictures.integrator(shadow_error=0, shadow_samples=args.truth), 0)
    without = pictures.render(pictures.integrator(shadow="none"), 0)[1]

    def row(name: str, by_neighbours: bool, **properties: Any) -> None:
        with filtered(by_neighbours):
            found, seconds = pictures.render(pictures.integrator(**properties), 1)
        cost = float(np.median(np.subtract(seconds, without)))
        errors: dict[str, list[float]] = {"objects": [], "shadows": [], "picture": []}
        for number, (layers, truth) in enumerate(zip(found, exact, strict=True)):
            apart = pictures.developed(number, layers) - pictures.developed(number, truth)
            errors["picture"].append(np.mean(apart**2))
            off = layers.light.mean(axis=-1) - truth.light.mean(axis=-1)
            objects = truth.instance > 0
            shadow = ~objects & (truth.light.mean(axis=-1) < 0.99)
            errors["objects"].append(np.mean(off[objects] ** 2))
            errors["shadows"].append(np.mean(off[shadow] ** 2))
        rms = {where: float(np.sqrt(np.mean(values))) for where, values in errors.items()}
        psnr = 20 * np.log10(255 / rms.pop("picture"))
        figure(cost, "s", name, "cpu")
        figure(psnr, "dB", name, "picture")
        for where, error in rms.items():
            figure(error, "", name, where)
        errors_said = "   ".join(f"{where} {error:.4f}" for where, error in rms.items())
        print(f"{name:32} {cost:6.2f} CPU s   {errors_said}   picture {psnr:.1f} dB", flush=True)

    for rays in (1, 4, 16, 64):
        row(f"{rays} rays everywhere", False, shadow_error=0, shadow_samples=rays)
    for rays in (4, 16):
        row(f"{rays} rays everywhere, filtered", True, shadow_error=0, shadow_samples=rays)
    for error in (0.1, 0.06, 0.03, 0.015):
        row(f"error {error}", True, shadow_error=error)


if __name__ == "__main__":
    main()
