"""Conversion of splat files by gaussforge, which :mod:`mitsplat.gaussians.splat_files` runs in a bounded process."""

from __future__ import annotations

from typing import BinaryIO

from mitsplat.errors import InputError


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
