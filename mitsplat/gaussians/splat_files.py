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
This package decodes ``.ply``, ``.splat``, ``.ksplat``, ``.sog`` and version 3 of ``.spz``. Its allocations are
limited by the size of the file. gaussforge decodes the other formats. It does not validate its input and therefore
runs in a separate process with bounded memory, which takes 0.1 s to start.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from mitsplat.errors import InputError
from mitsplat.gaussians.ksplat_files import decode_ksplat
from mitsplat.gaussians.ply_files import MAX_PLY_HEADER, decode_ply, encode_ply, examine_columns
from mitsplat.gaussians.sog_files import decode_sog
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh, sh_to_rgb
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_checks import check_precision
from mitsplat.gaussians.spz_files import decode_spz, encode_spz
from mitsplat.quality import KernelName
from mitsplat.storage.file_kinds import kind_of_file, refuse_placeholder
from mitsplat.storage.files import storage_errors, write_bytes

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]

_CONVERTED = (".ksplat", ".spz", ".sog")
_SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

_STARTS = {b"ply\n": ".ply", b"ply\r": ".ply", b"NGSP": ".spz", b"PK\3\4": ".sog", b"glTF": ".glb"}
"""First bytes of files by suffix."""

_logger = logging.getLogger(__name__)


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
        if (kind := _STARTS.get(data[:4], suffix)) != suffix:
            raise InputError(f"a {suffix} file must not begin as a {kind} file: rename it if it is one")
        arrays, kernel, warnings = _decode(data, suffix)
        check_precision(arrays.means, arrays.scales)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    for warning in warnings:
        _logger.warning("%s: %s", path, warning)
    return arrays, kernel


def _decode(data: bytes, suffix: str) -> tuple[SplatArrays, KernelName | None, list[str]]:
    """Decode a file of a known suffix; return its arrays, the kernel of the training, and warnings."""
    if suffix == ".splat":
        return _decode_splat(data), None, []
    if suffix == ".spz":
        return *decode_spz(data), []
    if suffix == ".sog":
        return *decode_sog(data), []
    if suffix == ".ksplat":
        return decode_ksplat(data), None, []
    arrays = decode_ply(data)
    warnings, kernel = examine_columns(data, arrays.sh[:, 0])
    return arrays, kernel, warnings


def write_splats(splats: SplatArrays, path: Path, kernel: KernelName | None) -> None:
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
        ".ply": encode_ply,
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
        write_bytes(path, data)


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
        sh=rgb_to_sh(rgba[:, None, :3]),
    )


def _encode_splat(splats: SplatArrays, _kernel: KernelName | None) -> bytes:
    rows = np.empty(len(splats.means), _SPLAT_ROW)
    rgba = np.column_stack([sh_to_rgb(splats.sh[:, 0]), splats.opacities])
    rows["mean"], rows["scale"] = splats.means, splats.scales
    rows["rgba"] = np.rint(255.0 * np.clip(rgba, 0.0, 1.0))
    rows["quat"] = np.clip(np.rint(128.0 * splats.quats[:, [3, 0, 1, 2]] + 128.0), 0.0, 255.0)
    return rows.tobytes()
