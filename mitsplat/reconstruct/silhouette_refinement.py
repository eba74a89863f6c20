"""Refinement of a mesh towards silhouettes in photographs, by gradient descent through Mitsuba.

The mesh emits uniformly in front of a black background, so its image is its silhouette. The loss is the squared
difference to the mask. Silhouette gradients come from projective sampling (Zhang et al. 2023, "Projective Sampling for
Differentiable Rendering of Geometry"), Mitsuba's ``prb_projective``. They are smoothed over the surface by "Large Steps
in Inverse Rendering of Geometry" (Nicolet et al. 2021), Mitsuba's ``mi.ad.LargeSteps``.

Mitsuba samples silhouettes of pinhole cameras only. Every mask is therefore resampled, from any lens, to a pinhole
camera at the same position that is directed at the centre of the mesh and fills its picture with the mesh. Rotating a
camera about its centre does not change the visible content, and views of one size share their kernels.

The colours of the photos are not used, because measurements showed no benefit. On a solid whose photos can be explained
by a colour per vertex without light, joint optimisation of colours raised the silhouette error in validation views from
0.35 to 0.37 %. It raised the distance to the solid from 0.035 to 0.037 % (weight 0.3) and 0.042 % (weight 1) of the
diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arguments import check_fields, check_least
from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.progress import Progress
from mitsplat.reconstruct.fold_repair import limit_motion
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped
from mitsplat.runtime.variant import ensure_variant

_VIEW_RADIUS = 1.1
"""Radius that a view shows around the centre of the mesh, in radii of the mesh."""
_VALIDATION_EVERY = 6
"""Interval of the validation views; smaller for few views, so that there are at least two of four and three of more."""
_BATCH = 2
"""Views per step."""
_VALIDATIONS = 10
"""Number of validations."""
_SAMPLES = 4
"""Rays per pixel of a silhouette; validation uses four times as many.

The gradient uses one silhouette sample per pixel of the picture, which is about a hundred per pixel on the silhouette.
"""
_BASE_HEIGHT = 0.005
"""Height above the table up to which vertices belong to the base of the object, in radii."""


@dataclass(frozen=True)
class MeshRefineSettings:
    """Settings of the mesh refinement.

    Attributes:
        steps: Gradient steps of two views each.
        size: Edge of the square pictures to which masks are resampled [px].
        rate: Step size of the optimiser, in radii of the mesh; it falls to zero by the end.
        smoothness: Weight λ of the Laplacian that smooths gradients.
        seed: Seed of view selection and samples; runs with equal seeds agree to the rounding of float32.
    """

    steps: int = 200
    size: int = 400
    rate: float = 2e-3
    smoothness: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        check_least(self, steps=1, size=16)
        for name in ("rate", "smoothness"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name} must be finite and > 0 (got {getattr(self, name)})")


@dataclass(frozen=True, eq=False)
class Refinement:
    """Comparison of silhouettes before and after a refinement with masks that were not fitted.

    Attributes:
        kept: True if the refined mesh or pose was accepted.
        before, after: Mean IoU of the silhouettes with the masks of the validation views. The best result is selected
            by these views, so other views may differ by slightly more. ``after`` is not finite if no result was valid.
        validation_views: Number of validation views; 0 if there were too few views.
    """

    least_views: ClassVar[int]
    kept: bool
    before: float = np.nan
    after: float = np.nan
    validation_views: int = 0

    def __str__(self) -> str:
        """Return the result as one clause."""
        if not self.validation_views:
            return f"rejected (a refinement needs masks from {self.least_views} positions outside the mesh)"
        if not np.isfinite(self.after):
            return "rejected (the refined mesh is invalid)"
        outcome = "accepted" if self.kept else "rejected, as not significantly better"
        return (
            f"{outcome} (IoU with the masks of {self.validation_views} validation photos: {self.before:.4f} before, "
            f"{self.after:.4f} after)"
        )


@dataclass(frozen=True, eq=False)
class RefinedMesh(Refinement):
    """Result of a mesh refinement.

    Attributes:
        mesh: The refined mesh if it was accepted, or the given mesh.
    """

    least_views = 4
    mesh: trimesh.Trimesh = field(kw_only=True)


def refine_mesh(
    mesh: trimesh.Trimesh,
    views: Sequence[MaskedView],
    settings: MeshRefineSettings = MeshRefineSettings(),
    *,
    floor: float | None = None,
    progress: Progress | None = None,
) -> RefinedMesh:
    """Move the vertices of a mesh so that its silhouettes match masks.

    Every sixth view, or more if there are few, is a validation view and is not fitted. The best mesh on the way is
    accepted if its mean IoU with the masks of these views exceeds that of the given mesh by more than its standard
    error. A given mesh that was made from all masks has an advantage. The faces stay the same; no face folds over
    or newly intersects another.

    Args:
        mesh: Mesh close to the masks, in the frame of the cameras.
        views: Cameras of any lens, and their masks.
        settings: Number and size of steps.
        floor: Height z of the table below the object, or None. Vertices on the table stay, and no vertex moves below
            it.
        progress: Called after each step.
    """
    ensure_variant()
    middle = mesh.bounds.mean(axis=0)
    radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max())
    outside = [view for view in views if np.linalg.norm(view.camera.centre - middle) > 1.05 * _VIEW_RADIUS * radius]
    if len(outside) < RefinedMesh.least_views:
        return RefinedMesh(False, mesh=mesh)
    masks = [SquareMask(view, middle, radius, settings.size) for view in outside]
    every = min(_VALIDATION_EVERY, max(2, len(masks) // 3))
    validation = masks[every // 2 :: every]
    training = [mask for mask in masks if mask not in validation]
    start = trimesh.Trimesh((mesh.vertices - middle) / radius, mesh.faces, process=False)
    lowest = -np.inf if floor is None else (floor - middle[2]) / radius
    on_table = np.abs(start.vertices[:, 2] - lowest) < _BASE_HEIGHT

    scene = Silhouettes(start)
    positions, faces = (scene.params[f"mesh.{name}"] for name in ("vertex_positions", "faces"))
    smoothing = mi.ad.LargeSteps(positions, faces, settings.smoothness)
    descent = mi.ad.Adam(lr=settings.rate, uniform=True, params={"latent": smoothing.to_differential(positions)})
    height, fixed = (wrapped(mi.Float, v.astype(np.float32)) for v in (start.vertices[:, 2], on_table))

    def moved() -> mi.Float:
        vertices = dr.unravel(mi.Point3f, smoothing.from_differential(descent["latent"]))
        above = dr.maximum(vertices.z, dr.minimum(height, float(lowest)))
        vertices.z = dr.select(fixed > 0, height, above)
        return dr.ravel(vertices)

    rng = np.random.default_rng(settings.seed)
    before = scene.overlaps(start.vertices, validation)
    refined, after = start.vertices, np.full(len(validation), -np.inf)
    for step in range(settings.steps):
        descent.set_learning_rate(settings.rate * (1 - step / settings.steps))
        chosen = rng.choice(len(training), min(_BATCH, len(training)), replace=False)
        dr.backward(scene.loss(moved(), [training[index] for index in chosen], rng))
        descent.step()
        if (step + 1) % max(1, settings.steps // _VALIDATIONS) == 0 or step + 1 == settings.steps:
            found = limit_motion(start, np.array(dr.detach(moved()), dtype=np.float64).reshape(-1, 3))
            if found is not None and (overlaps := scene.overlaps(found, validation)).mean() > after.mean():
                refined, after = found, overlaps
        if progress is not None:
            progress(step + 1, settings.steps, "refining the mesh")
    kept = is_gain(after - before)
    if kept:
        mesh = trimesh.Trimesh(refined * radius + middle, mesh.faces, process=False)
    return RefinedMesh(kept, float(before.mean()), float(after.mean()), len(validation), mesh=mesh)


def is_gain(gains: Float64Array, least: float = 1.0) -> bool:
    """Return True if the mean of gains (N,) is positive by more than ``least`` standard errors."""
    return bool(np.isfinite(gains).all() and gains.mean() > least * gains.std() / np.sqrt(max(len(gains) - 1, 1)))


class SquareMask:
    """A mask resampled to a pinhole camera that is directed at the bounding ball of the mesh.

    Attributes:
        sensor: Mitsuba's pinhole camera; lengths in radii, relative to the centre.
        focal: Focal length [px].
        mask: Share of each pixel that the object covers, (size * size,).
        known: 1 where the photo shows the pixel, else 0.
    """

    def __init__(self, view: MaskedView, middle: Float64Array, radius: float, size: int) -> None:
        given = view.camera
        distance = float(np.linalg.norm(given.centre - middle))
        half_angle = float(np.arcsin(_VIEW_RADIUS * radius / distance))
        self.focal = 0.5 * size / float(np.tan(half_angle))
        pose = look_at_pose(given.centre, middle, -given.world_from_camera[:3, 1])
        camera = Camera(size, size, self.focal, self.focal, 0.5 * size, 0.5 * size, pose)
        y, x = np.mgrid[:size, :size] + 0.5
        ahead = camera.rays(np.column_stack([x.ravel(), y.ravel()])) @ pose[:3, :3].T
        # Pixel centres are at +0.5 here, but at integers in OpenCV.
        pixels = np.nan_to_num(given.project(given.centre + distance * ahead)[0], nan=-9.0) - 0.5
        known = ((pixels > -0.5) & (pixels < np.array([given.width, given.height]) - 0.5)).all(axis=1)
        x, y = pixels.T.astype(np.float32).reshape(2, size, size)
        mask, known_share = (
            cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for part in (view.mask, view.known.astype(np.float32))
        )
        known &= known_share.ravel() == 1
        self.mask, self.known = (wrapped(mi.Float, v.ravel().astype(np.float32)) for v in (mask, known))
        pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
        pose[:3, 3] = (given.centre - middle) / radius
        box = {"type": "box"}
        film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance", "rfilter": box}
        placed = {"to_world": mi.ScalarTransform4f(pose), "fov": np.degrees(2 * half_angle)}
        self.sensor = mi.load_dict({"type": "perspective", "film": film, **placed})


class Silhouettes:
    """A uniformly emitting mesh with movable vertices."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        properties = mi.Properties()
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "uniform", "value": 1.0}})
        self.scene = ray_scene({"mesh": plain_mesh(mesh, properties)})
        # Only directly visible emission matters; inside a silhouette the image is constant.
        self.integrator = mi.load_dict({"type": "prb_projective", "max_depth": 1, "sppc": 0, "sppi": 0})
        self.integrator.sample_border_warning = False
        self.params = mi.traverse(self.scene)

    def loss(self, vertices: mi.Float, views: Sequence[SquareMask], rng: np.random.Generator) -> mi.Float:
        """Return the mean squared difference between silhouettes and masks, with gradients."""
        self.set_vertices(vertices)
        total = mi.Float(0)
        for view in views:
            shown = self.render(view, _SAMPLES, int(rng.integers(2**31)), self.params)
            total += dr.mean(dr.square(shown - view.mask) * view.known)
        return total

    def overlaps(self, vertices: Float64Array, views: Sequence[SquareMask]) -> Float64Array:
        """Return the IoU (V,) of silhouette and mask in V views, by pixel coverage, for vertices (N, 3)."""
        self.set_vertices(wrapped(mi.Float, vertices.ravel().astype(np.float32)))
        overlaps = []
        for view in views:
            shown = self.render(view, 4 * _SAMPLES, 0)
            both, either = (dr.sum(pick(shown, view.mask) * view.known)[0] for pick in (dr.minimum, dr.maximum))
            overlaps.append(both / max(either, 1e-9))
        return np.array(overlaps, dtype=np.float64)

    def set_vertices(self, vertices: mi.Float) -> None:
        """Set the vertex positions."""
        self.params["mesh.vertex_positions"] = vertices
        self.params.update()

    def render(self, view: SquareMask, samples: int, seed: int, params: mi.SceneParameters | None = None) -> mi.Float:
        """Render the share of each pixel that the mesh covers, (size * size,), with gradients to ``params``."""
        picture = mi.render(self.scene, params, view.sensor, self.integrator, seed=seed, spp=samples, spp_grad=1)
        return picture.array
