"""Files that cost time only when they are missing."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

_logger = logging.getLogger(__name__)


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/mitsplat``, ``~/.cache/mitsplat`` by default; it need not exist."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "mitsplat"


def keep_file(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Make a file by ``write(open file)`` and give it its name when it is complete; where it cannot be, only log it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            write(file)
        Path(file.name).replace(path)
    except OSError as error:
        _logger.warning("%s: is not kept (%s)", path, error)
