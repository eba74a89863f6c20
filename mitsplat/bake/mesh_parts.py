"""CAD meshes as Mitsuba scenes: their parts with materials, and the lights of the bake."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual import ColorVisuals
from trimesh.visual.color import to_rgba

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.bake.surface_materials import (
    DIELECTRIC_SPECULAR,
    LEAST_ROUGHNESS,
    ROUGHNESS,
    UNKNOWN_COLOUR,
    Material,
    SurfaceFinish,
    check_textures,
    read_material,
)
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.gaussians.splat_materials import MAX_SPECULAR
from mitsplat.geometry.mesh import check_faces
from mitsplat.geometry.mesh_normals import corner_normals
from mitsplat.geometry.untrusted_meshes import check_mesh
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.renderer.rays.device_arrays import ray_scene
from mitsplat.renderer.scene_emitters import emitter_dict
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import LightSpec
from mitsplat.storage.file_kinds import refuse_other_kinds
from mitsplat.storage.files import MESH_ERRORS

_SUFFIXES = (".stl", ".obj", ".glb", ".gltf", ".off", ".3mf", ".dae", ".ply")
_READER_PACKAGES = {".3mf": ("lxml", "lxml"), ".dae": ("collada", "pycollada")}
"""Modules that trimesh needs for some file types, and the packages that contain them."""
_WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
UNIFORM_LIGHT: dict[str, Any] = {"light": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}}
"""Emitter of radiance 1 from all directions."""
_LINEAR = decode_srgb(np.arange(256) / 255.0)
"""Linear values of 8-bit display-encoded values."""
_DETAIL_SAMPLES = 12
_DETAIL_CONTRAST = 0.12
"""Standard deviation of the encoded colour inside a face at which the density of Gaussians is largest."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Part of a mesh with one material.

    Attributes:
        name: Name of the part, for use in settings.
        mesh: Geometry [m], with vertices merged by position.
        colours: Linear base colour of every face corner, shape (F, 3, 3), or None if there is a ``texture``.
        texture: Display-encoded base colour, shape (H, W, 3) uint8, or None.
        uv: Texture coordinates of every face corner, v up, shape (F, 3, 2), or None.
        metallic: Metalness, 0 for dielectrics to 1 for metals; the mean if there is a texture of it.
        roughness: Roughness of the glTF material model, in (0, 1]; the mean if there is a texture of it.
        shiny: True if the material reflects a highlight.
        reflectance: Reflectance at normal incidence of the non-metallic part of the material.
        warnings: Ignored properties of the file's material, a sentence each.
        metallic_roughness: Texture of metalness and roughness times 255, shape (H, W, 2), or None.
        normal_map: Tangent-space normals of glTF, shape (H, W, 3) uint8, or None.
    """

    name: str
    mesh: trimesh.Trimesh
    colours: Float64Array | None
    texture: npt.NDArray[np.uint8] | None
    uv: Float64Array | None
    metallic: float
    roughness: float
    shiny: bool
    reflectance: float = DIELECTRIC_SPECULAR
    warnings: tuple[str, ...] = ()
    metallic_roughness: npt.NDArray[np.uint8] | None = None
    normal_map: npt.NDArray[np.uint8] | None = None

    @property
    def specular(self) -> float:
        """Reflectance at normal incidence, averaged to grey."""
        if not self.shiny:
            return 0.0
        faces = np.arange(len(self.mesh.faces))
        base = float(self.colours_at(faces, np.full((len(faces), 3), 1.0 / 3.0)).mean())
        return self.reflectance * (1.0 - self.metallic) + base * self.metallic

    def colours_at(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return linear base colours (N, 3) at barycentric coordinates (N, 3) of faces (N,)."""
        if self.colours is not None:
            return np.asarray(np.einsum("nk,nkc->nc", barycentric, self.colours[faces]))
        if self.texture is None:
            raise InputError(f"part {self.name} has neither colours nor a texture")
        return np.asarray(_LINEAR[self._texels(self.texture, faces, barycentric)])

    def materials_at(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return metallic, roughness and specular of ``principled``, shape (N, 3); 0, 1 and 0 for matt parts."""
        if not self.shiny:
            return np.tile([0.0, 1.0, 0.0], (len(faces), 1))
        values = np.tile([self.metallic, self.roughness, self.reflectance / MAX_SPECULAR], (len(faces), 1))
        if self.metallic_roughness is not None:
            values[:, :2] = self._texels(self.metallic_roughness, faces, barycentric) / 255.0
        return values

    def normals_at(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return unit shading normals (N, 3): smooth normals of the mesh, changed by the normal map.

        The tangents follow from the texture coordinates of each face (glTF 2.0, 3.7.2.1).
        """
        smooth = np.asarray(np.einsum("nk,nkd->nd", barycentric, corner_normals(self.mesh)[faces]))
        smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
        if self.normal_map is None or self.uv is None:
            return smooth
        corners, uv = self.mesh.triangles[faces], self.uv[faces]
        edges, (du, dv) = corners[:, 1:] - corners[:, :1], np.moveaxis(uv[:, 1:] - uv[:, :1], 2, 0)
        mirrored = np.sign(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0])[:, None]
        tangent = mirrored * (dv[:, 1:] * edges[:, 0] - dv[:, :1] * edges[:, 1])
        tangent -= np.einsum("nd,nd->n", tangent, smooth)[:, None] * smooth
        length = np.linalg.norm(tangent, axis=1, keepdims=True)
        x, y, z = (self._texels(self.normal_map, faces, barycentric) / 127.5 - 1.0).T[..., None]
        tangent /= np.maximum(length, 1e-30)
        normal = x * tangent + y * mirrored * np.cross(smooth, tangent) + np.maximum(z, 1e-3) * smooth
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(np.where(length > 0, normal, smooth))

    def _texels(
        self, texture: npt.NDArray[np.uint8], faces: Int64Array, barycentric: Float64Array
    ) -> npt.NDArray[np.uint8]:
        """Return the nearest texels, shape (N, channels)."""
        if self.uv is None:
            raise InputError(f"part {self.name} has a texture without coordinates")
        height, width = texture.shape[:2]
        uv = np.einsum("nk,nkc->nc", barycentric, self.uv[faces]) % 1.0
        column = np.minimum((uv[:, 0] * width).astype(int), width - 1)
        row = np.minimum(((1.0 - uv[:, 1]) * height).astype(int), height - 1)
        return np.asarray(texture[row, column])

    def detail_density(self, gain: float, rng: np.random.Generator) -> Float64Array:
        """Return the relative density (F,) of Gaussians: 1 for uniform texture, ``1 + gain`` where it changes most."""
        barycentric = np.tile(rng.dirichlet(np.ones(3), _DETAIL_SAMPLES), (len(self.mesh.faces), 1))
        colours = self.colours_at(np.repeat(np.arange(len(self.mesh.faces)), _DETAIL_SAMPLES), barycentric)
        deviation = (colours.reshape(-1, _DETAIL_SAMPLES, 3) ** (1 / 2.2)).std(axis=1).max(axis=1)
        return np.asarray(1.0 + gain * np.clip(deviation / _DETAIL_CONTRAST, 0.0, 1.0))


def read_parts(
    mesh: trimesh.Trimesh | trimesh.Scene | str | Path,
    *,
    metres_per_unit: float = 1.0,
    up: Literal["y", "z"] = "z",
    finish: SurfaceFinish | None = None,
) -> tuple[MeshPart, ...]:
    """Read the parts of a mesh or of a file that trimesh reads [m], z up; ``finish`` replaces their own materials.

    Raises:
        InputError: If the file or its textures cannot be read, there are no faces, none has an area, or a position is
            not finite.
        MissingResourceError: If the package that reads such files is not installed.
    """
    finish, linear = finish or SurfaceFinish(), False
    source = "mesh"
    if isinstance(mesh, str | Path):
        source, path = str(mesh), Path(mesh)
        refuse_other_kinds(path, "a mesh (.glb, .obj, .stl, .ply)", *_SUFFIXES)
        if not path.is_file():
            raise InputError(f"{source}: no such mesh file")
        check_mesh(path)
        if finish.colour is None:
            check_textures(path)
        linear = path.suffix.lower() in (".glb", ".gltf")
        try:
            mesh = trimesh.load_scene(mesh)
        except (OSError, *MESH_ERRORS) as error:
            if path.suffix.lower() in _READER_PACKAGES:
                needed = _READER_PACKAGES[path.suffix.lower()]
                if importlib.util.find_spec(needed[0]) is None:
                    raise MissingResourceError(f"{source}: reading it needs `pip install {needed[1]}`") from error
            raise InputError(f"{source}: not a mesh that can be read ({error})") from error
    if not (metres_per_unit > 0 and np.isfinite(metres_per_unit)):
        raise InputError(f"{source}: metres_per_unit must be > 0 (got {metres_per_unit})")
    scene = mesh if isinstance(mesh, trimesh.Scene) else trimesh.Scene({"mesh": mesh})
    to_world = world_from_file(metres_per_unit, up)
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry_name = scene.graph[node]
        geometry = scene.geometry[geometry_name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            check_faces(geometry, source)
            if not np.isfinite(geometry.vertices).all():
                row = int(np.flatnonzero(~np.isfinite(geometry.vertices).all(axis=1))[0])
                place = np.asarray(geometry.vertices[row]).tolist()
                raise InputError(f"{source}: vertex positions must be finite (got {place} at vertex {row})")
            try:
                part = _read_part(str(geometry_name), geometry, to_world @ transform, finish, linear=linear)
            except InputError as error:
                raise InputError(f"{source}: part {geometry_name}: {error}") from error
            if len(part.mesh.faces):
                parts.append(part)
    if not parts and any(len(getattr(g, "faces", ())) for g in scene.geometry.values()):
        raise InputError(f"{source}: a mesh needs faces that have an area (got none)")
    if not parts:
        raise InputError(f"{source}: a mesh needs at least one face (got none)")
    if not sum(float(part.mesh.area) for part in parts) > 0:
        raise InputError(f"{source}: a mesh needs faces that have an area (got none)")
    return tuple(parts)


def world_from_file(metres_per_unit: float, up: Literal["y", "z"]) -> Float64Array:
    """Return the transform (4, 4) from the file's units and axes to metres, z up."""
    matrix = np.diag([metres_per_unit, metres_per_unit, metres_per_unit, 1.0])
    if up == "y":
        matrix = matrix @ trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    return np.asarray(matrix)


def _read_part(
    name: str, source: trimesh.Trimesh, transform: Float64Array, finish: SurfaceFinish, *, linear: bool
) -> MeshPart:
    """Read a part; ``linear`` states that its vertex colours are linear instead of display-encoded."""
    geometry = trimesh.Trimesh(source.vertices, source.faces, process=False)
    geometry.merge_vertices(merge_tex=True, merge_norm=True)
    # Only collapsed faces are removed, because removing slivers would open holes.
    keep = np.diff(np.sort(geometry.faces, axis=1), axis=1).all(axis=1)
    geometry.update_faces(keep)
    geometry.apply_transform(transform)
    faces = source.faces[keep]
    visual, per_corner = source.visual, None
    if isinstance(visual, ColorVisuals):
        material = Material(np.ones(3), None, shiny=False)
        if visual.kind == "vertex":
            per_corner = visual.vertex_colors[faces]
        elif visual.kind == "face":
            per_corner = np.repeat(visual.face_colors[keep][:, None], 3, axis=1)
        else:
            material = replace(material, factor=np.full(3, UNKNOWN_COLOUR))
    else:
        material = read_material(visual.material)
        stored = visual.vertex_attributes.get("color")
        if stored is not None and len(stored) == len(source.vertices):
            per_corner = to_rgba(np.asarray(stored))[faces]
    warnings = [f"material of part {name!r}: {warning}" for warning in material.warnings]
    material = _apply_finish(material, finish)
    if finish.colour is not None:
        warnings, per_corner = [], None
    gloss = (material.metallic, material.roughness, material.shiny, material.specular)
    maps: tuple[npt.NDArray[np.uint8] | None, npt.NDArray[np.uint8] | None] = (None, None)
    uv = None
    if not isinstance(visual, ColorVisuals) and visual.uv is not None:
        maps = (material.metallic_roughness, material.normal_map)
        if any(texture is not None for texture in (material.texture, *maps)):
            uv = np.asarray(visual.uv)[faces]
    if material.texture is not None and uv is not None:
        if per_corner is not None and (per_corner[..., :3] < 255).any():
            warnings.append(f"part {name!r} has a texture and vertex colours: the vertex colours are ignored")
        texture = material.texture
        if not (material.factor == 1.0).all():
            texture = (255.0 * encode_srgb(decode_srgb(texture / 255.0) * material.factor)).round().astype(np.uint8)
        return MeshPart(name, geometry, None, texture, uv, *gloss, tuple(warnings), *maps)
    colours = np.ones((*faces.shape, 3))
    if per_corner is not None:
        colours = per_corner[..., :3] / 255.0 if linear else decode_srgb(per_corner[..., :3] / 255.0)
    return MeshPart(name, geometry, colours * material.factor, None, uv, *gloss, tuple(warnings), *maps)


def _apply_finish(material: Material, finish: SurfaceFinish) -> Material:
    """Return ``material`` with the values that ``finish`` defines."""
    colour = finish.linear_colour()
    if colour is not None:
        material = replace(material, factor=colour, texture=None)
    given = {
        name: value for name in ("roughness", "metallic", "specular") if (value := getattr(finish, name)) is not None
    }
    if not given:
        return material
    if not material.shiny:
        material = replace(material, roughness=ROUGHNESS, specular=DIELECTRIC_SPECULAR)
    material = replace(material, **given)
    texture = material.metallic_roughness
    if texture is not None:
        texture = texture.copy()
        for channel, name in enumerate(("metallic", "roughness")):
            if name in given:
                texture[..., channel] = round(255 * given[name])
    return replace(
        material,
        metallic_roughness=texture,
        roughness=max(material.roughness, LEAST_ROUGHNESS),
        shiny=material.specular > 0 or material.metallic > 0,
    )


def mitsuba_scene(parts: Sequence[MeshPart], lights: dict[str, Any], *, clay: bool = False) -> mi.Scene:
    """Create a Mitsuba scene of ``parts`` under emitters ``lights``.

    Metals and plastics are ``principled`` BSDFs. With ``clay``, all parts have a white diffuse BSDF instead.
    """
    ensure_variant()
    shapes = {f"part_{k}": _mitsuba_mesh(part, _WHITE) if clay else part_shape(part) for k, part in enumerate(parts)}
    return ray_scene({**shapes, **lights})


def part_shape(part: MeshPart) -> mi.Mesh:
    """Create the Mitsuba shape of a part in its own material."""
    return _mitsuba_mesh(part, _bsdf(part))


def _bsdf(part: MeshPart) -> dict[str, Any]:
    if part.texture is not None:
        colour: dict[str, Any] = {"type": "bitmap", "bitmap": mi.Bitmap(part.texture), "raw": False}
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


def _channel(part: MeshPart, number: int, uniform: float) -> Any:
    """Return a channel of the texture of metalness and roughness, or the uniform value if there is none."""
    if part.metallic_roughness is None:
        return uniform
    pixels = np.ascontiguousarray(part.metallic_roughness[..., number, None])
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def _mitsuba_mesh(part: MeshPart, bsdf: dict[str, Any]) -> mi.Mesh:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    count = len(part.mesh.faces)
    mesh = mi.Mesh(
        part.name, 3 * count, count, props=properties, has_vertex_normals=True, has_vertex_texcoords=part.uv is not None
    )
    if part.colours is not None:
        mesh.add_attribute("vertex_color", 3, np.ravel(part.colours).astype(np.float32))
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = np.ravel(part.mesh.triangles).astype(np.float32)
    buffers["vertex_normals"] = np.ravel(corner_normals(part.mesh)).astype(np.float32)
    if part.uv is not None:
        buffers["vertex_texcoords"] = np.ravel(part.uv * (1.0, -1.0) + (0.0, 1.0)).astype(np.float32)
    buffers["faces"] = np.arange(3 * count, dtype=np.uint32)
    buffers.update()
    return mesh


def bake_lights(lights: Sequence[LightSpec]) -> dict[str, Any]:
    """Return the Mitsuba emitters of a scene's lights, by name.

    Raises:
        InputError: If there is no light at all.
    """
    ensure_variant()
    if not lights:
        raise InputError("a scene whose lights are baked needs at least one light (got none)")
    return {f"light_{k}": emitter_dict(spec) for k, spec in enumerate(lights)}
