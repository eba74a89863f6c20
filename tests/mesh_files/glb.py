"""Small glTF files for tests."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SIZE = 0.1
"""Side of the square sheet and of the cube [m]."""
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=np.float32) * np.float32(SIZE)
CORNER_UV = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], dtype=np.float32)
"""Coordinates of the sheet, v down as in glTF: u grows with x and v falls with y."""
QUAD = np.array([0, 1, 2, 0, 2, 3], dtype=np.uint16)


def coordinate_image() -> Image.Image:
    """Build an image whose red is 4 times the column and whose green is 4 times the row."""
    row, column = np.mgrid[:64, :64]
    return Image.fromarray(np.stack([4 * column, 4 * row, np.full((64, 64), 255)], axis=2).astype(np.uint8))


class Glb:
    """glTF document with one buffer."""

    def __init__(self) -> None:
        self.data = b""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
            "meshes": [], "materials": [], "accessors": [], "bufferViews": [],
        }  # fmt: skip

    def view(self, data: bytes, **more: Any) -> int:
        """Add a buffer view."""
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more}
        self.document["bufferViews"].append(view)
        self.data += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **more: Any) -> int:
        """Add an accessor of an array (N,) or (N, C)."""
        kind = values.dtype.str[1:]
        width = 1 if values.ndim == 1 else values.shape[1]
        item = {"bufferView": self.view(values.tobytes()), "componentType": TYPES[kind], "count": len(values)}
        self.document["accessors"].append({**item, "type": KINDS[width], **more})
        return len(self.document["accessors"]) - 1

    def texture(self, image: Image.Image | None = None, **sampler: Any) -> int:
        """Add a texture, by default :func:`coordinate_image`."""
        buffer = io.BytesIO()
        (image or coordinate_image()).save(buffer, "PNG")
        images, textures = (self.document.setdefault(name, []) for name in ("images", "textures"))
        images.append({"bufferView": self.view(buffer.getvalue()), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1})
        if sampler:
            self.document.setdefault("samplers", []).append(sampler)
            textures[-1]["sampler"] = len(self.document["samplers"]) - 1
        return len(textures) - 1

    def mesh(self, attributes: dict[str, int], indices: int | None = None, material: Any = None, **more: Any) -> int:
        """Add a mesh of one primitive."""
        primitive: dict[str, Any] = {"attributes": attributes, **more}
        if indices is not None:
            primitive["indices"] = indices
        if material is not None:
            self.document["materials"].append(material)
            primitive["material"] = len(self.document["materials"]) - 1
        self.document["meshes"].append({"primitives": [primitive], "name": "sheet"})
        return len(self.document["meshes"]) - 1

    def save(self, path: Path, **more: Any) -> Path:
        """Write the file, with further entries of the document."""
        document = {**self.document, **more, "buffers": [{"byteLength": len(self.data)}, *more.get("buffers", [])]}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        binary = self.data + bytes(-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def matt(texture: int | None = None, **info: Any) -> dict[str, Any]:
    """Build a rough dielectric material, with a texture and its further properties."""
    values: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
    if texture is not None:
        values["baseColorTexture"] = {"index": texture, **info}
    return {"pbrMetallicRoughness": values}


def sheet(*, uv: np.ndarray = CORNER_UV, sampler: dict[str, Any] | None = None, **info: Any) -> Glb:
    """Build a square sheet in x and y that shows :func:`coordinate_image`."""
    glb = Glb()
    attributes = {"POSITION": glb.accessor(CORNERS), "TEXCOORD_0": glb.accessor(uv.astype(np.float32))}
    glb.mesh(attributes, glb.accessor(QUAD), matt(glb.texture(**(sampler or {})), **info))
    return glb


def cube_mesh() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, coordinates and indices of a cube that shows the image on each side."""
    positions, uv = [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            corner = np.insert(CORNER_UV[:, ::-1], axis, side, axis=1)
            positions.append(corner if side != (axis == 1) else corner[[0, 3, 2, 1]])
            uv.append(positions[-1][:, [k for k in range(3) if k != axis]])
    faces = np.concatenate([QUAD + 4 * k for k in range(6)]).astype(np.uint16)
    return np.concatenate(positions).astype(np.float32) * np.float32(SIZE), np.concatenate(uv).astype(np.float32), faces
