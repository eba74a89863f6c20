"""Reader of Gaussian splats in glTF (Khronos, ``KHR_gaussian_splatting`` and ``..._compression_spz_2``).

Scales and opacities are activated values, quaternions are xyzw, and coefficients of spherical harmonics have the order
and signs of 3DGS. Earlier drafts defined logarithms of scales; these are recognised by negative values, which the
standard forbids. SPZ data have axes right, up, back, and are converted to those of glTF: left, up, front. Files of
programs that omit this conversion are recognised by the bounds of their positions.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import encode_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.spz_files import decode_spz
from mitsplat.geometry.rigid import Z_UP_FROM_Y_UP
from mitsplat.geometry.untrusted_meshes import check_mesh, try_read
from mitsplat.mesh_files.gltf_data import GltfData
from mitsplat.mesh_files.gltf_nodes import instance_poses, world_poses
from mitsplat.storage.files import MESH_ERRORS, JsonObject

GLTF_SUFFIXES = (".glb", ".gltf")
EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = f"{EXTENSION}_compression_spz_2"
ENCODED, LINEAR = "srgb_rec709_display", "lin_rec709_display"
GLTF_FROM_SPZ = np.diag([-1.0, 1.0, -1.0, 1.0])
_READ_EXTENSIONS = {
    EXTENSION,
    COMPRESSION,
    "EXT_mesh_gpu_instancing",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_xmp_json_ld",
}
_SPZ_STEP = 2.0**-11
"""Tolerance of the bounds of positions in SPZ data, two steps of positions with 12 fractional bits."""
_MATERIALS = "KHR_materials_"
"""Prefix of extensions of materials, which splats do not have; other programs require the one of unlit materials."""
_THINNEST = 1e-6
"""Least scale of a Gaussian relative to its largest one. The standard permits 0."""

_logger = logging.getLogger(__name__)


def is_gltf(path: Path) -> bool:
    """Return True if a file has a suffix of glTF."""
    return path.suffix.lower() in GLTF_SUFFIXES


def read_gltf_splats(path: Path) -> Splats:
    """Read all Gaussian splats of the scene of a glTF file, in metres with z up.

    Meshes, cameras and lights are not read. A warning names properties of splats that are not used.

    Raises:
        InputError: If the file cannot be read, has no splats, requires an extension that is not supported, or mirrors,
            shears or scales splats non-uniformly.
    """
    check_mesh(path, read=_try_splats)
    try:
        return _read(path, warn=True)
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {error}") from error
    except (OSError, *MESH_ERRORS) as error:
        raise InputError(f"{path}: not a glTF file that can be read ({error})") from error


def _try_splats(output: BinaryIO, _: bytes, path: str) -> None:
    """Read a file and discard it."""
    try_read(output, lambda: _read(Path(path), warn=False))


def _read(path: Path, *, warn: bool) -> Splats:
    """Read the splats of all nodes; with ``warn``, what is left out is logged."""
    data = GltfData(path)
    required = {name for name in data.document.get("extensionsRequired", []) if not name.startswith(_MATERIALS)}
    if unknown := sorted(required - _READ_EXTENSIONS):
        raise InputError(f"it requires extensions that are not supported: export it without {', '.join(unknown)}")
    parts, cache, left_out = [], {}, set()
    for index, pose in world_poses(data).items():
        node = data.entry("nodes", index)
        if "mesh" not in node:
            continue
        for number, primitive in enumerate(data.entry("meshes", node["mesh"])["primitives"]):
            if EXTENSION not in primitive.get("extensions", {}):
                left_out.add("meshes, which `mitsplat bake` reads")
                continue
            key = node["mesh"], number
            if key not in cache:
                cache[key] = _read_primitive(data, primitive, left_out)
            for instance in instance_poses(data, node):
                try:
                    parts.append(cache[key].transformed(Z_UP_FROM_Y_UP @ pose @ instance))
                except ValueError as error:
                    raise InputError(f"node {node.get('name', index)}: {error}") from error
    if not parts:
        raise InputError(f"it has no Gaussian splats ({EXTENSION}); `mitsplat bake` reads meshes")
    if warn and left_out:
        _logger.warning("%s: not read: %s", path, "; ".join(sorted(left_out)))
    for warning in data.warnings if warn else ():
        _logger.warning("%s: %s", path, warning)
    return Splats.concatenate(parts)


def _read_primitive(data: GltfData, primitive: JsonObject, left_out: set[str]) -> Splats:
    """Read a primitive in the axes of its node."""
    stored = primitive["extensions"][EXTENSION]
    space = stored.get("colorSpace", ENCODED)
    for name, known in (("kernel", "ellipse"), ("projection", "perspective"), ("sortingMethod", "cameraDistance")):
        if stored.get(name, known) != known:
            left_out.add(f"the {name} {stored[name]}, for which {known} is used")
    compressed = stored.get("extensions", {}).get(COMPRESSION)
    if compressed is not None:
        arrays, kernel = decode_spz(bytes(data.view(compressed["bufferView"])))
        splats = Splats(**arrays._asdict(), kernel=kernel)
        splats = splats.transformed(_gltf_from_spz(data, primitive, splats.means, left_out))
        means, quats, scales = splats.means, splats.quats, splats.scales
        opacities, sh = splats.opacities, splats.sh
    else:
        kernel = None
        means = _attribute(data, primitive, "POSITION", 3)
        quats = _attribute(data, primitive, f"{EXTENSION}:ROTATION", 4)
        scales = _attribute(data, primitive, f"{EXTENSION}:SCALE", 3)
        if scales.min(initial=0.0) < 0:
            scales = np.exp(scales)
            left_out.add("negative scales; they are taken for the logarithms of earlier drafts")
        opacities = _attribute(data, primitive, f"{EXTENSION}:OPACITY", 1)[:, 0]
        sh = _spherical_harmonics(data, primitive)
    if space == LINEAR:
        sh = encode_sh(sh)
        if sh.shape[1] > 1:
            left_out.add("linear colours beyond first order, which are encoded")
    elif space != ENCODED:
        left_out.add(f"the colour space {space}, for which {ENCODED} is used")
    visible = scales.max(axis=1, initial=0.0) > 0
    scales = np.maximum(scales, _THINNEST * scales.max(axis=1, keepdims=True, initial=0.0))
    return Splats(means[visible], quats[visible], scales[visible], opacities[visible], sh[visible], kernel=kernel)


def _gltf_from_spz(data: GltfData, primitive: JsonObject, means: Float32Array, left_out: set[str]) -> Float64Array:
    """Return the transform (4, 4) from the axes of SPZ data to those of glTF, which the bounds of ``POSITION`` confirm.

    CesiumJS and other programs write and read data without this transform; then the bounds are those of the data.
    """
    index = primitive.get("attributes", {}).get("POSITION")
    accessor = {} if index is None else data.entry("accessors", index)
    if not len(means) or "min" not in accessor or "max" not in accessor:
        return GLTF_FROM_SPZ
    stated = np.array([accessor["min"], accessor["max"]], dtype=np.float64)
    tolerance = _SPZ_STEP + 1e-3 * np.abs(stated).max()

    def fit(matrix: Float64Array) -> bool:
        positions = means @ matrix[:3, :3].T
        return bool(np.abs([positions.min(axis=0), positions.max(axis=0)] - stated).max() <= tolerance)

    if fit(GLTF_FROM_SPZ):
        return GLTF_FROM_SPZ
    if fit(np.eye(4)):
        left_out.add("the axes of SPZ, because the bounds of positions are those without a conversion")
        return np.eye(4)
    left_out.add("the bounds of positions, which contradict the SPZ data; objects may be turned by 180 degrees")
    return GLTF_FROM_SPZ


def _spherical_harmonics(data: GltfData, primitive: JsonObject) -> Float32Array:
    """Return the coefficients (N, K, 3) of all degrees that a primitive has completely."""
    bands = []
    for degree in range(4):
        names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        if degree and names[0] not in primitive["attributes"]:
            break
        bands += [_attribute(data, primitive, name, 3) for name in names]
    return np.stack(bands, axis=1)


def _attribute(data: GltfData, primitive: JsonObject, name: str, width: int) -> Float32Array:
    if name not in primitive["attributes"]:
        raise InputError(f"its splats must have the attribute {name} (missing)")
    values = data.accessor(primitive["attributes"][name])
    if values.shape[1] != width:
        raise InputError(f"its attribute {name} must have {width} components (got {values.shape[1]})")
    return values.astype(np.float32)
