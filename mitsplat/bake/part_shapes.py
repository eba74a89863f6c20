"""Mitsuba shapes and scenes of the parts of a mesh, and the lights of a bake."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.bake.mesh_parts import LINEAR_LEVELS, MeshPart
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_materials import MAX_SPECULAR
from mitsplat.geometry.mesh_normals import corner_normals
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.mesh_file import Texture
from mitsplat.renderer.rays.device_arrays import ray_scene
from mitsplat.renderer.scene_emitters import MitsubaDict, emitter_dict, load_emitter
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import LightSpec

_WHITE: MitsubaDict = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
UNIFORM_LIGHT: MitsubaDict = {"light": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}}
"""Emitter of radiance 1 from all directions."""


def mitsuba_scene(parts: Sequence[MeshPart], lights: MitsubaDict, *, clay: bool = False) -> mi.Scene:
    """Create a Mitsuba scene of ``parts`` under emitters ``lights``.

    Metals and plastics are ``principled`` BSDFs. With ``clay``, all parts have a white diffuse BSDF instead.
    """
    ensure_variant()
    shapes = {f"part_{k}": _mitsuba_mesh(part, _WHITE) if clay else part_shape(part) for k, part in enumerate(parts)}
    return ray_scene({**shapes, **lights})


def part_shape(part: MeshPart) -> mi.Mesh:
    """Create the Mitsuba shape of a part in its own material."""
    return _mitsuba_mesh(part, _bsdf(part))


def _bsdf(part: MeshPart) -> MitsubaDict:
    """Return the material of a part; the second side of a double-sided part is added to its mesh."""
    if part.texture is not None:
        pixels = (255.0 * encode_srgb(LINEAR_LEVELS[part.texture.pixels] * part.factor)).round().astype(np.uint8)
        colour = _bitmap(part, replace(part.texture, pixels=pixels), raw=False)
    else:
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
    if not part.shiny:
        return {"type": "diffuse", "reflectance": colour}
    return {
        "type": "principled",
        "base_color": colour,
        "metallic": _channel(part, 0, part.metallic),
        "roughness": _channel(part, 1, part.roughness),
        "specular": part.reflectance / MAX_SPECULAR,
    }


def _channel(part: MeshPart, number: int, uniform: float) -> float | MitsubaDict:
    """Return a channel of the texture of metalness and roughness, or the uniform value if there is none."""
    texture = part.metallic_roughness
    if texture is None:
        return uniform
    return _bitmap(part, replace(texture, pixels=np.ascontiguousarray(texture.pixels[..., number, None])), raw=True)


def _bitmap(part: MeshPart, texture: Texture, *, raw: bool) -> MitsubaDict:
    """Return Mitsuba's description of a texture.

    Raises:
        InputError: If Mitsuba cannot represent it, because two textures of a part have different coordinates, or an
            image continues differently along its two axes.
    """
    low, high = texture.uv.min(axis=(0, 1)), texture.uv.max(axis=(0, 1))
    wraps = {wrap for wrap, first, last in zip(texture.wrap, low, high, strict=True) if first < 0 or last > 1}
    uv = _uv_of(part)
    if len(wraps) > 1 or uv is None or not np.array_equal(texture.uv, uv):
        raise InputError(
            f"part {part.name!r}: to bake the light of a scene, all its textures must have the same coordinates and "
            "the same wrap mode along both axes: bake it without lights"
        )
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texture.pixels), "raw": raw}
    return {**bitmap, "wrap_mode": wraps.pop()} if wraps else bitmap


def _uv_of(part: MeshPart) -> Float64Array | None:
    """Return the texture coordinates (F, 3, 2) of the first texture of a part that its BSDF uses, or None."""
    textures = (part.texture, part.metallic_roughness if part.shiny else None)
    return next((texture.uv for texture in textures if texture is not None), None)


def _mitsuba_mesh(part: MeshPart, bsdf: MitsubaDict) -> mi.Mesh:
    """Create the Mitsuba shape of a part with a material, which is that of both sides if it is double-sided."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf} if part.double_sided else bsdf)
    count, uv = len(part.mesh.faces), _uv_of(part)
    mesh = mi.Mesh(
        part.name, 3 * count, count, props=properties, has_vertex_normals=True, has_vertex_texcoords=uv is not None
    )
    if part.colours is not None:
        mesh.add_attribute("vertex_color", 3, np.ravel(part.colours).astype(np.float32))
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = np.ravel(part.mesh.triangles).astype(np.float32)
    buffers["vertex_normals"] = np.ravel(corner_normals(part.mesh)).astype(np.float32)
    if uv is not None:
        buffers["vertex_texcoords"] = np.ravel(uv * (1.0, -1.0) + (0.0, 1.0)).astype(np.float32)
    buffers["faces"] = np.arange(3 * count, dtype=np.uint32)
    buffers.update()
    return mesh


def bake_lights(lights: Sequence[LightSpec]) -> MitsubaDict:
    """Return the Mitsuba emitters of a scene's lights, by name.

    Raises:
        InputError: If there is no light at all.
    """
    ensure_variant()
    if not lights:
        raise InputError("a scene whose lights are baked needs at least one light (got none)")
    return {f"light_{k}": load_emitter(emitter_dict(spec), movable=False) for k, spec in enumerate(lights)}
