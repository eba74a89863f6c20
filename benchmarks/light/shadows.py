"""Shadows of relit splats against path-traced images of the same meshes by Mitsuba.

    python -m benchmarks.light.shadows [--out FOLDER] [--scenes table bin ...] [--lights lamp sky ...]

A scene's surroundings are baked under its lights without the objects, and every object alone under uniform light. The
composite of both under ``shadow: none``, ``image`` and ``traced`` is compared with a path-traced image of surroundings
and objects together. PSNR [dB] and FLIP (Andersson et al. 2020, if ``flip_evaluator`` is installed) are those of
display-encoded images:

* shadow: the surroundings where the objects remove at least 3 % of the light, and 3 pixels around;
* object: the pixels that objects cover completely;
* silhouette: the pixels that objects cover in part, and 1 pixel around;
* whole: all pixels.

A table of objects shows the PSNR of ``traced`` and its mean luminance relative to the path-traced image.

``capture`` replaces the splats of the surroundings by their path-traced image, so that only the error of the light
remains. ``direct`` is ``capture`` with the exact ratio of direct light: the optimum of shadow rays without light
reflected by the objects. Penumbrae are measured in the light ratio
itself, against direct light that is path-traced on white meshes: the distance [px] between 20 and 80 % of every edge.

Path-traced images and bakes take long; FOLDER stores them for later runs. With 48 paths per pixel, two path-traced
images of metal parts differ by 24 to 28 dB, so that their noise hides the error of objects.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mitsplat.arrays import BoolArray, Float64Array

# isort: off
# imports mitsplat, which must be imported before Dr.Jit
from benchmarks.light.shadow_scenes import LIGHTS, ROOT, SETUPS, Setup, baked, coverage, lights_of, placed

import mitsuba as mi
import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates, maximum_filter, minimum_filter

# isort: on
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.bake.part_shapes import bake_lights, mitsuba_scene
from mitsplat.frames.camera_response import lit_picture
from mitsplat.frames.scene_builder import make_asset_shape
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import LUMINANCE, decode_srgb, encode_srgb
from mitsplat.quality import resolve_quality
from mitsplat.renderer.emitters.emitter_sampling import reference_irradiance
from mitsplat.renderer.layers import Layers, make_integrator, render_layers
from mitsplat.renderer.path_tracing import trace_radiance
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.image_spec import Composite


class Photographer:
    """Path-traced linear images, cached in a folder.

    A pixel has ``side`` x ``side`` positions, and the number of paths is rounded to that of a square grid at each.
    """

    def __init__(self, camera: Camera, folder: Path, samples: int, side: int = 3) -> None:
        self.camera, self.folder, self.samples, self.side = camera, folder, samples, side
        folder.mkdir(parents=True, exist_ok=True)

    def take(
        self,
        name: str,
        parts: Sequence[MeshPart],
        lights: dict[str, Any],
        *,
        bounces: int = 6,
        clay: bool = False,
    ) -> tuple[Float64Array, Float64Array]:
        """Return radiance (H, W, 3) averaged over each pixel, and coverage (H, W)."""
        side, camera = self.side, self.camera
        samples = max(1, round(self.samples**0.5 / side)) ** 2
        file = self.folder / f"{name}_{side * side * samples}.npz"
        if not file.exists():
            scene = mitsuba_scene(parts, lights, clay=clay)
            fine = camera.resized(camera.width * side, camera.height * side)
            x, y = np.meshgrid(np.arange(fine.width) + 0.5, np.arange(fine.height) + 0.5)
            rays = fine.rays(np.stack([x.ravel(), y.ravel()], axis=1)) @ camera.world_from_camera[:3, :3].T
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            origins = np.broadcast_to(camera.centre, rays.shape)
            radiance, hit = trace_radiance(scene, origins, rays, samples=samples, bounces=bounces, seed=1)
            by_pixel = (camera.height, side, camera.width, side)
            np.savez(
                file,
                radiance=np.where(hit[:, None], radiance, 0).reshape(*by_pixel, 3).mean(axis=(1, 3)).astype(np.float32),
                cover=hit.reshape(by_pixel).mean(axis=(1, 3)).astype(np.float32),
            )
        stored = np.load(file)
        return stored["radiance"].astype(np.float64), stored["cover"].astype(np.float64)


@dataclass(frozen=True, eq=False)
class Truth:
    """Path-traced images of one setup under one light, all H x W, and regions in them.

    ``thing`` is the number of the object that covers a pixel completely, or 0.
    """

    photo: Float64Array
    empty: Float64Array
    ratio: Float64Array
    thing: npt.NDArray[np.uint32]
    shadow: BoolArray
    silhouette: BoolArray
    edges: BoolArray

    @property
    def objects(self) -> BoolArray:
        """Pixels that any object covers completely."""
        return self.thing > 0


def take_truth(setup: Setup, name: str, light: str, out: Path, samples: int) -> Truth:
    shots = Photographer(setup.camera, out / name, samples)
    few = Photographer(setup.camera, out / name, samples // 16)  # for direct light, which has less noise
    lights = bake_lights(lights_of(light, out))
    room, things = read_model(setup.room).parts, [placed(thing) for thing in setup.things]
    everything = [*room, *(part for parts in things for part in parts)]
    photo, _ = shots.take(f"{light}_photo", everything, lights)
    empty, _ = shots.take(f"{light}_empty", room, lights)
    direct, _ = few.take(f"{light}_direct", everything, lights, bounces=1, clay=True)
    bare, _ = few.take(f"{light}_bare", room, lights, bounces=1, clay=True)
    ratio = np.where(bare > 1e-4, direct / np.maximum(bare, 1e-4), 1.0)
    thing, cover = coverage(setup.camera, room, things)
    surroundings = cover == 0
    silhouette = binary_dilation((cover > 0) & (cover < 1), iterations=1)
    darker = surroundings & (photo @ LUMINANCE < 0.97 * (empty @ LUMINANCE)) & (bare @ LUMINANCE > 1e-3)
    # Excludes speckles of noise.
    darker = gaussian_filter(darker.astype(float), 1.5) > 0.5
    shadow = binary_dilation(darker, iterations=3) & surroundings
    edges = ~binary_dilation(~surroundings, iterations=1)
    return Truth(photo, empty, ratio, thing, shadow, silhouette, edges)


def composites(layers: Layers, relative: Layers, truth: Truth) -> dict[str, Float64Array]:
    """Return linear images to compare with the path-traced one, by name.

    ``relative`` are layers with light relative to an open place, the input of the image-space method.
    """
    captured = np.where(truth.objects[..., None], layers.captured, truth.empty).astype(np.float32)
    opaque = {"captured": captured, "alpha": np.ones_like(layers.alpha)}
    exact = replace(layers, **opaque)
    ratio = np.where(truth.objects[..., None], layers.light, truth.ratio).astype(np.float32)
    pictures = {"none": lit_picture(layers, Composite(shadow="none"))}
    pictures |= {"image": lit_picture(relative, Composite(shadow="image"))}
    pictures |= {"traced": lit_picture(layers, Composite())}
    pictures |= {"capture image": lit_picture(replace(relative, **opaque), Composite(shadow="image"))}
    pictures |= {"capture traced": lit(exact)}
    pictures["direct"] = lit(replace(exact, light=ratio))
    return {name: np.asarray(picture, dtype=np.float64) for name, picture in pictures.items()}


def lit(layers: Layers) -> Float64Array:
    """Return the linear image of opaque layers that were changed after rendering."""
    return np.maximum(layers.captured * layers.light + layers.highlight, 0)


def psnr(picture: Float64Array, photo: Float64Array, region: BoolArray) -> float:
    error = np.clip(encode_srgb(picture), 0, 1) - np.clip(encode_srgb(photo), 0, 1)
    return float(-10 * np.log10(np.mean(error[region] ** 2)))


def brightness(picture: Float64Array, photo: Float64Array, region: BoolArray) -> float:
    """Return the mean luminance in a region relative to the path-traced image."""
    return float(np.mean(picture[region] @ LUMINANCE) / np.mean(photo[region] @ LUMINANCE))


def difference(picture: Float64Array, photo: Float64Array) -> Float64Array:
    """Return four times the difference of display-encoded images around middle grey, as a linear image."""
    error = np.clip(encode_srgb(picture), 0, 1) - np.clip(encode_srgb(photo), 0, 1)
    return decode_srgb(np.clip(0.5 + 4 * error, 0, 1))


def flip(picture: Float64Array, photo: Float64Array, region: BoolArray) -> float:
    """Return the mean FLIP difference in a region; NaN if its library is not installed."""
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return float("nan")
    shown = [np.clip(encode_srgb(p), 0, 1).astype(np.float32) for p in (photo, picture)]
    errors, _, _ = evaluate(*shown, "LDR", applyMagma=False)
    return float(errors[region].mean())


def penumbra_widths(ratios: Sequence[Float64Array], on_room: BoolArray, *, reach: int = 14) -> Float64Array:
    """Return distances [px] between 20 and 80 % of the edges of the first ratio, in all ratios (edges, ratios)."""
    truth = gaussian_filter(ratios[0], 1.0)
    low, high = minimum_filter(truth, 2 * reach + 1), maximum_filter(truth, 2 * reach + 1)
    slope = np.stack(np.gradient(gaussian_filter(ratios[0], 2.0)), axis=-1)
    steep = np.linalg.norm(slope, axis=-1)
    middle = (high - low > 0.25) & (np.abs(truth - 0.5 * (high + low)) < 0.06 * (high - low)) & (steep > 0.01)
    centres = np.argwhere(middle & on_room)
    steps = np.arange(-reach, reach + 0.25, 0.25)
    rows = []
    for centre in centres:
        line = (centre + steps[:, None] * slope[tuple(centre)] / steep[tuple(centre)]).T
        if map_coordinates(on_room.astype(float), line, order=1).min() < 1:
            continue
        widths = [_rise(map_coordinates(ratio, line, order=1), steps) for ratio in ratios]
        if np.isfinite(widths[0]):
            rows.append(widths)
    return np.array(rows).reshape(-1, len(ratios))


def _rise(profile: Float64Array, steps: Float64Array) -> float:
    low, high = np.median(profile[:8]), np.median(profile[-8:])
    level = (profile - low) / (high - low) if high > low + 0.05 else np.full_like(profile, np.nan)
    above = np.flatnonzero(level > 0.8)
    below = np.flatnonzero(level[: above[0]] < 0.2) if len(above) else above
    return float(steps[above[0]] - steps[below[-1]]) if len(below) else np.nan


def save_sheet(path: Path, pictures: Sequence[Float64Array], scale: int = 2) -> None:
    """Save images side by side, three to a row, magnified."""
    rows = [np.concatenate(pictures[i : i + 3], axis=1) for i in range(0, len(pictures), 3)]
    rows = [np.pad(row, ((0, 0), (0, rows[0].shape[1] - row.shape[1]), (0, 0))) for row in rows]
    sheet = np.rint(255 * np.clip(encode_srgb(np.concatenate(rows)), 0, 1)).astype(np.uint8)
    Image.fromarray(sheet).resize((scale * sheet.shape[1], scale * sheet.shape[0]), Image.Resampling.NEAREST).save(path)


@dataclass(frozen=True, eq=False)
class SplatScene:
    """A setup as baked splats under one light.

    ``white`` is the irradiance that the surroundings show as white.
    """

    scene: mi.Scene
    camera: Camera
    white: float

    @classmethod
    def of(cls, setup: Setup, name: str, light: str, out: Path) -> SplatScene:
        """Return the scene of a setup; its bakes are stored in ``out``."""
        lights = lights_of(light, out)
        room = baked(setup.room, out / name / light, lights, 20000, kind="environment", density=setup.density)
        shapes = {"room": make_asset_shape(room, np.eye(4), 0)}
        for number, thing in enumerate(setup.things, 1):
            shapes[f"thing_{number}"] = make_asset_shape(thing.asset(out / name), thing.pose, number)
        scene = mi.load_dict({"type": "scene", **shapes, **bake_lights(lights)})
        return cls(scene, setup.camera, room.white)

    def render(self, **properties: Any) -> Layers:
        """Render the layers with properties of the integrator, and the defaults of scene files otherwise."""
        quality = replace(resolve_quality("fast"), samples="edges")
        return render_layers(make_integrator(quality=quality, **properties), self.scene, self.camera)


def compare(name: str, light: str, out: Path, samples: int) -> dict[str, Any]:
    """Return the figures of one setup under one light, and write the images side by side to ``out``."""
    setup = SETUPS[name]()
    truth = take_truth(setup, name, light, out, samples)
    splats = SplatScene.of(setup, name, light, out)
    layers = splats.render(white=splats.white)
    open_place = np.ravel(reference_irradiance(splats.scene, (0, 0, 0))).tolist()
    relative = splats.render(white={"type": "rgb", "value": open_place}, bounce=False)
    pictures = composites(layers, relative, truth)
    traced = pictures["traced"]
    ratios = [truth.ratio @ LUMINANCE, layers.light @ LUMINANCE]
    ratios.append(pictures["capture image"] @ LUMINANCE / np.maximum(truth.empty @ LUMINANCE, 1e-6))
    widths = penumbra_widths(ratios, truth.edges)
    regions = {"shadow": truth.shadow, "object": truth.objects, "silhouette": truth.silhouette}
    regions["whole"] = np.ones_like(truth.shadow)
    result: dict[str, Any] = {
        f"{region} {key}": psnr(picture, truth.photo, mask)
        for key, picture in pictures.items()
        for region, mask in regions.items()
        if region == "shadow" or key in ("none", "image", "traced")
    }
    result |= {f"flip {key}": flip(picture, truth.photo, truth.shadow) for key, picture in pictures.items()}
    result["things"] = {
        thing.name: (psnr(traced, truth.photo, mask), brightness(traced, truth.photo, mask))
        for i, thing in enumerate(setup.things, 1)
        if (mask := truth.thing == i).any()
    }
    error = (layers.light - truth.ratio)[truth.edges & truth.shadow]
    result["ratio rms"] = float(np.sqrt(np.mean(error**2)))
    result["edges"], result["width"] = len(widths), float(np.median(widths[:, 0])) if len(widths) else np.nan
    for column, key in ((1, "traced"), (2, "image")):
        error = np.abs(widths[:, column] - widths[:, 0]) / np.maximum(widths[:, 0], 0.5)
        result[f"width error {key}"] = float(np.nanmedian(error)) if len(widths) else np.nan
    shown = [truth.photo, pictures["none"], pictures["image"], traced]
    save_sheet(out / f"{name}_{light}.png", [*shown, pictures["capture traced"], layers.light.astype(np.float64)])
    save_sheet(out / f"{name}_{light}_traced.png", [traced, truth.photo, difference(traced, truth.photo)])
    return result


COLUMNS = ("none", "image", "traced", "capture image", "capture traced", "direct")


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "shadows")
    parser.add_argument("--scenes", nargs="*", choices=SETUPS, default=list(SETUPS))
    parser.add_argument("--lights", nargs="*", choices=LIGHTS, default=list(LIGHTS))
    parser.add_argument(
        "--samples",
        type=int,
        default=768,
        help="paths per pixel of a path-traced image",
    )
    options = parser.parse_args()
    ensure_variant()
    with recording("light.shadows", parser, options, ignore=("out",)):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Compare, and print the tables."""
    results = {}
    for name in options.scenes:
        for light in options.lights:
            start = time.perf_counter()
            results[name, light] = compare(name, light, options.out, options.samples)
            print(f"{name} {light}: {time.perf_counter() - start:.0f} s", flush=True)
    for quantity in ("shadow", "flip", "object", "silhouette", "whole"):
        columns = [c for c in COLUMNS if all(f"{quantity} {c}" in result for result in results.values())]
        print(f"\n{quantity:16s}" + "".join(f"{column:>16s}" for column in columns))
        rows = {key: [result[f"{quantity} {column}"] for column in columns] for key, result in results.items()}
        rows["mean", ""] = np.mean(list(rows.values()), axis=0)
        for column, mean in zip(columns, rows["mean", ""], strict=True):
            figure(mean, "" if quantity == "flip" else "dB", quantity, column)
        for key, row in rows.items():
            print(f"{' '.join(key):16s}" + "".join(f"{v:16.3f}" if quantity == "flip" else f"{v:16.1f}" for v in row))
    figure(len(results), "", "photographs")
    gains = [r["shadow traced"] - max(r["shadow none"], r["shadow image"]) for r in results.values()]
    figure(min(gains), "dB", "least gain of traced")
    print_things({(*key, thing): found for key, result in results.items() for thing, found in result["things"].items()})
    others = ("ratio rms", "edges", "width", "width error traced", "width error image")
    print("\n" + " " * 16 + "".join(f"{column:>20s}" for column in others))
    for key, result in results.items():
        print(f"{' '.join(key):16s}" + "".join(f"{result[column]:20.3f}" for column in others))


def print_things(things: Mapping[tuple[str, str, str], tuple[float, float]]) -> None:
    """Print PSNR and brightness of every object in every image."""
    print(f"\n{'object, traced':40s}{'PSNR [dB]':>12s}{'brightness':>12s}")
    for (name, light, thing), (error, bright) in things.items():
        print(f"{f'{name} {light} {thing}':40s}{error:12.1f}{bright:12.2f}")
        figure(error, "dB", "things", name, thing, light, "psnr")
        figure(bright, "", "things", name, thing, light, "brightness")
    errors, bright = np.array(list(things.values())).T
    print(f"{'mean':40s}{errors.mean():12.1f}{bright.mean():12.2f}")
    print(f"{'worst':40s}{errors.min():12.1f}{bright.min():12.2f} to {bright.max():.2f}")
    figure(errors.mean(), "dB", "things", "mean psnr")
    figure((errors.min(), errors.max()), "dB", "things", "range of psnr")
    figure((bright.min(), bright.max()), "", "things", "range of brightness")


if __name__ == "__main__":
    main()
