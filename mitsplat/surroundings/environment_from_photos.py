"""Pipeline from the capture and the fit of a place to an environment asset.

The environment is cleaned and level. It has supports, quality figures and an example scene.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture
from mitsplat.fit.image_metrics import psnr
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.rigid import homogeneous_matrix, scaling
from mitsplat.geometry.triangulation import nearest_point_to_lines, optical_axes
from mitsplat.pages.html import make_section, rgb_image
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import HeldOutView, show_asset
from mitsplat.reconstruct.reconstruct import AssetJob, ImportedMesh, Reconstruction, reconstruct_asset
from mitsplat.reconstruct.surface import reconstruct_surface
from mitsplat.storage.files import JsonObject
from mitsplat.surroundings.coverage import MIN_PHOTOS, Coverage, Hole, find_coverage, find_holes, free_rectangle
from mitsplat.surroundings.depth_views import DepthView, SurfacePoints, depth_views, surface_points
from mitsplat.surroundings.floaters import remove_floaters
from mitsplat.surroundings.ready_scene import Rectangle, scene_text
from mitsplat.surroundings.removal import RemovedObject, remove_objects
from mitsplat.surroundings.supports import Support, find_supports, flatten_mesh

_FOREGROUND_DISTANCE = 3.0
"""Distance from the focus of the cameras beyond which Gaussians are background, in camera distances.

The background is rendered, but it is not part of the mesh.
"""
_MAX_SUPPORT_TILT = 30.0
"""Largest angle of the support to the capture's vertical [degrees]."""
_MAX_AXIS_ANGLE = 55.0
"""Largest angle of the support to one of the six axes if the vertical is unknown [degrees]; this covers all directions.
"""
_MAX_LEVEL_TILT = 2.0
"""Largest angle between the support and other level surfaces [degrees]."""
_FLATTEN_RANGE = 0.03
"""Height range around a support in which the mesh is flattened, as a share of the typical depth."""
_MAX_HIDDEN_SHARE = 0.1
"""Largest share of the support that too few photos may show."""
_MAX_UNCHANGED = 1.5 / 255
"""Largest colour difference of a pixel that the removal of objects left unchanged."""
_MIN_REGION = 0.1
"""Least edge of a drop region [m]."""
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _PhotographedPlace:
    """Photographed place, with all parts in one frame.

    Attributes:
        capture: Photos with cameras.
        splats: Splats of the place.
        views: Depth of the splats from the cameras of the training photos.
        points: Points on the surfaces in these views.
        scale: Typical depth of the photos.
        supports: Level surfaces; the origin is on the first.
    """

    capture: Capture
    splats: Splats
    views: Sequence[DepthView]
    points: SurfacePoints
    scale: float
    supports: Sequence[Support] = ()

    @classmethod
    def of(cls, capture: Capture, splats: Splats, scale: float, supports: Sequence[Support] = ()) -> _PhotographedPlace:
        """Render the depth views of splats, and return the place."""
        views = depth_views(splats, [photo.camera for photo in capture.training])
        return cls(capture, splats, views, surface_points(views), scale, supports)


def reconstruct_environment(
    capture: Capture,
    splats: Splats,
    job: AssetJob,
    *,
    psnr: float | None = None,
    source: str | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Make an environment from splats that were fitted to a capture.

    Args:
        capture: Photos with cameras.
        splats: Splats in the capture's frame.
        job: Description of the asset.
        psnr: Held-out PSNR of the fit [dB].
        source: Source of the capture's scale and gravity, a clause.
        progress: Progress callback.

    Raises:
        InputError: As :func:`mitsplat.reconstruct.reconstruct.reconstruct_asset`.
    """
    if progress is not None:
        progress(0, 1, "removing floaters and finding supports")
    scale = _typical_depth(capture)
    splats, removed = remove_floaters(splats, capture.training, scale)
    place, motion = _level_place(capture, splats, scale)
    fitted, removed_objects = place.splats, list[RemovedObject]()
    if job.remove:
        splats, removed_objects = remove_objects(
            fitted, job.remove, place.capture, place.supports, place.points, scale, progress
        )
        place = _PhotographedPlace.of(place.capture, splats, scale, place.supports)
    background = _background(place)
    imported = job.imported or ImportedMesh(_mesh(place, ~background, job, progress), np.eye(4))
    if job.imported is not None and job.imported.capture_from_mesh is not None:
        imported = replace(job.imported, capture_from_mesh=motion @ job.imported.capture_from_mesh)
    made = reconstruct_asset(
        place.capture, place.splats, replace(job, imported=imported, remove=()), psnr=psnr, progress=progress
    )
    made, asset_from_place = _without_rotation(made, motion)
    rows = {
        "Frame": _frame_text(made.asset.units, place.capture.scale_error, source),
        "Removed Gaussians": ", ".join(f"{count} {reason}" for reason, count in removed.items()),
        "Background": f"{int(background.sum())} Gaussians far behind the focus of the cameras, which are kept",
    }
    findings, sections, record = list[str](), list[str](), dict[str, object]()
    if place.supports:
        surfaces = _describe_surfaces(place, removed_objects, made.asset, asset_from_place)
        rows |= surfaces.rows
        findings += surfaces.findings
        sections.append(surfaces.map)
        record |= surfaces.record
    else:
        findings.append(
            "no level surface was found for objects to stand on (one is required): photograph the table from above as "
            "well, and put texture on it"
        )
    if made.asset.units != "metre":
        findings.append(
            "the scale is unknown, so no scene file was written: put a board of `mitsplat board` on the table, "
            "or use --scale-from"
        )
    # The PSNR is that of the asset after all changes, not that of the fit.
    if made.held_out:
        psnr = _mean_psnr(made.held_out, fitted if removed_objects else None)
    verdict = replace(made.verdict, psnr=psnr, rows=rows, findings=tuple(findings))
    return replace(made, verdict=verdict, sections=tuple(sections), record=record)


def _frame_text(units: str, scale_error: float | None, source: str | None) -> str:
    """Describe the units of an environment, their relative error, and what they are known from."""
    error = "" if scale_error is None else f" ± {scale_error:.2%}"
    by = f", by {source}" if source else ""
    return f"{'in metres' if units == 'metre' else 'in unknown units'}{error}{by}"


class _Surfaces(NamedTuple):
    """Results on the level surfaces of an environment: rows, findings, map and record of its report."""

    rows: dict[str, str]
    findings: list[str]
    map: str
    record: JsonObject


def _describe_surfaces(
    place: _PhotographedPlace, removed: Sequence[RemovedObject], asset: Asset, asset_from_place: Float64Array
) -> _Surfaces:
    """Measure how the photos cover the first surface, and describe all.

    Args:
        place: The place without removed objects, with at least one support.
        removed: Objects that were removed from surfaces.
        asset: The environment.
        asset_from_place: Transform (4, 4) from the frame of the place to the asset's, without a rotation.
    """
    factor, metric, first = float(asset_from_place[0, 0]), asset.units == "metre", place.supports[0]
    coverage = find_coverage(first, place.views, place.points, place.scale)
    named = [(photo.name, photo.camera) for photo in place.capture.training]
    holes = find_holes(first, coverage, place.splats, named)
    supports = [support.transformed(asset_from_place) for support in place.supports]
    filled = coverage.cells_with(np.concatenate([np.zeros((0, 2)), *(t.filled for t in removed if t.support == 0)]))
    region = _region(coverage, factor)
    unit = "m" if metric else "units"
    rows = _rows(supports, coverage, holes, region, factor, unit)
    record: JsonObject = {}
    if removed:
        rows["Removed objects"] = "; ".join(_removal_text(one, factor, unit) for one in removed)
        record["removed_objects"] = [
            {
                "pick": t.pick,
                "gaussians": t.gaussians,
                "filled": factor**2 * t.area,
                "behind": factor**2 * t.behind,
                "copied": t.copied,
            }
            for t in removed
        ]
    record["supports"] = [
        {"pose": s.pose.tolist(), "size": list(s.size), "tilt": s.tilt, "roughness": s.roughness} for s in supports
    ]
    if region is not None and metric:
        seen = [photo.camera for photo in place.capture.transformed(asset_from_place).photos]
        record["scene"] = scene_text(asset.name, supports, region, seen)
    findings = _findings(coverage, holes, region, factor, unit, metric=metric)
    return _Surfaces(rows, findings, _support_map(coverage, filled), record)


def _level_place(capture: Capture, splats: Splats, scale: float) -> tuple[_PhotographedPlace, Float64Array]:
    """Return the place with its main support in z = 0, and the transform (4, 4) from the capture's frame to it.

    Without a support, the place stays in the capture's frame.
    """
    place = _PhotographedPlace.of(capture, splats, scale)
    found = _find_supports(place.points, scale, vertical_known=capture.up != "unknown")
    if not found:
        return place, np.eye(4)
    motion = np.asarray(np.linalg.inv(found[0].pose))
    supports = find_supports(place.points.transformed(motion), _UP, scale, within=_MAX_LEVEL_TILT)
    if supports:  # its frame differs from that of the first search, by a quarter turn if it is square
        change = np.asarray(np.linalg.inv(supports[0].pose))
        motion, supports = change @ motion, [support.transformed(change) for support in supports]
    level = _PhotographedPlace(
        capture=replace(capture.transformed(motion), up="z", table=True),
        splats=splats.transformed(motion),
        views=[view.transformed(motion) for view in place.views],
        points=place.points.transformed(motion),
        scale=scale,
        supports=supports,
    )
    return level, motion


def _find_supports(points: SurfacePoints, scale: float, *, vertical_known: bool) -> list[Support]:
    """Return the level surfaces; if the vertical is unknown and none is near z, those near any other axis."""
    found = find_supports(points, _UP, scale, within=_MAX_SUPPORT_TILT)
    if found or vertical_known:
        return found
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    candidates = (find_supports(points, axis, scale, within=_MAX_AXIS_ANGLE) for axis in axes)
    return max(candidates, key=lambda supports: supports[0].central_share if supports else 0.0)


def _without_rotation(made: Reconstruction, motion: Float64Array) -> tuple[Reconstruction, Float64Array]:
    """Undo the rotation by which a given size turns an asset to its mesh, because the support is already level.

    Returns:
        The reconstruction, and the scaling (4, 4) from the frame of the support to that of the asset.
    """
    factor = float(np.cbrt(np.linalg.det(made.asset_from_capture[:3, :3])))
    back = homogeneous_matrix(made.asset_from_capture[:3, :3].T / factor)
    asset_from_place = scaling(factor)
    made = replace(made, asset=made.asset.transformed(back), asset_from_capture=asset_from_place @ motion)
    return made, asset_from_place


def _typical_depth(capture: Capture) -> float:
    """Return the median over the photos of the median depth of their points."""
    depths = [photo.camera.project(capture.points[photo.seen])[1] for photo in capture.training]
    known = [float(np.median(depth)) for depth in depths if len(depth)]
    return float(np.median(known)) if known else 1.0


def _background(place: _PhotographedPlace) -> BoolArray:
    """Return True for Gaussians (N,) in the background."""
    centres, axes = optical_axes(photo.camera for photo in place.capture.training)
    focus = nearest_point_to_lines(centres, axes)
    away = float(np.quantile(np.linalg.norm(centres - focus, axis=1), 0.9))
    return np.asarray(np.linalg.norm(place.splats.means - focus, axis=1) > _FOREGROUND_DISTANCE * away)


def _mesh(place: _PhotographedPlace, shown: BoolArray, job: AssetJob, progress: Progress | None) -> trimesh.Trimesh:
    """Return the surface of the Gaussians in ``shown`` (N,), with flat supports."""
    cameras = [photo.camera.fitted(job.settings.view_size) for photo in place.capture.training]
    mesh = reconstruct_surface(place.splats.select(shown), cameras, settings=job.settings.surface, progress=progress)
    return flatten_mesh(mesh, place.supports, _FLATTEN_RANGE * place.scale)


def _region(coverage: Coverage, factor: float) -> Rectangle | None:
    """Return the largest free rectangle of the support in its frame [m or units]."""
    cells = free_rectangle(coverage.free)
    if cells is None:
        return None
    low = coverage.cell_centres(np.array([[cells[0] - 0.5, cells[2] - 0.5]]))[0] * factor
    high = coverage.cell_centres(np.array([[cells[1] - 0.5, cells[3] - 0.5]]))[0] * factor
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _rows(
    supports: Sequence[Support],
    coverage: Coverage,
    holes: Sequence[Hole],
    region: Rectangle | None,
    factor: float,
    unit: str,
) -> dict[str, str]:
    """Describe the surfaces by name; lengths are multiplied by ``factor`` and stated in ``unit``."""
    first = supports[0]
    rows = {
        "Support": f"{first.size[0]:.3g} x {first.size[1]:.3g} {unit}, {first.filled:.0%} of it visible as flat, "
        f"roughness {first.roughness:.2g} {unit}; {first.central_share:.0%} of the photos' central points lie on it"
    }
    if len(supports) > 1:
        rows["Other level surfaces"] = "; ".join(
            f"{s.size[0]:.3g} x {s.size[1]:.3g} {unit} at z = {s.height:.3g} {unit}" for s in supports[1:]
        )
    if region is not None:
        rows["Free to drop on"] = (
            f"{region[1] - region[0]:.3g} x {region[3] - region[2]:.3g} {unit}, x {region[0]:.3g} to {region[1]:.3g}, "
            f"y {region[2]:.3g} to {region[3]:.3g}"
        )
    rows["Hardly seen"] = f"{coverage.hidden.mean():.1%} of the support is in fewer than {MIN_PHOTOS} photos"
    if holes:
        rows["Holes"] = "; ".join(_hole_text(hole, factor, unit) for hole in holes)
    return rows


def _hole_text(hole: Hole, factor: float, unit: str) -> str:
    """Describe a hole and its best viewpoint as a clause."""
    x, y = (factor * value for value in hole.centre)
    place = f"{factor**2 * hole.area:.2g} {unit}² around x {x:.2f}, y {y:.2f}"
    if hole.nearest_photo is None:
        return f"{place}, hidden from all directions by objects: move them"
    return (
        f"{place}: photograph it from near {hole.nearest_photo}, {hole.elevation:.0f} degrees above it "
        f"(shows {hole.visible_share:.0%})"
    )


def _removal_text(one: RemovedObject, factor: float, unit: str) -> str:
    """Describe a removed object and the filled area as a clause."""
    size = " x ".join(f"{factor * edge:.2g}" for edge in one.high - one.low)
    x, y = (factor * 0.5 * (one.low + one.high))[:2]
    copied = "copies of the surroundings" if one.copied > 0.99 else f"copies of the surroundings ({one.copied:.0%})"
    behind = f" and {factor**2 * one.behind:.2g} {unit}² of a wall behind it" if one.behind else ""
    return (
        f"{size} {unit} around x {x:.2f}, y {y:.2f} of surface {one.support} ({one.pick}), {one.gaussians} "
        f"Gaussians; {factor**2 * one.area:.2g} {unit}²{behind} hidden by it are synthesised from {copied}"
    )


def _mean_psnr(views: Sequence[HeldOutView], fitted: Splats | None) -> float:
    """Return the mean PSNR of held-out photos [dB], without pixels that differ from ``fitted`` if it is not None."""
    if fitted is None:
        return float(np.mean([psnr(view.render, view.photo) for view in views]))
    found = []
    for view, before in zip(views, show_asset(fitted, None, [view.camera for view in views]), strict=True):
        same = np.abs(view.render - before.render).max(axis=2) < _MAX_UNCHANGED
        if same.any():
            found.append(psnr(view.render[same], view.photo[same]))
    return float(np.mean(found))


def _findings(
    coverage: Coverage, holes: Sequence[Hole], region: Rectangle | None, factor: float, unit: str, *, metric: bool
) -> list[str]:
    """Return a sentence for each defect of the first support; lengths as in :func:`_rows`."""
    found = []
    if coverage.hidden.mean() > _MAX_HIDDEN_SHARE:
        places = "; ".join(_hole_text(hole, factor, unit) for hole in holes) or "in many small parts: add photos"
        found.append(
            f"{coverage.hidden.mean():.0%} of the support is in fewer than {MIN_PHOTOS} photos "
            f"(at most {_MAX_HIDDEN_SHARE:.0%} is allowed): {places}"
        )
    if region is None or (metric and min(region[1] - region[0], region[3] - region[2]) < _MIN_REGION):
        found.append(
            f"the support has no free area of {_MIN_REGION:g} x {_MIN_REGION:g} m: clear the support, or "
            "write the scene's region by hand"
        )
    return found


def _support_map(coverage: Coverage, filled: BoolArray) -> str:
    """Return the top view of the support with covered, free, hardly visible and filled cells, as HTML."""
    tint = np.full((*coverage.photos.shape, 3), 0.85)
    tint[coverage.free] = (0.55, 0.8, 0.55)
    tint[coverage.covered] = (0.35, 0.4, 0.5)
    tint[coverage.hidden] = (0.85, 0.3, 0.25)
    tint[filled] = (0.9, 0.75, 0.3)
    picture = np.repeat(np.repeat(tint.transpose(1, 0, 2)[::-1], 5, axis=0), 5, axis=1)
    invented = ", yellow was hidden by removed objects and is synthesised" if filled.any() else ""
    note = (
        "The support from above, x to the right and y up: green is free, dark is covered, red is visible "
        f"in fewer than {MIN_PHOTOS} photos{invented}."
    )
    figure = f'<figure><img alt="support from above" src="{rgb_image(picture, 420)}"></figure>'
    return make_section("support", "Support", f"<p>{html.escape(note)}</p>{figure}")
