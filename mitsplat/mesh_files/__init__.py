"""Readers of mesh and CAD files from other programs.

In: an untrusted file (STEP, glTF, 3MF, OBJ, PLY, STL, OFF, COLLADA). Out: its parts with materials, textures and
colours, in the units and axes of the file, and the units and up axis that it states.
"""

from __future__ import annotations

from mitsplat.mesh_files.mesh_file import FilePart, Material, MeshFile, Texture
from mitsplat.mesh_files.mesh_reading import read_mesh_file
from mitsplat.mesh_files.step import read_step

__all__ = ["FilePart", "Material", "MeshFile", "Texture", "read_mesh_file", "read_step"]
