"""Proxy mesh of an asset for physics and shadows, made from the parts of a CAD mesh or a scan."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
import shapely
import trimesh

from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.geometry.mesh_holes import close_holes
from mitsplat.geometry.solids import is_closed, join_meshes, signed_volume, simplify_solid, turn_outwards, unite_bodies
from mitsplat.renderer.occluders.proxies import Occluder, Proxies

_LABEL_GAP = 0.01
"""Maximum distance of a label sheet from its solid, relative to the size of the sheet."""
_FLAT = 1e-9
"""Volume relative to the cube of the size below which both sides of a sheet enclose nothing."""
_TOUCHING = 1e-6
"""Tolerance of the simplification of the union of touching solids, relative to its size."""
_TOLERANCES = 1e-5 * 1.5 ** np.arange(18)
"""Tolerances of simplification relative to the size, up to 0.01; tried in turn until the face count is low enough."""


def make_proxy(parts: Sequence[MeshPart], most_faces: int) -> trimesh.Trimesh:
    """Merge all parts into one surface of at most about ``most_faces`` faces; labels on solids are left out.

    Open sheets are not decimated, because decimation would shrink them from their edges. Flat sheets are
    re-triangulated from their outlines.
    """
    solids: list[trimesh.Trimesh] = []
    sheets: list[trimesh.Trimesh] = []
    for part in parts:
        mesh = _close_solid(part.mesh)
        is_solid = is_closed(mesh) and signed_volume(mesh) > _FLAT * mesh.scale**3
        (solids if is_solid else sheets).append(mesh)
    if solids:
        solids = [_unite(solids)]
        sheets = [sheet for sheet in sheets if not _lies_on(sheet, solids[0])]
    sheets = [_retriangulate_flat(sheet) for sheet in sheets]
    face_budget = max(most_faces - sum(len(sheet.faces) for sheet in sheets), most_faces // 2)
    solids = [_simplify(solid, face_budget) for solid in solids]
    return _merged(trimesh.util.concatenate(solids + sheets))


def _unite(solids: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return solids as one mesh in which bodies are not inside out, and are united if they touch or overlap.

    Where solids touch, their union has vertices closer to each other than vertices of files are, which are merged. Four
    faces can then share an edge. The union is simplified in this case, which leaves no such vertices.
    """
    union = unite_bodies(turn_outwards(join_meshes(solids))[0])
    if _merged(union).is_volume:
        return union
    simple = simplify_solid(union, _TOUCHING * union.scale)
    return simple if _merged(simple).is_volume else union


def _merged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose equal vertices are merged."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces)


def _simplify(solid: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """Simplify a solid to at most about ``most`` faces, or to more faces if only those form a closed surface.

    Quadric decimation may tear meshes such as scans, and keeps many triangles of a plane; Manifold simplifies those
    instead.
    """
    if len(solid.faces) <= most:
        return solid
    fewer = _without_folds(solid.simplify_quadric_decimation(face_count=most))
    if fewer.is_volume and len(fewer.faces) <= most:
        return fewer
    fewest = simplify_solid(solid, *_TOLERANCES * solid.scale, most=most)
    if len(fewest.faces) <= most:
        return fewest
    return fewer if is_closed(fewer) and len(fewer.faces) < len(fewest.faces) else fewest


def _without_folds(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Remove pairs of faces with the same corners, into which decimation collapses thin features."""
    corners = np.sort(mesh.faces, axis=1)
    _, group, counts = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[counts[group.ravel()] != 2], process=False)


def _close_solid(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Close small holes of a solid, such as missing triangles of a scan; return any other mesh unchanged."""
    closed = close_holes(mesh)
    return closed if is_closed(closed) else mesh


def _retriangulate_flat(sheet: trimesh.Trimesh) -> trimesh.Trimesh:
    """Re-triangulate a planar sheet from its outline; return any other sheet unchanged."""
    normal = sheet.face_normals[0]
    height = (sheet.vertices - sheet.vertices[0]) @ normal
    if (sheet.face_normals @ normal < 0.999).any() or np.ptp(height) > 1e-5 * sheet.scale:
        return sheet
    to_plane = trimesh.geometry.plane_transform(sheet.vertices[0], normal)
    corners = trimesh.transform_points(sheet.vertices, to_plane)[sheet.faces, :2]
    faces = shapely.polygons(corners)
    try:
        outline = shapely.coverage_union_all(faces)
    except shapely.GEOSException:  # a corner lies on the edge of another face, as in cut-outs
        outline = shapely.union_all(faces, grid_size=1e-7 * sheet.scale)
    outline = outline.simplify(1e-6 * sheet.scale)
    flat = [trimesh.creation.triangulate_polygon(polygon, engine="earcut") for polygon in shapely.get_parts(outline)]
    vertices, triangles = trimesh.util.append_faces([v for v, _ in flat], [f for _, f in flat])
    vertices = np.pad(vertices, ((0, 0), (0, 1)))
    return trimesh.Trimesh(trimesh.transform_points(vertices, np.linalg.inv(to_plane)), triangles)


def _lies_on(sheet: trimesh.Trimesh, solid: trimesh.Trimesh) -> bool:
    """Return True if every face of an open sheet is within 1 % of the sheet's size from a solid, as a label is."""
    origins, down = sheet.triangles_center, -sheet.face_normals
    rays = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(down.T.astype(np.float32)))
    hit, _ = Proxies([Occluder(solid, 0, dynamic=False)]).nearest(rays)
    return bool((np.array(hit.distance) < _LABEL_GAP * sheet.scale).all())
