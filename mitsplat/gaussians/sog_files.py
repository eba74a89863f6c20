"""SOG files of Gaussian splats (PlayCanvas), version 2: an archive of lossless images and ``meta.json``.

A pixel of each image belongs to a Gaussian, in the order of rows. Positions have 16 bits of ``sign(x) log(1 + |x|)``,
rotations are the three smaller components of a quaternion, and other values are indices of codebooks.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from typing import Annotated

import numpy as np
import numpy.typing as npt
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_arrays import SplatArrays, exponential
from mitsplat.gaussians.splat_converter import max_decompressed_size
from mitsplat.quality import KernelName

_MAX_ENTRIES = 64
_VERSION = 2
_PALETTE_COLUMNS = 64
"""Number of centroids of SH coefficients in a row of their image."""
_FIRST_INDEX = 252
"""Alpha of rotations whose largest component is the first one, w."""
_Codebook = Annotated[list[float], Field(min_length=256, max_length=256)]
_Corner = tuple[float, float, float]


class _Files(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)

    files: list[str] = Field(min_length=1)


class _Means(_Files):
    files: list[str] = Field(min_length=2)
    mins: _Corner
    maxs: _Corner


class _Coded(_Files):
    codebook: _Codebook


class _Higher(_Coded):
    files: list[str] = Field(min_length=2)
    count: int = Field(gt=0)
    bands: int = Field(ge=1, le=3)


class _Meta(BaseModel):
    """Content of ``meta.json``."""

    count: int = Field(gt=0)
    means: _Means
    scales: _Coded
    quats: _Files
    sh0: _Coded
    shN: _Higher | None = None
    model: str | None = None
    antialias: bool | None = None


class _Version(BaseModel):
    version: int = 1


def decode_sog(data: bytes) -> tuple[SplatArrays, KernelName | None]:
    """Decode a file; return its arrays, and the kernel with which the splats were trained, if it is stated.

    Raises:
        InputError: If the archive or an image is damaged, or if they contradict each other.
    """
    archive = _open_zip(data)
    meta = _read_meta(archive)
    kernel: KernelName | None = "mip" if meta.model == "antialiased" or meta.antialias is True else None
    limit = max_decompressed_size(len(data))

    def rows(name: str) -> npt.NDArray[np.uint8]:
        pixels = _read_image(archive, name, limit).reshape(-1, 4)
        if len(pixels) < meta.count:
            raise InputError(f"{name} must have a pixel for each of the {meta.count} Gaussians (got {len(pixels)})")
        return pixels[: meta.count]

    low, high = (rows(name)[:, :3].astype(np.int64) for name in meta.means.files[:2])
    least, most = np.array(meta.means.mins), np.array(meta.means.maxs)
    logarithms = least + (most - least) * (low | high << 8) / 65535
    scales, colours = rows(meta.scales.files[0]), rows(meta.sh0.files[0])
    sh = np.array(meta.sh0.codebook)[colours[:, None, :3]]
    if meta.shN is not None:
        labels = rows(meta.shN.files[1]).astype(np.int64)
        centroids = _centroids(_read_image(archive, meta.shN.files[0], limit), meta.shN)
        label = labels[:, 0] | labels[:, 1] << 8
        if label.max() >= len(centroids):
            raise InputError(f"labels of {meta.shN.files[1]} must be below {len(centroids)} (got {label.max()})")
        sh = np.concatenate([sh, centroids[label]], axis=1)
    arrays = SplatArrays(
        means=(np.sign(logarithms) * np.expm1(np.abs(logarithms))).astype(np.float32),
        quats=_quaternions(rows(meta.quats.files[0]), meta.quats.files[0]).astype(np.float32),
        scales=exponential(np.array(meta.scales.codebook)[scales[:, :3]]),
        opacities=(colours[:, 3] / 255).astype(np.float32),
        sh=sh.astype(np.float32),
    )
    return arrays, kernel


def _quaternions(pixels: npt.NDArray[np.uint8], name: str) -> Float64Array:
    """Return unit quaternions xyzw (N, 4) of pixels: three components in the order w, x, y, z, and the largest."""
    largest = pixels[:, 3].astype(np.int64) - _FIRST_INDEX
    if largest.min() < 0:
        raise InputError(f"alpha of {name} must be {_FIRST_INDEX} to 255 (got {largest.min() + _FIRST_INDEX})")
    smaller = (pixels[:, :3] / 255 - 0.5) * np.sqrt(2)
    others = np.array([[k for k in range(4) if k != index] for index in range(4)])[largest]
    quats = np.empty((len(pixels), 4))
    np.put_along_axis(quats, others, smaller, axis=1)
    rest = np.sqrt(np.maximum(0, 1 - (smaller**2).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], rest[:, None], axis=1)
    return quats[:, [1, 2, 3, 0]]


def _centroids(image: npt.NDArray[np.uint8], part: _Higher) -> Float64Array:
    """Return the SH coefficients of the palette, shape (P, K, 3)."""
    coefficients = (part.bands + 1) ** 2 - 1
    if image.shape[1] != _PALETTE_COLUMNS * coefficients or image.shape[0] * _PALETTE_COLUMNS < part.count:
        raise InputError(
            f"{part.files[0]} must be {_PALETTE_COLUMNS * coefficients} px wide and hold {part.count} centroids (got "
            f"{image.shape[1]}x{image.shape[0]} px)"
        )
    values = np.array(part.codebook)[image[..., :3]]
    return values.reshape(-1, coefficients, 3)[: part.count]


def _read_image(archive: zipfile.ZipFile, name: str, limit: int) -> npt.NDArray[np.uint8]:
    """Return the pixels of an image, shape (H, W, 4), of at most ``limit`` bytes."""
    try:
        content = archive.read(name)
    except KeyError:
        raise InputError(f"not a valid sog file ({name} is missing)") from None
    if b"VP8 " in _chunks(content) or content.startswith(b"\xff\xd8"):
        raise InputError(f"{name} must be lossless (got an image of lossy compression): was it optimised as a picture?")
    try:
        with Image.open(io.BytesIO(content), formats=("WEBP", "PNG")) as image:
            if 4 * image.width * image.height > limit:
                raise InputError(
                    f"{name} must have at most {limit // 4} pixels, as the file is small (got "
                    f"{image.width}x{image.height})"
                )
            return np.asarray(image.convert("RGBA"))
    except InputError:
        raise
    except (OSError, ValueError, SyntaxError, struct.error, Image.DecompressionBombError) as error:
        raise InputError(f"not a valid sog file ({name}: {error})".replace("\n", " ")) from None


def _chunks(content: bytes) -> Iterator[bytes]:
    """Yield the names of the chunks of a WebP file."""
    place = 12
    while content.startswith(b"RIFF") and place + 8 <= len(content):
        yield content[place : place + 4]
        place += 8 + -(-int.from_bytes(content[place + 4 : place + 8], "little") // 2) * 2


def _read_meta(archive: zipfile.ZipFile) -> _Meta:
    """Read ``meta.json``."""
    names = archive.namelist()
    if "meta.json" not in names:
        inside = next((name for name in names if name.endswith("/meta.json")), None)
        remedy = f"; {inside} is in a folder: put the files at the top of the archive" if inside else ""
        raise InputError(f"not a valid sog file (meta.json is missing{remedy})")
    content = archive.read("meta.json")
    try:
        if (version := _Version.model_validate_json(content).version) != _VERSION:
            raise InputError(
                f"SOG files must have version {_VERSION} (got {version}): convert it to version {_VERSION}, or to .ply"
            )
        return _Meta.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, ("meta.json", *first["loc"])))
        raise InputError(f"not a valid sog file ({place}: {first['msg']})") from None


def _open_zip(data: bytes) -> zipfile.ZipFile:
    """Open an archive that has no entry outside of it, no implausible size, and correct checksums."""
    limit = max_decompressed_size(len(data))
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        entries = archive.infolist()
        for entry in entries:
            if entry.filename.startswith(("/", "\\")) or ".." in re.split(r"[/\\]", entry.filename):
                raise InputError(f"an archive must not hold files outside of it (got {entry.filename!r})")
        size = sum(entry.file_size for entry in entries)
        if size > limit or len(entries) > _MAX_ENTRIES:
            within = f"{limit} in {_MAX_ENTRIES} files (got {size} in {len(entries)})"
            raise InputError(f"{len(data)} compressed bytes must not decompress to more than {within}")
        damaged = archive.testzip()  # reads no more of an entry than its stated size
    except InputError:
        raise
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, RuntimeError, struct.error, zlib.error) as error:
        raise InputError(f"not a valid sog file ({error})") from None
    if damaged is not None:
        raise InputError(f"not a valid sog file ({damaged} in it is damaged)")
    return archive
