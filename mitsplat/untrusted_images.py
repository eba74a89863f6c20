"""Whether Mitsuba can read an image, tried in a process of its own: a damaged one may end the process that reads it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

IMAGES = (".exr", ".hdr", ".pfm", ".png", ".jpg", ".jpeg", ".bmp", ".tga")
"""Suffixes of what patterns of images match."""

_SECONDS = 120
_MEMORY = 6 << 30
_TRIAL = """
import os, resource, sys
import mitsplat, mitsuba as mi
mi.set_variant("scalar_rgb")
files = list(zip(sys.argv[1::2], map(int, sys.argv[2::2])))
with open("/proc/self/statm") as pages:  # a driver of a GPU may have set aside any amount of addresses
    held = int(pages.read().split()[0]) * resource.getpagesize()
most = held + max(memory for _, memory in files)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
for path, memory in files:
    resource.setrlimit(resource.RLIMIT_AS, (held + memory, most))
    try:
        mi.Bitmap(path)
    except RuntimeError as error:
        print(str(error).strip().splitlines()[-1], file=sys.stderr, flush=True)
        os._exit(1)
    print(flush=True)
os._exit(0)  # within this limit, what ends a driver may never end
"""

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
    command = [sys.executable, "-c", _TRIAL]
    for path, _, size in files:  # half-precision pixels of one colour take a thousandth of what they become
        command += [str(path), str(_MEMORY + 1000 * size)]
    try:
        result = subprocess.run(command, capture_output=True, check=False, timeout=_SECONDS + len(files))
    except subprocess.TimeoutExpired as error:
        return len((error.stdout or b"").splitlines()), f"its reader did not end within {_SECONDS} s"
    good = len(result.stdout.splitlines())
    if result.returncode == 0:
        return good, None
    lines = result.stderr.decode("utf-8", "replace").strip().splitlines()
    ended = f"its reader stopped with status {result.returncode}"
    return good, lines[-1] if lines and result.returncode > 0 else ended
