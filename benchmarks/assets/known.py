"""Reconstruction of a solid with known shape, colours, board and cameras from photographs, against the truth.

    python -m benchmarks.assets.known OUT [--views 60] [--width 1200] [--iterations 3000]

The solid, a ball and a box with a pocket, stands on a ChArUco board and is path-traced with sensor noise. ``mitsplat
asset`` makes an asset of the images, which is dropped into a scene and rendered. The exit status is 1 if a figure
misses its threshold. OUT stores the stages of the asset for later runs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import map_coordinates

from benchmarks.assets import photographing
from benchmarks.assets.judged import tell_wanted
from benchmarks.assets.photographing import Sensors, by_name, paint, photograph, speckle
from benchmarks.record import figure, recording
from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.boards.targets import Board
from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.dataset.write import write_dataset
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.images.masks import iou
from mitsplat.reconstruct.pipeline.asset_pipeline import asset_from_photos
from mitsplat.reconstruct.reconstruct import AssetJob
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.loading.scene_loading import load_scene

BOARD = Board(7, 5, 0.035)

WANTED = {
    "photos kept, %": 95.0,
    "worst camera, % of its distance": 1.0,
    "least IoU of a mask with the truth": 0.95,
    "mean IoU of the masks with the truth": 0.97,
    "scale error, %": 0.2,
    "table normal, degrees": 0.1,
    "Chamfer, % of the diagonal": 0.3,
    "shift of mesh and splats, % of the diagonal": 0.2,
    "held-out PSNR, dB": 32.0,
    "instances in the rendered frame": 1,
}
LEAST = {
    "photos kept, %",
    "least IoU of a mask with the truth",
    "mean IoU of the masks with the truth",
    "held-out PSNR, dB",
    "instances in the rendered frame",
}
"""Figures with a minimum; for all others, less is better."""


def solid() -> trimesh.Trimesh:
    """Return a ball and a box, with a pocket in the ball, standing on z = 0 [m]."""
    ball = trimesh.creation.icosphere(4, 0.045)
    box = trimesh.creation.box((0.06, 0.04, 0.07), trimesh.transformations.translation_matrix((0.035, 0.0, 0.0)))
    pocket = trimesh.creation.cylinder(
        0.018, 0.04, transform=trimesh.transformations.translation_matrix((-0.01, 0, 0.045))
    )
    under = trimesh.creation.box((0.3, 0.3, 0.1), trimesh.transformations.translation_matrix((0, 0, -0.085)))
    whole = trimesh.boolean.union([ball, box], engine="manifold")
    mesh = trimesh.boolean.difference([whole, pocket, under], engine="manifold")
    mesh.apply_translation((-0.01, 0.0, -mesh.bounds[0, 2]))
    return mesh


def cameras(count: int, width: int) -> list[Camera]:
    """Return cameras on three rings around the solid, in alternation, 4:3, that see the solid and most of the board."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights, radii = np.resize([0.10, 0.20, 0.30], count), np.resize([0.34, 0.29, 0.20], count)
    places = np.column_stack([radii * np.cos(turns), radii * np.sin(turns), heights])
    return [Camera.look_at(place, (0, 0, 0.025), width=width, height=width * 3 // 4, fov_x=42) for place in places]


def table_scene(board: Board, rng: np.random.Generator) -> dict[str, Any]:
    """Return a scene of a board at z = 0, centred on the origin, on a speckled table under a lamp and a uniform sky."""
    ensure_variant()
    drawn = board.draw(60).astype(np.float32) / 255
    sheet = np.array([board.columns, board.rows]) * board.square / 2
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.8}},
        "lamp": {
            "type": "sphere",
            "center": [0.4, -0.3, 0.9],
            "radius": 0.15,
            "light": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
        },
        "board": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale([float(sheet[0]), float(sheet[1]), 1]),
            "bsdf": paint(np.repeat(0.05 + 0.75 * drawn[..., None], 3, axis=2)),
        },
        "table": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -0.0005]).scale([0.5, 0.5, 1]),
            "bsdf": paint(speckle(rng, 40, (0.5, 0.45, 0.4))),
        },
    }


def speckled(mesh: trimesh.Trimesh, *, contrast: float = 1.6, finish: Mapping[str, Any] | None = None) -> Any:
    """Return the solid with speckles of 3 and 10 mm on its vertices, matt or with a principled BSDF's ``finish``."""
    from mitsplat.renderer.rays.device_arrays import plain_mesh

    fine = mesh.subdivide_to_size(0.0012)
    fine.update_faces(fine.nondegenerate_faces())
    rng = np.random.default_rng(3)
    shade = np.zeros((len(fine.vertices), 3))
    for size in (0.003, 0.01):
        places = (fine.vertices - fine.bounds[0]) / size
        grid = rng.random((*np.ceil(places.max(axis=0)).astype(int) + 2, 3))
        shade += 0.5 * np.stack([map_coordinates(grid[..., c], places.T, order=1) for c in range(3)], axis=1)
    properties = mi.Properties()
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    matt = {"type": "diffuse", "reflectance": colour}
    properties["bsdf"] = mi.load_dict(
        matt if finish is None else {"type": "principled", "base_color": colour, **finish}
    )
    shape = plain_mesh(fine, properties)
    painted = np.clip(0.5 + contrast * (shade - 0.5), 0.03, 0.9)
    shape.add_attribute("vertex_color", 3, np.ravel(painted).astype(np.float32))
    return shape


def compare(asset: Path, truth: Mapping[str, Camera], mesh: trimesh.Trimesh) -> dict[str, float]:
    """Compute the errors of an asset and its capture."""
    capture = Capture.load(asset / "capture")
    found = np.array([photo.camera.centre for photo in capture.photos])
    true = np.array([truth[photo.name].centre for photo in capture.photos])
    matrix, residuals = fit_similarity(found, true)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    pose = np.eye(4)
    pose[:3, :3] = matrix[:3, :3] / scale
    pose[:3, 3] = true.mean(axis=0) - pose[:3, :3] @ found.mean(axis=0)
    made = trimesh.load_mesh(asset / "mesh.ply")
    made.apply_transform(pose)
    verdict = json.loads((asset / "verdict.json").read_text())
    overlaps = mask_overlaps(capture, truth, mesh)
    return {
        "photos kept, %": 100 * len(capture.photos) / len(truth),
        "worst camera, % of its distance": 100
        * float((np.linalg.norm(residuals, axis=1) / np.linalg.norm(true, axis=1)).max()),
        "least IoU of a mask with the truth": min(overlaps),
        "mean IoU of the masks with the truth": float(np.mean(overlaps)),
        "scale error, %": 100 * abs(scale - 1),
        "table normal, degrees": float(np.degrees(np.arccos(np.clip(pose[2, 2], -1, 1)))),
        "Chamfer, % of the diagonal": 100 * chamfer(made, mesh),
        "shift of mesh and splats, % of the diagonal": 100 * float(verdict["offset"]),
        "held-out PSNR, dB": float(verdict["psnr"]),
    }


def chamfer(one: trimesh.Trimesh, truth: trimesh.Trimesh, samples: int = 20_000) -> float:
    """Return the symmetric mean distance between two surfaces, as a share of the true diagonal."""
    there = np.abs(DistanceSurface(truth).signed_distances(np.asarray(one.sample(samples, seed=1)))).mean()
    back = np.abs(DistanceSurface(one).signed_distances(np.asarray(truth.sample(samples, seed=2)))).mean()
    return float(there + back) / 2 / float(truth.scale)


def mask_overlaps(capture: Capture, truth: Mapping[str, Camera], mesh: trimesh.Trimesh) -> list[float]:
    """Return the IoU of each photo's mask with the true silhouette."""
    from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene

    solid = ray_scene({"solid": plain_mesh(mesh, mi.Properties())})
    depths = mi.load_dict({"type": "aov", "aovs": "depth:depth"})
    overlaps, sensors = [], Sensors()
    for photo in capture.photos:
        _, alpha, _ = photo.read()
        true = np.array(mi.render(solid, integrator=depths, sensor=sensors.like(truth[photo.name]), spp=1))[..., -1] > 0
        overlaps.append(0.0 if alpha is None else iou(alpha >= 0.5, true))
    return overlaps


def drop(asset: Path, out: Path) -> int:
    """Return the number of instances in a frame of a scene with the dropped asset."""
    scene = {
        "name": "known",
        "objects": [{"asset": str(asset.resolve())}],
        "shapes": [{"name": "table", "box": {"size": [1, 1, 0.05], "position": [0, 0, -0.025]}}],
        "region": {"min": [-0.12, -0.12, 0.05], "max": [0.12, 0.12, 0.25]},
        "camera": {"kind": "orbit", "target": [0, 0, 0.02], "radius": 0.4, "height": 0.3},
        "output": {"width": 320, "height": 240, "layouts": 1, "views": 1, "formats": ["coco"]},
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "scene.yaml").write_text(json.dumps(scene))
    path = write_dataset(load_scene(out / "scene.yaml", allow_outside=True), out / "frames", overwrite=True).path
    record = json.loads((path / "manifest.jsonl").read_text().splitlines()[0])
    return len(record["labels"]["instances"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--width", type=int, default=1200)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--max-size", type=int, default=800)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant, such as cuda_ad_rgb")
    args = parser.parse_args()
    mi.set_variant(args.variant)
    with recording("assets.known", parser, args, ignore=("out",), gpu=args.variant.startswith("cuda")):
        missed = measure(args)
    sys.exit(missed > 0)


def measure(args: argparse.Namespace) -> int:
    """Print and record the figures; return the number of missed thresholds."""
    mesh, views, photos = solid(), cameras(args.views, args.width), args.out / "photos"
    ensure_variant()
    scene = table_scene(BOARD, np.random.default_rng(5)) | {"solid": speckled(mesh)}
    source = hashlib.sha256(b"".join(Path(str(module)).read_bytes() for module in (__file__, photographing.__file__)))
    marker, made = args.out / "photos.json", json.dumps([args.views, args.width, args.samples, source.hexdigest()])
    if not (marker.exists() and marker.read_text() == made):
        shutil.rmtree(photos, ignore_errors=True)
        photograph(scene, views, photos, samples=args.samples)
        marker.write_text(made)
    truth = by_name(views)
    fit = FitSettings(gaussians=args.gaussians, iterations=args.iterations, max_size=args.max_size)

    def tell(done: int, total: int, text: str) -> None:
        if done == total:
            print(f"  {text}: {total}", file=sys.stderr)

    asset = args.out / "asset"
    job = AssetJob(name="known")
    done = asset_from_photos(photos, asset, job, capture=CaptureSettings(board=BOARD), fit=fit, progress=tell)
    found = compare(asset, truth, mesh)
    found["instances in the rendered frame"] = drop(asset, args.out / "dropped")
    print(
        f"{done.verdict.photos} of {args.views} photos, {done.verdict.gaussians} Gaussians, {done.verdict.faces} faces"
    )
    for count, what in (
        (args.views, "views"),
        (done.verdict.photos, "photos"),
        (done.verdict.gaussians, "gaussians"),
        (done.verdict.faces, "faces"),
    ):
        figure(count, "", what)
    return tell_wanted(found, WANTED, LEAST)


if __name__ == "__main__":
    main()
