"""Files of Gaussian splats; for conventions see :mod:`mitsplat.gaussians.splat_cloud`.

======================  ====  =====  ==========================================================================
suffix                  read  write  precision
======================  ====  =====  ==========================================================================
``.ply``                yes   yes    3DGS: all values, as float32 logarithms (scales) and logits (opacities)
``.compressed.ply``     yes   no     PlayCanvas: 11-bit positions in chunks of 256, SH to 1/32
``.splat``              yes   yes    float32 positions and scales; 8-bit colours, opacities, quaternions; no SH
``.ksplat``             yes   no     GaussianSplats3D: depends on its compression level
``.spz``                yes   yes    Niantic: 24-bit positions, log scales in steps of 1/16 from 4.5e-5 to 370
                                     file units, 8-bit colours and opacities, SH in [-1, 1] to 4 or 5 bits
``.sog``                yes   no     PlayCanvas: 16-bit log positions, 8-bit codebooks; the order changes
======================  ====  =====  ==========================================================================

Few files state their axes and none its unit, so ``x, y, z`` are returned as in the file, without rotation or scaling.
This package decodes ``.ply``, ``.splat``, ``.ksplat`` and version 3 of ``.spz``. Its allocations are
limited by the size of the file. gaussforge decodes the other formats. It does not validate its input and therefore
runs in a separate process with bounded memory, which takes 0.1 s to start.
"""

from __future__ import annotations

import gzip
import io
import logging
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import expit, logit

from mitsplat.arrays import Float32Array
from mitsplat.errors import InputError
from mitsplat.gaussians.ksplat_files import read_ksplat
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_checks import check_colour_space, check_encoding, colours_differ
from mitsplat.gaussians.splat_converter import convert_splats
from mitsplat.gaussians.splat_training import (
    SPZ_ANTIALIASED,
    SPZ_FLAGS_OFFSET,
    merge_filter,
    ply_comment,
    ply_kernel,
    sog_kernel,
    spz_kernel,
)
from mitsplat.quality import KernelName
from mitsplat.runtime.child_process import run_bounded
from mitsplat.storage.file_kinds import kind_of_file, refuse_placeholder
from mitsplat.storage.files import storage_errors, write_file

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]

_CONVERTED = (".ksplat", ".spz", ".sog")
_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
MAX_PLY_HEADER = 1 << 16
_MEANS, _QUATS, _SCALES = ("x", "y", "z"), ("rot_1", "rot_2", "rot_3", "rot_0"), ("scale_0", "scale_1", "scale_2")
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_CHUNK_COLUMNS = 12
"""Columns of the chunks of compressed PLY files without ranges of colours."""
_COLOUR_RANGES = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
_FLAT_THICKNESS = np.float32(0.01)
"""Third scale of flat Gaussians that have none, relative to the smaller of the others."""
_FILTER = "filter_3D"
_USED = re.compile(rf"[xyz]|f_dc_[012]|f_rest_\d+|opacity|scale_[012]|rot_[0123]|{_FILTER}")
_COLOURS = ("red", "green", "blue")
_REDUNDANT = ("nx", "ny", "nz", *_COLOURS)
"""Columns without further information: empty normals, and colours that repeat the SH coefficients of degree 0."""
_MAX_COMPRESSION_RATIO = 100
"""Maximum ratio of decompressed to compressed size. Real files have ratios of 1.1 to 3."""
_MAX_ENTRIES = 64
_LOGIT_LIMIT = 110.0
"""Largest stored logit. The sigmoid of +-110 is exactly 1 and 0 in float32, so no infinities are needed."""

_SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

_SPZ_HEADER = struct.Struct("<4s2I4B")
"""Magic number, version, number of Gaussians, SH degree, fractional bits of positions, flags, reserved."""
_SPZ_FRACTIONAL_BITS = 12
_SPZ_FRACTIONAL_BITS_OFFSET = 13
_SPZ_POSITION_BITS = 23

_logger = logging.getLogger(__name__)


class SplatArrays(NamedTuple):
    """Activated, unchecked arrays of N Gaussians: the arguments of :class:`~mitsplat.gaussians.splat_cloud.Splats`."""

    means: Float32Array
    quats: Float32Array
    scales: Float32Array
    opacities: Float32Array
    sh: Float32Array


def default_up_axis(path: Path) -> Axis:
    """Return the usual up axis of a file: y for ``.spz``, z if a PLY says so, or -y, as in structure from motion.

    Nerfstudio turns its scenes and writes the comment ``Vertical Axis: z``. With y, programs mean y or -y.
    """
    if path.suffix.lower() != ".ply":
        return "y" if path.suffix.lower() == ".spz" else "-y"
    with path.open("rb") as file:
        header = file.read(MAX_PLY_HEADER).partition(b"end_header")[0]
    return "z" if re.search(rb"^comment vertical axis:[ \t]*z\s*$", header, re.M | re.I) else "-y"


def read_splats(path: Path) -> tuple[SplatArrays, KernelName | None]:
    """Read a splat file in its own units and axes; a warning names columns that are not used.

    Returns:
        The arrays, and the kernel with which the splats were trained; None if the file does not state it, see
        :mod:`mitsplat.gaussians.splat_training`.

    Raises:
        InputError: If the file is missing, of an unknown suffix, or damaged, or if it holds an invalid value.
    """
    suffix = path.suffix.lower()
    if suffix not in (".ply", ".splat", *_CONVERTED):
        kind = kind_of_file(path)
        raise InputError(
            f"{path}: splats must be .ply, .compressed.ply, .splat, .ksplat, .spz or .sog (got suffix {suffix!r}"
            f"{f', {kind}' if kind else ''})"
        )
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: must be a file")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    refuse_placeholder(path, data[:MAX_PLY_HEADER])
    try:
        if not data:
            raise InputError("the file is empty")
        if suffix == ".splat":
            return _decode_splat(data), None
        if suffix == ".spz":
            return decode_spz(data)
        if suffix == ".sog":
            return _decode_ply(_convert(data, "sog", "ply")), sog_kernel(data)
        if suffix == ".ksplat":
            return _decode_ksplat(data), None
        arrays, names = _decode_ply(data), _vertex_names(data)
        other_colours = _has_other_colours(data, names)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if unused := [name for name in names if name not in _REDUNDANT and not _USED.fullmatch(name)]:
        _logger.warning("%s: the columns %s are not used", path, ", ".join(unused))
    if other_colours:
        rule = "%s: its columns red, green, blue differ from its coefficients f_dc_0 to f_dc_2, which are used"
        _logger.warning(rule, path)
    stated = ply_kernel(data[:MAX_PLY_HEADER].partition(b"end_header")[0])
    implied: KernelName | None = "mip" if _FILTER in names else "exact" if names and _SCALES[2] not in names else None
    return arrays, stated or implied


def write_splats(splats: SplatArrays, path: Path, kernel: KernelName | None = None) -> None:
    """Write ``splats`` in the format of the suffix of ``path``. The file is replaced atomically.

    Args:
        splats: Splats to write.
        path: The file.
        kernel: Kernel with which the splats were trained. ``.ply`` states it, and ``.spz`` states ``mip``.

    Raises:
        InputError: If the suffix is not ``.ply``, ``.splat`` or ``.spz``, the format cannot hold the splats, or the
            file cannot be written.
        MissingResourceError: If the disk is full.
    """
    encoders: dict[str, Callable[[SplatArrays, KernelName | None], bytes]] = {
        ".ply": _encode_ply,
        ".splat": _encode_splat,
        ".spz": encode_spz,
    }
    suffix = path.suffix.lower()
    if suffix not in encoders or path.name.lower().endswith(".compressed.ply"):
        raise InputError(f"{path}: splats can be written as .ply, .splat or .spz (got {path.name!r})")
    if not len(splats.means) and suffix != ".ply":
        raise InputError(f"{path}: a {suffix} file must hold at least one Gaussian (got 0)")
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot be written (the folder does not exist)")
    data = encoders[suffix](splats, kernel)
    if suffix == ".splat" and kernel == "mip":
        rule = "%s: .splat files cannot state that splats were trained with antialiasing: use .ply or .spz"
        _logger.warning(rule, path)
    with storage_errors(path):
        write_file(path, lambda partial: partial.write_bytes(data))


def _decode_ply(data: bytes) -> SplatArrays:
    form, elements, start = parse_ply_header(data)
    if "vertex" not in elements:
        raise InputError("a PLY file of splats must have a vertex element")
    names = elements["vertex"][1].names or ()
    if "packed_position" in names:
        return _decode_ply(_convert(_with_colour_ranges(data, form, elements, start), "compressed.ply", "ply"))
    scale_names = _SCALES if _SCALES[2] in names else _SCALES[:2]  # 2DGS has two
    missing = [n for n in (*_MEANS, *_COLOUR, "opacity", *scale_names, *_QUATS) if n not in names]
    if missing:
        cause = ": export coefficients in place of red, green, blue" if {"red", "f_dc_0"} <= {*names, *missing} else ""
        raise InputError(f"a PLY file of splats must have the vertex properties {', '.join(missing)} (missing){cause}")
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{i}" for i in range(rest)]
    if rest not in (0, 9, 24, 45) or not set(rest_names) <= set(names):
        raise InputError(f"f_rest must be numbered from 0 and have 0, 9, 24 or 45 properties (got {rest})")
    rows = vertex_rows(data, form, elements, start)
    check_encoding(*(columns_of(rows, names) for names in (_MEANS, scale_names, ("opacity",), _COLOUR)))
    if form != "ascii":
        check_colour_space(data, elements, start)
    scales, opacities = _exp(columns_of(rows, scale_names)), _sigmoid(rows["opacity"])
    if len(scale_names) == 2:
        scales = np.hstack([scales, _FLAT_THICKNESS * scales.min(axis=1, keepdims=True)])
    if _FILTER in names:
        if not (least := float(rows[_FILTER].min(initial=0.0))) >= 0:
            cause = "; are they logarithms?" if least < 0 else ""
            raise InputError(f"{_FILTER} must be standard deviations of at least 0 (got {least:.3g}){cause}")
        scales, opacities = merge_filter(scales, opacities, rows[_FILTER])
    # SH coefficients are channel-major: all of red, then green, then blue.
    higher = columns_of(rows, rest_names).reshape(len(rows), 3, rest // 3).transpose(0, 2, 1)
    return SplatArrays(
        means=columns_of(rows, _MEANS),
        quats=columns_of(rows, _QUATS),
        scales=scales,
        opacities=opacities,
        sh=np.concatenate([columns_of(rows, _COLOUR)[:, None], higher], axis=1),
    )


def _with_colour_ranges(data: bytes, form: str, elements: dict[str, tuple[int, np.dtype[Any]]], start: int) -> bytes:
    """Return a compressed PLY file with ranges of colours in its chunks. Early files have none, which means 0 to 1."""
    count, row = elements.get("chunk", (0, np.dtype([])))
    end = start + count * row.itemsize
    is_early = next(iter(elements)) == "chunk" and len(row.names or ()) == _CHUNK_COLUMNS and form != "ascii"
    if not is_early or row.itemsize != 4 * _CHUNK_COLUMNS or not len(data) >= end > start:
        return data
    ranges = np.frombuffer(data, row.descr[0][1], count * _CHUNK_COLUMNS, start).reshape(count, -1)
    colours = np.broadcast_to(np.repeat([0.0, 1.0], 3).astype(ranges.dtype), (count, 6))
    last = f"property float {(row.names or ())[-1]}\n"
    head = data[:start].decode("ascii", "replace").replace("\r\n", "\n")
    head = head.replace(last, last + "".join(f"property float {name}\n" for name in _COLOUR_RANGES))
    return head.encode() + np.hstack([ranges, colours]).tobytes() + data[end:]


def _decode_ksplat(data: bytes) -> SplatArrays:
    means, quats, scales, colours, sh = read_ksplat(data)
    constant = (colours[:, None, :3] - 0.5) / SH_C0
    arrays = (means, quats, scales, colours[:, 3], np.concatenate([constant, sh], axis=1))
    return SplatArrays(*(values.astype(np.float32) for values in arrays))


def _vertex_names(data: bytes) -> tuple[str, ...]:
    """Return the names of the columns of a PLY file of splats; none if they are packed."""
    names = parse_ply_header(data)[1]["vertex"][1].names or ()
    return () if "packed_position" in names else names


def _has_other_colours(data: bytes, names: tuple[str, ...]) -> bool:
    """Return True if a PLY file of splats has the columns red, green and blue, and they are not those of its f_dc."""
    if not set(_COLOURS) <= set(names):
        return False
    rows = vertex_rows(data, *parse_ply_header(data))
    return colours_differ(columns_of(rows, _COLOURS), columns_of(rows, _COLOUR))


def parse_ply_header(data: bytes) -> tuple[str, dict[str, tuple[int, np.dtype[Any]]], int]:
    """Parse the header of a PLY file (Turk 1994).

    Returns:
        Format; elements (name to count and row type; list properties have the type "object"); offset of the rows.

    Raises:
        InputError: If the header contains an invalid line.
    """
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:MAX_PLY_HEADER])
    if data.startswith(b"\x1f\x8b"):
        raise InputError("a PLY file must not be compressed by gzip: decompress it")
    if not re.match(rb"ply[ \t]*\r?\n", data) or end is None:
        raise InputError(f"a PLY file must have a header from 'ply' to 'end_header' within {MAX_PLY_HEADER} bytes")
    lines = data[: end.start()].decode("ascii", "replace").splitlines()
    form = ""
    counts: dict[str, int] = {}
    types: dict[str, list[tuple[str, str]]] = {}
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", order, "1.0"] if order in _PLY_ORDERS and not form:
                form = order
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count) and form and name not in counts:
                counts[name], types[name] = int(count), []
            case ["property", "list", _, _, name] if counts:
                types[next(reversed(types))].append((name, "O"))
            case ["property", kind, name] if kind in _PLY_TYPES and counts:
                types[next(reversed(types))].append((name, _PLY_ORDERS[form] + _PLY_TYPES[kind]))
            case _:
                raise InputError(f"line {number} of the PLY header is not valid (got {line[:80]!r})")
    return form, {name: (counts[name], np.dtype(types[name])) for name in counts}, end.end()


def vertex_rows(
    data: bytes, form: str, elements: dict[str, tuple[int, np.dtype[Any]]], start: int
) -> npt.NDArray[np.void]:
    """Return the vertices as a structured array.

    The stated count is checked against the file size before any allocation.
    """
    before = [elements[name] for name in list(elements)[: list(elements).index("vertex")]]
    count, row = elements["vertex"]
    if row.hasobject or any(kind.hasobject for _, kind in before) or (before and form == "ascii"):
        raise InputError("a PLY file of splats must not have list properties in or before its vertices")
    start += sum(number * kind.itemsize for number, kind in before)
    # In a text file, a number takes at least one digit and one separator.
    smallest = count * (row.itemsize if form != "ascii" else 2 * len(row.names or ()))
    present = max(0, len(data) - start + (form == "ascii"))
    if smallest > present:
        raise InputError(f"the PLY header states {count} Gaussians in at least {smallest} bytes (got {present} bytes)")
    if form != "ascii":
        return np.frombuffer(data, row, count, start) if count else np.empty(0, row)
    width = len(row.names or ())
    words = data[start:].split(maxsplit=count * width)[: count * width]
    if len(words) < count * width:
        raise InputError(f"the PLY header states {count} Gaussians of {width} numbers (got {len(words)} numbers)")
    numbers = np.array(words, dtype=np.bytes_).astype(np.float64)
    return numbers.view([(name, np.float64) for name in row.names or ()])


def _exp(logarithms: npt.ArrayLike) -> Float32Array:
    with np.errstate(over="ignore"):  # overflow becomes inf, which Splats refuses
        return np.exp(np.asarray(logarithms, dtype=np.float64)).astype(np.float32)


def _sigmoid(logits: npt.ArrayLike) -> Float32Array:
    return np.asarray(expit(np.asarray(logits, dtype=np.float64)), dtype=np.float32)


def columns_of(rows: npt.NDArray[np.void], names: tuple[str, ...] | list[str]) -> Float32Array:
    """Return the named properties as columns, shape (N, len(names))."""
    table = np.empty((len(rows), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for column, name in enumerate(names):
            table[:, column] = rows[name]
    return table


def _encode_ply(splats: SplatArrays, kernel: KernelName | None = None) -> bytes:
    """Encode in the layout of the original 3DGS files. It includes empty normals, which some loaders require."""
    with np.errstate(divide="ignore"):
        opacity = np.clip(logit(splats.opacities.astype(np.float64)), -_LOGIT_LIMIT, _LOGIT_LIMIT)
    count, coefficients = splats.sh.shape[:2]
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (coefficients - 1))
    rest_names = [f"f_rest_{i}" for i in range(rest.shape[1])]
    names = [*_MEANS, "nx", "ny", "nz", *_COLOUR, *rest_names, "opacity", *_SCALES, "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.hstack(
        [
            splats.means,
            np.zeros((count, 3)),
            splats.sh[:, 0],
            rest,
            opacity[:, None],
            np.log(splats.scales.astype(np.float64)),
            splats.quats[:, [3, 0, 1, 2]],
        ]
    ).astype("<f4")
    properties = "".join(f"property float {name}\n" for name in names)
    form = f"format binary_little_endian 1.0\n{ply_comment(kernel)}"
    header = f"ply\n{form}element vertex {count}\n{properties}end_header\n"
    return header.encode() + rows.tobytes()


def _decode_splat(data: bytes) -> SplatArrays:
    """Decode 32 bytes per Gaussian: position, scale, RGBA, and quaternion wxyz as (b - 128) / 128.

    The format is that of antimatter15's viewer.
    """
    if len(data) % _SPLAT_ROW.itemsize:
        raise InputError(f"a .splat file must hold {_SPLAT_ROW.itemsize} bytes per Gaussian (got {len(data)} bytes)")
    rows = np.frombuffer(data, _SPLAT_ROW)
    rgba = rows["rgba"].astype(np.float32) / 255.0
    return SplatArrays(
        means=rows["mean"],
        quats=rows["quat"][:, [1, 2, 3, 0]].astype(np.float32) - 128.0,  # normalised by Splats
        scales=rows["scale"],
        opacities=rgba[:, 3],
        sh=(rgba[:, None, :3] - 0.5) / SH_C0,
    )


def _encode_splat(splats: SplatArrays, _kernel: KernelName | None) -> bytes:
    rows = np.empty(len(splats.means), _SPLAT_ROW)
    rgba = np.column_stack([0.5 + SH_C0 * splats.sh[:, 0], splats.opacities])
    rows["mean"], rows["scale"] = splats.means, splats.scales
    rows["rgba"] = np.rint(255.0 * np.clip(rgba, 0.0, 1.0))
    rows["quat"] = np.clip(np.rint(128.0 * splats.quats[:, [3, 0, 1, 2]] + 128.0), 0.0, 255.0)
    return rows.tobytes()


def decode_spz(data: bytes) -> tuple[SplatArrays, KernelName | None]:
    """Decode SPZ version 3 (Niantic's ``load-spz.cc``): consecutive arrays of small integers in gzip.

    The result is bit-identical to that of gaussforge, without a separate process. gaussforge decodes or refuses other
    versions and files whose length does not match their header.
    """
    if data[:4] == b"NGSP":  # not in gzip since version 4
        version = int.from_bytes(data[4:8], "little")
        if version < 4:
            raise InputError(f"an SPZ file of version {version} must be compressed by gzip")
        raise InputError(f"SPZ files of version {version} are not supported: convert them to version 3, or to .ply")
    raw = _decompress_gzip(data)
    magic, version, count, degree, bits, _, _ = _SPZ_HEADER.unpack(raw[: _SPZ_HEADER.size].ljust(_SPZ_HEADER.size))
    widths = (9, 1, 3, 3, 4, 3 * (degree + 1) ** 2 - 3)
    known = (magic, version) == (b"NGSP", 3) and count > 0 and degree <= 3 and bits <= _SPZ_POSITION_BITS
    if not known or len(raw) != _SPZ_HEADER.size + count * sum(widths):
        return _decode_ply(_convert(data, "spz", "ply")), spz_kernel(raw)
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
        scales=_exp(scales / 16 - 10),
        opacities=_sigmoid(logits),
        sh=np.concatenate([base[:, None], rest.reshape(count, -1, 3).astype(np.float32) / 128 - 1], axis=1),
    )
    return decoded, spz_kernel(raw)


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
    packed = bytearray(gzip.decompress(_convert(_encode_ply(scaled), "ply", "spz")))
    packed[_SPZ_FRACTIONAL_BITS_OFFSET] = bits
    packed[SPZ_FLAGS_OFFSET] |= SPZ_ANTIALIASED if kernel == "mip" else 0
    return gzip.compress(bytes(packed), compresslevel=6, mtime=0)


def _convert(data: bytes, source: str, target: str) -> bytes:
    """Convert between formats with gaussforge in a separate process.

    Its decoders do not check every count against the size of the input, so a damaged file can crash the process.
    """
    if source == "sog":
        _check_zip(data)
    process = run_bounded(
        convert_splats,
        source,
        target,
        data=data,
        imports=["gaussforge"],
        memory=(4 << 30) + 64 * len(data),
        seconds=60 + len(data) / 1e6,
    )
    if process.status == 0:
        return process.output
    reason = process.reason if (process.status or 0) > 0 else f"its decoder {process.reason}"
    raise InputError(f"not a valid {source} file ({reason})")


def _decompress_gzip(data: bytes) -> bytes:
    """Return the decompressed content of a gzip file.

    Raises:
        InputError: If the file is invalid or truncated, or if its content is larger than splats can be.
    """
    limit, raw, rest = _max_decompressed_size(len(data)), bytearray(), data
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


def _check_zip(data: bytes) -> None:
    """Check that an archive has no entry outside of it, no implausible size, and correct checksums."""
    limit = _max_decompressed_size(len(data))
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
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


def _max_decompressed_size(size: int) -> int:
    """Return the maximum decompressed size of ``size`` compressed bytes."""
    return _MAX_COMPRESSION_RATIO * size + (16 << 20)
