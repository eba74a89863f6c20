"""Quality of an asset made of photographs, as figures and as sentences with advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import binary_erosion

from mitsplat.arrays import BoolArray, Float32Array, evenly_spaced
from mitsplat.capture.capture import Capture, Photo, known_where
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_training import trained_kernel
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.solids import is_closed
from mitsplat.images.colour import encode_srgb
from mitsplat.images.masks import iou
from mitsplat.quality import resolve_quality
from mitsplat.reconstruct.registration import measure_offset, surface_points
from mitsplat.reconstruct.segment_splats import Isolation
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers

VERDICT_FILE = "verdict.json"
T = TypeVar("T")


@dataclass(frozen=True)
class Thresholds:
    """Quality thresholds of an asset for training sets.

    Attributes:
        registered: Least share of the photos with a camera pose.
        psnr: Least PSNR of held-out photos [dB].
        splat_iou: Least mean IoU of the splats' alpha with the masks of held-out photos.
        mesh_iou: Least mean IoU of the mesh's silhouette with these masks.
        offset: Largest shift between mesh and splats, as a share of the diagonal.
        scale_error: Largest relative error of the metric scale, if it is known.
        lost: Largest share of the object that isolation removed with its surroundings.
    """

    registered: float = 0.75
    psnr: float = 24.0
    splat_iou: float = 0.95
    mesh_iou: float = 0.94
    offset: float = 0.005
    scale_error: float = 0.01
    lost: float = 0.05


_ADVICE = {
    "registered": "take photos with more overlap, 10 to 15 degrees apart, and put newsprint or another texture below",
    "psnr": "use even light, fixed exposure and sharp photos, and fit longer",
    "splat_iou": "check the masks in the report, and replace bad ones",
    "mesh_iou": "check the masks in the report, and photograph the object from more heights",
    "watertight": "photograph the object from all sides, or import a closed mesh",
    "offset": "fit longer, or check the frame and scale of an imported mesh",
    "scale_error": "measure a longer distance, or place the board where more photos see it",
    "surface": "check masks and splats in the report, replace bad masks, or fit longer",
    "lost": "check for parts of the object outside the masks",
}


@dataclass(frozen=True, eq=False)
class AssetView:
    """Rendering of an asset's splats and mesh from one camera.

    Attributes:
        camera: Camera at the size of these pictures.
        render: Splats, display-encoded and multiplied by alpha, (H, W, 3).
        alpha: Alpha of the splats, (H, W).
        mesh: True if the mesh covers the centre of the pixel, (H, W).
        normal: Unit normals of the mesh in the world, (H, W, 3).
    """

    camera: Camera
    render: Float32Array
    alpha: Float32Array
    mesh: BoolArray
    normal: Float32Array

    @property
    def picture(self) -> Float32Array:
        """Splats over grey, display-encoded, (H, W, 3)."""
        return np.asarray(self.render + 0.5 * (1 - self.alpha[..., None]), dtype=np.float32)

    def shaded(self, behind: Float32Array | float, share: float = 1.0) -> Float32Array:
        """Return the mesh, lit from the camera, over ``behind`` (H, W, 3); ``share`` is the opacity of the mesh."""
        towards = -self.camera.world_from_camera[:3, 2]
        light = 0.25 + 0.75 * np.clip(self.normal @ towards, 0, 1)
        grey = np.repeat(light[..., None], 3, axis=2) * (1.0, 0.75, 0.45)
        cover = share * self.mesh[..., None]
        return np.asarray(cover * grey + (1 - cover) * behind, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class HeldOutView(AssetView):
    """A held-out photo and the rendering of the asset from its camera.

    Attributes:
        name: Name of the photo.
        photo: Display-encoded colours, (H, W, 3).
        mask: Share of each pixel that the object covers, (H, W), or None.
        known: True where no other object may hide the object, (H, W).
    """

    name: str
    photo: Float32Array
    mask: Float32Array | None
    known: BoolArray


@dataclass(frozen=True)
class Verdict:
    """Quality figures of an asset; None if unknown or not applicable.

    Attributes:
        photos: Number of photos with a camera pose.
        rejected: Number of photos without a pose, or refused.
        psnr: PSNR of held-out photos, as the fit reports it [dB].
        psnr_object: PSNR of the object's pixels in held-out photos after isolation, without outline pixels [dB].
        splat_iou: Mean IoU of the splats' alpha with held-out masks.
        mesh_iou: Mean IoU of the mesh's silhouette with held-out masks.
        offset: Shift between mesh and the splats' surface, as a share of the mesh's diagonal.
        spread: Median distance between mesh and the splats' surface, in the same unit.
        lost: Share of the object that isolation removed.
        scale_error: Estimated relative error of the metric scale.
        units: Unit of the asset.
        gaussians: Number of Gaussians.
        faces: Number of faces of the mesh.
        watertight: True if the mesh encloses a volume.
        solid: True if the mesh must enclose a volume, as that of an object.
        causes: Measured causes in the photos, one clause each, by the threshold that they affect.
        surface: Source of the reconstructed mesh of an object, or None.
        surface_faults: Reasons why finer surfaces were rejected, one clause each.
        rows: Further figures in words, by their names.
        findings: Further problems, one sentence each with advice.
    """

    photos: int
    rejected: int
    psnr: float | None
    psnr_object: float | None
    splat_iou: float | None
    mesh_iou: float | None
    offset: float | None
    spread: float | None
    lost: float | None
    scale_error: float | None
    units: str
    gaussians: int
    faces: int
    watertight: bool
    solid: bool
    causes: Mapping[str, str] = field(default_factory=dict)
    surface: str | None = None
    surface_faults: tuple[str, ...] = ()
    rows: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("surface_faults", "findings"):  # JSON has lists
            object.__setattr__(self, name, tuple(getattr(self, name)))

    @property
    def registered(self) -> float:
        """Share of the photos with a camera pose."""
        return self.photos / max(1, self.photos + self.rejected)

    def misses(self) -> tuple[str, ...]:
        """Return a sentence with advice for each threshold that is missed."""
        thresholds = Thresholds()
        least = {
            "registered": f"only {self.photos} of {self.photos + self.rejected} photos have a camera pose",
            "psnr": f"held-out photos have a PSNR of only {self.psnr or 0:.1f} dB",
            "splat_iou": f"the splats have an IoU with held-out masks of only {self.splat_iou or 0:.3f}",
            "mesh_iou": f"the mesh has an IoU with held-out masks of only {self.mesh_iou or 0:.3f}",
        }
        most = {
            "offset": f"the shift between mesh and splats is {self.offset or 0:.2%} of the diagonal",
            "scale_error": f"the error of the scale is {self.scale_error or 0:.1%}",
            "lost": f"isolation removed {self.lost or 0:.1%} of the object",
        }
        found = []
        for names, sign in ((least, 1.0), (most, -1.0)):
            for name, sentence in names.items():
                value, limit = getattr(self, name), getattr(thresholds, name)
                if value is not None and sign * value < sign * limit:
                    rule = "at least" if sign > 0 else "at most"
                    wanted = f"{100 * limit:g}%" if "%" in sentence else f"{limit:g}"
                    found.append(f"{sentence} ({rule} {wanted} is required): {self._advice(name)}")
        if self.surface_faults:
            found.append(
                f"the mesh is only the {self.surface}, because {', and '.join(self.surface_faults)}: "
                f"{self._advice('surface')}"
            )
        if self.solid and not self.watertight:
            found.append(f"the mesh is open (a closed mesh is required): {self._advice('watertight')}")
        return (*found, *self.findings)

    def _advice(self, name: str) -> str:
        """Return the measured cause, if any, and the advice for a threshold."""
        return "; ".join(filter(None, [self.causes.get(name), _ADVICE[name]]))


def show_held_out(
    splats: Splats, mesh: trimesh.Trimesh | None, photos: Sequence[Photo], size: int
) -> list[HeldOutView]:
    """Render splats and mesh from the cameras of photos; the longest edge is at most ``size`` px."""
    sized = [photo.fitted(size) for photo in photos]
    shown = show_asset(splats, mesh, [camera for camera, *_ in sized])
    return [
        HeldOutView(**vars(view), name=photo.name, photo=rgb, mask=mask, known=known_where(hidden, camera))
        for photo, (camera, rgb, mask, hidden), view in zip(photos, sized, shown, strict=True)
    ]


def show_asset(splats: Splats, mesh: trimesh.Trimesh | None, cameras: Sequence[Camera]) -> list[AssetView]:
    """Render splats and mesh from cameras."""
    quality = replace(resolve_quality("balanced"), kernel=trained_kernel([splats.kernel]))
    integrator = make_integrator(quality=quality, shadow="none")
    scene = mi.load_dict({"type": "scene", "splats": make_splats_shape(splats, instance=1, proxy=mesh)})
    views = []
    for camera in cameras:
        layers = render_layers(integrator, scene, camera)
        alpha = np.maximum(layers.alpha, 1e-6)[..., None]
        views.append(
            AssetView(
                camera=camera,
                render=(encode_srgb(layers.captured / alpha) * layers.alpha[..., None]).astype(np.float32),
                alpha=layers.alpha,
                mesh=layers.proxy_instance > 0,
                normal=layers.normal,
            )
        )
    return views


def compute_verdict(
    capture: Capture,
    splats: Splats,
    mesh: trimesh.Trimesh | None,
    views: Sequence[HeldOutView],
    *,
    isolation: Isolation | None,
    psnr: float | None,
    causes: Mapping[str, str] | None = None,
) -> Verdict:
    """Compute the quality figures from held-out views of splats and mesh."""
    masked = [(view, view.mask >= 0.5) for view in views if view.mask is not None and (view.mask >= 0.5).any()]
    errors = [float(((view.render - view.photo)[_inside(mask)] ** 2).mean()) for view, mask in masked]
    offset = None
    if mesh is not None and views:
        offset = measure_offset(mesh, surface_points(splats, [view.camera for view in views]))
    return Verdict(
        photos=len(capture.photos),
        rejected=len(capture.rejected),
        psnr=psnr,
        psnr_object=_mean([psnr_of(error) for error in errors]),
        splat_iou=_mean([iou((view.alpha >= 0.5) & view.known, mask) for view, mask in masked]),
        mesh_iou=None if mesh is None else _mean([iou(view.mesh & view.known, mask) for view, mask in masked]),
        offset=None if offset is None else offset.shift,
        spread=None if offset is None else offset.spread,
        lost=None if isolation is None else isolation.lost,
        scale_error=capture.scale_error,
        units=capture.units,
        gaussians=len(splats),
        faces=0 if mesh is None else len(mesh.faces),
        watertight=mesh is not None and is_closed_when_read(mesh),
        solid=isolation is not None,
        causes=causes or {},
    )


def is_closed_when_read(mesh: trimesh.Trimesh) -> bool:
    """Return True if a mesh is closed after vertices at the same position are merged, as readers of its file do."""
    welded = mesh.copy()
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    return is_closed(welded)


def take_evenly(items: Sequence[T], count: int) -> list[T]:
    """Return at most ``count`` of the items, at equal intervals."""
    return [items[i] for i in evenly_spaced(len(items), count)]


def _inside(mask: BoolArray) -> BoolArray:
    """Return a mask without its outline pixels, which also show the background.

    If no other pixels are left, return the mask itself.
    """
    inner = np.asarray(binary_erosion(mask))
    return inner if inner.any() else mask


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
