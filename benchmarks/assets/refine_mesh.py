"""Accuracy gain of ``mitsplat mesh --refine`` on the mesh of a known solid, with true and with wrong masks.

    python -m benchmarks.assets.refine_mesh [--wrong 1.5] [--views 48] [--width 480] [--steps 200] [--smoothness 5]

Gaussians lie on the solid of ``benchmarks.assets.known``. The outlines of its masks are displaced by a standard
deviation of ``--wrong`` pixels, independently in every view. Every eighth view is held out, with its true mask.
"""

from __future__ import annotations

import argparse
import time

import cv2
import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from benchmarks.assets.known import chamfer, solid
from benchmarks.record import figure, recording
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import iou
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings, refine_mesh
from mitsplat.reconstruct.surface import SurfaceSettings, reconstruct_surface
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene
from mitsplat.runtime.variant import ensure_variant

WAVE = 8.0
"""Correlation length of the displacement of outlines [px]."""


def cameras(count: int, width: int, middle: np.ndarray) -> list[Camera]:
    """Return cameras evenly all around the solid, 4:3."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    around = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    return [Camera.look_at(middle + 0.35 * way, middle, width=width, height=width * 3 // 4, fov_x=28) for way in around]


def masked(mesh: trimesh.Trimesh, cameras: list[Camera], finer: int = 4) -> list[MaskedView]:
    """Return the masks of the cameras, traced with ``finer`` squared samples per pixel."""
    ensure_variant()
    scene = ray_scene({"mesh": plain_mesh(mesh)})
    views = []
    for camera in cameras:
        fine = camera.resized(finer * camera.width, finer * camera.height)
        y, x = np.mgrid[: fine.height, : fine.width] + 0.5
        ahead = fine.rays(np.column_stack([x.ravel(), y.ravel()])) @ camera.world_from_camera[:3, :3].T
        ray = mi.Ray3f(mi.Point3f(camera.centre), mi.Vector3f(np.ascontiguousarray(ahead.T, dtype=np.float32)))
        hit = np.array(scene.ray_test(ray)).reshape(camera.height, finer, camera.width, finer)
        views.append(MaskedView(camera, hit.mean(axis=(1, 3)).astype(np.float32)))
    return views


def wavered(view: MaskedView, pixels: float, rng: np.random.Generator) -> MaskedView:
    """Displace the outline of a mask by a standard deviation of ``pixels``."""
    inside = (view.mask > 0).astype(np.uint8)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    noise = gaussian_filter(rng.normal(size=depth.shape), WAVE)
    return MaskedView(view.camera, (depth > pixels * noise / noise.std()).astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wrong", type=float, default=0.0)
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--steps", type=int, default=MeshRefineSettings.steps)
    parser.add_argument("--smoothness", type=float, default=MeshRefineSettings.smoothness)
    args = parser.parse_args()
    with recording("assets.refine_mesh", parser, args):
        measure(args)


def measure(args: argparse.Namespace) -> None:
    ensure_variant()
    rng = np.random.default_rng(0)
    truth = solid()
    points = place_surfels(truth, 1.0, 6000, rng)
    splats = Splats(
        points.points, points.quats, points.scales, np.full(len(points), 0.98), np.zeros((len(points), 1, 3))
    )
    true = masked(truth, cameras(args.views, args.width, truth.bounds.mean(axis=0)), 1)
    held = true[::8]
    views = [wavered(view, args.wrong, rng) if args.wrong else view for index, view in enumerate(true) if index % 8]
    mesh = reconstruct_surface(splats, [v.camera for v in views], [v.mask for v in views], SurfaceSettings(), floor=0.0)

    def tell(name: str, mesh: trimesh.Trimesh) -> None:
        shown = masked(mesh, [view.camera for view in held], 1)
        overlap = np.mean([iou(one.mask > 0, view.mask > 0) for one, view in zip(shown, held, strict=True)])
        distance = chamfer(mesh, truth)
        figure(len(mesh.faces), "", name.partition(",")[0], "faces")
        figure(100 * distance, "%", name.partition(",")[0], "chamfer")
        figure(overlap, "", name.partition(",")[0], "iou")
        print(
            f"{name}: Chamfer {distance:.4%} of the diagonal, IoU with true held-out masks {overlap:.4f}",
            flush=True,
        )

    tell(f"reconstructed, {len(mesh.faces)} faces", mesh)
    began = time.perf_counter(), time.process_time()
    settings = MeshRefineSettings(steps=args.steps, smoothness=args.smoothness)
    found = refine_mesh(mesh, views, settings, floor=0.0)
    seconds = time.perf_counter() - began[0], time.process_time() - began[1]
    figure(seconds[1], "s", "cpu")
    figure(str(found), "", "verdict")
    print(f"{found} ({seconds[0]:.0f} s, {seconds[1]:.0f} CPU s)")
    tell("refined", found.mesh)


if __name__ == "__main__":
    main()
