"""Conversion of splat files by gaussforge, in a process with bounded memory and time."""

from __future__ import annotations

from typing import BinaryIO

from mitsplat.errors import InputError
from mitsplat.runtime.child_process import run_bounded

_MAX_COMPRESSION_RATIO = 100
"""Maximum ratio of decompressed to compressed size. Real files have ratios of 1.1 to 3."""


def convert_splats(output: BinaryIO, data: bytes, source: str, target: str) -> None:
    """Convert ``data`` between formats and write it.

    Raises:
        InputError: If the data cannot be decoded.
    """
    import gaussforge  # imported only in the bounded process

    # The strict mode checks array sizes. It also refuses the infinite logits that opacities of 0 and 1 have in .spz
    # files.
    result = gaussforge.GaussForge().convert(data, source, target, strict=source != "spz")
    if not result.get("data"):
        raise InputError(result.get("error", "nothing could be decoded"))
    output.write(result["data"])


def convert_apart(data: bytes, source: str, target: str) -> bytes:
    """Convert between formats with gaussforge in a separate process.

    Its decoders do not check every count against the size of the input, so a damaged file can crash the process.
    """
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


def max_decompressed_size(size: int) -> int:
    """Return the maximum decompressed size of ``size`` compressed bytes."""
    return _MAX_COMPRESSION_RATIO * size + (16 << 20)
