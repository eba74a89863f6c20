"""A photo as a fit sees it: its rays and pixels at the size of the fit, and the comparison with a render."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
from PIL import Image

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.capture.capture import Photo, Window
from mitsplat.fit.depth_priors import DepthMap, resize_map
from mitsplat.fit.image_metrics import psnr, ssim
from mitsplat.fit.optimizer import GaussianModel
from mitsplat.geometry.camera import Camera
from mitsplat.quality import Quality
from mitsplat.renderer.differentiation.backward import Eye
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.storage.files import write_file

_DIFFERENCE_GAIN = 4


@dataclass(frozen=True)
class HeldOut:
    """How a photo that was not fitted comes out.

    Attributes:
        name: Of the photo.
        psnr: Of the whole picture [dB], black where a mask leaves it out.
        ssim: Of the same.
        psnr_object: Of the pixels that the mask shows [dB]; ``psnr`` without mask.
        psnr_corrected: Of these after the affine colour correction that suits the photo best [dB].
    """

    name: str
    psnr: float
    ssim: float
    psnr_object: float
    psnr_corrected: float


class TrainingView:
    """A photo at one size.

    Args:
        photo: The photo.
        scale: Size relative to it.
        masked: Whether its mask is used.
        inverse_depth: Of its pixels, in any size, if they are known.
        window: The part of the photo that is used; all of it if None.

    Attributes:
        camera: Its camera at that size.
        masked: Whether it has a mask that is used.
        inverse_depth: Of its pixels [1/m], (H, W), NaN where unknown; or None.
    """

    def __init__(
        self,
        photo: Photo,
        scale: float,
        *,
        masked: bool,
        inverse_depth: DepthMap | None = None,
        window: Window | None = None,
    ) -> None:
        rgb, mask, hidden = photo.read(scale, window)
        height, width, _ = rgb.shape
        camera = photo.camera if window is None else photo.camera.cropped(*window)
        self.camera: Camera = camera.resized(width, height)
        self.masked = masked and mask is not None
        cover = mask if self.masked and mask is not None else np.ones((height, width), np.float32)
        pixels = np.rint(np.concatenate([rgb, cover[..., None]], axis=2) * 255).astype(np.uint8)
        self._pixels: npt.NDArray[np.uint8] | None = pixels
        self._photo, self._scale, self._mask_used, self._window = photo, scale, masked, window
        self._hidden = np.asarray(hidden > 0) if self.masked and hidden is not None else None
        self.inverse_depth = None if inverse_depth is None else resize_map(inverse_depth, width, height)
        self._depths: tuple[Any, Any] | None = None
        self._half: TrainingView | None = None

    @property
    def half(self) -> TrainingView:
        """The same photo at half the size, read when it is first asked for."""
        if self._half is None:  # a cached_property of Python 3.11 would let threads take turns
            self._half = TrainingView(
                self._photo,
                0.5 * self._scale,
                masked=self._mask_used,
                inverse_depth=self.inverse_depth,
                window=self._window,
            )
        return self._half

    @cached_property
    def eye(self) -> Eye:
        """The camera as the renderer takes it."""
        return Eye(view_of(make_sensor(self.camera)))

    @cached_property
    def packed(self) -> Any:
        """Its pixels on the device, flat, red in the lowest byte, the mask in the highest; see :func:`unpacked`.

        Four bytes per pixel, so that hundreds of photos fit in the device's memory; made to floats in the kernels.
        """
        pixels = self._bytes
        self._pixels = None
        return wrapped(mi.UInt32, pixels.view(np.uint32))

    @cached_property
    def hidden(self) -> Any:
        """On the device, flat, where another thing may hide the object; None where nothing does."""
        return None if self._hidden is None else wrapped(mi.Bool, self._hidden.ravel())

    @property
    def mask(self) -> Float32Array:
        """Share of every pixel that the object covers, (H, W)."""
        return np.asarray(self._bytes[..., 3] / np.float32(255), dtype=np.float32)

    @property
    def picture(self) -> Float32Array:
        """Display-encoded colour times mask, (H, W, 3)."""
        return np.asarray(self._bytes[..., :3] / np.float32(255) * self.mask[..., None], dtype=np.float32)

    @property
    def _bytes(self) -> npt.NDArray[np.uint8]:
        if self._pixels is not None:
            return self._pixels
        pixels: npt.NDArray[np.uint8] = np.array(self.packed).view(np.uint8)
        return pixels.reshape(self.camera.height, self.camera.width, 4)

    def depths(self, points: Float64Array) -> tuple[Any, Any]:
        """Pixels and inverse depths [1/m] on the device: of its map, else of the points (N, 3) that the photo sees."""
        if self.inverse_depth is not None:
            # Made anew each time: on the device, maps of hundreds of photos would not fit.
            number = np.flatnonzero(np.isfinite(self.inverse_depth) & (self.mask > 0.5))
            return wrapped(mi.UInt32, number.astype(np.uint32)), wrapped(mi.Float, self.inverse_depth.ravel()[number])
        if self._depths is None:
            pixels, depth = self.camera.project(points[self._photo.seen])
            inside = (
                (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < [self.camera.width, self.camera.height]).all(axis=1)
            )
            column, row = pixels[inside].astype(np.uint32).T
            shown = self.mask[row, column] > 0.5
            number = (row * self.camera.width + column)[shown]
            inverse = (1 / depth[inside][shown]).astype(np.float32)
            # One per pixel, the nearest: the gradients of several would be added in any order.
            order = np.lexsort((-inverse, number))
            number, first = np.unique(number[order], return_index=True)
            inverse = inverse[order][first]
            self._depths = wrapped(mi.UInt32, number), wrapped(mi.Float, inverse)
        return self._depths

    def render(self, model: GaussianModel, quality: Quality) -> tuple[Float32Array, Float32Array]:
        """Display-encoded colour times alpha, (H, W, 3), and alpha, (H, W), as the splats look from here."""
        seen = model.render(self.eye, quality)
        shape = self.camera.height, self.camera.width
        return np.stack([np.array(c).reshape(shape) for c in seen.rgb], axis=-1), np.array(seen.alpha).reshape(shape)

    def compare(self, seen: Float32Array, folder: Path | None) -> HeldOut:
        """A render (H, W, 3) against the photo; writes them and their difference, 4 times as bright, side by side."""
        cover = self.mask
        truth = self.picture
        seen = np.clip(seen, 0, 1)
        if self._hidden is not None:
            seen = np.where(self._hidden[..., None], truth, seen)  # nobody knows
        shown = cover > 0.5 if (cover > 0.5).any() else np.ones_like(cover, dtype=bool)
        design = np.column_stack([seen[shown], np.ones(shown.sum())])
        corrected = np.clip(design @ np.linalg.lstsq(design, truth[shown], rcond=None)[0], 0, 1)
        if folder is not None:
            difference = np.clip(_DIFFERENCE_GAIN * np.abs(seen - truth), 0, 1)
            sheet = np.rint(np.concatenate([truth, seen, difference], axis=1) * 255).astype(np.uint8)
            stem = Path(self._photo.name).with_suffix("").as_posix().replace("/", "_")
            write_file(folder / f"{stem}.png", lambda path: Image.fromarray(sheet).save(path, format="PNG"))
        return HeldOut(
            name=self._photo.name,
            psnr=psnr(seen, truth),
            ssim=ssim(seen, truth),
            psnr_object=psnr(seen[shown], truth[shown]),
            psnr_corrected=psnr(corrected, truth[shown]),
        )


def unpacked(packed: Any) -> tuple[list[Any], Any]:
    """Display-encoded colour times mask, and the mask, of the pixels of a :class:`TrainingView`."""
    red, green, blue, mask = (mi.Float((packed >> shift) & 0xFF) / 255 for shift in (0, 8, 16, 24))
    return [red * mask, green * mask, blue * mask], mask
