"""Meshes and scenes of trimesh in memory as parts with materials.

Colours are display-encoded. Factors and vertex colours of glTF, which trimesh also uses in memory, are linear by its
specification (Khronos, *glTF 2.0*, 3.9.2 and 3.7.2.1). A texture without a factor is used unchanged. An MTL without
``Ks``, ``Pr`` and ``Pm``, or with ``illum`` 0 or 1, is matt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals
from trimesh.visual.color import to_rgba
from trimesh.visual.material import Material as TrimeshMaterial
from trimesh.visual.material import PBRMaterial, SimpleMaterial, empty_material

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.mesh import check_faces
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.mesh_file import (
    DIELECTRIC_SPECULAR,
    LEAST_ROUGHNESS,
    OPAQUE,
    PAINTED_MATERIAL,
    ROUGHNESS,
    TRANSPARENT_COLOURS,
    TRANSPARENT_TEXELS,
    UNKNOWN_COLOUR,
    UNKNOWN_MATERIAL,
    WITHOUT_COORDINATES,
    FilePart,
    Material,
    Texture,
    gloss_texture,
    is_transparent,
    means_of,
    phong_gloss,
    pixels_of,
)

_TRIMESH_DIFFUSE = (102, 102, 102)
"""Value that trimesh inserts for an absent ``Kd``."""
_UNREAD_MAPS = {f"map_{name}" for name in ("pr", "pm", "ks", "ns", "d", "bump", "refl", "rma", "orm")}
_UNREAD_KEYS = {"bump", "norm", "disp", "decal", "refl", *_UNREAD_MAPS}
"""Keys of MTL files that are left out with a warning."""


def scene_parts(
    mesh: trimesh.Trimesh | trimesh.Scene, source: object, normals: Mapping[str, Float64Array] | None = None
) -> tuple[FilePart, ...]:
    """Return the parts of a mesh or of a scene, in the units and axes of its positions.

    Args:
        mesh: The mesh or scene.
        source: Name of the mesh in messages.
        normals: Normals (V, 3) that a file states at the vertices of its meshes, by their names. Those of trimesh are
            not read, because it computes absent ones.

    Raises:
        InputError: If a face refers to a missing vertex, or if a texture is damaged.
    """
    scene = mesh if isinstance(mesh, trimesh.Scene) else trimesh.Scene({"mesh": mesh})
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            check_faces(geometry, source)
            try:
                part = _read_part(str(name), geometry, np.asarray(transform))
            except InputError as error:
                raise InputError(f"{source}: part {name}: {error}") from error
            stated = (normals or {}).get(name)
            parts.append(part if stated is None else replace(part, normals=stated[part.faces]))
    return tuple(parts)


def _read_part(name: str, mesh: trimesh.Trimesh, transform: Float64Array) -> FilePart:
    """Convert a mesh of trimesh and its colours or material; ``transform`` (4, 4) places it in the file."""
    faces, visual = np.asarray(mesh.faces), mesh.visual
    vertices, colours, double_sided = np.asarray(mesh.vertices), None, False
    if isinstance(visual, ColorVisuals):
        material = PAINTED_MATERIAL
        if visual.kind == "vertex":
            colours = visual.vertex_colors[faces]
        elif visual.kind == "face":
            colours = np.repeat(visual.face_colors[:, None], 3, axis=1)
        else:
            material = UNKNOWN_MATERIAL
    else:
        stored = visual.vertex_attributes.get("color")
        if stored is not None and len(stored) == len(vertices):
            colours = to_rgba(np.asarray(stored))[faces]
        if _is_empty(visual.material):
            material = UNKNOWN_MATERIAL if colours is None else PAINTED_MATERIAL
        else:
            uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float64)[faces]
            material = read_material(visual.material, uv)
            double_sided = bool(getattr(visual.material, "doubleSided", False))
    if colours is not None and colours.shape[-1] == 4 and (colours[..., 3] < 255 * OPAQUE).any():
        material = replace(material, warnings=(*material.warnings, TRANSPARENT_COLOURS))
    linear = None if colours is None else decode_srgb(colours[..., :3] / 255.0)
    return FilePart(name, vertices, faces, transform, material, linear, double_sided)


def _is_empty(material: TrimeshMaterial) -> bool:
    """Return True for the dark grey image that trimesh uses for texture coordinates without a material."""
    if not isinstance(material, SimpleMaterial) or material.kwargs or material.image is None:
        return False
    return np.array_equal(np.asarray(material.image), np.asarray(empty_material().image))


def read_material(material: TrimeshMaterial, uv: Float64Array | None = None) -> Material:
    """Convert a material of trimesh on faces with texture coordinates (F, 3, 2), or None without any."""
    if isinstance(material, SimpleMaterial):
        return _read_mtl(material, uv)
    return _read_pbr(material if isinstance(material, PBRMaterial) else material.to_pbr(), uv)


def _read_pbr(source: PBRMaterial, uv: Float64Array | None) -> Material:
    """Convert a metallic-roughness material on faces with texture coordinates (F, 3, 2), or None without any."""
    warnings: list[str] = []
    # trimesh stores linear values as multiples of 1/255.
    factor = np.ones(3) if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255.0
    if source.alphaMode not in (None, "OPAQUE") and (factor[3:] < OPAQUE).any():
        warnings.append("it is transparent, but is baked as opaque")
    if source.emissiveTexture is not None or np.any(source.emissiveFactor):
        warnings.append("it emits light, which is not baked")
    metallic = 0.0 if source.metallicFactor is None else float(source.metallicFactor)
    roughness = ROUGHNESS if source.roughnessFactor is None else float(source.roughnessFactor)
    texture = _texture(source.baseColorTexture, uv)
    if source.baseColorTexture is not None and uv is None:
        warnings.append(WITHOUT_COORDINATES)
    if texture is not None and is_transparent(source.baseColorTexture):
        warnings.append(TRANSPARENT_TEXELS)
    gloss = _texture(source.metallicRoughnessTexture, uv)
    if gloss is not None:
        # If this texture exists, absent factors are 1.
        factors = (1.0 if given is None else float(given) for given in (source.metallicFactor, source.roughnessFactor))
        gloss = gloss_texture(gloss, *factors)
        metallic, roughness = means_of(gloss)
    return Material(
        factor[:3],
        texture,
        float(np.clip(metallic, 0.0, 1.0)),
        float(np.clip(roughness, LEAST_ROUGHNESS, 1.0)),
        warnings=tuple(warnings),
        metallic_roughness=gloss,
        normal_map=_texture(source.normalTexture, uv),
    )


def _texture(image: Image.Image | None, uv: Float64Array | None) -> Texture | None:
    return None if image is None or uv is None else Texture(pixels_of(image), uv)


def _read_mtl(source: SimpleMaterial, uv: Float64Array | None) -> Material:
    """Convert an MTL material from the file's own keys, because trimesh inserts dark grey for an absent ``Kd``."""
    keys: Mapping[str, npt.ArrayLike] = source.kwargs
    warnings: list[str] = []
    texture = _texture(source.image, uv)
    if source.image is not None and uv is None:
        warnings.append(WITHOUT_COORDINATES)
    elif source.image is not None and is_transparent(source.image):
        warnings.append(TRANSPARENT_TEXELS)
    diffuse = _numbers(keys, "kd")
    if diffuse is None and not np.array_equal(source.diffuse[:3], _TRIMESH_DIFFUSE):
        diffuse = np.asarray(source.diffuse[:3]) / 255.0
    if texture is not None and diffuse is not None and not diffuse.any():
        warnings.append("its Kd is black, which is not applied to its texture")
        diffuse = None
    if diffuse is None and source.image is None and (ambient := _numbers(keys, "ka")) is not None and ambient.any():
        warnings.append("it has no Kd, and its Ka is no surface colour: grey is used")
    if diffuse is not None:
        factor = decode_srgb(np.broadcast_to(np.clip(diffuse, 0, 1), 3))
    else:
        factor = np.ones(3) if source.image is not None else np.full(3, UNKNOWN_COLOUR)
    opacity, transparency = _numbers(keys, "d"), _numbers(keys, "tr")
    if (opacity is not None and opacity[-1] < OPAQUE) or (transparency is not None and transparency[0] > 1 - OPAQUE):
        warnings.append("it is transparent, but is baked as opaque")
    elif "tf" in keys and not ((passed := _numbers(keys, "tf")) is not None and np.isin(passed, (0, 1)).all()):
        warnings.append("it transmits light (Tf), but is baked as opaque")
    emission = _numbers(keys, "ke")
    if "map_ke" in keys or (emission is not None and emission.any()):
        warnings.append("it emits light, which is not baked")
    left_out = sorted((_UNREAD_KEYS | ({"map_ka"} if source.image is None else set())) & set(keys))
    if left_out:
        warnings.append(f"its {', '.join(left_out)} {'is' if len(left_out) == 1 else 'are'} left out")
    given_roughness, metallic = _numbers(keys, "pr"), _numbers(keys, "pm")
    highlight, illumination = _numbers(keys, "ks"), _numbers(keys, "illum")
    physical = given_roughness is not None or metallic is not None
    exponent = _numbers(keys, "ns")
    specular, roughness = phong_gloss(
        0.0 if highlight is None else float(highlight.mean()), None if exponent is None else float(exponent[0])
    )
    if illumination is not None and illumination[0] < 2 and not physical:
        specular = 0.0
    if physical and highlight is None:
        specular = DIELECTRIC_SPECULAR
    if given_roughness is not None:
        roughness = float(np.clip(given_roughness[0], LEAST_ROUGHNESS, 1.0))
    metal = 0.0 if metallic is None else float(np.clip(metallic[0], 0.0, 1.0))
    shiny = specular > 0 or metal > 0
    return Material(factor, texture, metal, roughness if shiny else 1.0, specular, shiny, tuple(warnings))


def _numbers(keys: Mapping[str, npt.ArrayLike], name: str) -> Float64Array | None:
    """Return the numbers of an MTL key, or None if it is absent or damaged."""
    try:
        given = keys[name]
        words = [word for word in given if word != "-halo"] if isinstance(given, list) else given
        found = np.atleast_1d(np.asarray(words, dtype=np.float64))
    except (KeyError, ValueError):
        return None
    return found if len(found) and np.isfinite(found).all() else None
