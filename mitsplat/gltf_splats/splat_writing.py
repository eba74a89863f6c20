"""Writer of Gaussian splats as binary glTF (``KHR_gaussian_splatting``), in metres with y up."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.spz_files import encode_spz
from mitsplat.geometry.rigid import Z_UP_FROM_Y_UP, scaling
from mitsplat.gltf_splats.splat_reading import COMPRESSION, ENCODED, EXTENSION, GLTF_FROM_SPZ
from mitsplat.storage.files import JsonObject, storage_errors, write_bytes
from mitsplat.version import __version__

_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
_LARGEST_SCALE = 300.0
"""Largest scale of SPZ, rounded down. Its smallest one, 4.5e-5, is too coarse in metres."""
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def export_asset_gltf(asset: Asset, path: Path, *, spz: bool = False) -> tuple[str, ...]:
    """Write the splats of an asset, and return what the file does not hold.

    Raises:
        InputError: If the asset has no splats or an unknown unit, or the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    if asset.units != "metre":
        raise InputError(f"{path}: glTF is in metres: state the size or the units of asset {asset.name}")
    write_gltf_splats(asset.splats, path, name=asset.name, spz=spz)
    losses = ["mesh, convex pieces, mass, friction and class: OpenUSD holds them"]
    if asset.splats.materials is not None:
        losses.append("metalness, roughness and specular of the splats, which have their base colours")
    return tuple(losses)


def write_gltf_splats(splats: Splats, path: Path, *, name: str, spz: bool = False) -> None:
    """Write splats in metres with z up as a ``.glb`` file with one node. The file is replaced atomically.

    Args:
        splats: Splats to write; materials and kernel are not stored.
        path: The file.
        name: Name of the node.
        spz: Compress the splats (``KHR_gaussian_splatting_compression_spz_2``), which quantises them.

    Raises:
        InputError: If there are no splats, or the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    if not len(splats):
        raise InputError(f"{path}: a glTF file must hold at least one Gaussian (got 0)")
    unit = _spz_unit(splats) if spz else 1.0
    turned = splats.transformed(scaling(1 / unit) @ Z_UP_FROM_Y_UP.T)
    names, properties, extensions = _attributes(turned), {"kernel": "ellipse", "colorSpace": ENCODED}, [EXTENSION]
    accessors: list[JsonObject] = []
    views: list[JsonObject] = []
    chunks: list[bytes] = []
    stored: JsonObject = dict(properties)
    if spz:
        arrays = turned.transformed(GLTF_FROM_SPZ.T)
        packed = encode_spz(SplatArrays(arrays.means, arrays.quats, arrays.scales, arrays.opacities, arrays.sh), None)
        views.append({"buffer": 0, "byteOffset": 0, "byteLength": len(packed)})
        chunks.append(packed + bytes(-len(packed) % 4))
        stored["extensions"] = {COMPRESSION: {"bufferView": 0}}
        extensions.append(COMPRESSION)
    for values in names.values():
        accessor = {"componentType": _FLOAT, "count": len(values), "type": _TYPES[values.shape[1]]}
        if not spz:
            accessor["bufferView"] = len(views)
            views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": values.nbytes})
            views[-1]["target"] = _ARRAY_BUFFER
            chunks.append(np.ascontiguousarray(values, "<f4").tobytes())
        accessors.append(accessor)
    accessors[0] |= {"min": turned.means.min(axis=0).tolist(), "max": turned.means.max(axis=0).tolist()}
    attributes = {attribute: index for index, attribute in enumerate(names)}
    primitive = {"mode": _POINTS, "attributes": attributes, "extensions": {EXTENSION: stored}}
    document = {
        "asset": {"version": "2.0", "generator": f"mitsplat {__version__}"},
        "extensionsUsed": extensions,
        **({"extensionsRequired": extensions} if spz else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name, **({"scale": [unit] * 3} if spz else {})}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(map(len, chunks))}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(chunks)
    content = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    if len(content) >= 1 << 32:
        raise InputError(f"{path}: a .glb file must have less than 4 GiB (got {len(content)} bytes)")
    with storage_errors(path):
        write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(content)) + content)


def _spz_unit(splats: Splats) -> float:
    """Return the unit of SPZ data [m], a power of ten of at least 1 mm in which the largest scale can be stored."""
    return float(10.0 ** max(-3, int(np.ceil(np.log10(float(splats.scales.max()) / _LARGEST_SCALE)))))


def _attributes(splats: Splats) -> dict[str, Float32Array]:
    """Return the attributes of splats by their names, positions first."""
    attributes = {
        "POSITION": splats.means,
        f"{EXTENSION}:ROTATION": splats.quats,
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities[:, None],
    }
    column = 0
    for degree in range(splats.sh_degree + 1):
        for number in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number}"] = splats.sh[:, column]
            column += 1
    return attributes
