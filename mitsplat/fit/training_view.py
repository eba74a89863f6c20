"""A photo in a fit: its rays and pixels at the size of the fit, and its comparison with a rendering."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt
from PIL import Image

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.capture.capture import Photo, Window, stored_name
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
    """Image quality at a photo that was not fitted.

    Attributes:
        name: Name of the photo.
        psnr: PSNR of the whole picture [dB], black outside the mask.
        ssim: SSIM of the whole picture.
        psnr_object: PSNR of the masked pixels [dB]; ``psnr`` without mask.
    """

    name: str
    psnr: float
    ssim: float
    psnr_object: float


class TrainingView:
    """A photo at one size.

    Args:
        photo: The photo.
        scale: Size relative to the photo.
        masked: True to use the mask of the photo.
        inverse_depth: Depth map of the photo in any size, or None.
        window: Part of the photo that is used; the whole photo if None.

    Attributes:
        camera: Camera at that size.
        masked: True if a mask exists and is used.
        inverse_depth: Depth map [1/m], (H, W), NaN where unknown; or None.
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
        self._depths: tuple[mi.UInt32, mi.Float] | None = None
        self._half: TrainingView | None = None

    @property
    def half(self) -> TrainingView:
        """The same photo at half the size, read at the first access."""
        if self._half is None:  # cached_property of Python 3.11 has a lock that would serialise threads
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
        """Camera of the differentiable renderer."""
        return Eye(view_of(make_sensor(self.camera)))

    @cached_property
    def packed(self) -> mi.UInt32:
        """Flat pixels on the device, red in the lowest byte, the mask in the highest; see :func:`unpacked`.

        Pixels have four bytes, so that hundreds of photos fit in device memory. Kernels convert them to floats.
        """
        pixels = self._bytes
        self._pixels = None
        return wrapped(mi.UInt32, pixels.view(np.uint32))

    @cached_property
    def hidden(self) -> mi.Bool | None:
        """Flat mask on the device of the pixels where another object may hide the object; None if there are none."""
        return None if self._hidden is None else wrapped(mi.Bool, self._hidden.ravel())

    @property
    def mask(self) -> Float32Array:
        """Share of each pixel that the object covers, (H, W)."""
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

    def depths(self, points: Float64Array) -> tuple[mi.UInt32, mi.Float]:
        """Return pixels and inverse depths [1/m] on the device: of the depth map, or else of the visible points.

        ``points`` has shape (N, 3).
        """
        if self.inverse_depth is not None:
            # Not cached: the maps of hundreds of photos would not fit in device memory.
            number = np.flatnonzero(np.isfinite(self.inverse_depth) & (self.mask > 0.5))
            return wrapped(mi.UInt32, number.astype(np.uint32)), wrapped(mi.Float, self.inverse_depth.ravel()[number])
        if self._depths is None:
            seen = points[self._photo.seen]
            inside, column, row = self.camera.visible_pixels(seen)
            depth = self.camera.project(seen)[1][inside]
            shown = self.mask[row, column] > 0.5
            number = (row * self.camera.width + column)[shown].astype(np.uint32)
            inverse = (1 / depth[shown]).astype(np.float32)
            # One point per pixel, the nearest: gradients of several points would be summed in an undefined order.
            order = np.lexsort((-inverse, number))
            number, first = np.unique(number[order], return_index=True)
            inverse = inverse[order][first]
            self._depths = wrapped(mi.UInt32, number), wrapped(mi.Float, inverse)
        return self._depths

    def render(self, model: GaussianModel, quality: Quality) -> tuple[Float32Array, Float32Array]:
        """Render the splats; return display-encoded colour times alpha, (H, W, 3), and alpha, (H, W)."""
        seen = model.render(self.eye, quality)
        shape = self.camera.height, self.camera.width
        return np.stack([np.array(c).reshape(shape) for c in seen.rgb], axis=-1), np.array(seen.alpha).reshape(shape)

    def compare(self, seen: Float32Array, folder: Path | None) -> HeldOut:
        """Compare a rendering (H, W, 3) with the photo.

        If ``folder`` is not None, write both and their difference, 4 times as bright, side by side as an image.
        """
        cover = self.mask
        truth = self.picture
        seen = np.clip(seen, 0, 1)
        if self._hidden is not None:
            seen = np.where(self._hidden[..., None], truth, seen)  # the true colour is unknown there
        shown = cover > 0.5 if (cover > 0.5).any() else np.ones_like(cover, dtype=bool)
        if folder is not None:
            difference = np.clip(_DIFFERENCE_GAIN * np.abs(seen - truth), 0, 1)
            sheet = np.rint(np.concatenate([truth, seen, difference], axis=1) * 255).astype(np.uint8)
            file = folder / stored_name(self._photo.name, ".png")
            write_file(file, lambda path: Image.fromarray(sheet).save(path, format="PNG"))
        return HeldOut(
            name=self._photo.name,
            psnr=psnr(seen, truth),
            ssim=ssim(seen, truth),
            psnr_object=psnr(seen[shown], truth[shown]),
        )


def unpacked(packed: mi.UInt32) -> tuple[list[mi.Float], mi.Float]:
    """Return display-encoded colour times mask, and the mask, of the pixels of a :class:`TrainingView`."""
    red, green, blue, mask = (mi.Float((packed >> shift) & 0xFF) / 255 for shift in (0, 8, 16, 24))
    return [red * mask, green * mask, blue * mask], mask
