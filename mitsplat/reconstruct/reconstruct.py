"""Reconstruction of an asset from a capture and splats: isolation, surface and evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import trimesh

from mitsplat.arguments import check_fields, check_text
from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, parse_pixel
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.geometry.rigid import scaling, split_similarity
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import HeldOutView, Verdict, compute_verdict, show_held_out
from mitsplat.reconstruct.causes import find_causes
from mitsplat.reconstruct.fallback_proxy import find_proxy_surface
from mitsplat.reconstruct.materials.capture_light import CaptureLight
from mitsplat.reconstruct.pose_refinement import RefinedPose, refine_pose
from mitsplat.reconstruct.registration import Alignment, measure_offset, register_mesh, surface_points
from mitsplat.reconstruct.segment_splats import Isolation, MaskedView, isolate_object
from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings, RefinedMesh, refine_mesh
from mitsplat.reconstruct.simplification import simplify_surface
from mitsplat.reconstruct.surface import SurfaceSettings, reconstruct_surface


@dataclass(frozen=True)
class ReconstructSettings:
    """Settings of the reconstruction.

    Attributes:
        surface: Settings of the mesh reconstruction.
        view_size: Longest edge of the pictures for masks and depth [px].
        verdict_size: Longest edge of the held-out pictures [px].
        size: Longest edge of the smallest upright box around the mesh [m], which determines the scale. The asset is
            rotated about z until the edges of that box are parallel to the axes.
        refine: Settings of the mask-based mesh refinement of an object; None disables it.
    """

    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    view_size: int = 640
    verdict_size: int = 800
    size: float | None = None
    refine: MeshRefineSettings | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.size is not None and not 1e-4 <= self.size <= 1e4:
            raise InputError(f"size must be 0.0001 to 10000 m (got {self.size:g})")


@dataclass(frozen=True, eq=False)
class ImportedMesh:
    """A mesh from another source.

    Attributes:
        mesh: Mesh in its own frame.
        capture_from_mesh: Similarity to the capture's frame, shape (4, 4); None to register the mesh to the splats.
        metres_per_unit: Scale of the mesh [m]; the registration to a capture in metres keeps it, and it gives the scale
            of a capture of unknown units.
    """

    mesh: trimesh.Trimesh
    capture_from_mesh: Float64Array | None = None
    metres_per_unit: float | None = None

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 1e-9 <= self.metres_per_unit <= 1e9:
            raise InputError(f"units must be 1e-9 to 1e9 m (got {self.metres_per_unit:g})")


@dataclass(frozen=True, eq=False)
class AssetJob:
    """Description of the asset to make.

    Attributes:
        name: Name of the asset.
        class_name: Class for detectors; the name if None.
        kind: Objects are isolated, get convex pieces and can be dropped; environments stay whole and get an open mesh.
        settings: Settings of the reconstruction.
        imported: Mesh that replaces the reconstructed one.
        remove: Objects to remove from an environment, PHOTO:X,Y in pixels of the capture's photos.
        material: Parameters of the one material that the asset gets, see :meth:`mitsplat.Splats.with_material`; None
            keeps the captured colours.
        light: Light of the photographs, from which the materials of an object are estimated; None if it is unknown.

    Raises:
        InputError: In one of these cases: refinement of a mesh that is not reconstructed from masks; ``remove`` with
            an object, an imported mesh or a text without pixel; ``light`` with an environment, a material or a size.
    """

    name: str
    class_name: str | None = None
    kind: Literal["object", "environment"] = "object"
    settings: ReconstructSettings = field(default_factory=ReconstructSettings)
    imported: ImportedMesh | None = None
    remove: tuple[str, ...] = ()
    material: Mapping[str, float] | None = None
    light: CaptureLight | None = None

    def __post_init__(self) -> None:
        check_text(self.name, "name")
        check_fields(self)
        if self.settings.refine is not None and (self.kind != "object" or self.imported is not None):
            raise InputError("only the mesh of an object that is reconstructed from masks can be refined")
        if self.remove and self.kind != "environment":
            raise InputError(
                "objects can be removed only from an environment: use --kind environment, or omit --remove"
            )
        if self.remove and self.imported is not None:
            raise InputError("objects cannot be removed from an imported mesh: omit one of the two")
        for place in self.remove:
            parse_pixel(place.rpartition(":")[2], place)
        if self.light is not None:
            if self.kind != "object":
                raise InputError(f"materials are estimated for objects only: omit the lights (got kind {self.kind})")
            if self.material is not None:
                raise InputError("lights and a given material both define the materials: omit one of the two")
            if self.settings.size is not None:
                raise InputError("lights need a capture in metres: omit the lights, or give the scale by a board")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed asset and its evaluation.

    Attributes:
        asset: The asset in the capture's frame. With a size it is rotated and in metres; with a registered mesh of
            known units it is in metres.
        verdict: Quality figures.
        held_out: Held-out views of the evaluation.
        isolation: Result of the isolation, or None for an environment.
        alignment: Registration of an imported mesh after the refinement of its pose, or None.
        refinement: Result of the mesh refinement in the capture's frame, or None if it was not requested.
        asset_from_capture: Similarity transform from the capture's frame to the asset's frame, shape (4, 4).
        sections: Further sections of the report, HTML.
        record: Further entries of the verdict file, JSON.
        pose: Refinement of the pose of a registered mesh, or None without a registration or masks.
    """

    asset: Asset
    verdict: Verdict
    held_out: Sequence[HeldOutView]
    isolation: Isolation | None
    alignment: Alignment | None
    refinement: RefinedMesh | None
    asset_from_capture: Float64Array
    sections: tuple[str, ...] = ()
    record: Mapping[str, object] = field(default_factory=dict)
    pose: RefinedPose | None = None


def reconstruct_asset(
    capture: Capture, splats: Splats, job: AssetJob, *, psnr: float | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Make an asset from splats that were fitted to a capture.

    Args:
        capture: Photos with cameras, and for an object with masks.
        splats: Splats in the capture's frame, with or without surroundings.
        job: Description of the asset.
        psnr: Held-out PSNR of the fit [dB].
        progress: Progress callback.

    Raises:
        InputError: If an object has no masks, a size is given for a capture in metres, or masks and splats do not
            match.
    """
    settings, imported = job.settings, job.imported
    if settings.size is not None and capture.units == "metre":
        raise InputError(
            f"{job.name}: the capture is already in metres and must have no size (got {settings.size:g} m)"
        )
    isolation = causes = None
    views: list[MaskedView] = []
    if job.kind == "object":
        views, causes = _masked_views(capture, settings.view_size)
        isolation = isolate_object(splats, views, progress=progress)
        splats = isolation.splats
    cameras = [photo.camera.fitted(settings.view_size) for photo in capture.training]
    alignment = pose = refinement = proxy = None
    if imported is None:
        floor = 0.0 if job.kind == "object" and capture.table and _may_stand_on_table(splats) else None
        if job.kind == "object":
            proxy = find_proxy_surface(splats, views, settings.surface, floor=floor, progress=progress)
            mesh = proxy.mesh
        else:
            mesh = reconstruct_surface(splats, cameras, settings=settings.surface, progress=progress)
        if settings.refine is not None:
            refinement = refine_mesh(mesh, views, settings.refine, floor=floor, progress=progress)
            mesh = refinement.mesh
    else:
        metric = capture.units == "metre"
        mesh, alignment, pose = _place_mesh(imported, splats, cameras, views, metric=metric, progress=progress)
        mesh = simplify_surface(mesh, settings.surface.faces)
    if progress is not None:
        progress(0, 1, "evaluating held-out photos")
    held_out = show_held_out(splats, mesh, capture.held_out, settings.verdict_size)
    verdict = compute_verdict(capture, splats, mesh, held_out, isolation=isolation, psnr=psnr, causes=causes)
    if proxy is not None:
        verdict = replace(verdict, surface=proxy.source, surface_faults=proxy.faults)
    refined = {"Refinement of the mesh": refinement, "Pose of the mesh": pose}
    verdict = replace(verdict, rows={name: str(one) for name, one in refined.items() if one is not None})
    asset = Asset(
        name=job.name,
        class_name=job.class_name or job.name,
        splats=splats,
        mesh=mesh,
        kind=job.kind,
        units=capture.units,
        capture_light="uniform" if job.kind == "object" else "scene",
    )
    asset, asset_from_capture = _in_metres(asset, job, alignment)
    if job.kind == "object":
        if progress is not None:
            progress(0, 1, "splitting the mesh into convex pieces")
        asset = replace(asset, pieces=convex_pieces(mesh if asset.mesh is None else asset.mesh))
    verdict = replace(verdict, units=asset.units)
    return Reconstruction(asset, verdict, held_out, isolation, alignment, refinement, asset_from_capture, pose=pose)


def _masked_views(capture: Capture, size: int) -> tuple[list[MaskedView], dict[str, str]]:
    """Return the training photos with masks, at most ``size`` px long, and the measured causes of low figures."""
    pictures = {photo.name: photo.fitted(size) for photo in capture.photos}
    views = [
        MaskedView(picture.camera, picture.mask, picture.hidden)
        for picture in (pictures[photo.name] for photo in capture.training)
        if picture.mask is not None
    ]
    if len(views) < 3:
        raise InputError(f"an object needs photos with masks from at least 3 sides (got {len(views)})")
    return views, find_causes(capture, [picture[:3] for picture in pictures.values()])


_MAX_SHARE_BELOW = 0.02
"""Largest share of an object below its table, in number of Gaussians and in height."""


def _may_stand_on_table(splats: Splats) -> bool:
    """Return True if z = 0 can be the support of the object.

    It is not if the tags are on the object itself, or if the board lies beside the object on a box.
    """
    height = splats.means[:, 2]
    return bool(
        np.quantile(height, _MAX_SHARE_BELOW)
        > -_MAX_SHARE_BELOW
        * np.ptp(np.quantile(splats.means, (_MAX_SHARE_BELOW, 1 - _MAX_SHARE_BELOW), axis=0), axis=0).max()
    )


def _in_metres(asset: Asset, job: AssetJob, alignment: Alignment | None) -> tuple[Asset, Float64Array]:
    """Scale an asset to the stated size, or by the unit of an imported mesh if its own units are unknown.

    Returns:
        The asset, and the transform (4, 4) from the frame of the capture to its own.
    """
    size, imported = job.settings.size, job.imported
    if size is not None:
        turn = _alignment_rotation(asset.mesh)
        asset = asset.transformed(turn)
        return asset.resized(size), scaling(asset.factor_to(size)) @ turn
    if asset.units == "metre" or imported is None or imported.metres_per_unit is None:
        return asset, np.eye(4)
    capture_from_mesh = imported.capture_from_mesh if alignment is None else alignment.splats_from_mesh
    if capture_from_mesh is None:
        return asset, np.eye(4)
    metres = imported.metres_per_unit / split_similarity(capture_from_mesh)[1]
    return replace(asset.scaled(metres), units="metre"), scaling(metres)


def _alignment_rotation(mesh: trimesh.Trimesh) -> Float64Array:
    """Return the smallest rotation about z (4, 4) that aligns the smallest upright box around a mesh with the axes.

    A ruler measures that box. Extents along arbitrary camera axes can be almost 50 % larger.
    """
    flat, _ = trimesh.bounds.oriented_bounds_2D(np.asarray(mesh.vertices)[:, :2])
    angle = float(np.arctan2(flat[1, 0], flat[0, 0]))
    angle -= np.pi / 2 * round(angle / (np.pi / 2))
    return np.asarray(trimesh.transformations.rotation_matrix(angle, (0, 0, 1)))


def _place_mesh(
    imported: ImportedMesh,
    splats: Splats,
    cameras: Sequence[Camera],
    views: Sequence[MaskedView],
    *,
    metric: bool,
    progress: Progress | None,
) -> tuple[trimesh.Trimesh, Alignment | None, RefinedPose | None]:
    """Return the mesh in the capture's frame, its registration, and the refinement of its pose by the masks.

    The registration is None if the transform was given, and the refinement is None without a registration or masks. In
    a ``metric`` capture, a mesh of stated units keeps its size: the surface of splats on metal is often too small.
    """
    mesh = imported.mesh.copy()
    if imported.capture_from_mesh is not None:
        mesh.apply_transform(imported.capture_from_mesh)
        return mesh, None, None
    scale = imported.metres_per_unit if metric else None
    points = surface_points(splats, cameras)
    alignment = register_mesh(imported.mesh, points, scale)
    mesh.apply_transform(alignment.splats_from_mesh)
    if not views:
        return mesh, alignment, None
    pose = refine_pose(mesh, views, rigid=scale is not None, progress=progress)
    if pose.kept:
        mesh.apply_transform(pose.motion)
        matrix = pose.motion @ alignment.splats_from_mesh
        alignment = Alignment(matrix, measure_offset(mesh, points).spread)
    return mesh, alignment, pose
