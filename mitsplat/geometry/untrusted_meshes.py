"""Mesh files from untrusted sources: a trial read in a process with bounded memory and time."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
import trimesh

from mitsplat.errors import InputError, MissingResourceError
from mitsplat.runtime.child_process import run_bounded
from mitsplat.storage.files import MESH_ERRORS

ARCHIVES = (".zip", ".bz2", ".gz", ".tar")
"""Suffixes of archives, which are refused so that the user unpacks and inspects them."""

TrialReader = Callable[[BinaryIO, bytes, str], None]
"""Function of a child process that reads a mesh file: its output, its data (none), and the path of the file."""

_SECONDS = 120
_MEMORY = 1 << 30
_MEMORY_PER_BYTE = 100
"""Permitted memory of a reader per byte of the file."""
_MAX_SIZE = 1 << 30
"""Maximum file size: 21 million triangles as binary STL [bytes]."""
_HEADER = 4096
_PLAIN_PLY = re.compile(
    rb"ply\r?\nformat binary_little_endian 1\.0\r?\n(?:comment [^\n]*\n)*element vertex (\d{1,12})\r?\n"
    rb"((?:property (?:float|double|uchar|uint8|float32|float64) \w+\r?\n)+)element face (\d{1,12})\r?\n"
    rb"property list (?:uchar|uint8) (?:int|uint|int32|uint32) vertex_ind(?:ex|ices)\r?\n"
    rb"(property list uchar float corner_normals\n)?end_header\r?\n"
)
_WIDTHS = {b"float": 4, b"float32": 4, b"double": 8, b"float64": 8, b"uchar": 1, b"uint8": 1}


def refuse_archive(path: Path) -> None:
    """Raise :class:`InputError` if the name of a mesh file is that of an archive."""
    if path.suffix.lower() in ARCHIVES:
        raise InputError(f"{path}: must be a mesh file, not an archive: unpack it")


def check_mesh(path: Path, *, read: TrialReader | None = None) -> None:
    """Refuse a mesh file whose reader crashes or takes more memory or time than its size justifies.

    Files of binary triangles (.stl, .ply) whose size matches their header are not tested, because their reader takes
    only a few times their size. Other errors are left to the actual reader.

    Args:
        path: The file.
        read: Function at a module's top level that reads the file in a child process; by default trimesh does.

    Raises:
        InputError: If the trial read fails, or for an archive, or if the file is missing or too large.
    """
    refuse_archive(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        status = path.stat()
        if status.st_size > _MAX_SIZE:
            raise InputError(f"{path}: must be a mesh file of at most {_MAX_SIZE} bytes (got {status.st_size})")
        is_plain = _is_plain_binary(path, status.st_size)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not is_plain and (reason := _try_mesh(path.resolve(), status.st_mtime_ns, status.st_size, read or _read_mesh)):
        raise InputError(f"{path}: not a mesh file that can be read ({reason})")


def _is_plain_binary(path: Path, size: int) -> bool:
    """Return True if a file holds binary triangles of one kind and its size matches its header."""
    with path.open("rb") as file:
        head = file.read(_HEADER)
    if path.suffix.lower() == ".stl":
        return len(head) >= 84 and size == 84 + 50 * int(struct.unpack_from("<I", head, 80)[0])
    if path.suffix.lower() != ".ply" or not (found := _PLAIN_PLY.match(head)):
        return False
    kinds = [line.split()[1] for line in found[2].splitlines()]
    face = 50 if found[4] else 13
    return size == found.end() + int(found[1]) * sum(_WIDTHS[kind] for kind in kinds) + int(found[3]) * face


@lru_cache(maxsize=256)
def _try_mesh(path: Path, _modified: int, size: int, read: TrialReader) -> str:
    """Return the reason why a file cannot be read within its limits.

    The reason is empty if the file can be read, or if its reader reports an ordinary error.
    """
    memory = _MEMORY + _MEMORY_PER_BYTE * size
    process = run_bounded(read, path, imports=["trimesh"], memory=memory, seconds=_SECONDS)
    if process.status == 0:
        return ""
    return process.reason if (process.status or 0) > 0 else f"its reader {process.reason}"


def try_read(output: BinaryIO, read: Callable[[], object]) -> None:
    """Read a file in a :data:`TrialReader` and discard it.

    Errors except lack of memory are ignored, because the actual reader reports them.
    """
    try:
        with np.errstate(all="ignore"):
            read()
    except MemoryError:
        raise InputError(
            "reading it takes more memory than its file size justifies: if it has large textures, embed them in a .glb "
            "or scale them down"
        ) from None
    except (InputError, MissingResourceError, OSError, *MESH_ERRORS):
        pass
    output.write(b"\n")


def _read_mesh(output: BinaryIO, _: bytes, path: str) -> None:
    """Read a file with trimesh and discard it."""
    try_read(output, lambda: trimesh.load_scene(path).to_mesh())
