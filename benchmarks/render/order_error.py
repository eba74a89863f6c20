"""Error of the blending order: accuracy of its estimate, and cost and error of the presets.

    python -m benchmarks.render.order_error [--captures FOLDER] [--size 1280x720] [--names plant boot_100k ...]

For every capture, and for the splats of a layout of the default scene:

* the rank correlation of the estimate with the true error, over pixels with an error;
* of the pixels whose error exceeds a tolerance, the share in tiles selected by the estimate, and the number missed;
* the largest and the root mean square error after repair.

CPU seconds of all threads and errors of the presets against ``exact`` follow; ``before`` is the former ``balanced``,
which sorted along every ray. All steps alternate; quote medians and ratios.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

# isort: off
import mitsplat as ms  # before Dr.Jit

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

# isort: on
from benchmarks.record import figure, recording
from benchmarks.render.captures import CAPTURES
from mitsplat.frames.accuracy.speed_accuracy import look_around
from mitsplat.frames.frame import Renderer
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import make_sensor
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.frame_plan import layout_index_of, plan_frame

ROOT = Path(__file__).resolve().parents[2]
TOLERANCES = (2e-3, 5e-3, 1e-2)
BEFORE = Quality(tolerance=0.0, alpha_min=1e-3)
STEPS = {"fast": PRESETS["fast"], "before": BEFORE, "balanced": PRESETS["balanced"], "exact": PRESETS["exact"]}
REPEATS = 5


def subjects(captures: Path, names: list[str], width: int, height: int) -> Iterator[tuple[str, Splats, Camera]]:
    """Yield name, splats and camera of every test case."""
    for file in sorted(captures.glob("*.splat")):
        if not names or file.stem in names:
            splats = Splats.load(file)
            yield file.stem, splats, look_around(splats, 0, 3, width=width, height=height)
    if not names or "workcell" in names:
        from mitsplat.plugins.splats import SplatsShape  # derives from a class of the variant

        with Renderer(ms.load_scene(ROOT / "scenes/workcell.yaml")) as renderer:
            layout, plan = (
                ms.settle_layout(renderer.scene, layout_index_of(renderer.scene, 0)),
                plan_frame(renderer.scene, 0),
            )
            shapes = mi.load_dict(renderer.scene_builder.describe(layout, plan.lights)).shapes()
            parts = [shape for shape in shapes if isinstance(shape, SplatsShape)]
            splats = Splats.concatenate([part.splats.transformed(part.world_from_splats) for part in parts])
        yield "workcell", splats, plan.camera.resized(width, height)


class Picture:
    """Splats on the device, seen by one camera."""

    def __init__(self, splats: Splats, camera: Camera) -> None:
        from mitsplat.renderer.projection.clouds import Placement, merge_clouds, upload_cloud
        from mitsplat.renderer.rays.sensors import view_of

        cloud = upload_cloud(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
        self.clouds, self.placements = merge_clouds([cloud]), [Placement(0, np.eye(4), 1)]
        self.view = view_of(make_sensor(camera))

    def show(self, quality: Quality) -> npt.NDArray[np.float32]:
        """Return display-encoded colours, (pixels, 3)."""
        from mitsplat.renderer.splatting.march import trace

        image = trace(self.clouds, self.placements, self.view, quality)
        dr.eval(image)
        return np.stack([channel.numpy() for channel in image.rgb], axis=-1)

    def estimate(self, quality: Quality) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return colours before any tile is repeated, and the estimate of their errors, (pixels,)."""
        from mitsplat.renderer.splatting.blending import ERROR, blend, new_state
        from mitsplat.renderer.splatting.lanes import Lanes
        from mitsplat.renderer.splatting.tiles import bin_gaussians
        from mitsplat.renderer.splatting.walk import Rays, walk

        lists = bin_gaussians(self.clouds, self.placements, self.view, quality)
        lanes = Lanes(lists, self.view, rows=1)
        far = [mi.Float(dr.inf)]
        rays = Rays.through(lists, self.view, quality, lanes.slopes(0.5, 0.5), far, lanes.start, lanes.stop)
        fresh, blend = (partial(step, several=False, late="estimated") for step in (new_state, blend))
        (pixel,) = walk(rays, "window", fresh, blend)
        *rgb, error = (lanes.image(mi.Float, [pixel[k]]).numpy() for k in (1, 2, 3, ERROR))
        return np.stack(rgb, axis=-1), error


def print_estimate(name: str, picture: Picture) -> None:
    """Print the agreement of estimate and truth, for the cut-offs of ``balanced``."""
    from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH

    quality = replace(PRESETS["balanced"], normalise_ended_rays=False)  # cut-off of the estimating walk
    exact = picture.show(replace(quality, tolerance=0.0))
    rgb, estimate = picture.estimate(quality)
    error = np.abs(rgb - exact).max(axis=-1)
    seen = error > 1e-6
    rank = spearmanr(estimate[seen], error[seen]).statistic
    figure(rank, "", name, "rank correlation")
    print(f"{name}: rank correlation {rank:.2f}; RMSE {rms(rgb - exact):.1e}, largest {error.max():.3f}")
    for tolerance in TOLERANCES:
        left = picture.show(replace(quality, tolerance=tolerance)) - exact
        worst = np.abs(left).max(axis=-1)
        above, missed = int((error > tolerance).sum()), int((worst > tolerance).sum())
        named = tiles_of(estimate > tolerance, picture.view.width)
        needed = tiles_of(error > tolerance, picture.view.width)
        again = np.kron(named, np.ones((TILE_HEIGHT, TILE_WIDTH), bool)).ravel()
        found = int(((error > tolerance) & again).sum()) / above if above else 1.0
        row = {
            "above": above,
            "found": found,
            "missed": missed,
            "tiles named": named.mean(),
            "tiles needed": needed.mean(),
            "left": rms(left),
            "largest left": worst.max(),
        }
        for key, value in row.items():
            figure(value, "", name, f"tolerance {tolerance:g}", key)
        print(
            f"  tolerance {tolerance:g}: {above} pixels above it, {found:.1%} found, {missed} missed; tiles selected "
            f"{named.mean():.2%}, needed {needed.mean():.2%}; left RMSE {rms(left):.1e}, largest {worst.max():.3f}"
        )


def tiles_of(pixels: npt.NDArray[np.bool_], width: int) -> npt.NDArray[np.bool_]:
    """Return the tiles with at least one of the given pixels, of an image whose edges tiles divide."""
    from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH

    return pixels.reshape(-1, TILE_HEIGHT, width // TILE_WIDTH, TILE_WIDTH).any(axis=(1, 3))


def rms(difference: npt.NDArray[np.float32]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(difference.astype(np.float64) ** 2)))


def print_presets(name: str, picture: Picture) -> None:
    """Print seconds and errors of the presets, measured in alternation."""
    exact = picture.show(STEPS["exact"])
    shown = {step: picture.show(quality) - exact for step, quality in STEPS.items()}
    times: dict[str, list[float]] = {step: [] for step in STEPS}
    for _ in range(REPEATS):
        for step, quality in STEPS.items():
            start = time.process_time()
            picture.show(quality)
            times[step].append(time.process_time() - start)
    before = statistics.median(times["before"])
    for step, difference in shown.items():
        seconds, error, largest = statistics.median(times[step]), rms(difference), float(np.abs(difference).max())
        for key, value, unit in (("cpu", seconds, "s"), ("rmse", error, ""), ("largest", largest, "")):
            figure(value, unit, name, step, key)
        figure(seconds / before, "", name, step, "share of before")
        print(f"  {step:9s}{seconds:7.3f} s, {seconds / before:.2f} of before, RMSE {error:.2e}, largest {largest:.4f}")


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=CAPTURES)
    parser.add_argument("--size", default="1280x720", help="size of the images, multiples of 8 px")
    parser.add_argument("--names", nargs="*", default=[], help="captures, or workcell; all by default")
    options = parser.parse_args()
    ensure_variant()
    width, height = map(int, options.size.split("x"))
    print(f"load before the run: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; processor seconds")
    with recording("render.order_error", parser, options, ignore=("captures",)):
        for name, splats, camera in subjects(options.captures, options.names, width, height):
            picture = Picture(splats, camera)
            print_estimate(name, picture)
            print_presets(name, picture)


if __name__ == "__main__":
    main()
