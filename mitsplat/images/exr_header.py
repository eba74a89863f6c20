"""Limits on the headers of OpenEXR files, checked before a library reads a file.

OpenEXR searches all channels and all attributes for each new one. 200,000 of them in 5 MB take it many minutes.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from mitsplat.errors import InputError

_MAGIC = b"\x76\x2f\x31\x01"
_MULTIPLE_PARTS = 0x1000
_MAX_CHANNEL_BYTES = 64 << 10
"""Maximum size of a channel list [bytes]; 2,000 channels with short names fit."""
_MAX_ATTRIBUTES = 2000
"""Maximum number of attributes of all parts."""
_MAX_NAME_LENGTH = 256


def check_exr_header(path: Path) -> None:
    """Refuse an OpenEXR file with an oversized header. Files of other formats are ignored.

    Raises:
        InputError: If a channel list or the number of attributes is too large, or if the header is truncated.
        OSError: If the file cannot be read.
    """
    with path.open("rb") as file:
        if file.read(4) != _MAGIC:
            return
        multiple = bool(_number(path, file) & _MULTIPLE_PARTS)
        for _ in range(_MAX_ATTRIBUTES):
            if not _attribute(path, file) and not (multiple and _has_more_parts(file)):
                return
    raise InputError(f"{path}: the header of an OpenEXR file must not hold more than {_MAX_ATTRIBUTES} attributes")


def _attribute(path: Path, file: BinaryIO) -> bool:
    """Read one attribute. Return False at the end of a part's header."""
    name = _text(path, file)
    if not name:
        return False
    kind, size = _text(path, file), _number(path, file)
    if kind == b"chlist" and size > _MAX_CHANNEL_BYTES:
        raise InputError(f"{path}: channels must be listed in at most {_MAX_CHANNEL_BYTES} bytes (got {size})")
    file.seek(size, 1)
    return True


def _has_more_parts(file: BinaryIO) -> bool:
    """Return True if the header of another part follows."""
    following = file.read(1)
    file.seek(-len(following), 1)
    return following not in (b"", b"\0")


def _text(path: Path, file: BinaryIO) -> bytes:
    """Read a text up to its zero byte."""
    found = file.read(_MAX_NAME_LENGTH)
    text, zero, rest = found.partition(b"\0")
    if not zero:
        raise InputError(
            f"{path}: the header of an OpenEXR file must have names of at most {_MAX_NAME_LENGTH - 1} bytes"
        )
    file.seek(-len(rest), 1)
    return text


def _number(path: Path, file: BinaryIO) -> int:
    """Read a non-negative 32-bit number."""
    data = file.read(4)
    value: int = struct.unpack("<i", data)[0] if len(data) == 4 else -1
    if value < 0:
        raise InputError(f"{path}: the header of the OpenEXR file is truncated or damaged")
    return value
