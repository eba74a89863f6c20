"""Content hashes equal SHA-256 of the stated bytes."""

from __future__ import annotations

import ast
import hashlib
from pathlib import Path

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.storage.content_hash import ContentHash, file_hash

PACKAGE = Path(__file__).parents[2] / "mitsplat"


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def test_file_hash_is_the_sha256_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"content")
    assert file_hash(tmp_path / "a") == sha256(b"content")
    with (tmp_path / "a").open("rb") as opened:
        assert file_hash(opened) == sha256(b"content")
    with pytest.raises(FileNotFoundError):
        file_hash(tmp_path / "none")


def test_a_content_hash_is_that_of_concatenated_parts(tmp_path: Path) -> None:
    digest = ContentHash(b"one", "twö")
    assert digest.hexdigest() == sha256("onetwö".encode())
    digest.add_json({"b": 1, "a": [None, 0.1]})
    text = "onetwö" + '{"a": [null, 0.1], "b": 1}'
    assert digest.hexdigest() == sha256(text.encode())
    (tmp_path / "a").write_bytes(b"content")
    digest.add_file(tmp_path / "a")
    assert digest.hexdigest() == sha256(text.encode() + hashlib.sha256(b"content").digest())
    with pytest.raises(InputError, match="none: cannot be read"):
        digest.add_file(tmp_path / "none")


def test_arrays_of_equal_bytes_differ_by_type_and_shape() -> None:
    zeros = [np.zeros((2, 3), np.float32), np.zeros((3, 2), np.float32), np.zeros((2, 3), np.int32)]
    hashes = set()
    for array in zeros:
        digest = ContentHash()
        digest.add_array(array)
        hashes.add(digest.hexdigest())
    assert len(hashes) == 3
    every_other = np.arange(12.0).reshape(3, 4)[:, ::2]
    one, other = ContentHash(), ContentHash()
    one.add_array(every_other)
    other.add_array(every_other.copy())
    assert one.hexdigest() == other.hexdigest() == sha256(b"float64 (3, 2)" + every_other.tobytes())


def test_one_module_computes_hashes() -> None:
    """The audit is an exception: it stores names as small numbers."""
    found = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import) and any(alias.name == "hashlib" for alias in node.names)
    }
    assert found == {"storage/content_hash.py", "audit/expected_files.py"}
