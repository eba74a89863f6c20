"""Reading of an untrusted USD stage in a child process, which returns its content as records."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from mitsplat.arrays import AnyArray
from mitsplat.errors import InputError
from mitsplat.runtime.child_process import run_bounded
from mitsplat.usd.stage_physics import Record
from mitsplat.usd.stage_reader import StageReader
from mitsplat.usd.usd_layers import open_confined, require_usd

_MEMORY = 2 << 30
_MEMORY_PER_BYTE = 60
"""Permitted memory of the reader per byte of the stage's folder; text is longer than the arrays that it states."""
_SECONDS = 600
_MAX_SIZE = 8 << 30


def read_records(path: Path, images: int | None = 1) -> Record:
    """Read the content of a stage in a child process with bounded memory and time.

    Args:
        path: The stage.
        images: Maximum number of time codes at which moving prims are read; None for all.

    Returns:
        Lists of records: ``fields``, ``bodies``, ``colliders``, ``meshes``, ``cameras`` and ``lights``; ``times``, the
        time codes; and ``notes``, one sentence for everything that is not read. A record is that of the first time
        code. Those of moving prims also have ``motion``, their matrices at all time codes, shape (T, 4, 4), and those
        of objects that appear or disappear have ``shown``, their visibility at all time codes.

    Raises:
        InputError: If a file is missing or damaged, lies outside of the stage's folder, or breaks a rule.
        MissingResourceError: If OpenUSD is not installed.
    """
    require_usd()
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    size = path.stat().st_size
    if size > _MAX_SIZE:
        raise InputError(f"{path}: must be a stage of at most {_MAX_SIZE} bytes (got {size})")
    size = min(_MAX_SIZE, size + sum(file.stat().st_size for file in path.parent.glob("**/*.usd*") if file.is_file()))
    memory = _MEMORY + _MEMORY_PER_BYTE * size
    result = run_bounded(write_records, path, str(images or 0), memory=memory, seconds=_SECONDS)
    if result.status:
        reason = result.reason if result.status > 0 else f"its reader {result.reason}"
        raise InputError(reason if reason.startswith(str(path)) else f"{path}: {reason}")
    if result.status is None:
        raise InputError(f"{path}: its reader {result.reason}")
    with np.load(io.BytesIO(result.output), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return cast(Record, _with_arrays(json.loads(arrays.pop("records").tobytes()), arrays))


def write_records(output: BinaryIO, _: bytes, path: str, images: str) -> None:
    """Read a stage and write its records, as the child's part of :func:`read_records`."""
    arrays: dict[str, AnyArray] = {}
    reader = StageReader(open_confined(Path(path)), int(images) or None)
    text = json.dumps(_without_arrays(reader.read(), arrays))
    arrays["records"] = np.frombuffer(text.encode(), dtype=np.uint8)
    np.savez(output, allow_pickle=False, **arrays)


def _without_arrays(value: object, arrays: dict[str, AnyArray]) -> Any:
    """Return a record whose arrays are replaced by their names in ``arrays``."""
    if isinstance(value, np.ndarray):
        arrays[f"a{len(arrays)}"] = value
        return {"array": f"a{len(arrays) - 1}"}
    if isinstance(value, dict):
        return {key: _without_arrays(one, arrays) for key, one in value.items()}
    return [_without_arrays(one, arrays) for one in value] if isinstance(value, list) else value


def _with_arrays(value: object, arrays: dict[str, AnyArray]) -> Any:
    if isinstance(value, dict):
        if value.keys() == {"array"}:
            return arrays[value["array"]]
        return {key: _with_arrays(one, arrays) for key, one in value.items()}
    return [_with_arrays(one, arrays) for one in value] if isinstance(value, list) else value
