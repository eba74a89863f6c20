"""Captures: photographs with their cameras, and the points of structure from motion.

A capture folder has ``capture.json`` (keys: :class:`~mitsplat.capture.capture_spec.CaptureSpec`), ``points.npz``,
``images/`` and ``masks/``. Cameras and points are in the frame of the asset that is made from the capture. Conventions
are those of :mod:`mitsplat.gaussians.splat_cloud`.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from mitsplat.arguments import checks_arguments, number_from
from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from mitsplat.capture.capture_spec import CaptureSpec, PhotoCamera, PhotoSpec
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import split_similarity
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.file_kinds import no_folder_with
from mitsplat.storage.files import IMAGE_ERRORS, copy_file, resolve_inside, write_file, write_text
from mitsplat.storage.format_version import FORMAT_VERSIONS
from mitsplat.storage.yaml_input import load_yaml

HELD_OUT_EVERY = 8
"""Interval of held-out photos, in the order of names (Kerbl et al. 2023, after Mip-NeRF 360)."""

CAPTURE_FILE = "capture.json"
_POINTS = "points.npz"

Window = tuple[int, int, int, int]
"""Rectangle in a photo: left, top, width and height [px]."""


class PhotoPixels(NamedTuple):
    """Pixels of a photo.

    Attributes:
        rgb: Display-encoded colours in [0, 1], shape (H, W, 3).
        mask: Share of each pixel that the object covers, shape (H, W), or None without a mask.
        hidden: Possible occlusion of the object by other objects, (H, W) in [0, 1], or None without occlusion.
    """

    rgb: Float32Array
    mask: Float32Array | None
    hidden: Float32Array | None


class SizedPhoto(NamedTuple):
    """Camera of H x W pixels of a reduced photo, and its pixels as in :class:`PhotoPixels`."""

    camera: Camera
    rgb: Float32Array
    mask: Float32Array | None
    hidden: Float32Array | None


@dataclass(frozen=True, eq=False)
class Photo:
    """Registered photograph.

    Attributes:
        name: File name as given by the user.
        file: Image file, in the orientation of the camera.
        camera: Camera in the frame of the capture.
        mask: 8-bit image of the same size, 255 = object; transparent where another object may occlude the object.
        seen: Indices of the capture's points that this photo observes, shape (K,).
        gain: Factors of linear red, green and blue that match the exposure of the other photos; None for no correction.
    """

    name: str
    file: Path
    camera: Camera
    mask: Path | None = None
    seen: Int32Array = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    gain: tuple[float, float, float] | None = None

    def read(self, scale: float = 1.0, window: Window | None = None) -> PhotoPixels:
        """Read the photo, with its exposure corrected by ``gain``, and its mask.

        Args:
            scale: Size relative to the camera, at most 1. Pixels are averages over the area they cover. The camera of
                the returned picture is ``camera.resized(W, H)``.
            window: Rectangle of the photo to read: left, top, width and height [px], inside the photo. The camera is
                then ``camera.cropped(*window).resized(W, H)``.

        Raises:
            InputError: If a file cannot be read or its size differs from that of the camera.
            ValueError: If ``scale`` is not in (0, 1].
        """
        if not 0 < scale <= 1:
            raise ValueError(f"scale must be in (0, 1] (got {scale})")
        rgb = self._read_pixels(self.file, ("RGB",), scale, window)
        if self.gain is not None:
            rgb = np.clip(encode_srgb(decode_srgb(rgb) * self.gain), 0, 1).astype(np.float32)
        return PhotoPixels(rgb, *self.read_mask(scale, window))

    def read_mask(
        self, scale: float = 1.0, window: Window | None = None
    ) -> tuple[Float32Array | None, Float32Array | None]:
        """Read only the mask and the hidden area of :meth:`read`, shape (H, W) each."""
        if self.mask is None:
            return None, None
        values = self._read_pixels(self.mask, ("L", "LA"), scale, window)
        return (values, None) if values.ndim == 2 else (values[..., 0].copy(), 1 - values[..., 1])

    def fitted(self, size: float) -> SizedPhoto:
        """Read the photo with a longest edge of at most ``size`` px."""
        scale = min(1.0, size / max(self.camera.size))
        return SizedPhoto(self.camera.fitted(size), *self.read(scale))

    @cached_property
    def image_hash(self) -> str:
        """SHA-256 of the image file, computed once.

        Raises:
            InputError: If the file cannot be read.
        """
        digest = ContentHash()
        digest.add_file(self.file)
        return digest.hexdigest()

    def _read_pixels(self, path: Path, modes: Sequence[str], scale: float, window: Window | None) -> Float32Array:
        """Read an image, converted to the first of ``modes`` unless its mode is among them."""
        with _open_image(path) as image:
            pixels = image.convert(image.mode if image.mode in modes else modes[0])
        size = self.camera.size
        if pixels.size != size:
            raise InputError(
                f"{path}: must have the size of its camera, {size[0]}x{size[1]} px (got {pixels.width}x{pixels.height})"
            )
        if window is not None:
            (left, top), size = window[:2], window[2:]
            pixels = pixels.crop((left, top, left + size[0], top + size[1]))
        values = np.asarray(pixels, dtype=np.float32) / np.float32(255)
        target = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
        return values if target == size else np.asarray(cv2.resize(values, target, interpolation=cv2.INTER_AREA))


def known_where(hidden: Float32Array | None, camera: Camera) -> BoolArray:
    """Return the pixels in which nothing occludes the object, so that the mask is valid, shape (H, W).

    Args:
        hidden: Hidden area of a photo.
        camera: Camera that gives the size of the result.
    """
    return np.ones((camera.height, camera.width), dtype=bool) if hidden is None else np.asarray(hidden == 0)


@contextmanager
def _open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image file; all read errors are raised as InputError."""
    try:
        with Image.open(path) as image:
            yield image
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IMAGE_ERRORS as error:
        raise InputError(f"{path}: not a readable image ({error})") from error


def parse_pixel(text: str, place: str) -> tuple[float, float]:
    """Return the coordinates of a text X,Y.

    Raises:
        InputError: If it is no such text. The message begins with ``place``.
    """
    try:
        x, y = (number_from(part, float) for part in text.split(","))
    except ValueError:
        raise InputError(f"{place}: a pixel must be given as X,Y (got {text})") from None
    return x, y


@checks_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """Photographs of one object or place, with the result of structure from motion.

    Attributes:
        photos: Registered photos, sorted by name.
        points: Triangulated points, shape (N, 3).
        colours: Display-encoded 8-bit colours of the points, shape (N, 3).
        units: ``metre`` if cameras and points are in metres, ``unknown`` if their scale is arbitrary.
        up: ``z`` if +z points against gravity, else ``unknown``.
        table: True if z = 0 is a plane on which objects stand.
        rejected: Reasons for photos that are not in ``photos``, by name; one clause per photo.
        scale_error: Estimated relative error of the metric scale, or None if unknown.

    Raises:
        ValueError: If a name occurs twice, shapes do not match, or a photo observes a point that does not exist.
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

    def __repr__(self) -> str:
        rejected = f", {len(self.rejected)} rejected" if self.rejected else ""
        units = "metres" if self.units == "metre" else "unknown units"
        return f"Capture({len(self.photos)} photos{rejected}, {len(self.points)} points, {units})"

    @property
    def held_out(self) -> tuple[Photo, ...]:
        """Photos for evaluation: the first of every eight."""
        return self.photos[::HELD_OUT_EVERY]

    @property
    def training(self) -> tuple[Photo, ...]:
        """Photos that are not held out."""
        return tuple(photo for index, photo in enumerate(self.photos) if index % HELD_OUT_EVERY)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of all values and files of the capture, computed once; file names in the folder do not matter.

        Raises:
            InputError: If a file cannot be read.
        """
        digest = ContentHash()
        digest.add_json([self.units, self.up, self.table, self.scale_error, dict(self.rejected)])
        for photo in self.photos:
            camera = asdict(photo.camera) | {"world_from_camera": photo.camera.world_from_camera.tolist()}
            digest.add_json([photo.name, camera, photo.gain, photo.image_hash, photo.mask is not None])
            digest.add_array(photo.seen.astype(np.int32))
            if photo.mask is not None:
                digest.add_file(photo.mask)
        digest.add_array(self.points)
        digest.add_array(self.colours)
        return digest.hexdigest()

    def picked(self, pick: str) -> tuple[Photo, tuple[float, float]]:
        """Return the photo and the pixel of a text PHOTO:X,Y.

        Raises:
            InputError: If the photo is not registered or the pixel is not two numbers.
        """
        name, _, pixel = pick.rpartition(":")
        photos = {photo.name: photo for photo in self.photos}
        if name not in photos:
            raise InputError(
                f"{pick}: a pick must be PHOTO:X,Y of a photo with a camera, such as {min(photos)}:400,300"
            )
        return photos[name], parse_pixel(pixel, pick)

    def transformed(self, matrix: npt.ArrayLike) -> Capture:
        """Return the capture after a similarity transform.

        Near distances are scaled, ``units`` and ``up`` are unchanged, and ``table`` becomes False.

        Args:
            matrix: Similarity transform, shape (4, 4).

        Raises:
            ValueError: If the matrix shears, mirrors or scales unevenly.
        """
        rotation, scale, translation = split_similarity(matrix)
        return replace(
            self,
            photos=tuple(replace(photo, camera=photo.camera.transformed(matrix)) for photo in self.photos),
            points=self.points @ (scale * rotation).T + translation,
            table=False,
        )

    def save(self, folder: str | PathLike[str]) -> Capture:
        """Write the capture folder with copies of images and masks.

        Returns:
            The capture with the copied files.

        Raises:
            InputError: If the folder cannot be written or a file is missing.
        """
        folder = Path(folder)
        photos = []
        try:
            (folder / CAPTURE_FILE).unlink(missing_ok=True)  # the file of an earlier capture describes other photos
            for photo in self.photos:
                file = copy_file(photo.file, folder / "images" / stored_name(photo.name, photo.file.suffix))
                mask = None if photo.mask is None else copy_file(photo.mask, folder / "masks" / mask_name(photo.name))
                photos.append(replace(photo, file=file, mask=mask))
            files = {path for photo in photos for path in (photo.file, photo.mask) if path is not None}
            if len(files) < sum(1 + (photo.mask is not None) for photo in photos):
                raise InputError(f"{folder}: photos must have different names without folder separators and suffix")
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
            # Written last, so that an interrupted save leaves no valid capture.
            write_text(folder / CAPTURE_FILE, json.dumps(spec.model_dump(), indent=1) + "\n")
        except OSError as error:
            raise InputError(f"{error.filename or folder}: cannot be written ({error.strerror})") from error
        return replace(self, photos=tuple(photos))

    @classmethod
    def load(cls, folder: str | PathLike[str]) -> Capture:
        """Read a capture folder; images are read later by :meth:`Photo.read`.

        Raises:
            InputError: If a file is missing, has a newer format version or is invalid.
        """
        folder = Path(folder)
        if not (folder / CAPTURE_FILE).exists():
            raise no_folder_with(folder, CAPTURE_FILE, "the folder of a capture")
        spec = load_yaml(folder / CAPTURE_FILE, CaptureSpec, newest=FORMAT_VERSIONS[CAPTURE_FILE])
        try:
            with (folder / _POINTS).open("rb") as stored, np.load(stored, allow_pickle=False) as arrays:
                points, colours = arrays["points"], arrays["colours"]
                seen, counts = arrays["seen"], arrays["seen_counts"]
        except FileNotFoundError:
            raise InputError(f"{folder / _POINTS}: no such file") from None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{folder / _POINTS}: not a capture's points ({error})") from error
        integral = seen.dtype.kind in "iu" and counts.dtype.kind in "iu"
        if not integral or np.any((counts < 0) | (counts > len(seen))):
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
    """Return the file name of a photo's image in a capture.

    The name is that of the photo with folders flattened. The suffix is appended if the name has another suffix.
    """
    flat = name.replace("/", "__")
    return flat if Path(flat).suffix.lower() == suffix.lower() else flat + suffix


def mask_name(name: str) -> str:
    """Return the file name of a photo's mask, by the convention of COLMAP."""
    return f"{name.replace('/', '__')}.png"


def _named_file(folder: Path, name: str) -> Path:
    """Return the path of a file named in ``capture.json``, see :func:`mitsplat.storage.files.resolve_inside`."""
    try:
        return resolve_inside(folder, name)
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
