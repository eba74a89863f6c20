"""glTF files that break a rule of the specification without an error in most readers."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.mesh_files.mesh_file import MeshFile
from mitsplat.mesh_files.mesh_reading import read_mesh_file
from tests.mesh_files.glb import CORNER_UV, CORNERS, QUAD, Glb


def sheet(uv: np.ndarray = CORNER_UV, colours: np.ndarray | None = None, name: str = "COLOR_0", **more: Any) -> Glb:
    """Make a sheet of two triangles with coordinates and colours of its vertices."""
    glb = Glb()
    attributes = {"POSITION": glb.accessor(CORNERS), "TEXCOORD_0": glb.accessor(uv)}
    if colours is not None:
        attributes[name] = glb.accessor(colours)
    glb.mesh(attributes, glb.accessor(more.pop("indices", QUAD)), **more)
    return glb


def parts_of(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the document and the buffer of a binary file."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def read_with_uri(folder: Path, uri: str) -> MeshFile:
    """Read the sheet as a text file whose buffer has a URI."""
    document, _ = parts_of(sheet().save(folder / "a.glb"))
    document["buffers"][0]["uri"] = uri
    (folder / "a.gltf").write_text(json.dumps(document))
    return read_mesh_file(folder / "a.gltf")


@pytest.mark.parametrize(
    ("glb", "sentence"),
    [
        (sheet(np.tile(CORNER_UV, (2, 1))), r"TEXCOORD_0 must have the 4 elements of POSITION \(got 8\)"),
        (sheet(CORNER_UV[:3]), r"TEXCOORD_0 must have the 4 elements of POSITION \(got 3\)"),
        (sheet(colours=np.zeros((6, 4), "f4")), r"COLOR_0 must have the 4 elements of POSITION \(got 6\)"),
        (sheet(indices=QUAD[:5]), r"triangles need a multiple of 3 indices \(got 5\)"),
    ],
)
def test_arrays_of_other_lengths_are_refused(tmp_path: Path, glb: Glb, sentence: str) -> None:
    with pytest.raises(InputError, match=rf"a\.glb: .*{sentence}"):
        read_mesh_file(glb.save(tmp_path / "a.glb"))


def test_matrices_that_are_stored_row_by_row_are_refused(tmp_path: Path) -> None:
    """Their translation is where nothing reads it, so that all parts of an assembly were at the origin."""
    glb = sheet()
    matrix = np.eye(4)
    matrix[:3, 3] = 5, 6, 7
    glb.document["nodes"][0]["matrix"] = matrix.T.ravel().tolist()
    part = read_mesh_file(glb.save(tmp_path / "a.glb")).parts[0]
    np.testing.assert_array_equal(part.transform, matrix)
    glb.document["nodes"][0]["matrix"] = matrix.ravel().tolist()
    with pytest.raises(
        InputError, match=r"must be 0, 0, 0, 1 \(got \[5\.0, 6\.0, 7\.0, 1\.0\]\); is it stored row by row"
    ):
        read_mesh_file(glb.save(tmp_path / "b.glb"))


@pytest.mark.parametrize(("name", "is_named"), [("COLOR_1", True), ("_COLOR", True), ("COLOR_0", False)])
def test_vertex_colours_that_are_not_read_are_named(tmp_path: Path, name: str, is_named: bool) -> None:
    glb = sheet(colours=np.full((4, 3), 0.5, "f4"), name=name)
    warnings = read_mesh_file(glb.save(tmp_path / "a.glb")).warnings
    assert warnings == ((f"its vertex colours {name} are left out: only COLOR_0 is read",) if is_named else ())


def test_a_buffer_that_is_longer_than_stated_is_named(tmp_path: Path) -> None:
    """It is valid, but in practice it is the buffer of an earlier export."""
    data = parts_of(sheet().save(tmp_path / "a.glb"))[1]
    (tmp_path / "a.bin").write_bytes(data)
    assert read_with_uri(tmp_path, "a.bin").warnings == ()
    (tmp_path / "a.bin").write_bytes(data + bytes(100))
    (warning,) = read_with_uri(tmp_path, "a.bin").warnings
    assert warning.startswith(f"its buffer a.bin has {len(data) + 100} bytes, but ")
    with pytest.raises(InputError, match=r"a\.gltf: its buffer b\.bin is missing; put it there$"):
        read_with_uri(tmp_path, "b.bin")


def test_base64_of_a_buffer_is_read_exactly(tmp_path: Path) -> None:
    """Characters outside of its alphabet were skipped, which moves all later bytes."""
    data = base64.b64encode(parts_of(sheet().save(tmp_path / "a.glb"))[1]).decode()
    lines = "\r\n".join(data[k : k + 76] for k in range(0, len(data), 76))
    for uri in (f"data:;base64,{data}", f"data:a/b;charset=utf-8;BASE64,{data}", f"data:;base64,{lines}"):
        np.testing.assert_allclose(read_with_uri(tmp_path, uri).parts[0].vertices, CORNERS)
    for wrong in (f"{data[:8]}#{data[8:]}", base64.urlsafe_b64encode(b"\xff" * 300).decode()):
        with pytest.raises(InputError, match="Only base64 data is allowed"):
            read_with_uri(tmp_path, f"data:;base64,{wrong}")


def test_zeros_after_the_document_are_padding(tmp_path: Path) -> None:
    """The specification wants blanks, but some programs write zeros."""
    document, data = parts_of(sheet().save(tmp_path / "a.glb"))
    text = json.dumps(document).encode() + bytes(4)
    text += bytes(-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    (tmp_path / "b.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    np.testing.assert_allclose(read_mesh_file(tmp_path / "b.glb").parts[0].vertices, CORNERS)
