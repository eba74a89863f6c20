"""PLY files of Gaussian splats: those of 3DGS and tools like it, and compressed files of PlayCanvas."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.special import logit

from mitsplat.arrays import Float32Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_arrays import SplatArrays, exponential, sigmoid
from mitsplat.gaussians.splat_checks import are_colours, check_colour_space, check_encoding, colours_differ
from mitsplat.gaussians.splat_converter import convert_apart
from mitsplat.gaussians.splat_training import merge_filter, ply_comment, ply_kernel
from mitsplat.quality import KernelName

PlyElements = Mapping[str, tuple[int, np.dtype[np.void]]]
"""Elements of a PLY file by name: number of rows and type of a row."""

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
MAX_PLY_HEADER = 1 << 16
_MEANS, _QUATS, _SCALES = ("x", "y", "z"), ("rot_1", "rot_2", "rot_3", "rot_0"), ("scale_0", "scale_1", "scale_2")
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_CHUNK_SIZE = 256
"""Number of Gaussians of a chunk of compressed PLY files."""
_CHUNK_COLUMNS = 12
"""Columns of the chunks of compressed PLY files without ranges of colours."""
_COLOUR_RANGES = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
_FLAT_THICKNESS = np.float32(0.01)
"""Third scale of flat Gaussians that have none, relative to the smaller of the others."""
_LEAST_LOGARITHM = -80.0
"""Logarithm of scales below which 32-bit numbers lose them; files with larger ones in no row hold flat Gaussians."""
_FILTER = "filter_3D"
_USED = re.compile(rf"[xyz]|f_dc_[012]|f_rest_\d+|opacity|scale_[012]|rot_[0123]|{_FILTER}")
_COLOURS = ("red", "green", "blue")
_REDUNDANT = ("nx", "ny", "nz", *_COLOURS)
"""Columns without further information: empty normals, and colours that repeat the SH coefficients of degree 0."""
_LOGIT_LIMIT = 110.0
"""Largest stored logit. The sigmoid of +-110 is exactly 1 and 0 in float32, so no infinities are needed."""


def decode_ply(data: bytes) -> SplatArrays:
    """Decode a PLY file of splats with two or three scales, a 3D filter, or packed columns."""
    form, elements, start = parse_ply_header(data)
    if "vertex" not in elements:
        raise InputError("a PLY file of splats must have a vertex element")
    names = elements["vertex"][1].names or ()
    if "packed_position" in names:
        return decode_ply(convert_apart(_with_colour_ranges(data, form, elements, start), "compressed.ply", "ply"))
    scale_names = _SCALES if _SCALES[2] in names else _SCALES[:2]  # 2DGS has two
    _check_names(names, scale_names, has_faces="face" in elements)
    rows = vertex_rows(data, form, elements, start)
    check_encoding(*(columns_of(rows, names) for names in (_MEANS, scale_names, ("opacity",), _COLOUR)))
    if len(scale_names) == 3 and len(rows) and rows[_SCALES[2]].max() < _LEAST_LOGARITHM:
        scale_names = _SCALES[:2]  # a program added a scale of zero to flat Gaussians
    if form != "ascii":
        check_colour_space(data, elements, start)
    scales, opacities = exponential(columns_of(rows, scale_names)), sigmoid(rows["opacity"])
    if len(scale_names) == 2:
        scales = np.hstack([scales, _FLAT_THICKNESS * scales.min(axis=1, keepdims=True)])
    if _FILTER in names:
        if not (least := float(rows[_FILTER].min(initial=0.0))) >= 0:
            cause = "; are they logarithms?" if least < 0 else ""
            raise InputError(f"{_FILTER} must be standard deviations of at least 0 (got {least:.3g}){cause}")
        scales, opacities = merge_filter(scales, opacities, rows[_FILTER])
    rest_names = [f"f_rest_{index}" for index in range(sum(name.startswith("f_rest_") for name in names))]
    # SH coefficients are channel-major: all of red, then green, then blue.
    higher = columns_of(rows, rest_names).reshape(len(rows), 3, len(rest_names) // 3).transpose(0, 2, 1)
    return SplatArrays(
        means=columns_of(rows, _MEANS),
        quats=columns_of(rows, _QUATS),
        scales=scales,
        opacities=opacities,
        sh=np.concatenate([columns_of(rows, _COLOUR)[:, None], higher], axis=1),
    )


def _check_names(names: tuple[str, ...], scale_names: tuple[str, ...], *, has_faces: bool) -> None:
    """Raise InputError if properties of the vertices are missing or of another number than SH coefficients."""
    missing = [n for n in (*_MEANS, *_COLOUR, "opacity", *scale_names, *_QUATS) if n not in names]
    if missing:
        cause = ": export coefficients in place of red, green, blue" if {"red", "f_dc_0"} <= {*names, *missing} else ""
        if has_faces and "opacity" in missing:
            cause = ": it is a mesh, which `mitsplat bake` reads"
        raise InputError(f"a PLY file of splats must have the vertex properties {', '.join(missing)} (missing){cause}")
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{i}" for i in range(rest)]
    if rest not in (0, 9, 24, 45) or not set(rest_names) <= set(names):
        raise InputError(f"f_rest must be numbered from 0 and have 0, 9, 24 or 45 properties (got {rest})")


def _with_colour_ranges(data: bytes, form: str, elements: PlyElements, start: int) -> bytes:
    """Return a compressed PLY file with ranges of colours in its chunks. Early files have none, which means 0 to 1.

    Raises:
        InputError: If the numbers of chunks or of coefficients contradict the number of Gaussians.
    """
    count, row = elements.get("chunk", (0, np.dtype([])))
    gaussians = elements["vertex"][0]
    if count != -(-gaussians // _CHUNK_SIZE):
        raise InputError(
            f"compressed PLY files must have a chunk for every {_CHUNK_SIZE} of their {gaussians} "
            f"Gaussians (got {count} chunks)"
        )
    if (rows := elements.get("sh", (gaussians,))[0]) != gaussians:
        raise InputError(f"element sh must have a row for each of the {gaussians} Gaussians (got {rows})")
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


def encode_ply(splats: SplatArrays, kernel: KernelName | None = None) -> bytes:
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


def examine_columns(data: bytes, constant: Float32Array) -> tuple[list[str], KernelName | None]:
    """Return warnings of unused columns, and the kernel with which the splats were trained, if it is known.

    Args:
        data: The file.
        constant: Its decoded constant coefficients, shape (N, 3).
    """
    form, elements, start = parse_ply_header(data)
    names = elements["vertex"][1].names or ()
    stated = ply_kernel(data[:start].partition(b"end_header")[0])
    if "packed_position" in names:
        return [], stated
    warnings = []
    if unused := [name for name in names if name not in _REDUNDANT and not _USED.fullmatch(name)]:
        warnings.append(f"the columns {', '.join(unused)} are not used")
    if (extra := _extra_rows(data, form, elements, start)) > 0:
        stated_count = elements["vertex"][0]
        warnings.append(f"{extra} rows after the {stated_count} Gaussians that its header states are not used")
    if are_colours(constant):
        warnings.append(
            "its coefficients f_dc_0 to f_dc_2 lie in 0 to 1, which makes all colours pale: if they are colours, "
            "convert them by (c - 0.5) / 0.2821"
        )
    if set(_COLOURS) <= set(names):
        rows = vertex_rows(data, form, elements, start)
        if colours_differ(columns_of(rows, _COLOURS), constant):
            warnings.append(
                "its columns red, green, blue differ from its coefficients f_dc_0 to f_dc_2, which are used"
            )
    return warnings, stated or ("mip" if _FILTER in names else "exact" if _SCALES[2] not in names else None)


def parse_ply_header(data: bytes) -> tuple[str, PlyElements, int]:
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


def vertex_rows(data: bytes, form: str, elements: PlyElements, start: int) -> npt.NDArray[np.void]:
    """Return the vertices as a structured array.

    The stated count is checked against the file size before any allocation.
    """
    before = [elements[name] for name in list(elements)[: list(elements).index("vertex")]]
    count, row = elements["vertex"]
    if row.hasobject or (any(kind.hasobject for _, kind in before) and form != "ascii"):
        raise InputError("a PLY file of splats must not have list properties in or before its vertices")
    start += sum(number * kind.itemsize for number, kind in before) if form != "ascii" else 0
    # In a text file, a number takes at least one digit and one separator.
    smallest = count * (row.itemsize if form != "ascii" else 2 * len(row.names or ()))
    present = max(0, len(data) - start + (form == "ascii"))
    if smallest > present:
        raise InputError(f"the PLY header states {count} Gaussians in at least {smallest} bytes (got {present} bytes)")
    if form != "ascii":
        return np.frombuffer(data, row, count, start) if count else np.empty(0, row)
    first = sum(number for number, _ in before)
    lines = [line.split() for line in text_lines(data, start)[first : first + count]]
    width = len(row.names or ())
    for number, words in enumerate(lines):
        if len(words) != width:
            raise InputError(f"row {number} of the vertices must have {width} numbers (got {len(words)} numbers)")
    if len(lines) < count:
        raise InputError(f"the PLY header states {count} Gaussians of {width} numbers (got {len(lines)} rows)")
    table = np.array(lines, dtype=np.bytes_).reshape(count, width)
    try:
        numbers = table.astype(np.float64)
    except ValueError:
        wrong = next(word for words in lines for word in words if not _is_number(word)).decode("ascii", "replace")
        raise InputError(f"vertices must be numbers with a decimal point (could not convert {wrong!r})") from None
    return numbers.ravel().view([(name, np.float64) for name in row.names or ()])


def text_lines(data: bytes, start: int) -> list[bytes]:
    """Return the lines of a text file from an offset that are not empty."""
    return [line for line in data[start:].splitlines() if line.strip()]


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _extra_rows(data: bytes, form: str, elements: PlyElements, start: int) -> int:
    """Return the number of rows after the stated number of vertices, which are the last element."""
    if list(elements)[-1] != "vertex" or (form != "ascii" and any(kind.hasobject for _, kind in elements.values())):
        return 0
    if form == "ascii":
        return len(text_lines(data, start)) - sum(count for count, _ in elements.values())
    rest = len(data) - start - sum(count * kind.itemsize for count, kind in elements.values())
    return rest // elements["vertex"][1].itemsize


def columns_of(rows: npt.NDArray[np.void], names: tuple[str, ...] | list[str]) -> Float32Array:
    """Return the named properties as columns, shape (N, len(names))."""
    table = np.empty((len(rows), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for column, name in enumerate(names):
            table[:, column] = rows[name]
    return table
