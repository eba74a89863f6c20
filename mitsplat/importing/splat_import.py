"""Import of splats from other programs as an asset: cleaned, upright, in metres, with its own mesh.

Only the splat file is needed. Masks of an object and depths of its surface, which photographs define in a capture, are
rendered from the splats themselves in views from all around. A splat file states neither its up axis nor its unit. The
up axis is estimated; the user must give the unit or the size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
import trimesh

from mitsplat.arguments import check_fields, check_number, check_text, check_type, path_of
from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import Axis, default_up_axis
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import spiral
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.geometry.rigid import homogeneous_matrix, scaling
from mitsplat.gltf_splats.splat_reading import is_gltf, read_gltf_splats
from mitsplat.images.masks import iou
from mitsplat.importing.cleaning import OUTLIERS, Cleaner
from mitsplat.importing.import_result import Imported, ImportSupport
from mitsplat.importing.standing import cut_base, topples
from mitsplat.importing.upright import Plane, Upright, cut_support, find_up
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import is_closed_when_read, show_asset
from mitsplat.reconstruct.registration import measure_offset, surface_points
from mitsplat.reconstruct.surface import SurfaceSettings, reconstruct_surface
from mitsplat.renderer.layers import render_splats
from mitsplat.runtime.variant import one_at_a_time
from mitsplat.usd.stage_assets import StageAsset, read_stage_asset
from mitsplat.usd.usd_layers import is_usd

_FOV, _DISTANCE = 29.0, 4.5
"""Field of view [degrees] of the views of an object, and their distance in radii of the object."""
_TEST_VIEWS = 6
_CONCAVITY = 0.04
"""Concavity threshold of convex pieces; the surface of splats is too rough for a smaller one."""
_SMALL_PART = 0.1
"""Volume of a part, relative to the largest part, below which its convex hull is one piece: leaves, lids, screws."""
FROM_GLTF_AXES: Mapping[Axis, Axis] = {"y": "z", "-y": "-z", "z": "-y", "-z": "y", "x": "x", "-x": "-x"}
"""Axis of splats with z up for each axis of their glTF file, in which y points up."""
_STAGES = 6


@dataclass(frozen=True)
class ImportSettings:
    """Settings of the conversion of a splat file to an asset.

    Attributes:
        up: Axis of the file that points up; estimated if None.
        units: Metres per unit of the file.
        size: Longest extent [m], instead of units.
        crop: Lower and upper corner of the box outside of which Gaussians are removed, in the file's units and axes.
        without_table: Remove the flat surface that the object stands on, and everything below it.
        flat_base: Cut off parts below the base until the object stands, because captures rarely show the underside.
        views: Number of pictures for the surface reconstruction.
        view_size: Edge length of these pictures [px].
        surface: Settings of the surface reconstruction.
        material: Parameters of the one material that the asset gets, see :meth:`mitsplat.Splats.with_material`; None
            keeps the captured colours.
    """

    up: Axis | None = None
    units: float | None = None
    size: float | None = None
    crop: tuple[float, float, float, float, float, float] | None = None
    without_table: bool = False
    flat_base: bool = False
    views: int = 48
    view_size: int = 480
    surface: SurfaceSettings = field(default_factory=lambda: SurfaceSettings(blur=1.0))
    material: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("units", "size"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"{name} must be finite and > 0 (got {value:g})")
        if self.units is not None and self.size is not None:
            raise InputError("units and size must not both be given")
        if self.crop is not None and not all(
            low < high for low, high in zip(self.crop[:3], self.crop[3:], strict=True)
        ):
            raise InputError(f"crop must be a lower and an upper corner (got {' '.join(f'{v:g}' for v in self.crop)})")


@one_at_a_time
def import_splats(
    path: str | Path,
    *,
    name: str,
    class_name: str | None = None,
    kind: Literal["object", "environment"] = "object",
    settings: ImportSettings = ImportSettings(),
    density: float | None = None,
    mass: float | None = None,
    friction: float = 0.5,
    capture_light: Literal["uniform", "scene"] | None = None,
    stage: StageAsset | None = None,
    progress: Progress | None = None,
) -> Imported:
    """Convert a splat file to an asset.

    Args:
        path: Any file that :meth:`mitsplat.Splats.load` reads, a glTF file, or a USD stage.
        name: Name of the asset.
        class_name: Class label for detectors; ``name`` if None.
        kind: ``object`` or ``environment``. Objects can be dropped, so they get a closed mesh and convex pieces.
            Environments are static.
        settings: Up axis, scale, removal of parts, and resolutions.
        density: Mass density [kg/m^3]; 1000 if neither this nor ``mass`` is given.
        mass: Mass [kg].
        friction: Coulomb friction coefficient.
        capture_light: As in :class:`mitsplat.Asset`; by default ``uniform`` for objects, ``scene`` for environments.
        stage: Content of the USD stage at ``path``; by default it is read.
        progress: Callback that gets the current stage.

    Raises:
        InputError: If the file cannot be read, no Gaussian remains, or a value breaks a rule.
    """
    path = path_of(path, "path")
    check_type(settings, ImportSettings, "settings", "for example mitsplat.ImportSettings(units=0.001)")
    check_text(name, "name")
    _check_physics(density, mass, friction)
    stages = iter(range(_STAGES))

    def report(stage_name: str) -> None:
        if progress is not None:
            progress(next(stages), _STAGES, stage_name)

    report("reading the file")
    loaded, settings, reason = _read_splats(path, settings, stage)
    cleaner, upright = _clean(path, loaded, kind, settings, report)
    if reason:
        upright = replace(upright, reason=reason)
    turn, support = homogeneous_matrix(upright.rotation), None
    if kind == "environment" and upright.support is not None:
        support, placed = _align_to_support(cleaner.splats.transformed(turn), upright.support)
        turn = placed @ turn
    report("finding the surface")
    seen_below = kind == "object" and not settings.without_table
    splats, mesh = _upright_surface(path, cleaner, turn, kind, settings, lowest=-1.0 if seen_below else 0.0)
    asset = Asset(
        name=name,
        class_name=class_name or name,
        splats=splats if settings.material is None else splats.with_material(**settings.material),
        mesh=mesh,
        kind=kind,
        density=1000.0 if density is None else density,
        mass=mass,
        friction=friction,
        capture_light=capture_light or ("uniform" if kind == "object" else "scene"),
        units="unknown",
    )
    asset, asset_from_file, factor = _in_metres(asset, turn, settings)
    if support is not None and factor is not None:
        support = replace(support, size=(factor * support.size[0], factor * support.size[1]))
    result = Imported(
        asset=asset,
        upright=upright,
        found=len(loaded),
        removed=cleaner.removed,
        removed_splats=cleaner.removed_splats().transformed(asset_from_file),
        support=support,
        watertight=asset.mesh is not None and is_closed_when_read(asset.mesh),
        topples=kind == "object" and asset.mesh is not None and topples(asset.mesh),
    )
    if asset.mesh is None:
        return result
    report("comparing mesh and splats")
    result = _compare_mesh(result, asset.mesh, settings, lowest=-0.3 if seen_below else 0.0)
    if kind == "environment":
        return result
    report("splitting the mesh into convex pieces")
    return replace(result, asset=replace(asset, pieces=_pieces_of_parts(asset.mesh)))


def _upright_surface(
    path: Path, cleaner: Cleaner, turn: Float64Array, kind: str, settings: ImportSettings, *, lowest: float
) -> tuple[Splats, trimesh.Trimesh | None]:
    """Return the upright splats and their surface, with a flat base if it is wanted or if the object would topple."""
    splats = cleaner.splats.transformed(turn)
    mesh = _surface(splats, kind, settings, lowest)
    if mesh is not None and (settings.flat_base or (settings.without_table and topples(mesh))):
        mesh, height = cut_base(path, mesh)
        cleaner.remove("below the base", splats.means[:, 2] < height, "nothing is above its base")
        splats = cleaner.splats.transformed(turn)
    return splats, mesh


def _compare_mesh(result: Imported, mesh: trimesh.Trimesh, settings: ImportSettings, *, lowest: float) -> Imported:
    """Return the result with pictures of splats and mesh, and their offset; for an object also their overlap."""
    asset = result.asset
    cameras = _cameras(asset.splats, asset.kind, settings, _TEST_VIEWS, lowest=lowest, turn=0.7)
    views = show_asset(asset.splats, mesh, cameras)
    offset = measure_offset(mesh, surface_points(asset.splats, cameras)).shift
    result = replace(result, views=views, offset=offset)
    if asset.kind != "object":
        return result
    return replace(result, mesh_iou=float(np.mean([iou(view.alpha >= 0.5, view.mesh) for view in views])))


def _clean(
    path: Path, loaded: Splats, kind: str, settings: ImportSettings, report: Callable[[str], None]
) -> tuple[Cleaner, Upright]:
    """Remove floaters, and what lies outside of the box or belongs to the table; return the rest and its up axis."""
    cleaner = Cleaner(path, loaded)
    if settings.crop is not None:
        cleaner.crop(settings.crop)
    report("removing floaters")
    cleaner.remove_floaters(kind)
    report("finding up")
    upright = find_up(cleaner.splats, kind, default_up_axis(path), settings.up)
    if settings.without_table:
        if upright.support is None:
            raise InputError(f"{path}: has no flat surface below the object: leave out --without-table")
        cleaner.remove("table", ~cut_support(cleaner.splats, upright.support), "nothing stands on the flat surface")
        cleaner.remove_floaters(kind)
    return cleaner, upright


def _check_physics(density: float | None, mass: float | None, friction: float) -> None:
    """Raise InputError if a physical value of an asset breaks a rule."""
    for key, value in (("density", density), ("mass", mass)):
        if value is not None:
            check_number(value, key)
            if not 0 < value < np.inf:
                raise InputError(f"{key} must be finite and > 0 (got {value:g})")
    if density is not None and mass is not None:
        raise InputError("density and mass must not both be given")
    check_number(friction, "friction")
    if not 0 <= friction < np.inf:
        raise InputError(f"friction must be a number of at least 0 (got {friction:g})")


def _read_splats(path: Path, settings: ImportSettings, stage: StageAsset | None) -> tuple[Splats, ImportSettings, str]:
    """Read the splats of a file.

    Returns:
        The splats, the settings with the unit and the axis that the file states, and where its axis comes from, empty
        if it must be found. Splats of USD and glTF files are in metres with z up.
    """
    reason = ""
    if is_usd(path) or is_gltf(path):
        if is_usd(path) and settings.up:
            raise InputError(
                f"{path}: states its up axis: correct upAxis of the stage, without --up (got {settings.up})"
            )
        reason = f"{settings.up}, as given" if settings.up else "as the file states"
        loaded = (stage or read_stage_asset(path)).splats if is_usd(path) else read_gltf_splats(path)
        units = settings.units if settings.units or settings.size else 1.0
        settings = replace(settings, up=FROM_GLTF_AXES[settings.up or "y"], units=units)
    else:
        loaded = Splats.load(path)
    if not len(loaded):
        raise InputError(f"{path}: must hold at least one Gaussian (got 0)")
    return loaded, settings, reason


def _in_metres(
    asset: Asset, asset_from_file: Float64Array, settings: ImportSettings
) -> tuple[Asset, Float64Array, float | None]:
    """Move the base of an object to the origin, and scale an asset if the settings state its unit or size.

    Returns:
        The asset, the transform from the file's coordinates to its coordinates, and the factor; None if the size is
        unknown.
    """
    if asset.kind == "object":
        low, high = asset.splats.bounds if asset.mesh is None else asset.mesh.bounds
        base = trimesh.transformations.translation_matrix(-np.array([*(low[:2] + high[:2]) / 2, low[2]]))
        asset, asset_from_file = asset.transformed(base), base @ asset_from_file
    factor = settings.units if settings.size is None else asset.factor_to(settings.size)
    if factor is not None:
        metres = scaling(factor)
        asset, asset_from_file = replace(asset.transformed(metres), units="metre"), metres @ asset_from_file
    return asset, asset_from_file, factor


def _cameras(
    splats: Splats, kind: str, settings: ImportSettings, count: int, *, lowest: float, turn: float = 0.0
) -> list[Camera]:
    """Return views from all around, at heights from ``lowest`` upwards; 1 is straight above and -1 straight below.

    Views of an environment look at the origin, from within its extent.
    """
    low, high = np.quantile(splats.means.astype(np.float64), (OUTLIERS, 1 - OUTLIERS), axis=0)
    if kind == "object":
        middle, radius, fov = (low + high) / 2, 0.5 * float(np.linalg.norm(high - low)), _FOV
        away = _DISTANCE * radius
    else:
        middle, radius, fov = np.zeros(3), 0.5 * float((high - low)[:2].max()), 75.0
        away, lowest = radius, 0.25
    outward = spiral(lowest + (1.0 - lowest) * (np.arange(count) + 0.5) / count, turn)
    size = settings.view_size
    return [
        Camera.look_at(middle + away * d, middle, width=size, height=size, fov_x=fov, near=0.02 * away) for d in outward
    ]


def _surface(splats: Splats, kind: str, settings: ImportSettings, lowest: float) -> trimesh.Trimesh | None:
    """Reconstruct the mesh of the splats; return None for an environment without opaque parts."""
    cameras = _cameras(splats, kind, settings, settings.views, lowest=lowest)
    if kind == "object":
        masks = [render_splats(splats, camera, quality="fast").alpha for camera in cameras]
        return reconstruct_surface(splats, cameras, masks, settings.surface, thin=True)
    try:
        return reconstruct_surface(splats, cameras, None, settings.surface)
    except InputError:
        return None


def _pieces_of_parts(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, ...]:
    """Return convex pieces of every connected part."""
    parts = sorted(mesh.split(only_watertight=True), key=lambda part: -float(part.volume)) or [mesh]
    small = [part for part in parts[1:] if part.volume < _SMALL_PART * parts[0].volume]
    large = parts[: len(parts) - len(small)]
    split = [piece for part in large for piece in convex_pieces(part, threshold=_CONCAVITY)]
    return (*split, *(part.convex_hull for part in small))


def _align_to_support(splats: Splats, plane: Plane) -> tuple[ImportSupport | None, Float64Array]:
    """Return the horizontal surface of an environment, and the transform that moves its centre to the origin.

    The transform aligns the sides of the surface with x and y. If the Gaussians in the plane span no area, the surface
    is None and the transform is the identity.
    """
    inside = np.abs(splats.means[:, 2] - plane.height) <= 3 * plane.thickness
    flat = splats.means[inside & (splats.opacities > 0.1), :2].astype(np.float64)
    if len(flat):
        low, high = np.quantile(flat, (0.02, 0.98), axis=0)
        flat = flat[((flat >= low) & (flat <= high)).all(axis=1)]
    envelope = shapely.oriented_envelope(shapely.MultiPoint(flat))
    if not envelope.area > 0:
        return None, np.eye(4)
    corners = np.array(envelope.exterior.coords)[:4]
    along = corners[1] - corners[0]
    across = corners[2] - corners[1]
    if np.abs(along[0]) < np.abs(along[1]):  # the smaller rotation
        along, across = across, along
    angle = float(np.arctan2(along[1], along[0]))
    angle -= np.pi * np.round(angle / np.pi)
    motion = trimesh.transformations.rotation_matrix(-angle, (0, 0, 1)) @ trimesh.transformations.translation_matrix(
        -np.append(corners.mean(axis=0), plane.height)
    )
    return ImportSupport((float(np.linalg.norm(along)), float(np.linalg.norm(across))), plane.share), motion
