"""A solid of known colours photographed under uneven light, freed of it by the light that a mirror ball shows.

    python -m benchmarks.assets.delight OUT [--views 48] [--width 400] [--gaussians 12000] [--iterations 1500]

The solid stands on a table beside a lamp, and is path-traced; the mirror ball stands where it stood, photographed at
four exposures. ``mitsplat lights`` makes lights of it, and ``mitsplat asset --delight`` an asset of the photos. Its
colours are compared with the reflectance that was painted, in views of which there is no photo: by the standard
deviation of the logarithm of their ratio, which no exposure changes. The same with lights turned by half a circle, and
of the solid under an even sky with these lights, both of which are to be refused. OUT keeps photos and fits.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image
from scipy.ndimage import binary_erosion

from benchmarks.assets.clutter import transforms
from benchmarks.assets.judged import tell_wanted
from benchmarks.assets.known import BOARD, cameras, solid, speckled, table_scene
from benchmarks.assets.photographing import Sensors, by_name, photograph, show_where
from benchmarks.assets.verdicts import views_around
from benchmarks.record import figure, recording
from mitsplat.arrays import Float32Array
from mitsplat.asset import Asset
from mitsplat.capture.lighting import BallView, LightSettings, estimate_light, read_ball, write_light
from mitsplat.capture.lighting.panorama import unit_vector
from mitsplat.capture.pipeline.capture_pipeline import CaptureSettings
from mitsplat.fit.trainer import FitSettings
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE, show_asset
from mitsplat.reconstruct.asset_pipeline import AssetJob, asset_from_photos
from mitsplat.renderer.layers import ensure_variant
from mitsplat.renderer.rays.device_arrays import ray_scene

WANTED = {"unlike painted colours, share that is left": 0.6, "turned lights are refused": 1, "even light is left": 1}
LEAST = {"turned lights are refused", "even light is left"}
"""Of these more is better."""

LAMP, POWER, SIZE = np.array([-0.55, -0.35, 0.55]), 24.0, 0.09
"""Middle of a spherical lamp [m], its radiance and radius [m]."""
SKY = {"lamp": 0.35, "even": 1.0}
BALL, HIGH = 0.03, 0.05
"""Radius of the ball and the height of its middle [m]."""
AZIMUTH, ELEVATION, AWAY, FOV = 250.0, 20.0, 0.5, 14.0
"""Of the camera that sees the ball, as seen from there [degrees, m]."""
EXPOSURES = (0.02, 0.1, 0.5, 2.0)


def scene(light: str, thing: Any) -> dict[str, Any]:
    """A thing on the table under a lamp and a dim sky, or under a sky alone."""
    whole = table_scene(BOARD, np.random.default_rng(5))
    whole["integrator"] = {"type": "path", "max_depth": 6}
    whole["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": SKY[light]}}
    whole["lamp"] = {
        "type": "sphere",
        "center": LAMP.tolist(),
        "radius": SIZE,
        "light": {"type": "area", "radiance": {"type": "rgb", "value": [POWER, 0.9 * POWER, 0.75 * POWER]}},
    }
    if light == "even":
        del whole["lamp"]
    return whole | {"thing": thing}


def ball_lights(folder: Path, samples: int) -> Path:
    """Photograph the ball, and make lights of that."""
    centre = np.array([0, 0, HIGH])
    eye = centre + AWAY * unit_vector(AZIMUTH, ELEVATION)
    mirror = {"type": "conductor", "material": "none"}
    ball = {"type": "sphere", "center": centre.tolist(), "radius": BALL, "bsdf": mirror}
    view = Camera.look_at(eye, centre, width=480, height=320, fov_x=FOV)
    rendered = mi.render(ray_scene(scene("lamp", ball)), sensor=Sensors().like(view), spp=samples)
    radiance, rng = np.nan_to_num(np.array(rendered)[..., :3]), np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for number, time in enumerate(EXPOSURES):
        electrons = rng.poisson(20_000 * np.minimum(time * radiance, 2.0)) + rng.normal(0, 4, radiance.shape)
        encoded = encode_srgb(np.clip(electrons / 20_000, 0, 1))
        files.append(folder / f"{number}.png")
        Image.fromarray(np.rint(255 * encoded).astype(np.uint8)).save(files[-1])
    found = read_ball(files, BallView(AZIMUTH, ELEVATION, fov_x=FOV, exposures=EXPOSURES))
    estimate = estimate_light(found.panorama.radiance, LightSettings(around=(0, 0, HIGH), irradiance=np.pi))
    write_light(estimate, folder / "lights.yaml", found.picture)
    return folder / "lights.yaml"


def turned(lights: Path) -> Path:
    """The same lights from the other side."""
    text, out = lights.read_text(), lights.with_name("turned.yaml")
    lines = []
    for line in text.splitlines():
        if "position: [" in line:
            before, rest = line.split("position: [", 1)
            values, after = rest.split("]", 1)
            x, y, z = map(float, values.split(","))
            line = f"{before}position: [{-x}, {-y}, {z}]{after}"
        elif "kind: environment, image" in line:
            line = line.replace("}", ", rotate_z: 180}")
        lines.append(line)
    out.write_text("\n".join(lines) + "\n")
    return out


@dataclass(frozen=True, eq=False)
class Truth:
    """What was painted, as views see it that no photo was taken from.

    Attributes:
        views: From where.
        albedo: Linear, (V, H, W, 3).
        inside: Where the solid is, without its rim, (V, H, W).
    """

    views: list[Camera]
    albedo: Float32Array
    inside: np.ndarray


def painted(width: int, shape: Any) -> Truth:
    views = views_around(solid(), width, lowest=12)
    alone, sensors = ray_scene({"type": "scene", "solid": shape}), Sensors()
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
    shown = (mi.render(alone, integrator=aov, sensor=sensors.like(view), spp=64) for view in views)
    albedo = [np.nan_to_num(np.array(picture)[..., -3:]) for picture in shown]
    inside = [binary_erosion(picture.min(axis=2) > 0.02, iterations=3) for picture in albedo]
    return Truth(views, np.array(albedo), np.array(inside))


def unlike(asset: Path, truth: Truth, picture: Path | None = None) -> float:
    """Standard deviation of the logarithm of an asset's colours over what was painted, mean over the channels."""
    made = Asset.load(asset)
    ratios, rows = [], []
    for view, albedo, inside in zip(
        show_asset(made.splats, None, truth.views), truth.albedo, truth.inside, strict=True
    ):
        good = inside & (view.alpha > 0.98)
        shown = decode_srgb((view.render / np.maximum(view.alpha, 1e-6)[..., None]).clip(0, 1))
        ratios.append(np.log(np.maximum(shown[good], 1e-3) / albedo[good]))
        rows.append(np.concatenate([encode_srgb(albedo), view.picture], axis=0))
    if picture is not None:
        Image.fromarray(np.rint(255 * np.concatenate(rows[::2], axis=1).clip(0, 1)).astype(np.uint8)).save(picture)
    return float(np.concatenate(ratios).std(axis=0).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--width", type=int, default=400)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--gaussians", type=int, default=12_000)
    parser.add_argument("--iterations", type=int, default=1500)
    args = parser.parse_args()
    with recording("assets.delight", parser, args, ignore=("out",)):
        missed = measure(args)
    sys.exit(missed > 0)


def measure(args: argparse.Namespace) -> int:
    """Print and keep the figures; how many of them miss what is wanted."""
    ensure_variant()
    shape, views = speckled(solid()), cameras(args.views, args.width)
    truth = painted(args.width, shape)
    marker, made = args.out / "photos.json", json.dumps([args.views, args.width, args.samples])
    if not (marker.exists() and marker.read_text() == made):
        shutil.rmtree(args.out, ignore_errors=True)
        for light in SKY:
            whole = scene(light, shape)
            photograph(whole, views, args.out / light / "photos", samples=args.samples, noise=0.006)
            show_where(whole, "thing", views, args.out / light / "masks")
            (args.out / light / "transforms.json").write_text(json.dumps(transforms(by_name(views))))
        marker.write_text(made)
    lights = ball_lights(args.out / "ball", 8 * args.samples)

    def asset(light: str, name: str, delight: Path | None) -> dict[str, Any]:
        """Make an asset of photos under a light; what its verdict keeps."""
        folder = args.out / light
        given = CaptureSettings(poses=folder / "transforms.json", metric=True, masks=folder / "masks")
        fit = FitSettings(gaussians=args.gaussians, iterations=args.iterations, size=args.width)
        job = AssetJob(name="solid", delight=delight)
        done = asset_from_photos(folder / "photos", folder / "asset", job, capture=given, fit=fit)
        shutil.copytree(
            done.folder, args.out / name, dirs_exist_ok=True, ignore=shutil.ignore_patterns("capture", "fit")
        )
        if delight is not None:
            print(f"  {name}: light: {done.verdict.rows['Light']}", file=sys.stderr)
        return dict(json.loads((done.folder / VERDICT_FILE).read_text()).get("light", {}))

    asset("lamp", "as_photographed", None)
    freed, wrong = asset("lamp", "freed", lights), asset("lamp", "turned", turned(lights))
    asset("even", "even_light", None)
    even = asset("even", "even_light_freed", lights)
    errors = {
        name: unlike(args.out / name, truth, args.out / f"{name}.png")
        for name in ("as_photographed", "freed", "even_light")
    }
    for name, value in errors.items():
        figure(value, "", "unlike", name)
        print(f"{name:45} {value:8.3f}")
    for name, told in (("freed", freed), ("turned", wrong), ("even", even)):
        figure(told["uneven"], "", "irradiance", name)
        figure(told["slope"], "", "slope", name)
        figure(min(told["borne_out"]), "", "lamp", name)
    found = {
        "unlike painted colours, share that is left": errors["freed"] / errors["as_photographed"],
        "turned lights are refused": float(not wrong["kept"]),
        "even light is left": float(not even["kept"]),
    }
    return tell_wanted(found, WANTED, LEAST)


if __name__ == "__main__":
    main()
