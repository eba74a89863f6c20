"""Files that cost time only when they are missing, and folders for them.

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
from typing import IO, Any

_logger = logging.getLogger(__name__)

ROOM = 16 * 2**20
"""Least free room of a usable cache folder [bytes]; all kernels of physics take 8 MiB."""

_WARP = "WARP_CACHE_PATH"
_reported: set[Path] = set()


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/mitsplat``, ``~/.cache/mitsplat`` by default; it need not exist."""
    return _cache_home() / "mitsplat"


def warp_folder() -> Path:
    """Folder of Warp's kernels."""
    return Path(os.environ.get(_WARP) or _cache_home() / "warp")


def drjit_folder() -> Path:
    """Folder of Dr.Jit's kernels."""
    return Path(os.environ.get("DRJIT_CACHE_DIR") or _home() / ".drjit")


def _cache_home() -> Path:
    home = os.environ.get("XDG_CACHE_HOME")
    return Path(home) if home else _home() / ".cache"


def _home() -> Path:
    """Home folder; of users who have none a path that does not exist."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")


def why_unusable(folder: Path) -> str:
    """Return why no file of :data:`ROOM` bytes can be made in a folder, or an empty text; the folder is made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, ROOM)
    except OSError as error:
        # File systems that cannot reserve room.
        return "" if error.errno in (errno.EOPNOTSUPP, errno.EINVAL) else error.strerror or str(error)
    return ""


@lru_cache(maxsize=1)
def prepare_caches() -> None:
    """Warn once if nothing can be kept, and let Warp compile into a temporary folder if its own is unusable.

    Child processes inherit the temporary folder, which is removed when this process ends. Kernels that can be read
    from the unusable folder are copied there.
    """
    own, kernels = cache_folder(), warp_folder()
    lacks = {folder: lack for folder in (own, kernels) if (lack := why_unusable(folder))}
    if kernels in lacks:
        temporary = tempfile.mkdtemp(prefix="mitsplat-kernels-")
        atexit.register(_remove, temporary, os.getpid())
        with suppress(OSError):  # there are none, or not all of them can be read
            shutil.copytree(kernels, temporary, dirs_exist_ok=True)
        os.environ[_WARP] = temporary
    if lacks:
        _warn(lacks)


def keep_file(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Make a file by ``write(open file)`` and give it its name when it is complete; warn once if it cannot be made."""
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


def _warn(lacks: dict[Path, str]) -> None:
    """Warn of unusable folders that were not reported, in one line; the parent of a worker process has done so."""
    new = [folder for folder in lacks if not any(folder.is_relative_to(known) for known in _reported)]
    _reported.update(new)
    if new and parent_process() is None:
        where = ", ".join(f"{folder} ({lacks[folder]})" for folder in new)
        _logger.warning("the cache cannot be used, so that work is done again in every run: %s", where)


def _remove(folder: str, process: int) -> None:
    if os.getpid() == process:  # and not in processes that it forks
        shutil.rmtree(folder, ignore_errors=True)
