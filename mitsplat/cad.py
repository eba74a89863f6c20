"""CAD meshes as Mitsuba scenes: their parts with materials, and the lights to bake them under."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual import ColorVisuals
from trimesh.visual.material import PBRMaterial

from mitsplat.colour import decode_srgb
from mitsplat.composite import black_body_colour
from mitsplat.errors import InputError
from mitsplat.plugins.device import ray_scene
from mitsplat.scene import LightSpec
from mitsplat.surfels import corner_normals

FloatArray = npt.NDArray[np.float64]

_DIELECTRIC_SPECULAR = 0.04
_WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
_DETAIL_SAMPLES = 12
_DETAIL_CONTRAST = 0.12
"""Standard deviation of the encoded colour inside a face at which detail counts in full."""


@dataclass(frozen=True, eq=False)
class Part:
    """One material's share of a mesh.

    Attributes:
        name: Name of the part, to address it in settings.
        mesh: Geometry [m], vertices at one position merged.
        colours: Linear base colour of every face corner, shape (F, 3, 3), or None where ``texture`` is.
        texture: Display-encoded base colour, shape (H, W, 3) uint8, or None.
        uv: Texture coordinates of every face corner, v up, shape (F, 3, 2), or None.
        metallic: 0 for dielectrics to 1 for metals.
        roughness: Of the glTF material model, in (0, 1]; None for a matt surface without highlight.
        shiny: Whether the material reflects a highlight at all.
    """

    name: str
    mesh: trimesh.Trimesh
    colours: FloatArray | None
    texture: npt.NDArray[np.uint8] | None
    uv: FloatArray | None
    metallic: float
    roughness: float
    shiny: bool

    @property
    def specular(self) -> float:
        """Reflectance at normal incidence, grey."""
        if not self.shiny:
            return 0.0
        base = float(self._face_colours(np.full((1, 3), 1.0 / 3.0)).mean())
        return _DIELECTRIC_SPECULAR * (1.0 - self.metallic) + base * self.metallic

    def _face_colours(self, barycentric: FloatArray) -> FloatArray:
        """Linear colours (F, S, 3) at ``barycentric`` (S, 3) of every face, by the nearest texel."""
        if self.colours is not None:
            return np.asarray(np.einsum("sk,fkc->fsc", barycentric, self.colours))
        if self.uv is None or self.texture is None:
            raise InputError(f"part {self.name} has neither colours nor a texture")
        height, width = self.texture.shape[:2]
        uv = np.einsum("sk,fkc->fsc", barycentric, self.uv) % 1.0
        column = np.minimum((uv[..., 0] * width).astype(int), width - 1)
        row = np.minimum(((1.0 - uv[..., 1]) * height).astype(int), height - 1)
        return decode_srgb(self.texture[row, column] / 255.0)

    def detail_density(self, gain: float, rng: np.random.Generator) -> FloatArray:
        """Relative density (F,) that the texture asks for: 1 where it is even, ``1 + gain`` where it changes most."""
        barycentric = rng.dirichlet(np.ones(3), _DETAIL_SAMPLES)
        deviation = (self._face_colours(barycentric) ** (1 / 2.2)).std(axis=1).max(axis=1)
        return np.asarray(1.0 + gain * np.clip(deviation / _DETAIL_CONTRAST, 0.0, 1.0))


def read_parts(
    mesh: trimesh.Trimesh | trimesh.Scene | str | Path, *, metres_per_unit: float = 1.0, up: Literal["y", "z"] = "z"
) -> tuple[Part, ...]:
    """Parts of a mesh or of a file that trimesh reads, in metres, z up.

    Raises:
        InputError: If the file cannot be read, there are no faces, or a position is not finite.
    """
    source = "mesh"
    if isinstance(mesh, str | Path):
        source = str(mesh)
        if not Path(mesh).is_file():
            raise InputError(f"{source}: no such mesh file")
        try:
            mesh = trimesh.load_scene(mesh)
        except (ValueError, TypeError, KeyError, OSError, NotImplementedError) as error:
            raise InputError(f"{source}: not a mesh that can be read ({error})") from error
    if not metres_per_unit > 0:
        raise InputError(f"{source}: metres_per_unit must be > 0 (got {metres_per_unit})")
    scene = mesh if isinstance(mesh, trimesh.Scene) else trimesh.Scene({"mesh": mesh})
    world_from_file = np.diag([metres_per_unit, metres_per_unit, metres_per_unit, 1.0])
    if up == "y":
        world_from_file = world_from_file @ trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry_name = scene.graph[node]
        geometry = scene.geometry[geometry_name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            parts.append(_read_part(str(geometry_name), geometry, world_from_file @ transform))
    if not parts:
        raise InputError(f"{source}: a mesh needs at least one face (got none)")
    if not all(np.isfinite(part.mesh.vertices).all() for part in parts):
        raise InputError(f"{source}: vertex positions must be finite")
    return tuple(parts)


def _read_part(name: str, source: trimesh.Trimesh, transform: FloatArray) -> Part:
    geometry = trimesh.Trimesh(source.vertices, source.faces, process=False)
    geometry.merge_vertices(merge_tex=True, merge_norm=True)
    # Only what has collapsed: dropping slivers would open holes.
    keep = np.diff(np.sort(geometry.faces, axis=1), axis=1).all(axis=1)
    geometry.update_faces(keep)
    geometry.apply_transform(transform)
    faces = source.faces[keep]
    visual = source.visual
    if isinstance(visual, ColorVisuals):
        if visual.kind == "vertex":
            colours = decode_srgb(visual.vertex_colors[faces][..., :3] / 255.0)
        elif visual.kind == "face":
            colours = np.repeat(decode_srgb(visual.face_colors[keep][:, None, :3] / 255.0), 3, axis=1)
        else:
            colours = np.full((*faces.shape, 3), 0.5)
        return Part(name, geometry, colours, None, None, metallic=0.0, roughness=1.0, shiny=False)
    material = visual.material if isinstance(visual.material, PBRMaterial) else visual.material.to_pbr()
    metallic = 0.0 if material.metallicFactor is None else float(material.metallicFactor)
    roughness = 0.6 if material.roughnessFactor is None else float(np.clip(material.roughnessFactor, 0.05, 1.0))
    factor = np.ones(3) if material.baseColorFactor is None else np.asarray(material.baseColorFactor)[:3] / 255.0
    if material.baseColorTexture is None or visual.uv is None:
        colours = np.broadcast_to(decode_srgb(factor), (*faces.shape, 3)).copy()
        return Part(name, geometry, colours, None, None, metallic, roughness, shiny=True)
    texture = np.asarray(material.baseColorTexture.convert("RGB"))
    texture = (texture * factor).round().astype(np.uint8)
    return Part(name, geometry, None, texture, np.asarray(visual.uv)[faces], metallic, roughness, shiny=True)


def mitsuba_scene(parts: Sequence[Part], lights: dict[str, Any], *, clay: bool = False) -> mi.Scene:
    """Mitsuba scene of ``parts`` under emitters ``lights``.

    Metals and plastics are ``principled`` BSDFs; with ``clay`` everything is a white diffuse one instead.
    """
    shapes = {f"part_{k}": _mitsuba_mesh(part, _WHITE if clay else _bsdf(part)) for k, part in enumerate(parts)}
    return ray_scene({**shapes, **lights})


def _bsdf(part: Part) -> dict[str, Any]:
    if part.texture is not None:
        colour: dict[str, Any] = {"type": "bitmap", "bitmap": mi.Bitmap(part.texture), "raw": False}
    else:
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
    if not part.shiny:
        return {"type": "diffuse", "reflectance": colour}
    return {
        "type": "principled",
        "base_color": colour,
        "metallic": part.metallic,
        "roughness": part.roughness,
        "specular": 0.5,
    }


def _mitsuba_mesh(part: Part, bsdf: dict[str, Any]) -> mi.Mesh:
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


def bake_lights(light: str | Sequence[LightSpec]) -> dict[str, Any]:
    """Mitsuba emitters, by name, of a named light (``uniform``, ``studio``) or of a scene's lights.

    Raises:
        InputError: If the name is unknown, or there is no light at all.
    """
    if light == "uniform":
        return {"light": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}}
    if light == "studio":
        return {"light": {"type": "envmap", "bitmap": mi.Bitmap(_studio()), "to_world": _z_up(0.0)}}
    if isinstance(light, str):
        raise InputError(f"light must be uniform, studio or a scene's lights (got {light!r})")
    if not light:
        raise InputError("a scene whose lights are baked needs at least one light (got none)")
    return {f"light_{k}": emitter_dict(spec) for k, spec in enumerate(light)}


def emitter_dict(light: LightSpec, folder: Path | None = None) -> dict[str, Any]:
    """Mitsuba's description of one light; images of environments are relative to ``folder``."""
    colour = np.asarray(light.colour)
    if light.kind != "environment" and light.temperature is not None:
        colour = colour * black_body_colour(light.temperature)
    if light.kind == "environment":
        if light.image is None:
            return {"type": "constant", "radiance": _rgb(light.radiance * colour)}
        return {
            "type": "envmap",
            "filename": str((folder or Path()) / light.image),
            "scale": light.radiance,
            "to_world": _z_up(light.rotate_z),
        }
    if light.kind == "point":
        return {"type": "point", "position": list(light.position), "intensity": _rgb(light.intensity * colour)}
    forward = np.subtract(light.target, light.position)
    up = [0.0, 0.0, 1.0] if np.hypot(forward[0], forward[1]) > 1e-6 * np.linalg.norm(forward) else [0.0, 1.0, 0.0]
    pose = mi.ScalarTransform4f().look_at(origin=list(light.position), target=list(light.target), up=up)
    if light.kind == "spot":
        return {
            "type": "spot",
            "to_world": pose,
            "cutoff_angle": light.cone,
            "intensity": _rgb(light.intensity * colour),
        }
    return {
        "type": "rectangle",
        "to_world": pose @ mi.ScalarTransform4f().scale([0.5 * light.size[0], 0.5 * light.size[1], 1.0]),
        "emitter": {"type": "area", "radiance": _rgb(light.radiance * colour)},
    }


def _rgb(value: FloatArray) -> dict[str, Any]:
    return {"type": "rgb", "value": value.tolist()}


def _z_up(degrees: float) -> mi.ScalarTransform4f:
    """Turns Mitsuba's y-up environment maps z up, then about z."""
    transform = mi.ScalarTransform4f()
    return transform.rotate([0, 0, 1], degrees) @ transform.rotate([1, 0, 0], 90.0)


def _studio() -> npt.NDArray[np.float32]:
    """Latitude-longitude map (H, W, 3) of eight soft boxes, one towards each corner of a cube, of mean radiance 1."""
    height, width = 64, 128
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(width) + 0.5) / width * 2.0 * np.pi
    direction = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(azimuth),
            np.sin(polar)[:, None] * np.sin(azimuth),
            np.broadcast_to(np.cos(polar)[:, None], (height, width)),
        ],
        axis=-1,
    )
    boxes = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3) / np.sqrt(3.0)
    radiance = 0.35 + np.exp(7.0 * (direction @ boxes.T - 1.0)).sum(axis=-1)
    radiance /= (radiance * np.sin(polar)[:, None]).sum() / (np.sin(polar).sum() * width)
    return np.repeat(radiance[..., None], 3, axis=2).astype(np.float32)
