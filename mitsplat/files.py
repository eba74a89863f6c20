"""Files that are never half written."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

Record = dict[str, Any]
"""The line of one frame in ``manifest.jsonl``."""

SPLITS = ("train", "val")


def write_file(path: Path, write: Callable[[Path], object]) -> str:
    """Make a file by ``write(temporary path)``, then move it to ``path`` at once and for good; its folder is made.

    Returns:
        The SHA-256 of the content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    write(temporary)
    with temporary.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
    temporary.replace(path)
    return digest


def write_text(path: Path, text: str) -> str:
    """Write UTF-8 text by :func:`write_file`."""
    return write_file(path, lambda temporary: temporary.write_bytes(text.encode()))


def link_file(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
