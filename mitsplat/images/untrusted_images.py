"""Whether Mitsuba can read an image, tried in a process of its own: a damaged one may end the process that reads it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from mitsplat.images.exr_header import check_exr_header
from mitsplat.runtime.child_process import limit_memory, run_bounded

IMAGES = (".exr", ".hdr", ".pfm", ".png", ".jpg", ".jpeg", ".bmp", ".tga")
"""Suffixes of what patterns of images match."""

_SECONDS = 120
_MEMORY = 6 << 30
_Stamp = tuple[Path, int, int]
"""A file, when it was changed [ns], and its size [bytes]."""


def check_images(paths: Sequence[Path]) -> list[str | None]:
    """Why each image cannot be read, or asks for more memory than its file warrants; None for what is not refused.

    All are tried in one process, as far as the first that is refused: those behind it are not looked at.
    """
    found: list[str | None] = []
    stamps = []
    for path in paths:
        try:
            status = path.stat()
        except OSError as error:
            found.append(f"{path}: cannot be read ({error.strerror})")
            break
        if not path.is_file():
            found.append(f"{path}: must be a file")
            break
        stamps.append((path.resolve(), status.st_mtime_ns, status.st_size))
    good, reason = _try_images(tuple(stamps)) if stamps else (0, None)
    if reason is not None:
        found = [f"{paths[good]}: not a readable image ({reason})"]
    known = [*[None] * (good if reason is not None else len(stamps)), *found]
    return [*known, *[None] * (len(paths) - len(known))]


@lru_cache(maxsize=64)
def _try_images(files: tuple[_Stamp, ...]) -> tuple[int, str | None]:
    """How many of the files can be read, and why the next one cannot, or None."""
    # Half-precision pixels of one colour take a thousandth of what they become.
    limits = [_MEMORY + 1000 * size for _, _, size in files]
    arguments = [text for (path, _, _), limit in zip(files, limits, strict=True) for text in (str(path), str(limit))]
    ended = run_bounded(
        _read_images, *arguments, imports=["mitsuba"], memory=max(limits), seconds=_SECONDS + len(files)
    )
    good = len(ended.output.splitlines())
    if ended.status == 0:
        return good, None
    return good, ended.reason if (ended.status or 0) > 0 else f"its reader {ended.reason}"


def _read_images(output: BinaryIO, _: bytes, *arguments: str) -> None:
    """Read images, each within the memory that follows its path, and write a line for each."""
    import mitsuba as mi  # for the child only

    mi.set_variant("scalar_rgb")
    for path, limit in zip(arguments[::2], arguments[1::2], strict=True):
        limit_memory(int(limit))
        check_exr_header(Path(path))
        mi.Bitmap(path)
        output.write(b"\n")
        output.flush()
