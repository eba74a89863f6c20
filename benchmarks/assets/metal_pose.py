"""Pose of the CAD mesh of a photographed metal part, and its effect on the estimated materials.

    python -m benchmarks.assets.metal_pose [--out FOLDER] [--part brass_fitting] [--photos 30] [--width 480]

The part lies on a mat in a room with windows, as in ``benchmarks.assets.materials``. Gaussians are fitted to its
path-traced photographs, and its CAD mesh, in another frame, is registered to them. Materials are estimated with the
mesh in the registered pose, in the pose refined by the masks, and in the true pose. For each pose:

* vertices: mean distance of the vertices from their true positions, as a share of the diagonal;
* surface: mean distance of the surface from the true one, in the same unit; turns of a symmetric part do not count;
* IoU: mean IoU of the silhouettes with the masks of held-out photographs;
* the figures of ``benchmarks.assets.materials``.

FOLDER stores photographs and fit for later runs.
"""

from __future__ import annotations

import argparse
from pathlib import Path

# isort: off
from mitsplat.arrays import Float64Array  # imports mitsplat, which must be imported before Dr.Jit

import numpy as np
import trimesh

# isort: on
from benchmarks.assets.materials import (
    GAUSSIANS,
    NEW_LIGHTS,
    balanced,
    capture_of,
    captured_splats,
    compare,
    mat,
    path_traced,
    placed,
    ring,
    score_new_lights,
    with_true_materials,
)
from benchmarks.assets.refine_mesh import masked
from benchmarks.light.shadow_scenes import ROOT, coverage
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_surface import MeshSurface
from mitsplat.bake.part_shapes import mitsuba_scene
from mitsplat.capture.capture import Capture
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.fit.trainer import fit_capture
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.images.masks import iou
from mitsplat.reconstruct.materials.capture_light import CaptureLight
from mitsplat.reconstruct.materials.estimation import estimate_materials
from mitsplat.reconstruct.pose_refinement import refine_pose
from mitsplat.reconstruct.registration import register_mesh, surface_points
from mitsplat.reconstruct.segment_splats import MaskedView, isolate_object
from mitsplat.runtime.variant import ensure_variant
from scenes.build.parts import PARTS

MILLIMETRE = 1e-3


def poses(capture: Capture, splats: Splats, truth: trimesh.Trimesh) -> dict[str, Float64Array]:
    """Register the mesh from another frame, and return the motions (4, 4) of the true mesh to each pose."""
    drawing_from_true = trimesh.transformations.rotation_matrix(2.0, (1, 2, 3))
    drawing_from_true[:3] /= MILLIMETRE
    drawing = truth.copy().apply_transform(drawing_from_true)
    photos = [photo.read() for photo in capture.training]
    views = [
        MaskedView(photo.camera, pixels.mask)
        for photo, pixels in zip(capture.training, photos, strict=True)
        if pixels.mask is not None
    ]
    points = surface_points(isolate_object(splats, views).splats, [view.camera for view in views])
    registered = register_mesh(drawing, points, MILLIMETRE).splats_from_mesh @ drawing_from_true
    found = refine_pose(truth.copy().apply_transform(registered), views, rigid=True)
    print(found, flush=True)
    return {"registered": registered, "refined": found.motion @ registered, "true": np.eye(4)}


def pose_errors(capture: Capture, truth: trimesh.Trimesh, motion: Float64Array) -> dict[str, float]:
    """Return the errors of a pose."""
    mesh = truth.copy().apply_transform(motion)
    samples = np.asarray(trimesh.sample.sample_surface(mesh, 3000, seed=0)[0])
    shown = masked(mesh, [photo.camera for photo in capture.held_out])
    masks = [photo.read_mask()[0] for photo in capture.held_out]
    overlaps = [iou(one.mask > 0.5, mask > 0.5) for one, mask in zip(shown, masks, strict=True) if mask is not None]
    return {
        "vertices": float(np.linalg.norm(mesh.vertices - truth.vertices, axis=1).mean() / truth.scale),
        "surface": float(DistanceSurface(truth).nearest(samples)[2].mean() / truth.scale),
        "iou": float(np.mean(overlaps)),
    }


def measure(name: str, out: Path, photos: int, width: int, samples: int) -> None:
    """Print and record the figures of all poses."""
    parts, folder = placed(name), out / name
    surface = MeshSurface(parts)
    mesh = trimesh.Trimesh(surface.mesh.vertices, surface.mesh.faces, process=False)
    cameras, lights = ring(mesh, photos, width=width), balanced("interior", out)
    radiance, _ = path_traced(parts, lights, cameras, samples, folder / "photos.npz")
    masks = np.array([coverage(camera, mat(), [parts])[1] >= 0.5 for camera in cameras])
    capture = capture_of(radiance, masks, cameras, folder)
    settings = FitSettings(gaussians=10_000, iterations=1500, max_size=width)
    fit = fit_capture(capture, folder / "fit", settings)
    surfels = place_surfels(mesh, 1.0, GAUSSIANS, np.random.default_rng(0))
    captured, seen = captured_splats(mitsuba_scene(parts, {}), surfels, capture)
    for label, motion in poses(capture, fit.splats, mesh).items():
        figures = pose_errors(capture, mesh, motion)
        found = estimate_materials(capture, mesh.copy().apply_transform(motion), CaptureLight(lights))
        figures |= compare(surface, surfels, seen, found)
        looks = captured, found.apply(captured), with_true_materials(captured, surface, surfels)
        figures |= score_new_lights(parts, mesh, looks, folder, samples)
        print(f"{label}: {', '.join(f'{key} {value:.4g}' for key, value in figures.items())}", flush=True)
        for key, value in figures.items():
            figure(value, "dB" if key.split()[0] in NEW_LIGHTS else "", label, key)


def main() -> None:
    """Parse the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "metal_pose")
    parser.add_argument("--part", choices=PARTS, default="brass_fitting")
    parser.add_argument("--photos", type=int, default=30)
    parser.add_argument("--width", type=int, default=480, help="width of the photographs [px]")
    parser.add_argument("--samples", type=int, default=24, help="paths per pixel of a photograph")
    options = parser.parse_args()
    ensure_variant()
    with recording("assets.metal_pose", parser, options, ignore=("out",)):
        measure(options.part, options.out, options.photos, options.width, options.samples)


if __name__ == "__main__":
    main()
