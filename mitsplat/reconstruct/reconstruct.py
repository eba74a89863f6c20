"""Captures and splats to assets: isolate the object, find its surface, and judge the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import HeldOutView, Verdict, judge, show_held_out, sized_photo
from mitsplat.reconstruct.causes import find_causes
from mitsplat.reconstruct.fallback_proxy import find_sound_surface
from mitsplat.reconstruct.registration import Alignment, register_mesh, surface_points
from mitsplat.reconstruct.segment_splats import Isolation, MaskedView, isolate_object
from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings, RefinedMesh, refine_mesh
from mitsplat.reconstruct.surface import SurfaceSettings, reconstruct_surface, simplify_surface


@dataclass(frozen=True)
class ReconstructSettings:
    """How an asset is made of splats.

    Attributes:
        surface: How the mesh is reconstructed.
        view_size: Longest edge of the pictures that masks and depth are read from [px].
        verdict_size: Longest edge of the held-out pictures [px].
        size: Longest edge of the smallest upright box around the mesh [m], which then decides the units; the asset is
            turned about z until that box lies along its axes.
        refine: How the mesh of an object is refined by its masks; None leaves it as it is reconstructed.
    """

    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    view_size: int = 640
    verdict_size: int = 800
    size: float | None = None
    refine: MeshRefineSettings | None = None

    def __post_init__(self) -> None:
        if self.size is not None and not 1e-4 <= self.size <= 1e4:
            raise InputError(f"size must be 0.0001 to 10000 m (got {self.size:g})")


@dataclass(frozen=True, eq=False)
class ImportedMesh:
    """A mesh made elsewhere.

    Attributes:
        mesh: In its own frame.
        capture_from_mesh: Where it belongs in the capture, shape (4, 4); None: it is registered to the splats.
        metres_per_unit: Of the mesh; a registered one gives a capture of unknown units its scale.
    """

    mesh: trimesh.Trimesh
    capture_from_mesh: Float64Array | None = None
    metres_per_unit: float | None = None

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 1e-9 <= self.metres_per_unit <= 1e9:
            raise InputError(f"units must be 1e-9 to 1e9 m (got {self.metres_per_unit:g})")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An asset and what is known about it.

    Attributes:
        asset: In the capture's frame, or in metres where a size was given, and then turned, or a mesh registered.
        verdict: Its quality.
        held_out: The views that this was judged by.
        isolation: What was removed, or None for surroundings.
        alignment: Where a registered mesh was found.
        refinement: What came of refining the mesh, in the capture's frame, or None where that was not asked for.
        asset_from_capture: Where the capture's frame is in the asset's, a similarity, shape (4, 4).
        sections: Further sections of the report, HTML.
        record: What else is kept beside the verdict, JSON.
    """

    asset: Asset
    verdict: Verdict
    held_out: Sequence[HeldOutView]
    isolation: Isolation | None
    alignment: Alignment | None
    refinement: RefinedMesh | None
    asset_from_capture: Float64Array
    sections: tuple[str, ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict)


def reconstruct_asset(
    capture: Capture,
    splats: Splats,
    *,
    name: str,
    class_name: str | None = None,
    kind: Literal["object", "environment"] = "object",
    settings: ReconstructSettings = ReconstructSettings(),
    imported: ImportedMesh | None = None,
    psnr: float | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Make an asset of splats that were fitted to a capture.

    Args:
        capture: Photos with cameras, and for an object with masks.
        splats: In the capture's frame, with or without surroundings.
        name: Of the asset.
        class_name: Class that detectors learn; the name if None.
        kind: Objects are isolated and get convex pieces; environments stay as they are and get an open mesh.
        settings: Resolutions and size.
        imported: A mesh to take instead of a reconstructed one.
        psnr: Held-out PSNR that the fit reported [dB].
        progress: Told what is being done.

    Raises:
        InputError: If an object has no masks, a size is given to a capture in metres, what is to be refined was not
            reconstructed by masks, or masks and splats do not belong together.
    """
    if settings.size is not None and capture.units == "metre":
        raise InputError(f"{name}: the capture is in metres already: it takes no size (got {settings.size:g} m)")
    check_refinable(settings, kind, imported)
    pictures = [sized_photo(photo, settings.view_size) for photo in capture.training]
    isolation = None
    views: Sequence[MaskedView] = [
        MaskedView(camera, mask, hidden) for camera, _, mask, hidden in pictures if mask is not None
    ]
    if kind == "object":
        if len(views) < 3:
            raise InputError(f"an object needs photos with masks from at least 3 sides (got {len(views)})")
        isolation = isolate_object(splats, views, progress=progress)
        splats = isolation.splats
    cameras = [camera for camera, *_ in pictures]
    alignment = refinement = sound = None
    if imported is None:
        floor = 0.0 if kind == "object" and capture.table and _stands(splats) else None
        if kind == "object":
            sound = find_sound_surface(splats, views, settings.surface, floor=floor, progress=progress)
            mesh = sound.mesh
        else:
            mesh = reconstruct_surface(splats, cameras, settings=settings.surface, progress=progress)
        if settings.refine is not None:
            refinement = refine_mesh(mesh, views, settings.refine, floor=floor, progress=progress)
            mesh = refinement.mesh
    else:
        mesh, alignment = _placed(imported, splats, cameras)
        mesh = simplify_surface(mesh, settings.surface.faces)
    if progress is not None:
        progress(0, 1, "judging by held-out photos")
    held_out = show_held_out(splats, mesh, capture.held_out, settings.verdict_size)
    causes = None
    if kind == "object":
        seen = [sized_photo(photo, settings.view_size)[:3] for photo in capture.photos]
        causes = find_causes(capture, seen)
    verdict = judge(
        capture, splats, mesh, held_out, isolation=isolation, psnr=psnr, refinement=refinement, causes=causes
    )
    if sound is not None:
        verdict = replace(verdict, surface=sound.source, surface_faults=sound.faults)
    asset = Asset(
        name=name,
        class_name=class_name or name,
        splats=splats,
        mesh=mesh,
        kind=kind,
        units=capture.units,
        capture_light="uniform" if kind == "object" else "scene",
    )
    asset_from_capture = np.eye(4)
    if settings.size is not None:
        turn = _squaring_turn(mesh)
        asset = asset.transformed(turn)
        asset_from_capture = np.diag([*[asset.factor_to(settings.size)] * 3, 1.0]) @ turn
        asset = asset.resized(settings.size)
    elif capture.units == "unknown" and alignment is not None and imported and imported.metres_per_unit:
        metres = imported.metres_per_unit / alignment.scale
        asset = replace(asset.scaled(metres), units="metre")
        asset_from_capture = np.diag([metres, metres, metres, 1.0])
    if kind == "object":
        if progress is not None:
            progress(0, 1, "splitting the mesh into convex pieces")
        asset = replace(asset, pieces=convex_pieces(mesh if asset.mesh is None else asset.mesh))
    verdict = replace(verdict, units=asset.units)
    return Reconstruction(asset, verdict, held_out, isolation, alignment, refinement, asset_from_capture)


def check_refinable(settings: ReconstructSettings, kind: str, imported: ImportedMesh | None) -> None:
    """Refuse to refine what has no masks or was not reconstructed.

    Raises:
        InputError: If that is asked for.
    """
    if settings.refine is not None and (kind != "object" or imported is not None):
        raise InputError("only the mesh of an object that is reconstructed by its masks is refined")


_BELOW = 0.02
"""Share of an object that may be found below the table that it stands on, in Gaussians and in height."""


def _stands(splats: Splats) -> bool:
    """Whether z = 0 can be what an object stands on: tags may be on the object itself, a board beside it on a box."""
    height = splats.means[:, 2]
    return bool(
        np.quantile(height, _BELOW)
        > -_BELOW * np.ptp(np.quantile(splats.means, (_BELOW, 1 - _BELOW), axis=0), axis=0).max()
    )


def _squaring_turn(mesh: trimesh.Trimesh) -> Float64Array:
    """The least turn about z, (4, 4), after which the smallest upright box around a mesh lies along the axes.

    A ruler is held against that box; extents along axes that cameras chose may be larger by almost a half.
    """
    flat, _ = trimesh.bounds.oriented_bounds_2D(np.asarray(mesh.vertices)[:, :2])
    angle = float(np.arctan2(flat[1, 0], flat[0, 0]))
    angle -= np.pi / 2 * round(angle / (np.pi / 2))
    return np.asarray(trimesh.transformations.rotation_matrix(angle, (0, 0, 1)))


def _placed(
    imported: ImportedMesh, splats: Splats, cameras: Sequence[Camera]
) -> tuple[trimesh.Trimesh, Alignment | None]:
    """The mesh in the capture's frame, and how it was found there."""
    alignment = None
    matrix = imported.capture_from_mesh
    if matrix is None:
        alignment = register_mesh(imported.mesh, surface_points(splats, cameras))
        matrix = alignment.splats_from_mesh
    mesh = imported.mesh.copy()
    mesh.apply_transform(matrix)
    return mesh, alignment
