"""Trial read of images by Mitsuba in a separate process, because a damaged image can crash its reader."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from mitsplat.images.exr_header import check_exr_header
from mitsplat.runtime.child_process import limit_memory, run_bounded

IMAGE_SUFFIXES = (".exr", ".hdr", ".pfm", ".png", ".jpg", ".jpeg", ".bmp", ".tga")
"""Suffixes of image files that patterns match."""

_REMEDIES = {
    "Unsupported number of components": "its colours are CMYK: export it as RGB",
    "Unknown file format": f"it must be one of {', '.join(IMAGE_SUFFIXES)}: export it as .png",
}
"""Messages in place of those of Mitsuba that contain the key."""
_SECONDS = 120
_MEMORY = 6 << 30
_Stamp = tuple[Path, int, int]
"""Path, modification time [ns] and size [bytes] of a file."""


def check_images(paths: Sequence[Path]) -> list[str | None]:
    """Return for each image the reason why it is refused, or None.

    An image is refused if it cannot be read, or if it needs more memory than its size justifies. All images are tested
    in one process, up to the first that is refused. Later images are not tested and have None.
    """
    reason = None
    stamps = []
    for path in paths:
        try:
            status = path.stat()
        except OSError as error:
            reason = f"{path}: cannot be read ({error.strerror})"
            break
        if not path.is_file():
            reason = f"{path}: must be a file"
            break
        stamps.append((path.resolve(), status.st_mtime_ns, status.st_size))
    num_readable, fault = _try_images(tuple(stamps)) if stamps else (0, None)
    if fault is not None:
        reason = f"{paths[num_readable]}: not a readable image ({fault})"
    return [reason if index == num_readable else None for index in range(len(paths))]


@lru_cache(maxsize=64)
def _try_images(files: tuple[_Stamp, ...]) -> tuple[int, str | None]:
    """Return the number of files that can be read, and the reason why the next one cannot, or None."""
    # A file of half-precision pixels of one colour can be a thousandth of the size of its pixels.
    limits = [_MEMORY + 1000 * size for _, _, size in files]
    arguments = [text for (path, _, _), limit in zip(files, limits, strict=True) for text in (str(path), str(limit))]
    process = run_bounded(
        _read_images, *arguments, imports=["mitsuba"], memory=max(limits), seconds=_SECONDS + len(files)
    )
    if process.status == 0:
        return len(files), None
    num_readable = len(process.output.splitlines())
    return num_readable, process.reason if (process.status or 0) > 0 else f"its reader {process.reason}"


def _read_images(output: BinaryIO, _: bytes, *arguments: str) -> None:
    """Read images, each within the memory limit that follows its path, and write one line per image."""
    import mitsuba as mi  # imported only in the child process
    import numpy as np

    from mitsplat.runtime.threads import ensure_threads  # imports Dr.Jit

    mi.set_variant("scalar_rgb")
    ensure_threads()
    for path, limit in zip(arguments[::2], arguments[1::2], strict=True):
        limit_memory(int(limit), final=False)
        check_exr_header(Path(path))
        try:
            pixels = np.array(mi.Bitmap(path), copy=False)
        except RuntimeError as error:
            remedy = next((text for part, text in _REMEDIES.items() if part in str(error)), None)
            raise error if remedy is None else ValueError(remedy) from None
        low, high = float(pixels.min()), float(pixels.max())  # both are NaN if one pixel is
        if not (low >= 0 and np.isfinite(high)):
            raise ValueError(f"its pixels must be finite and >= 0 (got {low:g} to {high:g}): replace them by 0")
        output.write(b"\n")
        output.flush()
