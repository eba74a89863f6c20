"""Result of an import: the asset, what was removed and found, and problems with their remedies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from mitsplat.asset import Asset
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.importing.upright import Upright
from mitsplat.reconstruct.asset_evaluation import AssetView, Thresholds


@dataclass(frozen=True, eq=False)
class ImportSupport:
    """Horizontal surface of an environment for dropping objects; its centre is the origin.

    Attributes:
        size: Size along x and y [m].
        share: Fraction of the visible area that lies in the surface.
    """

    size: tuple[float, float]
    share: float


@dataclass(frozen=True, eq=False)
class Imported:
    """Imported asset and the results of the import.

    Attributes:
        asset: Asset in metres, or in the file's units where these are unknown; z up. An object stands on z = 0 with the
            centre of its base at the origin. For an environment, the origin is the centre of its largest horizontal
            surface.
        upright: Estimated up direction, in the file's axes, and its reason.
        found: Number of Gaussians in the file.
        removed: Number of removed Gaussians, by reason.
        removed_splats: Removed Gaussians, in the asset's frame.
        support: Surface of an environment for dropping objects, or None.
        watertight: True if the mesh encloses a volume.
        topples: True if the object would fall over in its pose.
        views: Pictures of asset and mesh from views that were not used for the reconstruction.
        mesh_iou: Mean IoU of the silhouettes of mesh and splats in these views, for an object.
        offset: Shift between the mesh and the surface of the splats, as a fraction of the mesh's diagonal.
    """

    asset: Asset
    upright: Upright = field(repr=False)
    found: int
    removed: dict[str, int]
    removed_splats: Splats
    support: ImportSupport | None
    watertight: bool
    topples: bool
    views: Sequence[AssetView] = field(default=(), repr=False)
    mesh_iou: float | None = None
    offset: float | None = None

    @property
    def removed_of_all(self) -> str:
        """Summary of the remaining and the removed Gaussians, as text."""
        removed = ", ".join(f"{count} {reason}" for reason, count in self.removed.items() if count) or "none"
        return f"{len(self.asset.splats)} of {self.found}; removed: {removed}"

    @property
    def training(self) -> str | None:
        """Training that the file states, with the kernel that renders it, as text; None if it states none."""
        kernel = self.asset.splats.kernel
        if kernel == "mip":
            return (
                "with antialiasing; scenes render it with `rendering: {kernel: mip}` unless they state another kernel"
            )
        if kernel in ("3dgs", "gsplat"):
            return f"without antialiasing; `rendering: {{kernel: {kernel}}}` in a scene renders it as it was trained"
        return None

    @property
    def misses(self) -> tuple[str, ...]:
        """Problems of the asset with their remedies, a sentence each."""
        asset, found, thresholds = self.asset, [], Thresholds()
        if asset.units == "unknown":
            found.append("its size is unknown: give --size, the longest extent in metres, or --units")
        if self.topples:
            found.append(
                "it would roll or fall over in the pose of the pictures: give --up if it lies on its side, or "
                "--flat-base if the capture lacks its underside"
            )
        if self.mesh_iou is not None and self.mesh_iou < thresholds.mesh_iou:
            found.append(
                f"the silhouettes of mesh and splats have an IoU of only {self.mesh_iou:.3f} (at least "
                f"{thresholds.mesh_iou:g} is expected): crop haze around the object, or give more --voxels"
            )
        if self.offset is not None and self.offset > thresholds.offset:
            found.append(
                f"mesh and splats are {self.offset:.2%} of the diagonal apart (at most {thresholds.offset:.2%} is "
                "expected): if the file contains more than the object, crop it"
            )
        if asset.kind == "object" and not self.watertight:
            found.append("the mesh is open (it must be closed): give more --voxels, or crop the surroundings")
        if asset.kind == "environment" and self.support is None:
            found.append("no horizontal surface was found: state shapes and the region of a scene by hand")
        return tuple(found)
