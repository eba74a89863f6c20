"""Materials that are estimated from path-traced photographs of the shipped parts, against the true materials.

    python -m benchmarks.assets.materials [--out FOLDER] [--parts hex_bolt relay_box ...]

Every part lies on a grey mat in a room with windows, whose light is known, and is photographed from 20 directions with
8 bits. Cameras and meshes are the true ones, so that the errors are those of the estimate. For each part:

* colour: relative error of the mean base colour, as vectors of linear RGB, on the true material with the largest
  visible area;
* roughness: absolute error on this material;
* all colours, all roughness: means over all true materials, weighted by visible area;
* metal: share of the surface that is correctly metal or plastic;
* explained: share of the error of captured colours in the photographs that the materials avoid;
* dB: PSNR of the object under other lights, with its captured colours times the ratio of light, with the estimated
  materials, and with the true ones, against path-traced images of the true mesh. All use the same Gaussians, and
  captured colours are SH of degree 1. The true materials show the limit that Gaussians and renderer set.

FOLDER stores the path-traced images for later runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

# isort: off
from mitsplat.arrays import Float64Array, Int64Array  # imports mitsplat, which must be imported before Dr.Jit

import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import KDTree

# isort: on
from benchmarks.light.shadow_scenes import ROOT, block, coverage, lights_of, pose, worn
from benchmarks.light.shadows import psnr, save_sheet
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.bake.mesh_surface import MeshSurface
from mitsplat.bake.part_shapes import bake_lights, mitsuba_scene, part_shape
from mitsplat.capture.capture import Capture, Photo
from mitsplat.gaussians.spherical_harmonics import SH_C0, sh_basis
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import Surfels, place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import LUMINANCE, encode_srgb
from mitsplat.reconstruct.materials.capture_light import CaptureLight
from mitsplat.reconstruct.materials.estimation import MaterialEstimate, estimate_materials
from mitsplat.renderer.emitters.emitter_sampling import reference_irradiance
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.path_tracing import render_mesh
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import LightSpec
from scenes.build import materials as m
from scenes.build.parts import PARTS, build_part

WIDTH, PHOTOS, HELD_OUT = 192, 20, 1
TILTS = {"hex_bolt": 90, "brass_fitting": 90, "proximity_sensor": 90}
"""Rotations of parts that do not stand, about x [degrees]."""
NEW_LIGHTS = ("softbox", "lamp")
GAUSSIANS = 15_000
MAIN_SHARE = 0.1
"""Share of the visible surface from which a true material must be recognised."""


def placed(name: str) -> tuple[MeshPart, ...]:
    """Return the true parts of the object on the mat."""
    scene = build_part(name, 0)[0].copy().apply_transform(pose(0, 0, 0, 20, TILTS.get(name, 0)))
    return read_model(scene.apply_translation((0, 0, -float(scene.bounds[0, 2])))).parts


def mat() -> tuple[MeshPart, ...]:
    image = m.cast((120, 122, 120), np.random.default_rng(4), size=256)
    return read_model(trimesh.Scene({"mat": worn(block((-0.4, -0.4, -0.03), (0.4, 0.4, 0)), image)})).parts


def balanced(name: str, folder: Path) -> tuple[LightSpec, ...]:
    """Return lights by name, scaled so that level white paper has the radiance 1."""
    lights = lights_of(name, folder)
    scene = mi.load_dict({"type": "scene", **bake_lights(lights)})
    scale = np.pi / float(np.ravel(reference_irradiance(scene, (0, 0, 0))) @ LUMINANCE)
    key = {"spot": "intensity", "point": "intensity"}
    return tuple(
        light.model_copy(update={(k := key.get(light.kind, "radiance")): getattr(light, k) * scale}) for light in lights
    )


def ring(mesh: trimesh.Trimesh, count: int, turn: float = 0.0, width: int = WIDTH) -> list[Camera]:
    """Return cameras in three heights around a mesh, with 4:3 images."""
    centre, radius = mesh.bounds.mean(axis=0), 0.5 * float(np.linalg.norm(mesh.extents))
    azimuth = np.radians(np.arange(count) * 360 / count + turn)
    elevation = np.radians(np.resize((15, 40, 65), count))
    flat = np.cos(elevation)
    towards = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    return [
        Camera.look_at(centre + 5.2 * radius * one, centre, width=width, height=3 * width // 4, fov_x=26)
        for one in towards
    ]


def path_traced(
    parts: Sequence[MeshPart], lights: Sequence[LightSpec], cameras: Sequence[Camera], samples: int, file: Path
) -> tuple[Float64Array, Float64Array]:
    """Return linear images (N, H, W, 3) on the mat, and the pixels that the object covers completely (N, H, W)."""
    if not file.exists():
        table = mat()
        scene = mitsuba_scene([*table, *parts], bake_lights(lights))
        radiance = [render_mesh(scene, camera, samples=samples, seed=i)[0] for i, camera in enumerate(cameras, 1)]
        masks = [coverage(camera, table, [parts])[0] > 0 for camera in cameras]
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, radiance=np.array(radiance, dtype=np.float32), masks=np.array(masks))
    stored = np.load(file)
    return stored["radiance"].astype(np.float64), stored["masks"]


def capture_of(radiance: Float64Array, masks: Float64Array, cameras: Sequence[Camera], folder: Path) -> Capture:
    """Write 8-bit photos with masks, and return their capture."""
    folder.mkdir(parents=True, exist_ok=True)
    photos = []
    for number, camera in enumerate(cameras):
        file, mask = folder / f"{number:02}.png", folder / f"{number:02}_mask.png"
        Image.fromarray(np.rint(255 * np.clip(encode_srgb(radiance[number]), 0, 1)).astype(np.uint8)).save(file)
        Image.fromarray(np.uint8(255) * masks[number].astype(np.uint8)).save(mask)
        photos.append(Photo(file.name, file, camera, mask))
    none = np.zeros((0, 3))
    return Capture(tuple(photos), none, none.astype(np.uint8), units="metre", up="z", table=True)


def visible(scene: mi.Scene, surfels: Surfels, camera: Camera) -> Int64Array:
    """Return the indices of the surfels that a camera sees."""
    towards = camera.centre - surfels.points
    distance = np.linalg.norm(towards, axis=1)
    towards /= distance[:, None]
    origins = surfels.points + 1e-5 * surfels.normals
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(towards.T.astype(np.float32)))
    free = ~np.array(scene.ray_test(ray))
    return np.flatnonzero(free & (np.einsum("nd,nd->n", towards, surfels.normals) > 0.15))


def captured_splats(scene: mi.Scene, surfels: Surfels, capture: Capture) -> tuple[Splats, Int64Array]:
    """Return Gaussians with the radiance in the photos, and the number of photos that show each."""
    count, bands = len(surfels), 4
    left, right, seen = np.zeros((count, bands, bands)), np.zeros((count, bands, 3)), np.zeros(count, dtype=np.int64)
    for photo in capture.photos:
        rows = visible(scene, surfels, photo.camera)
        inside, x, y = photo.camera.visible_pixels(surfels.points[rows])
        pixels = photo.read()
        shown = pixels.mask[y, x] > 0.5 if pixels.mask is not None else np.ones(len(x), dtype=bool)
        rows, x, y = rows[inside][shown], x[shown], y[shown]
        towards = surfels.points[rows] - photo.camera.centre
        basis = sh_basis(towards / np.linalg.norm(towards, axis=1, keepdims=True), 1)
        left[rows] += basis[:, :, None] * basis[:, None]
        right[rows] += basis[:, :, None] * (pixels.rgb[y, x].astype(np.float64) - 0.5)[:, None]
        seen[rows] += 1
    ridge = np.diag([1e-6, 0.1, 0.1, 0.1])
    sh = np.linalg.solve(left + ridge, right)
    known = seen > 0
    sh[~known] = sh[known][KDTree(surfels.points[known]).query(surfels.points[~known])[1]]
    return surfels.splats(sh), seen


def relit(splats: Splats, mesh: trimesh.Trimesh, lights: Sequence[LightSpec], camera: Camera) -> Float64Array:
    """Return the linear image of splats on the mat under lights."""
    shapes = {"mat": part_shape(mat()[0]), "object": make_splats_shape(splats, None, mesh, instance=1)}
    scene = mi.load_dict({"type": "scene", **shapes, **bake_lights(lights)})
    return render_layers(make_integrator(white=float(np.pi), hide_emitters=True), scene, camera).rgb.astype(np.float64)


def compare(surface: MeshSurface, surfels: Surfels, seen: Int64Array, found: MaterialEstimate) -> dict[str, float]:
    """Return the errors of an estimate on the visible surfels."""
    rows = np.flatnonzero(seen)
    faces, barycentric = surfels.faces[rows], surfels.barycentric[rows]
    colours, materials = surface.base_colours(faces, barycentric), surface.materials(faces, barycentric)
    nearest = KDTree(found.points).query(surfels.points[rows])[1]
    regions = np.array([(region.metallic, region.roughness) for region in found.regions])[found.region[nearest]]
    correct = (regions[:, 0] >= 0.5) == (materials[:, 0] >= 0.5)
    errors, recognised = [], True
    for material in np.unique(materials.round(3), axis=0):
        own = (materials.round(3) == material).all(axis=1)
        true, estimate = colours[own].mean(axis=0), found.colours[nearest[own]].mean(axis=0)
        colour = float(np.linalg.norm(estimate - true) / np.linalg.norm(true))
        errors.append((float(own.mean()), colour, float(abs(regions[own, 1].mean() - material[1]))))
        recognised &= bool(own.mean() < MAIN_SHARE or correct[own].mean() > 0.5)
    _, colour, roughness = max(errors)
    return {
        "colour": colour,
        "roughness": roughness,
        "all colours": sum(share * error for share, error, _ in errors),
        "all roughness": sum(share * error for share, _, error in errors),
        "metal": float(correct.mean()),
        "recognised": float(recognised),
        "confidence": found.confidence,
        "explained": found.explained,
    }


def with_true_materials(splats: Splats, surface: MeshSurface, surfels: Surfels) -> Splats:
    """Return the splats with the materials of the true mesh."""
    colours = encode_srgb(surface.base_colours(surfels.faces, surfels.barycentric))
    values = surface.materials(surfels.faces, surfels.barycentric).astype(np.float32)
    sh = ((colours[:, None] - 0.5) / SH_C0).astype(np.float32)
    return replace(splats, sh=sh, materials=SplatMaterials(*values.T))


def measure(name: str, out: Path, samples: int) -> dict[str, float]:
    """Estimate the materials of one part, and return the figures."""
    parts, folder = placed(name), out / name
    surface = MeshSurface(parts)
    mesh = trimesh.Trimesh(surface.mesh.vertices, surface.mesh.faces, process=False)
    cameras, lights = ring(mesh, PHOTOS), balanced("interior", out)
    capture = capture_of(*path_traced(parts, lights, cameras, samples, folder / "photos.npz"), cameras, folder)
    found = estimate_materials(capture, mesh, CaptureLight(lights))
    for region in found.regions:
        print(f"  {region}", flush=True)
    surfels = place_surfels(mesh, 1.0, GAUSSIANS, np.random.default_rng(0))
    scene = mitsuba_scene(parts, {})
    captured, seen = captured_splats(scene, surfels, capture)
    figures = compare(surface, surfels, seen, found)
    looks = captured, found.apply(captured), with_true_materials(captured, surface, surfels)
    figures |= score_new_lights(parts, mesh, looks, folder, samples)
    return figures


def score_new_lights(
    parts: Sequence[MeshPart], mesh: trimesh.Trimesh, looks: tuple[Splats, Splats, Splats], folder: Path, samples: int
) -> dict[str, float]:
    """Return the PSNR [dB] under other lights of captured, estimated and true materials; write a sheet of pictures."""
    figures = {}
    others, pictures = ring(mesh, HELD_OUT, turn=29.0), []
    for light in NEW_LIGHTS:
        new = balanced(light, folder.parent)
        truth, masks = path_traced(parts, new, others, 8 * samples, folder / f"{light}.npz")
        scores = []
        for camera, photo, mask in zip(others, truth, masks, strict=True):
            shown = [relit(splats, mesh, new, camera) for splats in looks]
            scores.append([psnr(picture, photo, mask) for picture in shown])
            pictures += [photo, *shown[:2]]
        for kind, score in zip(("captured", "estimated", "true"), np.mean(scores, axis=0).tolist(), strict=True):
            figures[f"{light} {kind}"] = score
    save_sheet(folder.with_suffix(".png"), pictures)
    return figures


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "materials")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--samples", type=int, default=24, help="paths per pixel of a photograph")
    options = parser.parse_args()
    ensure_variant()
    with recording("assets.materials", parser, options, ignore=("out",)):
        results = {}
        for name in options.parts:
            results[name] = measure(name, options.out, options.samples)
            line = ", ".join(f"{key} {value:.3g}" for key, value in results[name].items())
            print(f"{name}: {line}", flush=True)
        report(results)


def report(results: dict[str, dict[str, float]]) -> None:
    """Print and record the figures of all parts."""
    for name, figures in results.items():
        for key, value in figures.items():
            figure(value, "dB" if key.split()[0] in NEW_LIGHTS else "", name, key)
    gains = {
        name: [found[f"{light} estimated"] - found[f"{light} captured"] for light in NEW_LIGHTS]
        for name, found in results.items()
    }
    recognised = sum(found["recognised"] for found in results.values())
    summary = {
        "parts": (len(results), ""),
        "parts recognised": (recognised, ""),
        "largest colour error": (max(found["colour"] for found in results.values()), ""),
        "mean colour error": (np.mean([found["colour"] for found in results.values()]), ""),
        "largest roughness error": (max(found["roughness"] for found in results.values()), ""),
        "mean roughness error": (np.mean([found["roughness"] for found in results.values()]), ""),
        "mean gain": (np.mean(list(gains.values())), "dB"),
        "least gain": (min(map(min, gains.values())), "dB"),
        "parts with colour within 15 %": (sum(found["colour"] <= 0.15 for found in results.values()), ""),
        "parts with roughness within 0.1": (sum(found["roughness"] <= 0.1 for found in results.values()), ""),
        "parts with gain of 5 dB": (sum(min(gain) >= 5 for gain in gains.values()), ""),
        "parts whose true materials gain 5 dB": (
            sum(min(f[f"{one} true"] - f[f"{one} captured"] for one in NEW_LIGHTS) >= 5 for f in results.values()),
            "",
        ),
        "least explained": (min(found["explained"] for found in results.values()), ""),
        "least confidence": (min(found["confidence"] for found in results.values()), ""),
    }
    for key, (value, unit) in summary.items():
        print(f"{key:32s}{value:10.3f} {unit}")
        figure(value, unit, key)


if __name__ == "__main__":
    main()
