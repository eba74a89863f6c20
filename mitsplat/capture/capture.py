"""Captures: photographs with their cameras, and the points that these were found from.

A folder holds ``capture.json`` (:class:`CaptureSpec` lists its keys), ``points.npz``, ``images/`` and ``masks/``.
Cameras and points share the frame of the asset that is to be made of them; conventions are those of
:mod:`mitsplat.gaussians.splat_cloud`.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera, Lens
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.storage.files import IMAGE_ERRORS, copied, file_inside, write_file, write_text
from mitsplat.storage.format_version import FORMAT_VERSIONS
from mitsplat.storage.yaml_input import load_yaml

HELD_OUT_EVERY = 8
"""One photo in so many, by name, is kept for evaluation (Kerbl et al. 2023, after Mip-NeRF 360)."""

CAPTURE_FILE = "capture.json"
_POINTS = "points.npz"
_Row = tuple[float, float, float, float]
_Gain = Annotated[float, Field(gt=0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PhotoCamera(_Strict):
    """A camera's keys: those of :class:`~mitsplat.geometry.camera.Camera`."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    near: float
    lens: Lens = "opencv"
    world_from_camera: tuple[_Row, _Row, _Row, _Row]


class PhotoSpec(_Strict):
    """A photo's keys; files are relative to the folder, ``gain`` is absent where a photo is as it was taken."""

    name: str = Field(min_length=1)
    file: str = Field(min_length=1)
    mask: str | None = None
    camera: PhotoCamera
    gain: tuple[_Gain, _Gain, _Gain] | None = Field(None, exclude_if=lambda gain: gain is None)


class CaptureSpec(_Strict):
    """Keys of ``capture.json``."""

    format_version: int = Field(1, ge=1)
    units: Literal["metre", "unknown"]
    up: Literal["z", "unknown"]
    table: bool = False
    scale_error: Annotated[float, Field(ge=0)] | None = None
    rejected: dict[str, str]
    photos: list[PhotoSpec]


Window = tuple[int, int, int, int]
"""Part of a photo: left, top, width and height [px]."""


@dataclass(frozen=True, eq=False)
class Photo:
    """One registered photograph.

    Attributes:
        name: File name as the user knows it.
        file: The image, upright as the camera has it.
        camera: From where and through which lens; its frame is the capture's.
        mask: 8-bit image of the same size, 255 = object; transparent where another thing may hide the object.
        seen: Indices of the capture's points that this photo observes, shape (K,).
        gain: What its linear red, green and blue are multiplied by to look as the capture's other photos; None: they
            are as they are.
    """

    name: str
    file: Path
    camera: Camera
    mask: Path | None = None
    seen: Int32Array = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    gain: tuple[float, float, float] | None = None

    def picture(self, scale: float = 1.0, window: Window | None = None) -> tuple[Float32Array, Float32Array | None]:
        """The photo, display-encoded in [0, 1], shape (H, W, 3), and its mask as alpha, shape (H, W), or None.

        Its exposure is corrected by ``gain``.

        Args:
            scale: Size relative to the camera's, at most 1; pixels are averages over the area they cover. The camera of
                the picture is ``camera.resized(W, H)``.
            window: Part of the photo to show, by left, top, width and height [px], inside of it; the camera is then
                ``camera.cropped(*window).resized(W, H)``.

        Raises:
            InputError: If a file cannot be read or has another size than the camera.
            ValueError: If ``scale`` is not in (0, 1].
        """
        return self.read(scale, window)[:2]

    def read(
        self, scale: float = 1.0, window: Window | None = None
    ) -> tuple[Float32Array, Float32Array | None, Float32Array | None]:
        """The two of :meth:`picture`, and :meth:`hidden`; the mask is read once for both."""
        if not 0 < scale <= 1:
            raise ValueError(f"scale must be in (0, 1] (got {scale})")
        rgb = self._pixels(self.file, ("RGB",), scale, window)
        if self.gain is not None:
            rgb = np.clip(encode_srgb(decode_srgb(rgb) * self.gain), 0, 1).astype(np.float32)
        return rgb, *self._matte(scale, window)

    def alpha(self, scale: float = 1.0, window: Window | None = None) -> Float32Array | None:
        """The mask of :meth:`picture` alone, for which the photo need not be read."""
        return self._matte(scale, window)[0]

    def hidden(self, scale: float = 1.0, window: Window | None = None) -> Float32Array | None:
        """Where in :meth:`picture` another thing may hide the object, (H, W) in [0, 1]; None where nothing does."""
        return self._matte(scale, window)[1]

    def _matte(self, scale: float, window: Window | None) -> tuple[Float32Array | None, Float32Array | None]:
        if self.mask is None:
            return None, None
        values = self._pixels(self.mask, ("L", "LA"), scale, window)
        return (values, None) if values.ndim == 2 else (values[..., 0].copy(), 1 - values[..., 1])

    def _pixels(self, path: Path, modes: Sequence[str], scale: float, window: Window | None) -> Float32Array:
        """An image in its mode if that is among ``modes``, else in the first of them."""
        with _opened(path) as image:
            pixels = image.convert(image.mode if image.mode in modes else modes[0])
        size = (self.camera.width, self.camera.height)
        if pixels.size != size:
            raise InputError(
                f"{path}: must be of its camera's {size[0]}x{size[1]} px (got {pixels.width}x{pixels.height})"
            )
        if window is not None:
            (left, top), size = window[:2], window[2:]
            pixels = pixels.crop((left, top, left + size[0], top + size[1]))
        values = np.asarray(pixels, dtype=np.float32) / np.float32(255)
        target = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
        return values if target == size else np.asarray(cv2.resize(values, target, interpolation=cv2.INTER_AREA))


def known_where(hidden: Float32Array | None, camera: Camera) -> BoolArray:
    """Where a mask says whether there is the object, as nothing hides it by :meth:`Photo.hidden`, (H, W)."""
    return np.ones((camera.height, camera.width), dtype=bool) if hidden is None else np.asarray(hidden == 0)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image file; what is wrong with it is one sentence."""
    try:
        with Image.open(path) as image:
            yield image
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IMAGE_ERRORS as error:
        raise InputError(f"{path}: not a readable image ({error})") from error


@dataclass(frozen=True, eq=False)
class Capture:
    """Photographs of one object or place, and what their structure from motion found.

    Attributes:
        photos: Registered photos, sorted by name.
        points: Triangulated points, shape (N, 3).
        colours: Of the points, display-encoded 8-bit, shape (N, 3).
        units: Whether cameras and points are in metres; if not, their scale is arbitrary.
        up: Whether +z points against gravity.
        table: Whether z = 0 is a plane that things stand on.
        rejected: Why a given photo is not among ``photos``, one clause, by name.
        scale_error: Estimated relative error of the metric scale, if known.

    Raises:
        ValueError: If a name occurs twice, shapes do not match, or a photo sees a point that does not exist.
    """

    photos: tuple[Photo, ...]
    points: Float64Array
    colours: npt.NDArray[np.uint8]
    units: Literal["metre", "unknown"] = "unknown"
    up: Literal["z", "unknown"] = "unknown"
    rejected: Mapping[str, str] = field(default_factory=dict)
    scale_error: float | None = None
    table: bool = False

    def __post_init__(self) -> None:
        photos = tuple(sorted(self.photos, key=lambda photo: photo.name))
        names = [photo.name for photo in photos]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"names of photos must be unique (got {twice} twice)")
        points = np.array(self.points, dtype=np.float64)
        colours = np.array(self.colours, dtype=np.uint8)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"points must be finite, of shape (N, 3) (got shape {points.shape})")
        if colours.shape != points.shape:
            raise ValueError(f"colours must have the points' shape {points.shape} (got {colours.shape})")
        for photo in photos:
            if photo.seen.size and (photo.seen.min() < 0 or photo.seen.max() >= len(points)):
                raise ValueError(f"{photo.name} must see points from 0 to {len(points) - 1} (got {photo.seen.max()})")
        points.flags.writeable = colours.flags.writeable = False
        for name, value in (("photos", photos), ("points", points), ("colours", colours)):
            object.__setattr__(self, name, value)

    @property
    def held_out(self) -> tuple[Photo, ...]:
        """Photos for evaluation: the first of every eight."""
        return self.photos[::HELD_OUT_EVERY]

    @property
    def training(self) -> tuple[Photo, ...]:
        """The photos that are not held out."""
        return tuple(photo for index, photo in enumerate(self.photos) if index % HELD_OUT_EVERY)

    def picked(self, pick: str) -> tuple[Photo, tuple[float, float]]:
        """The photo and the pixel that PHOTO:X,Y means.

        Raises:
            InputError: If it means none.
        """
        name, _, pixel = pick.rpartition(":")
        photos = {photo.name: photo for photo in self.photos}
        if name not in photos:
            raise InputError(f"{pick}: a pick must be PHOTO:X,Y with a registered photo, such as {min(photos)}:400,300")
        try:
            x, y = map(float, pixel.split(","))
        except ValueError:
            raise InputError(f"{pick}: a pixel must be given as X,Y (got {pixel})") from None
        return photos[name], (x, y)

    def transformed(self, matrix: npt.ArrayLike) -> Capture:
        """Cameras and points after a similarity transform (4, 4), near distances scaled; units and up are left.

        Where the table is, is forgotten.

        Raises:
            ValueError: If the matrix shears, mirrors or scales unevenly.
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        if not (
            scale > 0 and np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, scale**2 * np.eye(3), atol=1e-9 * scale**2)
        ):
            raise ValueError("a capture is moved by rotation, uniform scale and translation only")
        return replace(
            self,
            photos=tuple(replace(photo, camera=photo.camera.transformed(matrix)) for photo in self.photos),
            points=self.points @ matrix[:3, :3].T + matrix[:3, 3],
            table=False,
        )

    def save(self, folder: str | PathLike[str]) -> Capture:
        """Write the capture as a folder, images and masks copied into it, and return it with these files.

        Raises:
            InputError: If the folder cannot be written or a file is missing.
        """
        folder = Path(folder)
        photos = []
        try:
            (folder / CAPTURE_FILE).unlink(missing_ok=True)  # an earlier capture's is not of these photos
            for photo in self.photos:
                file = copied(photo.file, folder / "images" / stored_name(photo.name, photo.file.suffix))
                mask = None if photo.mask is None else copied(photo.mask, folder / "masks" / mask_name(photo.name))
                photos.append(replace(photo, file=file, mask=mask))
            files = {path for photo in photos for path in (photo.file, photo.mask) if path is not None}
            if len(files) < sum(1 + (photo.mask is not None) for photo in photos):
                raise InputError(f"{folder}: photos need names that differ in more than folder marks and suffix")
            seen = [photo.seen for photo in photos]
            arrays: dict[str, Any] = {
                "points": self.points,
                "colours": self.colours,
                "seen": np.concatenate([*seen, np.zeros(0)]).astype(np.int32),
                "seen_counts": np.array([len(indices) for indices in seen], dtype=np.int64),
            }

            def write_points(temporary: Path) -> None:
                with temporary.open("wb") as file:
                    np.savez_compressed(file, **arrays)

            write_file(folder / _POINTS, write_points)
            spec = CaptureSpec(
                format_version=FORMAT_VERSIONS[CAPTURE_FILE],
                units=self.units,
                up=self.up,
                table=self.table,
                scale_error=self.scale_error,
                rejected=dict(sorted(self.rejected.items())),
                photos=[_photo_spec(photo, folder) for photo in photos],
            )
            # Last, so that an interrupted save is not mistaken for a capture.
            write_text(folder / CAPTURE_FILE, json.dumps(spec.model_dump(), indent=1) + "\n")
        except OSError as error:
            raise InputError(f"{error.filename or folder}: cannot be written ({error.strerror})") from error
        return replace(self, photos=tuple(photos))

    @classmethod
    def load(cls, folder: str | PathLike[str]) -> Capture:
        """Read a capture's folder; images are read only by :meth:`Photo.picture`.

        Raises:
            InputError: If a file is missing, of a newer version or breaks a rule.
        """
        folder = Path(folder)
        spec = load_yaml(folder / CAPTURE_FILE, CaptureSpec, newest=FORMAT_VERSIONS[CAPTURE_FILE])
        try:
            with (folder / _POINTS).open("rb") as stored, np.load(stored, allow_pickle=False) as arrays:
                points, colours = arrays["points"], arrays["colours"]
                seen, counts = arrays["seen"], arrays["seen_counts"]
        except FileNotFoundError:
            raise InputError(f"{folder / _POINTS}: no such file") from None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{folder / _POINTS}: not a capture's points ({error})") from error
        whole = seen.dtype.kind in "iu" and counts.dtype.kind in "iu"
        if not whole or np.any((counts < 0) | (counts > len(seen))):
            raise InputError(f"{folder / _POINTS}: must count points in whole numbers of 0 to {len(seen)}")
        if len(counts) != len(spec.photos) or counts.sum() != len(seen):
            raise InputError(
                f"{folder / _POINTS}: must count the points of {len(spec.photos)} photos (got {len(counts)})"
            )
        starts = np.cumsum(counts)[:-1]
        photos = []
        for entry, indices in zip(spec.photos, np.split(seen, starts) if len(counts) else [], strict=True):
            try:
                camera = Camera(**entry.camera.model_dump())
            except ValueError as error:
                raise InputError(f"{folder / CAPTURE_FILE}: {entry.name}: {error}") from error
            file = _named_file(folder, entry.file)
            mask = None if entry.mask is None else _named_file(folder, entry.mask)
            photos.append(Photo(entry.name, file, camera, mask, indices, entry.gain))
        try:
            known = {key: getattr(spec, key) for key in ("units", "up", "rejected", "scale_error", "table")}
            return cls(tuple(photos), points, colours, **known)
        except ValueError as error:
            raise InputError(f"{folder}: {error}") from error


def stored_name(name: str, suffix: str) -> str:
    """File name of a photo's image of some format: the photo's own, without folder marks, where its suffix agrees."""
    flat = name.replace("/", "__")
    return flat if Path(flat).suffix.lower() == suffix.lower() else flat + suffix


def mask_name(name: str) -> str:
    """File name of a photo's mask, as COLMAP has it."""
    return f"{name.replace('/', '__')}.png"


def _named_file(folder: Path, name: str) -> Path:
    """A file that ``capture.json`` names, see :func:`mitsplat.storage.files.file_inside`."""
    try:
        return file_inside(folder, name)
    except InputError as error:
        raise InputError(f"{folder / CAPTURE_FILE}: {error}") from error


def _photo_spec(photo: Photo, folder: Path) -> PhotoSpec:
    camera = photo.camera
    return PhotoSpec(
        name=photo.name,
        file=photo.file.relative_to(folder).as_posix(),
        mask=None if photo.mask is None else photo.mask.relative_to(folder).as_posix(),
        gain=photo.gain,
        camera=PhotoCamera(
            **{key: getattr(camera, key) for key in PhotoCamera.model_fields if key != "world_from_camera"},
            world_from_camera=tuple(map(tuple, camera.world_from_camera.tolist())),
        ),
    )
