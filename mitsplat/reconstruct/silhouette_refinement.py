"""A mesh closer to the outlines that photographs show, by gradient descent through Mitsuba.

The mesh shines evenly before a black background, so its picture is its silhouette; the squared difference to the mask
is lowered. How a silhouette moves with the vertices comes from projective sampling (Zhang et al. 2023, "Projective
Sampling for Differentiable Rendering of Geometry"), Mitsuba's ``prb_projective``; the gradients are spread over the
surface by "Large Steps in Inverse Rendering of Geometry" (Nicolet et al. 2021), Mitsuba's ``mi.ad.LargeSteps``.

Mitsuba samples the outlines of pinhole cameras only. Every mask is therefore resampled, through whatever lens it was
taken, to a pinhole at the same place that looks at the middle of the mesh and is filled by it: turning a camera about
its centre changes nothing of what it sees, and views of one size share their kernels.

The photos' colours are left out by measurement. On a solid whose photos a colour per vertex explains without light,
colours that were found together with the vertices raised the error of the silhouettes in views set aside from 0.35 to
0.37 %, and the distance to the solid from 0.035 to 0.037 % (weight 0.3) and 0.042 % (weight 1) of the diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.progress import Progress
from mitsplat.reconstruct.fold_repair import mend_motion
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.renderer.layers import ensure_variant
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped

_ROOM = 1.1
"""Radius that a view shows around the middle of the mesh, in radii of the mesh."""
_VALIDATION_EVERY = 6
"""One view in so many judges what the others ask for, or one in fewer, so that two do of four and three of more."""
_LEAST = 4
"""Views without which nothing is refined."""
_BATCH = 2
"""Views that a step looks at."""
_CHECKS = 10
"""Times that the mesh is judged on the way."""
_SAMPLES = 4
"""Rays per pixel of a silhouette, and four times as many where it judges; its gradient takes one sample of the outline
per pixel of the picture, which is a hundred for each that the outline passes through."""
_STANDING = 0.005
"""Height above the table up to which vertices are what the object stands on, in radii."""


@dataclass(frozen=True)
class MeshRefineSettings:
    """How a mesh is refined.

    Attributes:
        steps: Gradient steps of two views each.
        size: Edge of the square pictures that masks are resampled to [px].
        rate: Step of the optimiser, in radii of the mesh; it falls to nothing by the end.
        smoothness: Weight λ of the Laplacian that gradients are spread by.
        seed: Of the choice of views and of the samples; runs of the same seed agree to the rounding of float32.
    """

    steps: int = 200
    size: int = 400
    rate: float = 2e-3
    smoothness: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("size", 16)):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least} (got {getattr(self, name)})")
        for name in ("rate", "smoothness"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name} must be finite and > 0 (got {getattr(self, name)})")


@dataclass(frozen=True, eq=False)
class RefinedMesh:
    """What came of a refinement.

    Attributes:
        mesh: Refined if that was kept, or as it was.
        kept: Whether it is the refined one.
        before: Mean of 1 - IoU between the silhouettes of the mesh and the masks of the views that judge.
        after: The same of the best refined mesh; infinite if none was valid. These views chose it among those on the
            way, so others may differ by a little more: a verdict judges by photos that had no say.
        judges: Number of these views; 0 if there were too few views to try.
    """

    mesh: trimesh.Trimesh
    kept: bool
    before: float
    after: float
    judges: int

    def __str__(self) -> str:
        """What came of it in one clause."""
        if not self.judges:
            return f"dropped: it takes masks from {_LEAST} places outside of the mesh"
        if not np.isfinite(self.after):
            return "dropped: it broke the mesh"
        fate = "kept" if self.kept else "dropped" if self.after >= self.before else "dropped, as it may be chance"
        return (
            f"{fate}: silhouettes and masks of the {self.judges} photos that decide differ by "
            f"{self.before:.2%} of the object before and by {self.after:.2%} after"
        )


def refine_mesh(
    mesh: trimesh.Trimesh,
    views: Sequence[MaskedView],
    settings: MeshRefineSettings = MeshRefineSettings(),
    *,
    floor: float | None = None,
    progress: Progress | None = None,
) -> RefinedMesh:
    """Move the vertices of a mesh to where masks want its outlines.

    Every sixth view, or more of few, takes no part, and judges: the best mesh on the way is kept if its error there is
    below that of the given one, by more than the standard error of the mean over these views. If the given one was made
    of all masks, it has an advantage. Faces stay what they are, and none turns over or newly passes through another.

    Args:
        mesh: Close to what the masks show, in the frame of the cameras.
        views: Cameras of any lens, and their masks.
        settings: Number and size of steps.
        floor: Height z of the table that the object stands on, if it does: what is on it stays, and nothing sinks.
        progress: Told after every step how many of how many are done.
    """
    ensure_variant()
    middle = mesh.bounds.mean(axis=0)
    radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max())
    outside = [view for view in views if np.linalg.norm(view.camera.centre - middle) > 1.05 * _ROOM * radius]
    if len(outside) < _LEAST:
        return RefinedMesh(mesh, False, np.inf, np.inf, 0)
    outlines = [Outline(view, middle, radius, settings.size) for view in outside]
    every = min(_VALIDATION_EVERY, max(2, len(outlines) // 3))
    judges = range(every // 2, len(outlines), every)
    held = [outlines[index] for index in judges]
    shown = [outline for index, outline in enumerate(outlines) if index not in judges]
    start = trimesh.Trimesh((mesh.vertices - middle) / radius, mesh.faces, process=False)
    lowest = -np.inf if floor is None else (floor - middle[2]) / radius
    standing = np.abs(start.vertices[:, 2] - lowest) < _STANDING

    scene = Silhouettes(start)
    positions, faces = (scene.params[f"mesh.{name}"] for name in ("vertex_positions", "faces"))
    smoothing = mi.ad.LargeSteps(positions, faces, settings.smoothness)
    descent = mi.ad.Adam(lr=settings.rate, uniform=True, params={"latent": smoothing.to_differential(positions)})
    height, stays = (wrapped(mi.Float, v.astype(np.float32)) for v in (start.vertices[:, 2], standing))

    def moved() -> Any:
        vertices = dr.unravel(mi.Point3f, smoothing.from_differential(descent["latent"]))
        above = dr.maximum(vertices.z, dr.minimum(height, float(lowest)))
        vertices.z = dr.select(stays > 0, height, above)
        return dr.ravel(vertices)

    rng = np.random.default_rng(settings.seed)
    before = scene.errors(start.vertices, held)
    refined, after = start.vertices, np.full(len(held), np.inf)
    for step in range(settings.steps):
        descent.set_learning_rate(settings.rate * (1 - step / settings.steps))
        chosen = rng.choice(len(shown), min(_BATCH, len(shown)), replace=False)
        dr.backward(scene.loss(moved(), [shown[index] for index in chosen], rng))
        descent.step()
        if (step + 1) % max(1, settings.steps // _CHECKS) == 0 or step + 1 == settings.steps:
            found = mend_motion(start, np.array(dr.detach(moved()), dtype=np.float64).reshape(-1, 3))
            if found is not None and (errors := scene.errors(found, held)).mean() < after.mean():
                refined, after = found, errors
        if progress is not None:
            progress(step + 1, settings.steps, "refining the mesh")
    gain = before - after
    kept = bool(np.isfinite(gain).all() and gain.mean() > gain.std() / np.sqrt(max(len(held) - 1, 1)))
    if kept:
        mesh = trimesh.Trimesh(refined * radius + middle, mesh.faces, process=False)
    return RefinedMesh(mesh, kept, float(before.mean()), float(after.mean()), len(held))


class Outline:
    """What a mask shows of the unit ball around the mesh, as a pinhole that looks at it sees it.

    Attributes:
        sensor: Mitsuba's pinhole, in radii about the middle.
        focal: Its focal length [px].
        mask: Share of each pixel that is the object, (size * size,).
        known: 1 where the photo shows the pixel, else 0.
    """

    def __init__(self, view: MaskedView, middle: Float64Array, radius: float, size: int) -> None:
        given = view.camera
        distance = float(np.linalg.norm(given.centre - middle))
        fov = 2 * float(np.degrees(np.arcsin(_ROOM * radius / distance)))
        up = -given.world_from_camera[:3, 1]
        camera = Camera.look_at(given.centre, middle, up=up, width=size, height=size, fov_x=fov)
        self.focal = camera.fx
        y, x = np.mgrid[:size, :size] + 0.5
        slopes = camera.ray_slopes(np.column_stack([x.ravel(), y.ravel()]))
        pose = camera.world_from_camera
        ahead = np.column_stack([slopes, np.ones(len(slopes))]) @ pose[:3, :3].T
        # Pixel centres are at +0.5 here, and whole in OpenCV.
        pixels = np.nan_to_num(given.project(given.centre + distance * ahead)[0], nan=-9.0) - 0.5
        known = ((pixels > -0.5) & (pixels < np.array([given.width, given.height]) - 0.5)).all(axis=1)
        x, y = pixels.T.astype(np.float32).reshape(2, size, size)
        mask, told = (
            cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for part in (view.mask, view.known.astype(np.float32))
        )
        known &= told.ravel() == 1
        self.mask, self.known = (wrapped(mi.Float, v.ravel().astype(np.float32)) for v in (mask, known))
        pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
        pose[:3, 3] = (given.centre - middle) / radius
        box = {"type": "box"}
        film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance", "rfilter": box}
        placed = {"to_world": mi.ScalarTransform4f(pose), "fov": fov}
        self.sensor = mi.load_dict({"type": "perspective", "film": film, **placed})


class Silhouettes:
    """A mesh that shines evenly, whose vertices can be moved."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        properties = mi.Properties()
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "uniform", "value": 1.0}})
        self.scene = ray_scene({"mesh": plain_mesh(mesh, properties)})
        # Directly seen light alone; inside a silhouette nothing changes.
        self.integrator = mi.load_dict({"type": "prb_projective", "max_depth": 1, "sppc": 0, "sppi": 0})
        self.integrator.sample_border_warning = False
        self.params = mi.traverse(self.scene)

    def loss(self, vertices: Any, views: Sequence[Outline], rng: np.random.Generator) -> Any:
        """Mean squared difference of silhouettes and masks, with gradients."""
        self.move(vertices)
        total = mi.Float(0)
        for view in views:
            shown = self.shown(view, _SAMPLES, int(rng.integers(2**31)), self.params)
            total += dr.mean(dr.square(shown - view.mask) * view.known)
        return total

    def errors(self, vertices: Float64Array, views: Sequence[Outline]) -> Float64Array:
        """1 - IoU of silhouette and mask, of which every pixel has a share, per view."""
        self.move(wrapped(mi.Float, vertices.ravel().astype(np.float32)))
        errors = []
        for view in views:
            shown = self.shown(view, 4 * _SAMPLES, 0)
            both, either = (dr.sum(pick(shown, view.mask) * view.known)[0] for pick in (dr.minimum, dr.maximum))
            errors.append(1 - both / max(either, 1e-9))
        return np.array(errors, dtype=np.float64)

    def move(self, vertices: Any) -> None:
        """Put the vertices elsewhere."""
        self.params["mesh.vertex_positions"] = vertices
        self.params.update()

    def shown(self, view: Outline, samples: int, seed: int, params: Any = None) -> Any:
        """Share of each pixel that the mesh covers, (size * size,); gradients reach ``params``."""
        picture = mi.render(self.scene, params, view.sensor, self.integrator, seed=seed, spp=samples, spp_grad=1)
        return picture.array
