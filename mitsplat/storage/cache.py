"""Cache files, whose loss only costs time, and their folders.

Layouts and convex pieces are in ``$XDG_CACHE_HOME/mitsplat``, kernels of Warp in ``$XDG_CACHE_HOME/warp`` or
``$WARP_CACHE_PATH``, and kernels of Dr.Jit in ``~/.drjit`` or ``$DRJIT_CACHE_DIR``.
"""

from __future__ import annotations

import atexit
import errno
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from multiprocessing import parent_process
from pathlib import Path
from typing import IO

_logger = logging.getLogger(__name__)

MIN_FREE_SPACE = 16 * 2**20
"""Minimum free space of a usable cache folder [bytes]; all kernels of physics take 8 MiB."""

_WARP = "WARP_CACHE_PATH"
_reported: set[Path] = set()


def cache_folder() -> Path:
    """Return ``$XDG_CACHE_HOME/mitsplat``, by default ``~/.cache/mitsplat``; it need not exist."""
    return _cache_home() / "mitsplat"


def warp_folder() -> Path:
    """Return the folder of Warp's kernels."""
    return Path(os.environ.get(_WARP) or _cache_home() / "warp")


def drjit_folder() -> Path:
    """Return the folder of Dr.Jit's kernels."""
    return Path(os.environ.get("DRJIT_CACHE_DIR") or _home() / ".drjit")


def _cache_home() -> Path:
    home = os.environ.get("XDG_CACHE_HOME")
    return Path(home) if home else _home() / ".cache"


def _home() -> Path:
    """Return the home folder, or a path that does not exist for users without one."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")


def unusable_reason(folder: Path) -> str:
    """Create a folder, and return the reason why it cannot hold :data:`MIN_FREE_SPACE` bytes, or ""."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, MIN_FREE_SPACE)
    except OSError as error:
        # These errors come from file systems that cannot reserve space.
        return "" if error.errno in (errno.EOPNOTSUPP, errno.EINVAL) else error.strerror or str(error)
    return ""


@lru_cache(maxsize=1)
def prepare_caches() -> None:
    """Warn once about unusable cache folders; redirect Warp to a temporary folder if its own is unusable.

    Child processes inherit the temporary folder, which is removed when this process ends. Kernels that can be read from
    the unusable folder are copied there.
    """
    if os.environ.get(_WARP) == "":
        del os.environ[_WARP]  # Warp would use the working folder
    own, kernels = cache_folder(), warp_folder()
    reasons = {folder: reason for folder in (own, kernels) if (reason := unusable_reason(folder))}
    if kernels in reasons:
        temporary = tempfile.mkdtemp(prefix="mitsplat-kernels-")
        atexit.register(remove_in_process, temporary, os.getpid())
        with suppress(OSError):  # there are none, or some cannot be read
            shutil.copytree(kernels, temporary, dirs_exist_ok=True)
        os.environ[_WARP] = temporary
    if reasons:
        _warn(reasons)


def write_cache_file(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a cache file atomically by ``write(open file)``; warn once if it cannot be written."""
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            temporary = Path(file.name)
            write(file)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()
        _warn({path.parent: error.strerror or str(error)})


def _warn(reasons: dict[Path, str]) -> None:
    """Warn about newly found unusable folders in one line; in a worker process, the parent has already done so."""
    new = [folder for folder in reasons if not any(folder.is_relative_to(known) for known in _reported)]
    _reported.update(new)
    if new and parent_process() is None:
        where = ", ".join(f"{folder} ({reasons[folder]})" for folder in new)
        _logger.warning("a cache folder cannot be written, so every run computes kernels or layouts again: %s", where)


def remove_in_process(folder: str, process: int) -> None:
    """Remove a folder if this is the process with that id, and not a fork of it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
