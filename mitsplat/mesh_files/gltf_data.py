"""Data of a glTF 2.0 file: its JSON document, accessors and images (Khronos, *glTF 2.0*, 3.6 and 4)."""

from __future__ import annotations

import base64
import io
import json
import struct
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from PIL import Image

from mitsplat.arrays import AnyArray
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.images.picture_files import describe_fault
from mitsplat.mesh_files.file_references import find_reference
from mitsplat.mesh_files.mesh_file import item
from mitsplat.storage.file_kinds import refuse_placeholder
from mitsplat.storage.files import IMAGE_ERRORS, JsonObject

_MAGIC, _JSON, _BINARY = b"glTF", 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_IMAGE_EXTENSIONS = ("EXT_texture_webp", "EXT_texture_avif")
_REMEDY = "`npx @gltf-transform/cli {} in.glb out.glb` decompresses it"


class GltfData:
    """JSON document of a glTF file with its buffers, which are read when they are needed.

    Damaged data raise the errors of :data:`mitsplat.storage.files.MESH_ERRORS`.

    Args:
        path: The file, whose folder has the files that it names.
        content: Its content; by default it is read.

    Attributes:
        path: The file.
        document: The JSON document.
        warnings: Warnings of the data that were read, a sentence each.
    """

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        self.path = path
        self._binary = b""
        self.warnings: list[str] = []
        content = path.read_bytes() if content is None else content
        refuse_placeholder(path, content[:1024])
        if content[:4] == _MAGIC:
            content = self._read_chunks(content)
        self.document: JsonObject = json.loads(content.rstrip(b"\0").decode("utf-8-sig"))
        version = self.document["asset"]["version"]
        if not str(version).startswith("2."):
            raise ValueError(f"only version 2 of glTF can be read (got {version!r})")
        self.buffer = cache(self._read_buffer)
        self.image = cache(self._read_image)

    def _read_chunks(self, content: bytes) -> bytes:
        """Return the JSON chunk of a binary file; the other chunk is the first buffer."""
        _, version, _, size, kind = struct.unpack_from("<4sIIII", content)
        if version != 2 or kind != _JSON or 20 + size > len(content):
            raise ValueError(f"not a complete binary glTF of version 2 (got version {version})")
        if len(content) >= 28 + size:
            length, kind = struct.unpack_from("<II", content, 20 + size)
            if kind == _BINARY:
                self._binary = content[28 + size : 28 + size + length]
        return content[20 : 20 + size]

    def entry(self, kind: str, index: object) -> JsonObject:
        """Return an object of a list of the document.

        Raises:
            ValueError: If it is missing.
        """
        found: JsonObject = item(self.document.get(kind), index, f"entry of {kind}")
        return found

    def _read_buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer: the binary chunk, data in the document, or a file."""
        uri = self.entry("buffers", index).get("uri")
        if uri is None:
            if index == 0 and self._binary:
                return self._binary
            raise ValueError(f"buffer {index} has no data")
        data = self._content(uri, "buffer")
        stated = self.entry("buffers", index).get("byteLength", len(data))
        if len(data) > stated + 3:  # padding
            name = "" if uri.startswith("data:") else f" {uri}"
            self.warnings.append(
                f"its buffer{name} has {len(data)} bytes, but {stated} are stated: is it of another version of it?"
            )
        return data

    def _content(self, uri: str, kind: str) -> bytes:
        """Return the data of a URI: its own, or those of a file in the folder of the glTF file."""
        if uri.startswith("data:"):
            head, _, data = uri.partition(",")
            if not head.lower().endswith(";base64"):
                return unquote_to_bytes(data)
            return base64.b64decode("".join(unquote(data).split()), validate=True)
        return find_reference(self.path, unquote_to_bytes(uri).decode(), kind).read_bytes()

    def view(self, index: object) -> memoryview:
        """Return the bytes of a buffer view.

        Raises:
            InputError: If it is compressed by meshoptimizer.
        """
        view = self.entry("bufferViews", index)
        for name in _MESHOPT:
            if name in view.get("extensions", {}) and not self._has_data(view["buffer"]):
                raise InputError(f"its geometry is compressed by meshoptimizer ({name}); {_REMEDY.format('copy')}")
        start, length = view.get("byteOffset", 0), view["byteLength"]
        data = self.buffer(view["buffer"])
        if not 0 <= start <= start + length <= len(data):
            raise ValueError(f"buffer view {index} extends beyond its buffer")
        return memoryview(data)[start : start + length]

    def _has_data(self, index: object) -> bool:
        return "uri" in self.entry("buffers", index) or (index == 0 and bool(self._binary))

    def accessor(self, index: object) -> AnyArray:
        """Return the elements of an accessor, shape (count, components); normalised integers become floats."""
        stored = self.entry("accessors", index)
        kind, count = np.dtype(_TYPES[stored["componentType"]]), stored["count"]
        width = _COMPONENTS[stored["type"]]
        if "bufferView" in stored:
            values = self._elements(stored, kind, count, width)
        else:
            values = np.zeros((count, width), kind)
        if sparse := stored.get("sparse"):
            index_kind = np.dtype(_TYPES[sparse["indices"]["componentType"]])
            rows = self._elements(sparse["indices"], index_kind, sparse["count"], 1)[:, 0]
            values = values.copy()
            values[rows] = self._elements(sparse["values"], kind, sparse["count"], width)
        return normalised(values) if stored.get("normalized") else values

    def _elements(self, place: JsonObject, kind: np.dtype[Any], count: int, width: int) -> AnyArray:
        """Return ``count`` elements of a buffer view."""
        data, size = self.view(place["bufferView"]), width * kind.itemsize
        stride = self.entry("bufferViews", place["bufferView"]).get("byteStride") or size
        start = place.get("byteOffset", 0)
        if min(count, start) < 0 or stride < size or (count and start + (count - 1) * stride + size > len(data)):
            raise ValueError("an accessor extends beyond its data")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def draco(self, compressed: JsonObject) -> tuple[dict[str, AnyArray], AnyArray]:
        """Return the attributes and faces of a primitive that is compressed by Draco.

        Raises:
            MissingResourceError: If DracoPy is not installed.
        """
        try:
            import DracoPy  # optional
        except ImportError:
            raise MissingResourceError(
                f"{self.path}: its geometry is compressed by Draco, which needs `pip install 'mitsplat[draco]'`; "
                + _REMEDY.format("copy")
            ) from None
        try:
            mesh = DracoPy.decode(bytes(self.view(compressed["bufferView"])))
        except Exception as error:
            raise ValueError(f"its geometry is compressed by Draco and damaged: {error}") from error
        decoded = {attribute["unique_id"]: np.asarray(attribute["data"]) for attribute in mesh.attributes}
        return {name: decoded[number] for name, number in compressed["attributes"].items()}, np.asarray(mesh.faces)

    def texture_image(self, index: object) -> Image.Image:
        """Return the image of a texture.

        Raises:
            InputError: If it has images in unsupported formats only.
        """
        try:
            texture = self.entry("textures", index)
        except ValueError:
            raise InputError(f"a material's texture {index} is missing; give a colour") from None
        extensions = texture.get("extensions", {})
        for name in _IMAGE_EXTENSIONS:
            if name in extensions:
                return self.image(extensions[name]["source"])
        if "source" in texture:
            return self.image(texture["source"])
        if "KHR_texture_basisu" in extensions:
            raise InputError(
                f"its texture {index} is compressed as KTX2 (KHR_texture_basisu), which is not supported: "
                "`npx @gltf-transform/cli ktxdecompress in.glb out.glb` decompresses it with KTX-Software; "
                "or give a colour"
            )
        raise InputError(f"a material's texture {index} has no image; give a colour")

    def _read_image(self, index: int) -> Image.Image:
        """Read an image of a texture from a buffer view, a data URI or a file."""
        try:
            stored = self.entry("images", index)
        except ValueError:
            raise InputError(f"a material's texture image {index} is missing; give a colour") from None
        uri = stored.get("uri")
        place = f"texture {uri}" if uri is not None and not uri.startswith("data:") else f"texture image {index}"
        data = bytes(self.view(stored["bufferView"])) if uri is None else self._content(uri, "texture")
        try:
            image = Image.open(io.BytesIO(data))
            image.load()
        except IMAGE_ERRORS as error:
            raise InputError(
                f"{self.path}: its {place} cannot be read ({describe_fault(error)}); replace it, or give a colour"
            ) from None
        return image


def normalised(values: AnyArray) -> AnyArray:
    """Return integers of any shape as floats of at most 1 (glTF 2.0, 3.11); floats are not changed."""
    if values.dtype.kind == "f":
        return values
    return np.asarray(np.maximum(values / float(np.iinfo(values.dtype).max), -1.0))
