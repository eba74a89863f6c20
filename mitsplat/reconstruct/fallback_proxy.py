"""Surface of an object with consistency checks and fallbacks.

Inconsistent depth, floating splats or contradictory masks can produce a closed mesh of any shape. Each candidate
surface is therefore compared with the masks' silhouettes and with the surface of the splats. The first candidate is the
surface from depth; by construction it lies inside the visual hull and around the bulk of the splats (:mod:`.surface`).
The fallbacks are the visual hull alone, and then the convex hull of the splats, which always exists if the splats span
a volume.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from mitsplat.asset import opaque_core
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.images.masks import iou
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import is_closed_when_read, show_asset, take_evenly
from mitsplat.reconstruct.registration import measure_offset, surface_points
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.reconstruct.surface import SurfaceSettings, reconstruct_surface

MIN_MASK_IOU = 0.85
"""Least mean IoU of a surface's silhouettes with the masks."""
MAX_SPREAD = 0.02
"""Largest median distance between a surface and that of the splats, as a share of its diagonal."""
_MIN_THICKNESS = 1e-4
"""Least extent of a volume, as a share of its longest extent."""
_VIEWS = 8
"""Number of views in the comparison."""

FINEST = "depth of the splats inside the hull of the masks"
HULL = "hull of the masks"
CONVEX = "convex hull of the splats"


@dataclass(frozen=True, eq=False)
class ProxySurface:
    """A closed mesh and its source.

    Attributes:
        mesh: Mesh in the splats' frame.
        source: Source of the mesh: :data:`FINEST`, :data:`HULL` or :data:`CONVEX`.
        faults: Reasons why finer surfaces were rejected, one clause each.
    """

    mesh: trimesh.Trimesh
    source: str
    faults: tuple[str, ...]


def find_proxy_surface(
    splats: Splats,
    views: Sequence[MaskedView],
    settings: SurfaceSettings,
    *,
    floor: float | None = None,
    progress: Progress | None = None,
) -> ProxySurface:
    """Return the finest surface that agrees with masks and splats, or else the one with the largest IoU with the masks.

    Args:
        splats: One isolated object.
        views: Masks of the object from all sides.
        settings: Resolution and size.
        floor: Height z of the support of the object, if known.
        progress: Called after each view.

    Raises:
        InputError: If the splats span no volume.
    """
    cameras, masks = [view.camera for view in views], [view.possible for view in views]

    def fused(depth: bool) -> trimesh.Trimesh:
        return reconstruct_surface(splats, cameras, masks, settings, floor=floor, depth=depth, progress=progress)

    makers: dict[str, Callable[[], trimesh.Trimesh]] = {
        FINEST: lambda: fused(depth=True),
        HULL: lambda: fused(depth=False),
        CONVEX: lambda: _convex_hull(splats, floor),
    }
    seen = take_evenly(views, _VIEWS)
    faults: list[str] = []
    found: list[tuple[float, str, trimesh.Trimesh]] = []
    for source, make in makers.items():
        try:
            mesh = make()
        except InputError as error:
            if source == CONVEX and not found:
                raise
            faults.append(f"the {source} could not be made: {error}")
            continue
        overlap, fault = _check_surface(mesh, splats, seen)
        if fault is None:
            return ProxySurface(mesh, source, tuple(faults))
        faults.append(f"the {source} {fault}")
        found.append((overlap, source, mesh))
    _, source, mesh = max(found, key=lambda one: one[0])
    return ProxySurface(mesh, source, tuple(faults))


def _check_surface(mesh: trimesh.Trimesh, splats: Splats, views: Sequence[MaskedView]) -> tuple[float, str | None]:
    """Return the mean IoU of a mesh's silhouettes with masks, and the reason for a rejection or None."""
    if not (is_closed_when_read(mesh) and mesh.volume > 0):
        return 0.0, "is open"
    shown = show_asset(splats, mesh, [view.camera for view in views])
    overlap = float(
        np.mean([iou(one.mesh & view.known, view.mask >= 0.5) for one, view in zip(shown, views, strict=True)])
    )
    if overlap < MIN_MASK_IOU:
        return overlap, f"has an IoU with the masks of only {overlap:.2f}"
    spread = measure_offset(mesh, surface_points(splats, [view.camera for view in views])).spread
    if spread > MAX_SPREAD:
        return overlap, f"is {spread:.1%} of the diagonal from the splats"
    return overlap, None


def _convex_hull(splats: Splats, floor: float | None) -> trimesh.Trimesh:
    """Return the convex hull of the opaque Gaussians without floaters, clipped at the floor."""
    points = opaque_core(splats).astype(np.float64)
    if floor is not None:
        points[:, 2] = np.maximum(points[:, 2], floor)
    spans = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) > 3 else np.zeros(3)
    if not spans[2] > _MIN_THICKNESS * spans[0]:
        raise InputError(f"the opaque Gaussians must span a volume (got {len(points)} on a point, line or plane)")
    return trimesh.convex.convex_hull(points)
