"""Reader of glTF 2.0 files: nodes, primitives and materials (Khronos, *glTF 2.0*).

The unit is the metre and y points up. Skins and morph targets have the pose that the nodes of the file define.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import AnyArray, Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.geometry.mesh_normals import normal_matrix
from mitsplat.mesh_files.cut_outs import cut_out, opaque_texture
from mitsplat.mesh_files.gltf_data import GltfData, normalised
from mitsplat.mesh_files.gltf_nodes import instance_poses, world_poses
from mitsplat.mesh_files.mesh_file import (
    DIELECTRIC_SPECULAR,
    LEAST_ROUGHNESS,
    MAX_FRACTION,
    OPAQUE,
    PAINTED_MATERIAL,
    TRANSPARENT_COLOURS,
    TRANSPARENT_TEXELS,
    UNKNOWN_MATERIAL,
    FilePart,
    Material,
    MeshFile,
    Texture,
    Wrap,
    alpha_of,
    gloss_texture,
    is_transparent,
    means_of,
    pixels_of,
)
from mitsplat.storage.files import JsonObject

_READ_EXTENSIONS = {
    "EXT_mesh_gpu_instancing",
    "EXT_texture_avif",
    "EXT_texture_webp",
    "KHR_draco_mesh_compression",
    "KHR_materials_ior",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_specular",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
}
_COMPRESSIONS = {"EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_texture_basisu"}
"""Extensions that are refused where their data are needed, with a remedy."""
_WITHOUT_EFFECT = {"KHR_materials_variants", "KHR_materials_emissive_strength", "KHR_xmp_json_ld", "KHR_xmp"}
"""Extensions of materials that change nothing in what is baked."""
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_METAL_SPECULAR = 0.25
"""Specular colour of the specular-glossiness model above which a material is a metal."""


def read_gltf(path: Path, *, textures: bool = True, content: bytes | None = None) -> MeshFile:
    """Read a ``.gltf`` or ``.glb`` file.

    Damaged files raise the errors of :data:`mitsplat.storage.files.MESH_ERRORS`.

    Args:
        path: The file.
        textures: False to ignore all textures, which need not exist.
        content: Content of the file; by default it is read.

    Raises:
        InputError: If the file requires an extension that is not supported, or if a texture cannot be read.
        MissingResourceError: If the package that decompresses its geometry is not installed.
    """
    data = GltfData(path, content)
    unknown = sorted(set(data.document.get("extensionsRequired", [])) - _READ_EXTENSIONS - _COMPRESSIONS)
    splats = InputError("it has Gaussian splats, which `mitsplat import` reads")
    if "KHR_gaussian_splatting" in unknown:
        raise splats
    if unknown:
        raise InputError(
            f"it requires extensions of glTF that are not supported: export it without {', '.join(unknown)}"
        )
    file = _GltfReader(data, textures).read()
    if not file.parts and "KHR_gaussian_splatting" in data.document.get("extensionsUsed", []):
        raise splats
    return file


class _GltfReader:
    """Reader of the scene of one file."""

    def __init__(self, data: GltfData, textures: bool) -> None:
        self._data, self._textures = data, textures
        self._names: dict[str, int] = {}
        self._warnings: list[str] = []
        self._read_part = cache(self._read_primitive)
        self._pixels = cache(lambda texture: pixels_of(data.texture_image(texture)))

    def read(self) -> MeshFile:
        """Read all parts of the scene."""
        scenes = self._data.document.get("scenes", [])
        if len(scenes) > 1:
            number = self._data.document.get("scene", 0)
            self._warnings.append(f"it has {len(scenes)} scenes, of which only scene {number} is read")
        parts = tuple(part for node, pose in self._world_poses.items() for part in self._read_node(node, pose))
        warnings = tuple(dict.fromkeys((*self._warnings, *self._data.warnings)))
        return MeshFile(parts, 1.0, "y", warnings, in_single=True)

    @cached_property
    def _world_poses(self) -> dict[int, Float64Array]:
        return world_poses(self._data)

    def _read_node(self, index: int, pose: Float64Array) -> Iterator[FilePart]:
        """Read the mesh of a node, once per instance."""
        node = self._data.entry("nodes", index)
        if "mesh" not in node:
            return
        mesh = self._data.entry("meshes", node["mesh"])
        poses = [pose @ one for one in instance_poses(self._data, node)]
        weights = tuple(node.get("weights") or mesh.get("weights") or ())
        for number, primitive in enumerate(mesh["primitives"]):
            if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                self._warnings.append("its points and lines are left out")
                continue
            part = self._read_part(node["mesh"], number, weights)
            if "skin" in node:
                yield self._skinned(self._data.entry("skins", node["skin"]), primitive, part)
                continue
            yield from (replace(part, transform=one) for one in poses)

    def _skinned(self, skin: JsonObject, primitive: JsonObject, part: FilePart) -> FilePart:
        """Return a part in the pose of the joints of a skin."""
        outside = [joint for joint in skin["joints"] if joint not in self._world_poses]
        if outside:
            raise ValueError(f"joint {outside[0]} of a skin is not in the scene")
        poses = np.array([self._world_poses[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            inverse = self._data.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
            poses = poses @ inverse[: len(poses)]
        sets = sum(name.startswith("JOINTS_") for name in primitive["attributes"])
        joints, weights = (
            np.hstack([self._attribute(primitive, f"{name}_{k}") for k in range(sets)])
            for name in ("JOINTS", "WEIGHTS")
        )
        at = np.pad(part.vertices, ((0, 0), (0, 1)), constant_values=1.0)
        total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
        blended = np.einsum("vj,vjab->vab", weights / total, poses[joints.astype(int)])
        vertices = np.einsum("vab,vb->va", blended, at)[:, :3]
        normals = part.normals
        if normals is not None:
            normals = np.einsum("fkab,fkb->fka", normal_matrix(blended[:, :3, :3])[part.faces], normals)
        return replace(part, vertices=vertices, normals=normals)

    def _attribute(self, primitive: JsonObject, name: str) -> AnyArray:
        return self._data.accessor(primitive["attributes"][name])

    def _read_primitive(self, mesh: int, number: int, weights: tuple[float, ...]) -> FilePart:
        """Read a primitive of a mesh whose morph targets have ``weights``."""
        stored_mesh = self._data.entry("meshes", mesh)
        primitive = stored_mesh["primitives"][number]
        attributes, indices = self._read_arrays(primitive)
        for target, weight in zip(primitive.get("targets", []), weights, strict=False):
            for name in (set(target) & set(attributes)) if weight else ():
                attributes[name] = normalised(attributes[name]) if name == "COLOR_0" else attributes[name]
                attributes[name] = attributes[name] + weight * self._data.accessor(target[name]).astype(np.float64)
        vertices = attributes["POSITION"].astype(np.float64)
        faces = _triangles(indices, primitive.get("mode", _TRIANGLES))
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise ValueError(f"a face has vertices {faces.min()} to {faces.max()} of {len(vertices)}")
        normals = attributes["NORMAL"].astype(np.float64)[faces] if "NORMAL" in attributes else None
        name = str(stored_mesh.get("name", f"mesh_{mesh}"))
        self._names[name] = self._names.get(name, -1) + 1
        name = f"{name}_{self._names[name]}" if self._names[name] else name
        colours, alpha = None, None
        if "COLOR_0" in attributes:
            given = normalised(attributes["COLOR_0"]).astype(np.float64)
            if "targets" not in primitive and given.max(initial=0.0) > MAX_FRACTION:
                raise InputError(
                    f"colours of vertices must be within 0 to 1 (got {given.max():g}): divide them by 255, or export "
                    "them as integers"
                )
            stored_colours = np.clip(given, 0.0, 1.0)[faces]
            colours = stored_colours[..., :3]
            alpha = stored_colours[..., 3] if stored_colours.shape[2] == 4 else None
        if "material" not in primitive:
            material = UNKNOWN_MATERIAL if colours is None else PAINTED_MATERIAL
            return FilePart(name, vertices, faces, np.eye(4), material, colours, normals=normals)
        stored = self._data.entry("materials", primitive["material"])
        uv = {int(key[9:]): values[faces] for key, values in attributes.items() if key.startswith("TEXCOORD_")}
        material = self._read_material(stored, uv)
        double_sided = bool(stored.get("doubleSided"))
        part = FilePart(name, vertices, faces, np.eye(4), material, colours, double_sided, normals)
        if stored.get("alphaMode") == "BLEND" and alpha is not None and (alpha < OPAQUE).any():
            material = replace(material, warnings=(*material.warnings, TRANSPARENT_COLOURS))
            return replace(part, material=material)
        return self._cut_out(part, stored, uv, alpha) if stored.get("alphaMode") == "MASK" else part

    def _cut_out(
        self, part: FilePart, stored: JsonObject, uv: dict[int, Float64Array], opacity: Float64Array | None
    ) -> FilePart:
        """Remove the places of a part that its material, of ``alphaMode`` MASK, makes invisible.

        Args:
            part: The part.
            stored: The material.
            uv: Texture coordinates (F, 3, 2) by their set.
            opacity: Opacity of the colours of the face corners, shape (F, 3), or None.
        """
        values = stored.get("pbrMetallicRoughness", {})
        factor, base = values.get("baseColorFactor", (1, 1, 1, 1)), values.get("baseColorTexture")
        if (given := stored.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")) is not None:
            factor, base = given.get("diffuseFactor", (1, 1, 1, 1)), given.get("diffuseTexture")
        cutoff = float(stored.get("alphaCutoff", 0.5))
        alpha = self._read_texture(base, uv, [], alpha=True)
        if alpha is None and opacity is not None:
            alpha = opaque_texture(len(part.faces))
        if alpha is not None and factor[3] > 0:
            return cut_out(part, alpha, 255.0 * cutoff / factor[3], opacity)
        return part if factor[3] >= cutoff else replace(part, faces=part.faces[:0], normals=None)

    def _read_arrays(self, primitive: JsonObject) -> tuple[dict[str, AnyArray], Int64Array]:
        """Return the positions, colours and texture coordinates of a primitive, and its indices."""
        decoded: dict[str, AnyArray] = {}
        indices = None
        if (compressed := primitive.get("extensions", {}).get("KHR_draco_mesh_compression")) is not None:
            decoded, indices = self._data.draco(compressed)
        attributes = {}
        for name, index in primitive["attributes"].items():
            if name not in ("POSITION", "NORMAL", "COLOR_0") and not name.startswith("TEXCOORD_"):
                if "COLOR" in name.upper() and "COLOR_0" not in primitive["attributes"]:
                    self._warnings.append(f"its vertex colours {name} are left out: only COLOR_0 is read")
                continue
            if name not in decoded:
                attributes[name] = self._data.accessor(index)
            elif self._data.entry("accessors", index).get("normalized"):
                attributes[name] = normalised(decoded[name])
            else:
                attributes[name] = decoded[name]
        for name, values in attributes.items():
            if len(values) != len(attributes["POSITION"]):
                count = len(attributes["POSITION"])
                raise ValueError(f"{name} must have the {count} elements of POSITION (got {len(values)})")
        if "NORMAL" in attributes and attributes["NORMAL"].shape[1] != 3:
            raise ValueError(f"NORMAL must have 3 components (got {attributes['NORMAL'].shape[1]})")
        if indices is None and "indices" in primitive:
            indices = self._data.accessor(primitive["indices"])
        if indices is None:
            indices = np.arange(len(attributes["POSITION"]))
        return attributes, np.ravel(indices).astype(np.int64)

    def _read_material(self, stored: JsonObject, uv: dict[int, Float64Array]) -> Material:
        """Convert a material for faces with coordinates ``uv`` (F, 3, 2) by their set."""
        warnings: list[str] = []
        values, extensions = stored.get("pbrMetallicRoughness", {}), stored.get("extensions", {})
        metallic, roughness = (_share(values, f"{name}Factor") for name in ("metallic", "roughness"))
        factor, base = values.get("baseColorFactor", (1, 1, 1, 1)), values.get("baseColorTexture")
        specular, left_out = DIELECTRIC_SPECULAR, set(extensions) - _READ_EXTENSIONS - _WITHOUT_EFFECT
        if "KHR_materials_ior" in extensions:
            index = float(extensions["KHR_materials_ior"].get("ior", 1.5))
            specular = ((index - 1.0) / (index + 1.0)) ** 2
        if (given := extensions.get("KHR_materials_specular")) is not None:
            colour = np.mean(given.get("specularColorFactor", (1, 1, 1)))
            specular *= float(given.get("specularFactor", 1.0) * colour)
            left_out |= {name for name in ("specularTexture", "specularColorTexture") if name in given}
        if (given := extensions.get("KHR_materials_pbrSpecularGlossiness")) is not None:
            factor, base = given.get("diffuseFactor", (1, 1, 1, 1)), given.get("diffuseTexture")
            metallic, roughness = 0.0, 1.0 - float(given.get("glossinessFactor", 1.0))
            reflected = np.asarray(given.get("specularFactor", (1, 1, 1)), dtype=np.float64)
            if "specularGlossinessTexture" in given:
                left_out.add("specularGlossinessTexture")
                roughness, specular = max(roughness, 0.5), DIELECTRIC_SPECULAR
            elif reflected.max() > _METAL_SPECULAR:
                factor, base, metallic = (*reflected, 1.0), None, 1.0
            else:
                specular = float(reflected.mean())
            values = {}
        if stored.get("alphaMode", "OPAQUE") == "BLEND" and factor[3] < OPAQUE:
            warnings.append("it is transparent, but is baked as opaque")
        if "emissiveTexture" in stored or any(stored.get("emissiveFactor", ())):
            warnings.append("it emits light, which is not baked")
        if left_out:
            names = ", ".join(sorted(left_out))
            warnings.append(f"its {names} {'is' if len(left_out) == 1 else 'are'} left out")
        texture, is_blended = self._read_texture(base, uv, warnings), stored.get("alphaMode", "OPAQUE") == "BLEND"
        if texture is not None and is_blended and is_transparent(self._data.texture_image(base["index"])):
            warnings.append(TRANSPARENT_TEXELS)
        gloss = self._read_texture(values.get("metallicRoughnessTexture"), uv, warnings)
        if gloss is not None:
            gloss = gloss_texture(gloss, metallic, roughness)
            metallic, roughness = means_of(gloss)
        normal = self._read_texture(stored.get("normalTexture"), uv, warnings)
        if normal is not None and (scale := stored["normalTexture"].get("scale", 1.0)) != 1.0:
            normal = Texture(_steeper(normal.pixels, scale), normal.uv, normal.wrap)
        return Material(
            np.clip(np.asarray(factor[:3], dtype=np.float64), 0.0, 1.0),
            texture,
            float(np.clip(metallic, 0.0, 1.0)),
            float(np.clip(roughness, LEAST_ROUGHNESS, 1.0)),
            specular,
            "KHR_materials_unlit" not in extensions,
            tuple(warnings),
            gloss,
            normal,
        )

    def _read_texture(
        self, given: JsonObject | None, uv: dict[int, Float64Array], warnings: list[str], *, alpha: bool = False
    ) -> Texture | None:
        """Read a texture, or only its channel ``alpha``, with its own coordinates."""
        if given is None or not (self._textures or alpha):
            return None
        pixels = alpha_of(self._data.texture_image(given["index"])) if alpha else self._pixels(given["index"])
        transform = given.get("extensions", {}).get("KHR_texture_transform", {})
        number = transform.get("texCoord", given.get("texCoord", 0))
        if number not in uv:
            warnings.append(f"its texture uses coordinates TEXCOORD_{number}, which are missing, and is left out")
            return None
        coordinates = _transformed(uv[number].astype(np.float64), transform) * (1.0, -1.0) + (0.0, 1.0)
        sampler = self._data.entry("textures", given["index"]).get("sampler")
        stored = {} if sampler is None else self._data.entry("samplers", sampler)
        wrap_u, wrap_v = (_WRAPS[stored.get(name, 10497)] for name in ("wrapS", "wrapT"))
        return Texture(pixels, coordinates, (wrap_u, wrap_v))


def _triangles(indices: Int64Array, mode: int) -> Int64Array:
    """Return the faces (F, 3) of a list, strip or fan of triangles."""
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise ValueError(f"triangles need a multiple of 3 indices (got {len(indices)})")
        return indices.reshape(-1, 3)
    first = np.arange(max(0, len(indices) - 2))
    if mode == _FAN:
        return np.stack([indices[first + 1], indices[first + 2], np.full(len(first), indices[:1])], axis=1)
    odd = first % 2
    return np.stack([indices[first], indices[first + 1 + odd], indices[first + 2 - odd]], axis=1)


def _transformed(uv: Float64Array, transform: JsonObject) -> Float64Array:
    """Return coordinates (F, 3, 2), v down, after ``KHR_texture_transform``: scale, rotation, offset.

    The rotation is counter-clockwise in the image, whose v axis points down.
    """
    angle = float(transform.get("rotation", 0.0))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.asarray((uv * transform.get("scale", (1, 1))) @ turn.T + transform.get("offset", (0, 0)))


def _share(values: JsonObject, name: str) -> float:
    """Return a number from 0 to 1 of a material, 1 by default.

    Raises:
        InputError: If it is no such number.
    """
    value = values.get(name, 1.0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise InputError(f"{name} of a material must be from 0 to 1 (got {value})")
    return float(value)


def _steeper(pixels: npt.NDArray[np.uint8], scale: object) -> npt.NDArray[np.uint8]:
    """Return a normal map (H, W, 3) whose slopes along x and y are multiplied by ``scale``, as unit vectors.

    Raises:
        InputError: If the scale is not a finite number.
    """
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not np.isfinite(scale):
        raise InputError(f"scale of a normal map must be a finite number (got {scale})")
    normals = (pixels / 127.5 - 1.0) * (scale, scale, 1.0)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-6)
    return np.asarray(np.rint(127.5 + 127.5 * normals).astype(np.uint8))
