"""Time and error of traced light: adaptive rays with a filter, compared with equal numbers of rays per pixel.

    python -m benchmarks.light.traced [--scene scenes/workcell.yaml] [--frames 4] [--truth 2048]

The truth is the ratio of ``--truth`` rays per pixel without a filter, and reflected light of many rays. Errors are the
standard deviation of the light factor (mean of RGB) from it, on relit objects and where a shadow removes 1 % or more
of the light. Pixels next to another instance are excluded: their rays may hit the proxy of the other instance, so that
no number of rays without a filter is a truth. The PSNR [dB] compares developed images, including camera noise, outside
of those pixels with images of the truth; it includes errors of highlights.
CPU seconds of all threads are medians over frames, minus those of the same frames without light.
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
from scipy.ndimage import maximum_filter, minimum_filter

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.arrays import Float32Array
from mitsplat.frames.camera_response import develop, lit_picture
from mitsplat.frames.frame import Renderer
from mitsplat.frames.light_properties import light_properties
from mitsplat.quality import resolve_quality
from mitsplat.renderer.layers import Layers, make_integrator, render_layers
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.frame_plan import FramePlan, layout_index_of, plan_frame

ensure_variant()
import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mitsplat.renderer.light import bounce  # noqa: E402
from mitsplat.renderer.light.light_estimate import Estimate, LightMeans  # noqa: E402
from mitsplat.renderer.light.light_filter import LightFilter  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SMOOTH = LightFilter.smooth
REFLECTED = 96
"""Rays of reflected light for every pixel of the truth."""


def means(light_filter: LightFilter, estimate: Estimate, bounced: tuple[Any, Any] | None = None) -> LightMeans:
    """Return the values of a filter of one pixel; reflected light has few rays and is always averaged."""
    count = dr.rcp(dr.maximum(estimate.rays, 1))
    return LightMeans(
        estimate.lit * count,
        estimate.base * count,
        SMOOTH(light_filter, estimate, bounced).bounced,
    )


@contextmanager
def filtered(by_neighbours: bool) -> Iterator[None]:
    """Return filtered light, or unfiltered light of every pixel."""
    if by_neighbours:
        yield
        return
    with patch.object(LightFilter, "smooth", means):
        yield


@contextmanager
def reflected() -> Iterator[None]:
    """Return reflected light of many rays, without the mean over cells on meshes."""
    rays = patch.multiple(bounce, BOUNCE_RAYS=REFLECTED, CELL_RAYS=REFLECTED, MESH_RAYS=REFLECTED)
    with rays, patch.object(LightFilter, "average", lambda _, values, radius=0: values):
        yield


class Pictures:
    """Frames of a scene's first layout, with integrators of the same splats."""

    def __init__(self, path: Path, frames: int) -> None:
        self.scene = ms.load_scene(path)
        quality = resolve_quality("fast")
        self.renderer = Renderer(self.scene, quality=quality)
        layout = ms.settle_layout(self.scene, layout_index_of(self.scene, 0))
        print(f"{len(layout.instances)} objects, {len(self.scene.spec.lights)} lights, {frames} frames")
        self.frames: list[tuple[Any, Any]] = []
        self.plans: list[FramePlan] = []
        for index in range(frames):
            plan = plan_frame(self.scene, index, layout)
            self.frames.append((mi.load_dict(self.renderer.scene_builder.describe(layout, plan.lights)), plan.camera))
            self.plans.append(plan)

    def integrator(self, **properties: Any) -> Any:
        """Return the scene's integrator with some changed properties."""
        return make_integrator(quality=resolve_quality("fast"), **{**light_properties(self.scene), **properties})

    def developed(self, number: int, layers: Layers) -> Float32Array:
        """Return the developed image of a frame, 0 to 255."""
        plan, composite = self.plans[number], self.scene.spec.composite
        linear = lit_picture(layers, composite)
        image = develop(linear, plan.draws, composite, seed=plan.seed)
        return image.astype(np.float32)

    def render(self, number: int, integrator: Any, seed: int) -> tuple[Layers, float]:
        """Return layers and CPU seconds of a frame."""
        start = time.process_time()
        layers = render_layers(integrator, *self.frames[number], seed=seed)
        dr.sync_thread()
        return layers, time.process_time() - start


class Row:
    """One method to trace light: its cost and error, frame by frame."""

    def __init__(self, name: str, by_neighbours: bool, integrator: Any) -> None:
        self.name, self.by_neighbours, self.integrator = name, by_neighbours, integrator
        self.seconds: list[float] = []
        self.errors: dict[str, list[float]] = {"objects": [], "shadows": [], "picture": []}

    def render(self, pictures: Pictures, number: int) -> tuple[Layers, float]:
        """Return layers and CPU seconds of a frame."""
        with filtered(self.by_neighbours):
            return pictures.render(number, self.integrator, 1)

    def compare(self, pictures: Pictures, number: int, truth: Layers, without: float) -> None:
        """Add a frame with its time without light [s]."""
        layers, seconds = self.render(pictures, number)
        self.seconds.append(seconds - without)
        apart = pictures.developed(number, layers) - pictures.developed(number, truth)
        off = layers.light.mean(axis=-1) - truth.light.mean(axis=-1)
        inside = maximum_filter(truth.instance, 3) == minimum_filter(truth.instance, 3)
        objects = inside & (truth.instance > 0)
        shadow = inside & (truth.instance == 0) & (truth.light.mean(axis=-1) < 0.99)
        for where, squares in (
            ("picture", apart[inside] ** 2),
            ("objects", off[objects] ** 2),
            ("shadows", off[shadow] ** 2),
        ):
            self.errors[where].append(float(np.mean(squares)))

    def tell(self) -> None:
        """Print and record the row."""
        cost = float(np.median(self.seconds))
        rms = {where: float(np.sqrt(np.mean(values))) for where, values in self.errors.items()}
        psnr = 20 * np.log10(255 / rms.pop("picture"))
        figure(cost, "s", self.name, "cpu")
        figure(psnr, "dB", self.name, "picture")
        for where, error in rms.items():
            figure(error, "", self.name, where)
        errors_said = "   ".join(f"{where} {error:.4f}" for where, error in rms.items())
        print(f"{self.name:32} {cost:6.2f} CPU s   {errors_said}   picture {psnr:.1f} dB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes/workcell.yaml")
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--truth", type=int, default=2048)
    args = parser.parse_args()
    with recording("light.traced", parser, args):
        measure(args)


def measure(args: argparse.Namespace) -> None:
    """Print and record the rows; their times alternate, so that other load affects all of them equally."""
    pictures = Pictures(args.scene, args.frames)
    rows = [Row(f"{n} rays everywhere", False, _everywhere(pictures, n)) for n in (1, 4, 16, 64)]
    rows += [Row(f"{n} rays everywhere, filtered", True, _everywhere(pictures, n)) for n in (4, 16)]
    rows += [Row(f"error {e}", True, pictures.integrator(shadow_error=e)) for e in (0.1, 0.06, 0.03, 0.015)]
    rows += [Row("no reflected light", True, pictures.integrator(bounce=False))]
    dark, exact = pictures.integrator(shadow="none"), _everywhere(pictures, args.truth)
    for row in rows:
        row.render(pictures, 0)  # compiles kernels
    pictures.render(0, dark, 1)
    for number in range(args.frames):
        with filtered(False), reflected():
            truth, _ = pictures.render(number, exact, 0)
        without = float(np.median([pictures.render(number, dark, 1)[1] for _ in range(3)]))
        for row in rows:
            row.compare(pictures, number, truth, without)
    for row in rows:
        row.tell()


def _everywhere(pictures: Pictures, rays: int) -> Any:
    return pictures.integrator(shadow_error=0, shadow_samples=rays)


if __name__ == "__main__":
    main()
