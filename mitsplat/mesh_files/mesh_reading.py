"""Reading of mesh files from untrusted sources."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np
import trimesh
from PIL import Image

from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.mesh import check_faces
from mitsplat.geometry.mesh_normals import read_stated_normals
from mitsplat.geometry.untrusted_meshes import check_mesh, refuse_archive, try_read
from mitsplat.mesh_files.gltf import read_gltf
from mitsplat.mesh_files.mesh_file import MeshFile, MeshFrame
from mitsplat.mesh_files.step import STEP_SUFFIXES, read_step
from mitsplat.mesh_files.threemf import read_3mf
from mitsplat.mesh_files.trimesh_files import read_with_trimesh
from mitsplat.storage.file_kinds import refuse_other_kinds, refuse_placeholder
from mitsplat.storage.files import MESH_ERRORS

SUFFIXES = (".stl", ".obj", ".glb", ".gltf", ".off", ".3mf", ".dae", ".ply", *STEP_SUFFIXES)
SCENE_SUFFIXES = (".glb", ".gltf", ".3mf", *STEP_SUFFIXES)
"""Suffixes of files of nodes and components that this package reads without trimesh."""
_READERS = {".glb": read_gltf, ".gltf": read_gltf, ".3mf": read_3mf}


def read_mesh(path: Path, *, merge: bool = True, frame: MeshFrame | None = None) -> trimesh.Trimesh:
    """Read a mesh file of any format; several parts become one mesh.

    Args:
        path: The file.
        merge: Merge vertices at the same position. Without merging, an STL is never watertight.
        frame: Convert to metres with z up; by default, the mesh has the units and axes of the file.

    Raises:
        InputError: If the file is missing or damaged, has no triangles, or has a vertex that is not finite.
        MissingResourceError: If the package that reads such files is not installed.
    """
    if path.suffix.lower() in SCENE_SUFFIXES or (frame is not None and path.suffix.lower() == ".dae"):
        mesh = _read_surface(path, merge=merge, frame=frame)
    else:
        mesh = _read_with_trimesh(path, merge=merge)
        if frame is not None and isinstance(mesh, trimesh.Trimesh):
            mesh.apply_transform(frame.to_world())
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: a mesh must have triangles (got none)")
    check_faces(mesh, path)
    if not np.isfinite(mesh.vertices).all():
        row = int(np.argmin(np.isfinite(mesh.vertices).all(axis=1)))
        raise InputError(f"{path}: vertices must be finite (got {mesh.vertices[row].tolist()} at vertex {row})")
    return mesh


def read_proxy(path: Path, *, merge: bool = True) -> trimesh.Trimesh:
    """Read the proxy mesh of an asset, with the normals that its PLY file states.

    Args:
        path: The file.
        merge: Merge vertices at the same position.

    Raises:
        InputError: If it cannot be read as a mesh, or if its normals break a rule.
        MissingResourceError: If the package that reads such files is not installed.
    """
    mesh = read_mesh(path, merge=merge)
    try:
        read_stated_normals(mesh)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return mesh


def _read_with_trimesh(path: Path, *, merge: bool) -> trimesh.Trimesh:
    check_mesh(path)
    try:
        with np.errstate(all="ignore"):
            return trimesh.load_mesh(path, process=merge)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except MESH_ERRORS as error:
        raise InputError(f"{path}: not a valid mesh file ({type(error).__name__}: {error})") from error


def _read_surface(path: Path, *, merge: bool, frame: MeshFrame | None) -> trimesh.Trimesh:
    """Read the geometry of a file of nodes and components as one mesh, see :func:`read_mesh`."""
    meshes, file = [], read_mesh_file(path, textures=False)
    for part in file.parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        meshes.append(mesh.apply_transform(part.transform))  # which reverses the faces of mirrored parts
    joined = trimesh.util.concatenate(meshes) if meshes else trimesh.Trimesh()
    if frame is not None:
        joined.apply_transform(frame.to_world(file.metres_per_unit, file.up))
    return trimesh.Trimesh(joined.vertices, joined.faces, process=merge)


def read_mesh_file(path: Path, *, textures: bool = True) -> MeshFile:
    """Read a mesh file, after a trial read in a process with bounded memory and time.

    Args:
        path: The file.
        textures: False to ignore all textures, which need not exist.

    Raises:
        InputError: If the file cannot be read, requires what is not supported, or lacks a texture.
        MissingResourceError: If the package that reads such files is not installed.
    """
    refuse_archive(path)
    refuse_other_kinds(path, "a mesh (.glb, .step, .obj, .stl, .ply)", *SUFFIXES)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{path}: must be a mesh ({', '.join(SUFFIXES)}) (got {path.suffix or 'no suffix'}): export it as .glb"
        )
    try:
        with path.open("rb") as file:
            refuse_placeholder(path, file.read(1024))
    except OSError as error:
        raise InputError(f"{path}: not a mesh that can be read ({error})") from error
    if path.suffix.lower() in STEP_SUFFIXES:
        return read_step(path)
    check_mesh(path, read=_try_mesh_file)
    try:
        return _read(path, textures=textures)
    except InputError as error:
        if str(error).startswith((f"{path.parent}/", str(path))):
            raise
        raise InputError(f"{path}: {error}") from error
    except MissingResourceError:
        raise
    except (OSError, *MESH_ERRORS) as error:
        raise InputError(f"{path}: not a mesh that can be read ({error})") from error


def _read(path: Path, *, textures: bool) -> MeshFile:
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # large textures are valid
        return _READERS.get(path.suffix.lower(), read_with_trimesh)(path, textures=textures)


def _try_mesh_file(output: BinaryIO, _: bytes, path: str) -> None:
    """Read a file with all its textures and discard it."""
    try_read(output, lambda: _read(Path(path), textures=True))
