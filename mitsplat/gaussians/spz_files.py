"""SPZ files of Gaussian splats (Niantic): versions 1 to 3 are read, version 3 is written."""

from __future__ import annotations

import gzip
import struct
import zlib

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array
from mitsplat.errors import InputError
from mitsplat.gaussians.ply_files import decode_ply, encode_ply
from mitsplat.gaussians.splat_arrays import SplatArrays, exponential, sigmoid
from mitsplat.gaussians.splat_converter import convert_apart, max_decompressed_size
from mitsplat.gaussians.splat_training import SPZ_ANTIALIASED, SPZ_FLAGS_OFFSET, spz_kernel
from mitsplat.quality import KernelName

_SPZ_HEADER = struct.Struct("<4s2I4B")
"""Magic number, version, number of Gaussians, SH degree, fractional bits of positions, flags, reserved."""
_SPZ_FRACTIONAL_BITS = 12
_SPZ_FRACTIONAL_BITS_OFFSET = 13
_SPZ_POSITION_BITS = 23
_SPZ_MAX_FRACTIONAL_BITS = 30
_SPZ_EXTENDED = 0x2
"""Flag of files with data after the Gaussians."""
_SPZ_WIDTHS = {1: (6, 3), 2: (9, 3), 3: (9, 4)}
"""Bytes of the position and of the rotation of a Gaussian by version."""


def decode_spz(data: bytes) -> tuple[SplatArrays, KernelName | None]:
    """Decode SPZ versions 1 to 3 (Niantic's ``load-spz.cc``): consecutive arrays of small integers in gzip.

    Version 3 is decoded here, bit-identical to gaussforge and without a separate process. gaussforge decodes the
    others.

    Raises:
        InputError: If the data are damaged, of another version, or of a length that contradicts their header.
    """
    if data[:4] == b"NGSP":  # not in gzip since version 4
        version = int.from_bytes(data[4:8], "little")
        if version < 4:
            raise InputError(f"an SPZ file of version {version} must be compressed by gzip")
        raise InputError(_unsupported(version))
    raw = _decompress_gzip(data)
    version, count, degree, bits = _check_header(raw)
    if version < 3:
        return decode_ply(convert_apart(data, "spz", "ply")), spz_kernel(raw)
    widths = (9, 1, 3, 3, 4, 3 * (degree + 1) ** 2 - 3)
    ends = _SPZ_HEADER.size + count * np.cumsum(widths)
    arrays = np.split(np.frombuffer(raw, np.uint8, ends[-1]), [_SPZ_HEADER.size, *ends[:-1]])[1:]
    positions, alphas, colours, scales, turns, rest = (a.reshape(count, -1).astype(np.int32) for a in arrays)
    low, middle, high = np.moveaxis(positions.reshape(count, 3, 3), 2, 0)
    alpha, base = alphas[:, 0].astype(np.float32) / 255, (colours.astype(np.float32) / 255 - 0.5) / np.float32(0.15)
    with np.errstate(divide="ignore"):
        logits = np.log((alpha / (1 - alpha)).astype(np.float64)).astype(np.float32)
    decoded = SplatArrays(
        means=((high << 24 | middle << 16 | low << 8) >> 8).astype(np.float32) / np.float32(1 << bits),
        quats=_smallest_three(turns.astype(np.uint8).view("<u4")[:, 0].copy()),
        scales=exponential(scales / 16 - 10),
        opacities=sigmoid(logits),
        sh=np.concatenate([base[:, None], rest.reshape(count, -1, 3).astype(np.float32) / 128 - 1], axis=1),
    )
    return decoded, spz_kernel(raw)


def _check_header(raw: bytes) -> tuple[int, int, int, int]:
    """Return the version, number of Gaussians, SH degree and fractional bits of decompressed data.

    The arrays follow each other without marks, so that a wrong number of Gaussians would mix them up.
    """
    magic, version, count, degree, bits, flags, _ = _SPZ_HEADER.unpack(raw[: _SPZ_HEADER.size].ljust(_SPZ_HEADER.size))
    if magic != b"NGSP":
        raise InputError(f"not a valid spz file (it must begin with NGSP, got {magic!r})")
    if version not in _SPZ_WIDTHS:
        raise InputError(_unsupported(version))
    if degree > 3:
        raise InputError(f"SPZ files must have SH of degree 0 to 3 (got {degree}): export a lower degree")
    if bits > _SPZ_MAX_FRACTIONAL_BITS:
        raise InputError(f"positions must have at most {_SPZ_MAX_FRACTIONAL_BITS} fractional bits (got {bits})")
    if not count:
        raise InputError("an SPZ file must hold at least one Gaussian (got 0)")
    position, rotation = _SPZ_WIDTHS[version]
    size = _SPZ_HEADER.size + count * (position + 7 + rotation + 3 * (degree + 1) ** 2 - 3)
    if len(raw) < size or (len(raw) > size and not flags & _SPZ_EXTENDED):
        raise InputError(
            f"{count} Gaussians of SH degree {degree}, as the header states, must take {size} bytes (got {len(raw)}): "
            "is the file damaged?"
        )
    return version, count, degree, bits


def _unsupported(version: int) -> str:
    return f"SPZ files of version {version} are not supported: convert them to version 3, or to .ply"


def _smallest_three(packed: npt.NDArray[np.uint32]) -> Float32Array:
    """Decode unit quaternions xyzw (N, 4) from the index of the largest component and ten bits per other component.

    The first of the ten bits is the sign.
    """
    largest = packed >> 30
    quats, squares = np.zeros((len(packed), 4), np.float32), np.zeros(len(packed), np.float32)
    for axis in range(3, -1, -1):
        rows = np.flatnonzero(largest != axis)
        value = np.float32(np.sqrt(0.5)) * (packed[rows] & 511).astype(np.float32) / np.float32(511)
        quats[rows, axis] = np.where(packed[rows] & 512, -value, value)
        squares[rows] += value * value
        packed[rows] >>= 10
    quats[np.arange(len(packed)), largest] = np.sqrt(np.maximum(0, 1 - squares))
    return quats


def encode_spz(splats: SplatArrays, kernel: KernelName | None) -> bytes:
    """Encode SPZ version 3 with the maximum number of fractional position bits that the extent of the splats permits.

    The encoder itself uses 12 bits, which are steps of 0.24 mm. Here, positions are multiplied by a power of two before
    encoding, which is exact. The number of fractional bits in the header is increased by the exponent.
    """
    extent = max(float(np.abs(splats.means).max()), 2.0**-60)
    bits = int(np.clip(np.floor(_SPZ_POSITION_BITS - np.log2(extent * (1.0 + 2.0**-20))), 0, _SPZ_POSITION_BITS))
    means = splats.means * np.float32(2.0 ** (bits - _SPZ_FRACTIONAL_BITS))
    scaled = SplatArrays(means, splats.quats, splats.scales, splats.opacities, splats.sh)
    packed = bytearray(gzip.decompress(convert_apart(encode_ply(scaled), "ply", "spz")))
    packed[_SPZ_FRACTIONAL_BITS_OFFSET] = bits
    packed[SPZ_FLAGS_OFFSET] |= SPZ_ANTIALIASED if kernel == "mip" else 0
    return gzip.compress(bytes(packed), compresslevel=6, mtime=0)


def _decompress_gzip(data: bytes) -> bytes:
    """Return the decompressed content of a gzip file.

    Raises:
        InputError: If the file is invalid or truncated, or if its content is larger than splats can be.
    """
    limit, raw, rest = max_decompressed_size(len(data)), bytearray(), data
    decoder = zlib.decompressobj(wbits=31)
    try:
        while rest and not decoder.eof:
            raw += decoder.decompress(rest, 1 << 20)
            rest = decoder.unconsumed_tail
            if len(raw) > limit:
                raise InputError(
                    f"{len(data)} compressed bytes must not decompress to more than {limit} bytes (got more)"
                )
    except zlib.error as error:
        raise InputError(f"not a valid spz file ({error})") from None
    if not decoder.eof:
        raise InputError(f"not a complete spz file: its gzip stream has no end within {len(data)} bytes")
    return bytes(raw)
