"""Whether Mitsuba can read an image, tried in a process of its own: a damaged one may end the process that reads it."""

from __future__ import annotations

import subprocess
import sys
from functools import lru_cache
from pathlib import Path

from mitsplat.errors import InputError

_SECONDS = 120
_TRIAL = """
import resource, sys
path, memory = sys.argv[1:]
import mitsplat, mitsuba as mi
mi.set_variant("scalar_rgb")
resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
try:
    mi.Bitmap(path)
except RuntimeError as error:
    sys.exit(str(error).strip().splitlines()[-1])
"""


def check_image(path: Path) -> None:
    """Refuse an image that cannot be read, or that asks for more memory than its file warrants.

    Raises:
        InputError: With the reason, or the signal that ended the reader.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not path.is_file():
        raise InputError(f"{path}: must be a file")
    reason = _try_image(path.resolve(), status.st_mtime_ns, status.st_size)
    if reason is not None:
        raise InputError(f"{path}: not a readable image ({reason})")


@lru_cache(maxsize=64)
def _try_image(path: Path, modified: int, size: int) -> str | None:
    """Why a file of this size and time cannot be read, or None."""
    memory = (6 << 30) + 1000 * size  # half-precision pixels of one colour take a thousandth of what they become
    command = [sys.executable, "-c", _TRIAL, str(path), str(memory)]
    try:
        result = subprocess.run(command, capture_output=True, check=False, timeout=_SECONDS)
    except subprocess.TimeoutExpired:
        return f"its reader did not end within {_SECONDS} s"
    if result.returncode == 0:
        return None
    lines = result.stderr.decode("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines and result.returncode > 0 else f"its reader stopped with status {result.returncode}"
