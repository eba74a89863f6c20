"""Reader of ``.ksplat`` files (Kellogg, *GaussianSplats3D*, ``SplatBuffer.js``, file version 0.1).

A file has a header of 4096 bytes, headers of its sections of 1024 bytes each, and the sections. A section holds the
lengths of its partially filled buckets, the centres of all buckets, and one row per Gaussian. From compression level 1
on, positions are unsigned 16-bit numbers relative to the centre of a bucket.
"""

from __future__ import annotations

import struct

import numpy as np

from mitsplat.arrays import AnyArray, Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_arrays import SplatArrays

_HEADER, _SECTION_HEADER = 4096, 1024
_VERSION = (0, 1)
_FLOATS = ("<f4", "<f2", "<f2")
"""Numbers of scales and rotations by compression level."""
_CENTRES, _SH = ("<f4", "<u2", "<u2"), ("<f4", "<f2", "u1")
_COEFFICIENTS = (0, 3, 8)
"""Number of higher SH coefficients of each channel by degree."""
_RANGE = 32767
"""Largest offset from the centre of a bucket, if the file states none."""
_HALF_RANGE = 1.5
"""Largest 8-bit SH coefficient, if the file states none."""
_LEAST_SCALE = 2.0**-24
"""Smallest positive 16-bit number, in place of scales that were rounded to 0."""


def decode_ksplat(data: bytes) -> SplatArrays:
    """Decode a file; its allocations are limited by its size.

    Raises:
        InputError: If the data are incomplete, of another version, or contradict themselves.
    """
    if len(data) < _HEADER:
        raise InputError("not a valid ksplat file (its header is incomplete)")
    version, sections, level = (data[0], data[1]), *struct.unpack_from("<I12xH", data, 4)
    if version != _VERSION or level not in (0, 1, 2):
        got = f"{version[0]}.{version[1]} and {level}"
        raise InputError(f"ksplat files must have version 0.1 and compression level 0 to 2 (got {got})")
    (stated,) = struct.unpack_from("<I", data, 16)
    least, most = struct.unpack_from("<2f", data, 36)
    sh_range = least or -_HALF_RANGE, most or _HALF_RANGE
    start, found = _HEADER + sections * _SECTION_HEADER, []
    if start > len(data):
        raise InputError("not a valid ksplat file (the headers of its sections are incomplete)")
    for number in range(sections):
        arrays, start = _read_section(data, _HEADER + number * _SECTION_HEADER, start, level, sh_range)
        found.append(arrays)
    if len({arrays.sh.shape[1] for arrays in found}) > 1:
        raise InputError("sections of ksplat files must have the same SH degree")
    if not found:
        raise InputError("not a valid ksplat file (it has no sections)")
    if (count := sum(len(arrays.means) for arrays in found)) != stated:
        raise InputError(f"the sections of a ksplat file must hold all {stated} Gaussians of its header (got {count})")
    return SplatArrays(*(np.concatenate(sections) for sections in zip(*found, strict=True)))


def _read_section(
    data: bytes, header: int, start: int, level: int, sh_range: tuple[float, float]
) -> tuple[SplatArrays, int]:
    """Read the section whose header and data are at ``header`` and ``start``; return its end, too."""
    count, maximum, bucket_size, buckets = struct.unpack_from("<4I", data, header)
    block, bucket_bytes, number_range = struct.unpack_from("<fH2xI", data, header + 16)
    full, partial, degree = struct.unpack_from("<2IH", data, header + 32)
    if degree >= len(_COEFFICIENTS):
        raise InputError(f"ksplat files must have SH of degree 0 to 2 (got {degree})")
    kind = np.dtype(
        [
            ("centre", _CENTRES[level], 3),
            ("scale", _FLOATS[level], 3),
            ("rotation", _FLOATS[level], 4),
            ("colour", "u1", 4),
            ("sh", _SH[level], 3 * _COEFFICIENTS[degree]),
        ]
    )
    first = start + 4 * partial + bucket_bytes * buckets
    end = first + maximum * kind.itemsize
    if count > maximum or end > len(data):
        raise InputError("not a valid ksplat file (a section extends beyond the file)")
    rows = np.frombuffer(data, kind, count, first)
    means = rows["centre"].astype(np.float64)
    if level:
        lengths = np.frombuffer(data, "<u4", partial, start)
        if bucket_bytes != 12 or full + partial > buckets or full * bucket_size + int(lengths.sum()) != count:
            raise InputError("not a valid ksplat file (the buckets of a section do not hold its Gaussians)")
        bucket = np.repeat(np.arange(full + partial), [*([bucket_size] * full), *lengths])
        centres = np.frombuffer(data, "<f4", 3 * buckets, start + 4 * partial).reshape(-1, 3)
        number_range = number_range or _RANGE
        means = (means - number_range) * (block / 2 / number_range) + centres[bucket]
    sh = rows["sh"].astype(np.float64)
    if level == 2:
        sh = sh_range[0] + sh / 255 * (sh_range[1] - sh_range[0])
    colours = rows["colour"] / 255.0
    constant = rgb_to_sh(colours[:, None, :3])
    arrays = SplatArrays(
        means=means.astype(np.float32),
        quats=rows["rotation"].astype(np.float32),
        scales=np.maximum(rows["scale"].astype(np.float64), _LEAST_SCALE if level else 0.0).astype(np.float32),
        opacities=colours[:, 3].astype(np.float32),
        sh=np.concatenate([constant, _by_channel(sh)], axis=1).astype(np.float32),
    )
    return arrays, end


def _by_channel(sh: AnyArray) -> Float64Array:
    """Return coefficients (N, K, 3) of rows (N, 3 K): those of degree 1 of red, green and blue, then of degree 2."""
    bands = [band.reshape(len(sh), 3, band.shape[1] // 3) for band in (sh[:, :9], sh[:, 9:])]
    return np.asarray(np.concatenate(bands, axis=2).transpose(0, 2, 1))
