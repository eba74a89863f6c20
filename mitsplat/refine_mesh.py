"""A mesh closer to the outlines that photographs show, by gradient descent through Mitsuba.

The mesh shines evenly before a black background, so its picture is its silhouette; the squared difference to the mask
is lowered. How a silhouette moves with the vertices comes from projective sampling (Zhang et al. 2023, "Projective
Sampling for Differentiable Rendering of Geometry"), Mitsuba's ``prb_projective``; the gradients are spread over the
surface by "Large Steps in Inverse Rendering of Geometry" (Nicolet et al. 2021), Mitsuba's ``mi.ad.LargeSteps``.

Mitsuba samples the outlines of pinhole cameras only. Every mask is therefore resampled, through whatever lens it was
taken, to a pinhole at the same place that looks at the middle of the mesh and is filled by it: turning a camera about
its centre changes nothing of what it sees, and views of one size share their kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.camera import Camera
from mitsplat.errors import InputError
from mitsplat.isolate import MaskedView
from mitsplat.plugins.device import plain_mesh, wrapped
from mitsplat.render import ensure_variant

FloatArray = npt.NDArray[np.float64]

_ROOM = 1.1
"""Radius that a view shows around the middle of the mesh, in radii of the mesh."""
_VALIDATION_EVERY = 6
"""One view in so many judges what the others ask for."""
_BATCH = 2
"""Views that a step looks at."""
_CHECKS = 10
"""Times that the mesh is judged on the way."""
_SAMPLES = 4
"""Rays per pixel of a silhouette, and four times as many where it judges; its gradient takes one sample of the outline
per pixel of the picture, which is a hundred for each that the outline passes through."""
_STANDING = 0.005
"""Height above the table up to which vertices are what the object stands on, in radii."""
_THINNEST = 1e-3
"""Share of a face's area that must be left to its side of the old plane."""
_ROUNDS = 12
"""Times that vertices of faces which went wrong are taken half of their way back."""


@dataclass(frozen=True)
class MeshRefineSettings:
    """How a mesh is refined.

    Attributes:
        steps: Gradient steps of two views each.
        size: Edge of the square pictures that masks are resampled to [px].
        rate: Step of the optimiser, in radii of the mesh; it falls to nothing by the end.
        smoothness: Weight λ of the Laplacian that gradients are spread by.
        seed: Of the choice of views and of the samples.
    """

    steps: int = 200
    size: int = 400
    rate: float = 2e-3
    smoothness: float = 19.0
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
        mesh: Refined, or as it was.
        before: Mean of 1 - IoU between the silhouettes of the mesh and the masks of the views that judge.
        after: The same of the best that was found; it is kept where this is less.
    """

    mesh: trimesh.Trimesh
    before: float
    after: float


def refine_mesh(
    mesh: trimesh.Trimesh,
    views: Sequence[MaskedView],
    settings: MeshRefineSettings = MeshRefineSettings(),
    *,
    floor: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RefinedMesh:
    """Move the vertices of a mesh to where masks want its outlines.

    Every sixth view takes no part, and judges: the best mesh on the way is returned where its error there is below that
    of the given one, which is returned otherwise. The faces stay what they are, and none turns over or newly passes
    through another.

    Args:
        mesh: Close to what the masks show, in the frame of the cameras.
        views: Cameras of any lens, and their masks.
        settings: Number and size of steps.
        floor: Height z of the table that the object stands on, if it does: what is on it stays there, and nothing sinks.
        progress: Told after every step how many of how many are done.

    Raises:
        InputError: If fewer than four views see the mesh from outside.
    """
    ensure_variant()
    middle = mesh.bounds.mean(axis=0)
    radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max())
    outside = [view for view in views if np.linalg.norm(view.camera.centre - middle) > 1.05 * _ROOM * radius]
    if len(outside) < 4:
        raise InputError(f"a mesh is refined by masks from at least 4 places outside of it (got {len(outside)})")
    held, shown = [], []
    for number, view in enumerate(outside):
        kind = held if number % _VALIDATION_EVERY == _VALIDATION_EVERY // 2 else shown
        kind.append(_Outline(view, middle, radius, settings.size))
    start = trimesh.Trimesh((mesh.vertices - middle) / radius, mesh.faces, process=False)
    lowest = -np.inf if floor is None else (floor - middle[2]) / radius
    standing = np.abs(start.vertices[:, 2] - lowest) < _STANDING

    scene = _Silhouettes(start)
    steps = mi.ad.LargeSteps(scene.vertices, scene.faces, settings.smoothness)
    descent = mi.ad.Adam(lr=settings.rate, uniform=True, params={"latent": steps.to_differential(scene.vertices)})
    height, stays = (wrapped(mi.Float, v.astype(np.float32)) for v in (start.vertices[:, 2], standing))

    def moved() -> Any:
        vertices = dr.unravel(mi.Point3f, steps.from_differential(descent["latent"]))
        above = dr.maximum(vertices.z, dr.minimum(height, float(lowest)))
        vertices.z = dr.select(stays > 0, height, above)
        return dr.ravel(vertices)

    rng = np.random.default_rng(settings.seed)
    before, after, kept = scene.error(start.vertices, held), np.inf, mesh
    old = _crossings(start, start.vertices)
    for step in range(settings.steps):
        descent.set_learning_rate(settings.rate * (1 - step / settings.steps))
        chosen = rng.choice(len(shown), min(_BATCH, len(shown)), replace=False)
        dr.backward(scene.loss(moved(), [shown[index] for index in chosen], seed=step + settings.seed * settings.steps))
        descent.step()
        if (step + 1) % max(1, settings.steps // _CHECKS) == 0 or step + 1 == settings.steps:
            found = _mended(start, np.array(dr.detach(moved()), dtype=np.float64).reshape(-1, 3), old)
            error = np.inf if found is None else scene.error(found, held)
            if found is not None and error < after:
                after = error
                if after < before:
                    kept = trimesh.Trimesh(found * radius + middle, mesh.faces, process=False)
        if progress is not None:
            progress(step + 1, settings.steps)
    return RefinedMesh(kept, before, after)


class _Outline:
    """What a mask shows of the unit ball around the mesh, as a pinhole that looks at it sees it.

    Attributes:
        sensor: Mitsuba's pinhole, in radii about the middle.
        mask: Share of each pixel that is the object, (size * size,).
        known: 1 where the photo shows the pixel, else 0.
    """

    def __init__(self, view: MaskedView, middle: FloatArray, radius: float, size: int) -> None:
        given = view.camera
        distance = float(np.linalg.norm(given.centre - middle))
        camera = Camera.look_at(
            given.centre,
            middle,
            up=-given.world_from_camera[:3, 1],
            width=size,
            height=size,
            fov_x=2 * float(np.degrees(np.arcsin(_ROOM * radius / distance))),
        )
        y, x = np.mgrid[:size, :size] + 0.5
        slopes = camera.ray_slopes(np.column_stack([x.ravel(), y.ravel()]))
        pose = camera.world_from_camera
        ahead = np.column_stack([slopes, np.ones(len(slopes))]) @ pose[:3, :3].T
        pixels = given.project(given.centre + distance * ahead)[0].astype(np.float32).reshape(size, size, 2) - 0.5
        height, width = view.mask.shape
        known = ((pixels > -0.5) & (pixels < (width - 0.5, height - 0.5))).all(axis=2)
        mask = cv2.remap(view.mask, np.where(known[..., None], pixels, -9), None, cv2.INTER_LINEAR)
        self.mask, self.known = (wrapped(mi.Float, v.ravel().astype(np.float32)) for v in (mask, known))
        pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
        pose[:3, 3] = (given.centre - middle) / radius
        self.sensor = mi.load_dict(
            {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f(pose),
                "fov": 2 * float(np.degrees(np.arctan(0.5 * size / camera.fx))),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
            }
        )


class _Silhouettes:
    """A mesh that shines evenly, whose vertices can be moved."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        properties = mi.Properties()
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "uniform", "value": 1.0}})
        self.scene = mi.load_dict({"type": "scene", "mesh": plain_mesh(mesh, properties)})
        # Directly seen light alone; inside a silhouette nothing changes.
        self.integrator = mi.load_dict({"type": "prb_projective", "max_depth": 1, "sppc": 0, "sppi": 0})
        self.integrator.sample_border_warning = False
        self.params = mi.traverse(self.scene)

    @property
    def vertices(self) -> Any:
        """Positions, flat."""
        return mi.Float(self.params["mesh.vertex_positions"])

    @property
    def faces(self) -> Any:
        """Vertices of the triangles, flat."""
        return self.params["mesh.faces"]

    def loss(self, vertices: Any, views: Sequence[_Outline], seed: int) -> Any:
        """Mean squared difference of silhouettes and masks, with gradients."""
        self._move(vertices)
        total = mi.Float(0)
        for number, view in enumerate(views):
            shown = self._shown(view, _SAMPLES, _BATCH * seed + number, self.params)
            total += dr.mean(dr.square(shown - view.mask) * view.known)
        return total

    def error(self, vertices: FloatArray, views: Sequence[_Outline]) -> float:
        """Mean of 1 - IoU of silhouettes and masks, of which every pixel has a share."""
        self._move(wrapped(mi.Float, vertices.ravel().astype(np.float32)))
        errors = []
        for view in views:
            shown = self._shown(view, 4 * _SAMPLES, 0)
            both, either = (dr.sum(pick(shown, view.mask) * view.known)[0] for pick in (dr.minimum, dr.maximum))
            errors.append(1 - both / max(either, 1e-9))
        return float(np.mean(errors))

    def _move(self, vertices: Any) -> None:
        self.params["mesh.vertex_positions"] = vertices
        self.params.update()

    def _shown(self, view: _Outline, samples: int, seed: int, params: Any = None) -> Any:
        picture = mi.render(
            self.scene, params, view.sensor, self.integrator, seed=seed, spp=samples, spp_grad=1
        )
        return picture.array


def _mended(start: trimesh.Trimesh, vertices: FloatArray, old: npt.NDArray[np.intp]) -> FloatArray | None:
    """Moved vertices, held back where faces turn over, vanish, or newly cross; None if that does not help.

    Args:
        start: Mesh that they belong to.
        vertices: Where they moved to, (V, 3).
        old: Edges that cross faces of ``start``.
    """
    share = np.ones((len(vertices), 1))
    across = np.cross(*_sides(start.vertices, start.faces))
    for _ in range(_ROUNDS):
        found = start.vertices + share * (vertices - start.vertices)
        left = (np.cross(*_sides(found, start.faces)) * across).sum(axis=1)
        turned = left < _THINNEST * (across**2).sum(axis=1)
        crossing = np.setdiff1d(_crossings(start, found), old)
        wrong = np.union1d(start.faces[turned], start.edges_unique[crossing])
        if not len(wrong):
            return found
        share[wrong] /= 2
    return None


def _sides(vertices: FloatArray, faces: npt.NDArray[np.integer[Any]]) -> tuple[FloatArray, FloatArray]:
    """Two sides of every face."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return b - a, c - a


def _crossings(mesh: trimesh.Trimesh, vertices: FloatArray) -> npt.NDArray[np.intp]:
    """Edges, as rows of ``edges_unique``, that pass through a face which they do not touch."""
    edges, faces = mesh.edges_unique, np.asarray(mesh.faces)
    scene = mi.load_dict({"type": "scene", "mesh": plain_mesh(trimesh.Trimesh(vertices, faces, process=False))})
    a, b = (np.asarray(vertices, dtype=np.float32)[end].T for end in edges.T)
    origin = mi.Point3f(np.ascontiguousarray(0.999 * a + 0.001 * b))
    hit = scene.ray_intersect_preliminary(
        mi.Ray3f(origin, mi.Vector3f(np.ascontiguousarray(0.998 * (b - a))), 1.0, 0.0, [])
    )
    face = np.array(hit.prim_index)
    valid = np.flatnonzero(np.array(hit.is_valid()))
    apart = ~(faces[face[valid]][:, :, None] == edges[valid][:, None, :]).any(axis=(1, 2))
    return valid[apart]
