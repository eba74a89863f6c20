"""Conversion of splat files by gaussforge, run in a bounded process by :mod:`mitsplat.gaussians.splat_files`."""

from __future__ import annotations

from typing import BinaryIO

from mitsplat.errors import InputError


def convert_splats(output: BinaryIO, data: bytes, source: str, target: str) -> None:
    """Write ``data`` of one format as another.

    Raises:
        InputError: If nothing can be decoded.
    """
    import gaussforge  # its decoders are for a bounded process only

    # Strict checks array sizes; it also refuses the infinite logits that an opacity of 0 or 1 has in an .spz file.
    result = gaussforge.GaussForge().convert(data, source, target, strict=source != "spz")
    if not result.get("data"):
        raise InputError(result.get("error", "nothing could be decoded"))
    output.write(result["data"])
