"""The one surface of an asset that physics and shadows use, of the parts of a CAD mesh or a scan."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
import shapely
import trimesh

from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.geometry.mesh import simplify_solid
from mitsplat.renderer.occluders.proxies import Occluder, Proxies

_LABEL_GAP = 0.01
"""Distance from a solid, relative to its own size, within which a sheet is a label on it."""
_TOLERANCES = 1e-5 * 1.5 ** np.arange(18)
"""Of simplification, relative to the size, up to a hundredth; tried in turn until the faces are few enough."""


def make_proxy(parts: Sequence[MeshPart], most_faces: int) -> trimesh.Trimesh:
    """One surface of all parts, of at most about ``most_faces`` faces; labels on solids are left out.

    Decimation eats open sheets from their edges, so they keep all faces, the flat ones only as many as they need.
    """
    meshes = [_without_holes(part.mesh) for part in parts]
    solids = [mesh for mesh in meshes if mesh.is_volume]
    sheets = [mesh for mesh in meshes if not mesh.is_volume]
    if len(solids) > 1:
        solids = [trimesh.boolean.union(solids, engine="manifold")]
    if solids:
        sheets = [sheet for sheet in sheets if not _lies_on(sheet, solids[0])]
    sheets = [_flattened(sheet) for sheet in sheets]
    room = max(most_faces - sum(len(sheet.faces) for sheet in sheets), most_faces // 2)
    solids = [_of_fewer_faces(solid, room) for solid in solids]
    proxy = trimesh.util.concatenate(solids + sheets)
    return trimesh.Trimesh(proxy.vertices, proxy.faces)


def _of_fewer_faces(solid: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """A solid of at most about ``most`` faces; what quadric decimation tears, as it does scans, Manifold thins."""
    if len(solid.faces) <= most:
        return solid
    fewer = solid.simplify_quadric_decimation(face_count=most)
    if fewer.is_volume:
        return fewer
    closed = (simplify_solid(solid, tolerance) for tolerance in _TOLERANCES * solid.scale)
    return next((mesh for mesh in closed if len(mesh.faces) <= most), fewer)


def _without_holes(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A solid that lacks a triangle or two, as scans do, closed; any other mesh as it is."""
    if mesh.is_watertight:
        return mesh
    closed = mesh.copy()
    closed.fill_holes()
    return closed if closed.is_volume else mesh


def _flattened(sheet: trimesh.Trimesh) -> trimesh.Trimesh:
    """A sheet in a plane with no more faces than its outline needs; any other sheet as it is."""
    normal = sheet.face_normals[0]
    height = (sheet.vertices - sheet.vertices[0]) @ normal
    if (sheet.face_normals @ normal < 0.999).any() or np.ptp(height) > 1e-5 * sheet.scale:
        return sheet
    to_plane = trimesh.geometry.plane_transform(sheet.vertices[0], normal)
    corners = trimesh.transform_points(sheet.vertices, to_plane)[sheet.faces, :2]
    outline = shapely.coverage_union_all(shapely.polygons(corners)).simplify(1e-6 * sheet.scale)
    flat = [trimesh.creation.triangulate_polygon(polygon, engine="earcut") for polygon in shapely.get_parts(outline)]
    vertices, faces = trimesh.util.append_faces([v for v, _ in flat], [f for _, f in flat])
    vertices = np.pad(vertices, ((0, 0), (0, 1)))
    return trimesh.Trimesh(trimesh.transform_points(vertices, np.linalg.inv(to_plane)), faces)


def _lies_on(sheet: trimesh.Trimesh, solid: trimesh.Trimesh) -> bool:
    """Whether an open sheet hugs a solid, as a label does: everywhere within a hundredth of its size."""
    origins, down = sheet.triangles_center, -sheet.face_normals
    rays = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(down.T.astype(np.float32)))
    hit, _ = Proxies([Occluder(solid, 0, dynamic=False)]).nearest(rays)
    return bool((np.array(hit.distance) < _LABEL_GAP * sheet.scale).all())
