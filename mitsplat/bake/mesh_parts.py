"""CAD meshes as parts in metres, each with one material."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.bake.file_normals import NormalCount, normal_warnings, place_normals
from mitsplat.bake.surface_materials import SurfaceFinish
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_materials import MAX_SPECULAR
from mitsplat.geometry.camera_poses import spiral
from mitsplat.geometry.coplanar import coplanar_place
from mitsplat.geometry.mesh_normals import corner_normals
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.mesh_file import (
    DIELECTRIC_SPECULAR,
    OPAQUE,
    Axis,
    FilePart,
    MeshFile,
    Texture,
    world_from_file,
)
from mitsplat.mesh_files.mesh_reading import read_mesh_file
from mitsplat.mesh_files.trimesh_parts import scene_parts

_MAX_POSITION = 1e10
"""Largest coordinate [units of the file] at which vertices can be merged by their positions."""
_SINGLE_STEP = 2.0**-23
"""Step of 32-bit numbers relative to their value."""
_MAX_STEP = 1e-3
"""Maximum step of stored positions relative to the size of the mesh."""
_MAX_DISTANCE = 1000.0
"""Distance from the origin, relative to the size of the mesh, beyond which 32-bit numbers are too coarse to render."""
LINEAR_LEVELS = decode_srgb(np.arange(256) / 255.0)
"""Linear values of 8-bit display-encoded values."""
_DETAIL_SAMPLES = 12
_DETAIL_CONTRAST = 0.12
"""Standard deviation of the encoded colour inside a face at which the density of Gaussians is largest."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Part of a mesh with one material.

    Attributes:
        name: Name of the part, for use in settings.
        mesh: Geometry [m], with vertices merged by position, and with the normals that its file states.
        colours: Linear base colour of every face corner, shape (F, 3, 3), or None if there is a ``texture``.
        texture: Display-encoded base colour, three channels, or None.
        metallic: Metalness, 0 for dielectrics to 1 for metals; the mean if there is a texture of it.
        roughness: Roughness of the glTF material model, in (0, 1]; the mean if there is a texture of it.
        shiny: True if the material reflects a highlight.
        reflectance: Reflectance at normal incidence of the non-metallic part of the material.
        warnings: Ignored properties of the file's material, a sentence each.
        factor: Linear factor of ``texture``, shape (3,) or a number.
        metallic_roughness: Texture of metalness and roughness times 255, two channels, or None.
        normal_map: Tangent-space normals of glTF, three channels, or None.
        double_sided: True if the surface is an open sheet whose two sides are visible.
    """

    name: str
    mesh: trimesh.Trimesh
    colours: Float64Array | None
    texture: Texture | None
    metallic: float
    roughness: float
    shiny: bool
    reflectance: float = DIELECTRIC_SPECULAR
    warnings: tuple[str, ...] = ()
    factor: Float64Array | float = 1.0
    metallic_roughness: Texture | None = None
    normal_map: Texture | None = None
    double_sided: bool = False

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
        return np.asarray(LINEAR_LEVELS[self.texture.at(faces, barycentric)] * self.factor)

    def materials_at(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return metallic, roughness and specular of ``principled``, shape (N, 3); 0, 1 and 0 for matt parts."""
        if not self.shiny:
            return np.tile([0.0, 1.0, 0.0], (len(faces), 1))
        values = np.tile([self.metallic, self.roughness, self.reflectance / MAX_SPECULAR], (len(faces), 1))
        if self.metallic_roughness is not None:
            values[:, :2] = self.metallic_roughness.at(faces, barycentric) / 255.0
        return values

    def normals_at(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return unit shading normals (N, 3): smooth normals of the mesh, changed by the normal map.

        The tangents follow from the texture coordinates of the map (glTF 2.0, 3.7.2.1).
        """
        smooth = np.asarray(np.einsum("nk,nkd->nd", barycentric, corner_normals(self.mesh)[faces]))
        smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
        if self.normal_map is None:
            return smooth
        corners, uv = self.mesh.triangles[faces], self.normal_map.uv[faces]
        edges, (du, dv) = corners[:, 1:] - corners[:, :1], np.moveaxis(uv[:, 1:] - uv[:, :1], 2, 0)
        mirrored = np.sign(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0])[:, None]
        tangent = mirrored * (dv[:, 1:] * edges[:, 0] - dv[:, :1] * edges[:, 1])
        tangent -= np.einsum("nd,nd->n", tangent, smooth)[:, None] * smooth
        length = np.linalg.norm(tangent, axis=1, keepdims=True)
        x, y, z = (self.normal_map.at(faces, barycentric) / 127.5 - 1.0).T[..., None]
        tangent /= np.maximum(length, 1e-30)
        normal = x * tangent + y * mirrored * np.cross(smooth, tangent) + np.maximum(z, 1e-3) * smooth
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(np.where(length > 0, normal, smooth))

    def detail_density(self, gain: float, rng: np.random.Generator) -> Float64Array:
        """Return the relative density (F,) of Gaussians: 1 for uniform texture, ``1 + gain`` where it changes most."""
        barycentric = np.tile(rng.dirichlet(np.ones(3), _DETAIL_SAMPLES), (len(self.mesh.faces), 1))
        colours = self.colours_at(np.repeat(np.arange(len(self.mesh.faces)), _DETAIL_SAMPLES), barycentric)
        deviation = (colours.reshape(-1, _DETAIL_SAMPLES, 3) ** (1 / 2.2)).std(axis=1).max(axis=1)
        return np.asarray(1.0 + gain * np.clip(deviation / _DETAIL_CONTRAST, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class MeshModel:
    """Parts of a mesh in metres, z up.

    Attributes:
        parts: The parts.
        units: Length of the unit of the source [m].
        up: Axis that points up in the source.
        stated: Values of ``units`` and ``up`` that the source states and that were used.
        warnings: Warnings for the user, a sentence each.
    """

    parts: tuple[MeshPart, ...]
    units: float
    up: Axis
    stated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def read_model(
    mesh: trimesh.Trimesh | trimesh.Scene | MeshFile | str | Path,
    *,
    metres_per_unit: float | None = None,
    up: Literal["y", "z"] | None = None,
    finish: SurfaceFinish | None = None,
) -> MeshModel:
    """Read a mesh or a mesh file [m], z up.

    Args:
        mesh: The mesh, or its file, or the content of a file.
        metres_per_unit: Length of the unit of the mesh [m]; by default that which the file states, or 1 m.
        up: Axis that points up in the mesh; by default that which the file states, or z.
        finish: Values that replace those of the materials.

    Raises:
        InputError: If the file or its textures cannot be read, there are no faces, none has an area, or positions are
            not finite or too coarse.
        MissingResourceError: If the package that reads such files is not installed.
    """
    finish = finish or SurfaceFinish()
    if metres_per_unit is not None and not (metres_per_unit > 0 and np.isfinite(metres_per_unit)):
        source = str(mesh) if isinstance(mesh, str | Path) else "mesh"
        raise InputError(f"{source}: metres_per_unit must be > 0 (got {metres_per_unit})")
    if isinstance(mesh, str | Path):
        source, file = str(mesh), read_mesh_file(Path(mesh), textures=finish.colour is None)
    elif isinstance(mesh, MeshFile):
        source, file = "mesh", mesh
    else:
        source, file = "mesh", MeshFile(scene_parts(mesh, "mesh"))
    stated = [
        name
        for name, given, own in (("units", metres_per_unit, file.metres_per_unit), ("up", up, file.up))
        if given is None and own is not None
    ]
    units: float = metres_per_unit or file.metres_per_unit or 1.0
    axis: Axis = up or file.up or "z"
    to_world, placed = world_from_file(units, axis), []
    for part in file.parts:
        if not np.isfinite(part.vertices).all():
            row = int(np.flatnonzero(~np.isfinite(part.vertices).all(axis=1))[0])
            place = np.asarray(part.vertices[row]).tolist()
            raise InputError(f"{source}: vertex positions must be finite (got {place} at vertex {row})")
        if len(part.vertices) and (most := float(np.abs(part.vertices).max())) > _MAX_POSITION:
            raise InputError(f"{source}: vertex positions must be at most {_MAX_POSITION:g} units (got {most:g})")
        placed.append(_place(part, to_world @ part.transform, finish))
    parts = [part for part, _ in placed if part.mesh.area > 0]  # a scale of 0 hides a part
    if not file.parts:
        raise InputError(f"{source}: a mesh needs at least one face (got none; is the file complete?)")
    if not parts:
        raise InputError(f"{source}: a mesh needs faces that have an area (got none)")
    warnings = [*file.warnings, *normal_warnings([count for _, count in placed])]
    warnings += _recentre(parts, file, source)
    warnings += _inverted_bodies(parts)
    warnings += _coincident_parts(parts)
    return MeshModel(tuple(parts), units, axis, tuple(stated), tuple(warnings))


def _place(source: FilePart, transform: Float64Array, finish: SurfaceFinish) -> tuple[MeshPart, NormalCount]:
    """Transform a part of a file, apply a finish, and count its normals."""
    corners = np.arange(3)
    if np.linalg.det(transform[:3, :3]) < 0:  # a mirrored part: the order of its corners keeps its faces outward
        corners = corners[::-1]
    geometry = trimesh.Trimesh(source.vertices, source.faces, process=False)
    geometry.merge_vertices(merge_tex=True, merge_norm=True)
    # Only collapsed and repeated faces are removed, because removing slivers would open holes.
    keep = np.diff(np.sort(geometry.faces, axis=1), axis=1).all(axis=1)
    first = _first_copies(geometry.faces)
    repeated = int(np.count_nonzero(keep & ~first))
    keep &= first
    vertices = trimesh.transform_points(geometry.vertices, transform)
    mesh = trimesh.Trimesh(vertices, geometry.faces[keep][:, corners], process=False)
    mesh.remove_unreferenced_vertices()
    count = NormalCount()
    if source.normals is not None:
        count = place_normals(mesh, source.normals[keep][:, corners], transform[:3, :3])

    def select(texture: Texture | None) -> Texture | None:
        return None if texture is None else replace(texture, uv=texture.uv[keep][:, corners])

    material = finish.applied_to(source.material)
    name, texture, colours = source.name, select(material.texture), None
    warnings = [f"material of part {name!r}: {warning}" for warning in material.warnings]
    if repeated:
        warnings.append(
            f"{repeated} faces of part {name!r} repeat other faces of it and are left out: was it exported twice?"
        )
    if material.specular > MAX_SPECULAR:
        warnings.append(f"part {name!r} reflects {material.specular:.2g} at normal incidence: {MAX_SPECULAR} is used")
    painted = source.colours if finish.colour is None else None
    if texture is None:
        colours = (1.0 if painted is None else painted[keep][:, corners]) * np.tile(
            material.factor, (*mesh.faces.shape, 1)
        )
    elif painted is not None and (painted < OPAQUE).any():
        warnings.append(f"part {name!r} has a texture and vertex colours: the vertex colours are ignored")
    part = MeshPart(
        name=name,
        mesh=mesh,
        colours=colours,
        texture=texture,
        metallic=material.metallic,
        roughness=material.roughness,
        shiny=material.shiny,
        reflectance=min(material.specular, MAX_SPECULAR),
        warnings=tuple(warnings),
        factor=material.factor if texture is not None else 1.0,
        metallic_roughness=select(material.metallic_roughness),
        normal_map=select(material.normal_map),
        double_sided=source.double_sided and not (mesh.is_watertight and mesh.volume > 0),
    )
    return part, count


def _first_copies(faces: Int64Array) -> BoolArray:
    """Return a mask (F,) without the faces that repeat the vertices and the winding of an earlier face."""
    starts = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (starts + np.arange(3)) % 3, axis=1)
    is_first = np.zeros(len(faces), dtype=bool)
    is_first[np.unique(turned, axis=0, return_index=True)[1]] = True
    return is_first


def _recentre(parts: Sequence[MeshPart], file: MeshFile, source: str) -> Iterator[str]:
    """Move a mesh that is far from its origin to the centre of its bounds, and yield a warning about it.

    Raises:
        InputError: If the file stores its positions in numbers that are too coarse at their distance.
    """
    if file.in_single and all(np.array_equal(part.vertices, part.vertices.astype(np.float32)) for part in file.parts):
        vertices = np.concatenate([part.vertices for part in file.parts])
        step, extent = float(np.abs(vertices).max()) * _SINGLE_STEP, float(np.ptp(vertices, axis=0).max())
        if step > _MAX_STEP * extent:
            raise InputError(
                f"{source}: positions must be within {_MAX_STEP / _SINGLE_STEP:.0f} times the size of the mesh from "
                f"the origin, because its file has 32-bit numbers (got steps of {step:.2g} on {extent:.2g} units): "
                "move the mesh to the origin in the program that wrote it"
            )
    bounds = np.array([part.mesh.bounds for part in parts])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    size, centre = float((high - low).max()), (low + high) / 2
    distance = float(np.abs(centre).max())
    if distance <= _MAX_DISTANCE * size:
        return
    for part in parts:
        part.mesh.apply_translation(-centre)
    place = ", ".join(f"{value:.10g}" for value in centre)
    yield f"the mesh is {distance:.4g} m from the origin of its file: its centre ({place}) m becomes the origin"


def _coincident_parts(parts: Sequence[MeshPart]) -> Iterator[str]:
    """Yield a warning about each pair of parts of different looks that have faces in one plane, such as decals."""
    bounds = np.array([part.mesh.bounds for part in parts])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    eyes = (low + high) / 2 + 10 * np.linalg.norm(high - low) * spiral(np.linspace(-0.95, 0.95, 32), 0.0)
    for one, part in enumerate(parts):
        meets = ((bounds[:, 0] <= bounds[one, 1]) & (bounds[:, 1] >= bounds[one, 0])).all(axis=1)
        for other in (parts[index] for index in np.flatnonzero(meets).tolist() if index > one):
            if _look_alike(part, other):
                continue
            if (place := coplanar_place(part.mesh, other.mesh, eyes, one_sided=True)) is not None:
                at = ", ".join(f"{value:.4g}" for value in place)
                yield (
                    f"parts {part.name!r} and {other.name!r} have faces in one plane, for example at [{at}] m: both "
                    "show in random spots; move one of them by 0.1 mm or more"
                )


def _look_alike(one: MeshPart, other: MeshPart) -> bool:
    """Return True if two parts have the same colour everywhere."""
    if one.colours is None or other.colours is None:
        return False
    return all(bool((part.colours == one.colours[0, 0]).all()) for part in (one, other))


def _inverted_bodies(parts: Sequence[MeshPart]) -> Iterator[str]:
    """Yield a warning about each closed body that is inside out and not a cavity of another body."""
    names, volumes, bounds = [], [], []
    for part in parts:
        if part.double_sided:
            continue
        mesh = part.mesh
        label = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
        count = label.max() + 1
        closed = 2 * np.bincount(label[mesh.face_adjacency[:, 0]], minlength=count) == 3 * np.bincount(label)
        low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
        np.minimum.at(low, label, mesh.triangles.min(axis=1))
        np.maximum.at(high, label, mesh.triangles.max(axis=1))
        names += [part.name] * int(closed.sum())
        volumes.append(np.bincount(label, weights=np.linalg.det(mesh.triangles - mesh.vertices[0]) / 6)[closed])
        bounds.append(np.stack([low, high], axis=1)[closed])
    if not names:
        return
    volume, extent = np.concatenate(volumes), np.concatenate(bounds)
    solids = extent[volume > 0]
    for index in np.flatnonzero(volume < 0):
        low, high = extent[index]
        if not ((solids[:, 0] <= low) & (high <= solids[:, 1])).all(axis=1).any():
            size = " x ".join(f"{1e3 * length:.3g}" for length in high - low)
            yield (
                f"a closed body of {size} mm in part {names[index]!r} is inside out, so that it gets no Gaussians: "
                "reverse its faces in the program that wrote the file"
            )
