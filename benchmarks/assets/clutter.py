"""Reconstruction of a known solid from casual photographs without a board, against the truth.

    python -m benchmarks.assets.clutter OUT [--views 60] [--width 640] [--iterations 3000] [--ground cushion] [--beside]
        [--known-poses]

The solid of ``benchmarks.assets.known`` stands on a crumpled cloth among other objects in a room. The photographs are
hand-held, with a drifting exposure. ``mitsplat asset --size`` makes an asset of the path-traced images without a hint.
With ``--beside``, another object is at the point that the cameras look at, and the solid is picked by one click. The
exit status is 1 if a figure misses its threshold. OUT stores the photos and the stages of the asset for later runs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from benchmarks.assets.judged import on_truth, tell_wanted
from benchmarks.assets.known import chamfer, solid, speckled
from benchmarks.assets.photographing import by_name, paint, photograph, show_where, speckle
from benchmarks.record import recording
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo, known_where
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL
from mitsplat.images.masks import iou
from mitsplat.reconstruct.asset_evaluation import show_asset
from mitsplat.reconstruct.pipeline.asset_pipeline import asset_from_photos
from mitsplat.reconstruct.reconstruct import AssetJob, ReconstructSettings
from mitsplat.runtime.variant import ensure_variant

WANTED = {
    "photos kept, %": 95.0,
    "worst camera, % of its distance": 1.0,
    "least IoU of a mask with the truth": 0.9,
    "mean IoU of the masks with the truth": 0.97,
    "scale error, %": 0.5,
    "Chamfer, % of the diagonal": 0.5,
    "PSNR of the object in held-out photos, dB": 30.0,
}
LEAST = {
    "photos kept, %",
    "least IoU of a mask with the truth",
    "mean IoU of the masks with the truth",
    "PSNR of the object in held-out photos, dB",
}
"""Figures with a minimum; for all others, less is better."""

CLOTH = 1.1
"""Edge of the cloth [m]."""


def walk(count: int, width: int, seed: int = 11) -> list[Camera]:
    """Return the cameras of hand-held photos, 4:3: three rounds at rising heights, with errors in roll and aim."""
    rng = np.random.default_rng(seed)
    cameras = []
    for number in range(count):
        share = number / count
        turn = 2 * np.pi * 3 * share + rng.normal(0, 0.04)
        height = np.radians(
            np.interp(share, [0, 0.33, 0.34, 0.66, 0.67, 1], [16, 18, 30, 34, 48, 54]) + rng.normal(0, 1.5)
        )
        distance = 0.36 + 0.03 * np.sin(5 * share * np.pi) + rng.normal(0, 0.008)
        place = distance * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        target = np.array([0, 0, 0.025]) + rng.normal(0, 0.008, 3)
        up = np.array([0, 0, 1]) + rng.normal(0, 0.03, 3)
        cameras.append(Camera.look_at(place, target, up=up, width=width, height=width * 3 // 4, fov_x=52))
    return cameras


def ground(kind: str = "cloth", seed: int = 4) -> trimesh.Trimesh:
    """Return the ground [m], one of :data:`GROUNDS`, flattened below the solid."""
    rng = np.random.default_rng(seed)
    cells = 441
    axis = np.linspace(-CLOTH / 2, CLOTH / 2, cells)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    away = np.hypot(x / 0.075, y / 0.06)
    pressed = np.clip((away - 0.75) / 0.6, 0, 1) ** 2 * (3 - 2 * np.clip((away - 0.75) / 0.6, 0, 1))
    height = GROUNDS[kind](x, y, rng) * pressed - 0.0003
    vertices = np.column_stack([x.ravel(), y.ravel(), height.ravel()])
    corner = (np.arange(cells - 1)[:, None] * cells + np.arange(cells - 1)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + cells, corner + cells + 1]),
            np.column_stack([corner, corner + cells + 1, corner + 1]),
        ]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


def _cloth(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the heights of folds of up to a centimetre."""
    bumps = sum(
        weight * gaussian_filter(rng.normal(size=x.shape), sigma, mode="wrap") * sigma
        for sigma, weight in ((4, 0.25), (9, 0.7), (22, 1.0))
    )
    ridged = 1 - np.abs(bumps / np.abs(bumps).max() * 3) % 1.0
    return np.asarray(0.016 * (gaussian_filter(ridged, 1.2) - 0.6) + 0.008 * bumps / np.abs(bumps).max())


def _cushion(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the heights of a dome that falls by 8 cm, with a bulge around the solid."""
    away = np.hypot(x, y)
    return np.asarray(0.08 * (np.exp(-((away / 0.4) ** 2)) - 1) + 0.012 * np.exp(-(((away - 0.12) / 0.04) ** 2)))


def _gravel(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the heights of stones of one and two centimetres."""
    stones = gaussian_filter(rng.normal(size=x.shape), 2.5, mode="wrap")
    return np.asarray(0.005 * stones / np.abs(stones).max() * 2)


def _ledge(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the heights of a table that ends 15 cm away, and of the bench 8 cm below."""
    return np.asarray(np.where(x + 0.3 * y > 0.15, -0.08, 0.0))


GROUNDS: Mapping[str, Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]] = {
    "cloth": _cloth,
    "table": lambda x, y, rng: np.zeros_like(x),
    "cushion": _cushion,
    "gravel": _gravel,
    "ledge": _ledge,
}
"""Height functions of the grounds at x and y [m]."""


def coloured(mesh: trimesh.Trimesh, colours: np.ndarray) -> Any:
    """Return a matt mesh with a colour on each vertex (N, 3)."""
    from mitsplat.renderer.rays.device_arrays import plain_mesh

    properties = mi.Properties()
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}})
    shape = plain_mesh(mesh, properties)
    shape.add_attribute("vertex_color", 3, np.ravel(np.clip(colours, 0.02, 0.9)).astype(np.float32))
    return shape


def woven(mesh: trimesh.Trimesh, seed: int = 8) -> np.ndarray:
    """Return the colours (N, 3) of the cloth's vertices: a faded print with a weave."""
    rng = np.random.default_rng(seed)
    places = (mesh.vertices[:, :2] + CLOTH / 2) / CLOTH
    shade = np.zeros((len(places), 3))
    for cells, weight in ((12, 0.35), (40, 0.3), (150, 0.35)):
        grid = rng.random((cells + 2, cells + 2, 3))
        shade += weight * np.stack([map_coordinates(grid[..., c], cells * places.T, order=1) for c in range(3)], axis=1)
    return np.array([0.55, 0.5, 0.62]) * (0.35 + 1.1 * shade)


def mottled(mesh: trimesh.Trimesh, colour: tuple[float, float, float], seed: int) -> Any:
    """Return a mesh with paint that is worn off in places."""
    fine = mesh.subdivide_to_size(0.004)
    rng = np.random.default_rng(seed)
    places = (fine.vertices - fine.bounds[0]) / 0.012
    grid = rng.random(np.ceil(places.max(axis=0)).astype(int) + 2)
    worn = map_coordinates(grid, places.T, order=1)[:, None]
    return coloured(fine, np.array(colour) * (0.3 + 1.1 * worn))


def things(cloth: trimesh.Trimesh, beside: bool) -> dict[str, Any]:
    """Return the other objects on the cloth, from 0.17 m away; with ``beside``, one in the cameras' focus."""
    box, ball, can = trimesh.creation.box, trimesh.creation.icosphere, trimesh.creation.cylinder
    made = [
        (box((0.10, 0.07, 0.04)), (0.20, 0.05), 0.6, (0.7, 0.2, 0.15)),
        (can(0.035, 0.13, sections=48), (-0.17, 0.44), 0.0, (0.2, 0.45, 0.7)),
        (ball(4, 0.028), (-0.19, -0.06), 0.0, (0.8, 0.7, 0.2)),
        (box((0.18, 0.12, 0.03)), (0.06, -0.22), 0.3, (0.25, 0.55, 0.3)),
        (box((0.05, 0.05, 0.18)), (0.40, 0.27), 1.0, (0.6, 0.6, 0.6)),
        (can(0.05, 0.035, sections=48), (-0.11, 0.19), 0.0, (0.5, 0.3, 0.5)),
        (box((0.14, 0.2, 0.1)), (-0.43, -0.2), 0.4, (0.3, 0.3, 0.6)),
    ]
    if beside:
        made.append((can(0.03, 0.08, sections=48), (0.02, 0.115), 0.0, (0.75, 0.5, 0.2)))
    tree = cloth.vertices[:, :2]
    shapes = {}
    for number, (mesh, (x, y), turn, colour) in enumerate(made):
        under = np.linalg.norm(tree - (x, y), axis=1) < 0.4 * np.linalg.norm(mesh.extents[:2])
        lift = float(np.quantile(cloth.vertices[under, 2], 0.7)) - mesh.bounds[0, 2]
        mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        mesh.apply_translation((x, y, lift))
        shapes[f"thing{number}"] = mottled(mesh, colour, 20 + number)
    return shapes


def room(beside: bool = False, kind: str = "cloth") -> dict[str, Any]:
    """Return a room with a cloth on a bed, wallpaper, a window and objects on the cloth, without the solid.

    Any of :data:`GROUNDS` can replace the cloth.
    """
    ensure_variant()
    rng = np.random.default_rng(5)
    cloth = ground(kind)
    place = mi.ScalarTransform4f()
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.55}},
        "lamp": {
            "type": "sphere",
            "center": [1.0, -0.8, 1.8],
            "radius": 0.35,
            "light": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}},
        },
        "cloth": coloured(cloth, woven(cloth)),
        "floor": {
            "type": "rectangle",
            "to_world": place.translate([0, 0, -0.5]).scale([3, 3, 1]),
            "bsdf": paint(speckle(rng, 50, (0.45, 0.32, 0.2))),
        },
        "bed": {
            "type": "cube",
            "to_world": place.translate([0, 0, -0.25 + min(-0.02, cloth.bounds[0, 2] - 0.005)]).scale([0.7, 0.7, 0.25]),
            "bsdf": paint(speckle(rng, 30, (0.6, 0.6, 0.65))),
        },
    }
    for number in range(4):
        turn = place.rotate([0, 0, 1], 90 * number).translate([2.2, 0, 0.3]).rotate([0, 1, 0], -90)
        scene[f"wall{number}"] = {
            "type": "rectangle",
            "to_world": turn.scale([1.0, 2.2, 1]),
            "bsdf": paint(
                speckle(rng, 24, [(0.6, 0.5, 0.4), (0.4, 0.5, 0.6), (0.5, 0.6, 0.5), (0.6, 0.6, 0.4)][number])
            ),
        }
    return scene | things(cloth, beside)


def exposures(count: int, seed: int = 2) -> np.ndarray:
    """Return gains (count, 3) of automatic exposure and white balance that change with every photo."""
    rng = np.random.default_rng(seed)
    drift = 0.12 * np.sin(np.linspace(0, 5, count)) + rng.normal(0, 0.03, count)
    return np.exp(drift[:, None] + np.outer(0.03 * np.sin(np.linspace(1, 7, count)), [1, 0, -1]))


def linear(path: Path) -> np.ndarray:
    """Return the linear light of a photo, (H, W, 3)."""
    return np.asarray((np.array(Image.open(path).convert("RGB")) / 255) ** 2.2)


def overlap(photo: Photo, truth: np.ndarray) -> float:
    """Return the IoU of a photo's mask with the truth, outside of pixels where another object may hide the solid."""
    known = known_where(photo.read_mask()[1], photo.camera)
    return iou((photo.read_mask()[0] >= 0.5) & known, truth & known)


def compare(asset: Path, truth: Mapping[str, Camera], mesh: trimesh.Trimesh, out: Path) -> dict[str, float]:
    """Compute the errors of an asset and its capture, aligned by the cameras' similarity transform.

    Splats are compared with held-out photos where the true solid is visible. They are composed over the room without
    the
    solid, stored in ``out/behind``, because pixels of the outline show both. The photos' true exposures are inverted,
    and
    each channel of the splats has one gain for all photos.
    """
    made = Asset.load(asset)
    moved, truth_from_asset, residuals = on_truth(asset, truth)
    scale = float(np.cbrt(np.linalg.det(truth_from_asset[:3, :3])))
    surface = trimesh.load_mesh(asset / "mesh.ply")
    surface.apply_transform(truth_from_asset)
    gains = dict(zip(truth, exposures(len(truth)), strict=True))
    parts = []
    views = show_asset(made.splats, None, [photo.camera for photo in moved.held_out])
    for photo, view, empty in zip(moved.held_out, views, sorted((out / "behind").iterdir()), strict=True):
        shown = np.array(Image.open(out / "truth" / photo.name)) > 0
        seen, behind = (linear(path)[shown] for path in (out / "photos" / photo.name, empty))
        cover = view.alpha[shown][:, None]
        own = cover * np.clip(view.render[shown] / np.maximum(cover, 1e-6), 0, 1) ** 2.2
        parts.append((seen / gains[photo.name], own, (1 - cover) * behind))
    seen, own, through = (np.concatenate(part) for part in zip(*parts, strict=True))
    gain = ((seen - through) * own).sum(axis=0) / (own**2).sum(axis=0)
    errors = [
        ((one ** (1 / 2.2) - np.clip(gain * other + rest, 0, 1) ** (1 / 2.2)) ** 2).mean() for one, other, rest in parts
    ]
    shares = [overlap(photo, np.array(Image.open(out / "truth" / photo.name)) > 0) for photo in moved.photos]
    distances = np.linalg.norm([truth[photo.name].centre for photo in moved.photos], axis=1)
    return {
        "photos kept, %": 100 * len(moved.photos) / len(truth),
        "worst camera, % of its distance": 100 * float((np.linalg.norm(residuals, axis=1) / distances).max()),
        "least IoU of a mask with the truth": min(shares),
        "mean IoU of the masks with the truth": float(np.mean(shares)),
        "scale error, %": 100 * abs(scale - 1),
        "Chamfer, % of the diagonal": 100 * chamfer(surface, mesh),
        "PSNR of the object in held-out photos, dB": float(np.mean([-10 * np.log10(error) for error in errors])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--max-size", type=int, default=800)
    parser.add_argument("--ground", choices=list(GROUNDS), default="cloth", help="ground below the solid")
    parser.add_argument("--beside", action="store_true", help="another object in the cameras' focus, and one click")
    parser.add_argument("--known-poses", action="store_true", help="give the true cameras, in unknown units")
    args = parser.parse_args()
    with recording("assets.clutter", parser, args, ignore=("out",)):
        missed = measure(args)
    sys.exit(missed > 0)


def measure(args: argparse.Namespace) -> int:
    """Print and record the figures; return the number of missed thresholds."""
    views, photos, mesh = walk(args.views, args.width), args.out / "photos", solid()
    made, marker = (
        json.dumps([args.views, args.width, args.samples, args.beside, args.ground]),
        args.out / "photos.json",
    )
    if not (marker.exists() and marker.read_text() == made):
        shutil.rmtree(photos, ignore_errors=True)
        scene = room(args.beside, args.ground) | {"solid": speckled(mesh)}
        photograph(scene, views, photos, samples=args.samples, noise=0.008, gains=exposures(len(views)))
        show_where(scene, "solid", views, args.out / "truth")
        marker.write_text(made)
    named, poses = by_name(views), None
    if args.known_poses:
        poses = args.out / "transforms.json"
        poses.write_text(json.dumps(transforms(named)))
    picks: tuple[str, ...] = ()
    if args.beside:
        name, camera = next(iter(named.items()))
        x, y = camera.project(np.array([[-0.01, 0.0, 0.07]]))[0][0]
        picks = (f"{name}:{x:.0f},{y:.0f}",)

    def tell(done: int, total: int, text: str) -> None:
        if done == total:
            print(f"  {text}: {total}", file=sys.stderr)

    done = asset_from_photos(
        photos,
        args.out / "asset",
        AssetJob(name="clutter", settings=ReconstructSettings(size=float(mesh.extents.max()))),
        capture=CaptureSettings(poses=poses, picks=picks),
        fit=FitSettings(gaussians=args.gaussians, iterations=args.iterations, max_size=args.max_size),
        progress=tell,
    )
    for sentence in done.verdict.misses():
        print(f"  verdict: {sentence}", file=sys.stderr)
    behind = args.out / "behind"
    shutil.rmtree(behind, ignore_errors=True)
    held_out = [named[photo.name] for photo in Capture.load(args.out / "asset" / "capture").held_out]
    photograph(room(args.beside, args.ground), held_out, behind, samples=args.samples, noise=0.0)
    return tell_wanted(compare(args.out / "asset", named, mesh, args.out), WANTED, LEAST)


def transforms(views: Mapping[str, Camera]) -> dict[str, Any]:
    """Return cameras in the format of ``transforms.json``."""
    one = next(iter(views.values()))
    frames = [
        {"file_path": name, "transform_matrix": (camera.world_from_camera @ OPENCV_FROM_OPENGL).tolist()}
        for name, camera in views.items()
    ]
    return {
        "fl_x": one.fx,
        "fl_y": one.fy,
        "cx": one.cx,
        "cy": one.cy,
        "w": one.width,
        "h": one.height,
        "frames": frames,
    }


if __name__ == "__main__":
    main()
