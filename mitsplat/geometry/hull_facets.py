"""Convex hulls of scans with fewer facets: facets that are almost coplanar become one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection

# Hulls with more facets are those of scans, whose flat sides consist of many facets. MuJoCo finds the contacts of one
# facet of each body, in each step of another one, so that a stack of three scanned boxes creeps at 3 mm/s. Facets are
# merged within an angle [degrees] and a depth [m], or share of the size: then it creeps at less than 0.01 mm/s.
_SCAN_FACETS, _FACET_ANGLE, _FACET_DEPTH, _FACET_DEPTH_SHARE = 300, 1.5, 3e-4, 0.002


def merge_facets(hull: trimesh.Trimesh, *, angle: float, tolerance: float) -> trimesh.Trimesh:
    """Return a convex mesh that contains a hull and has one facet in place of several that are almost coplanar.

    Facets are processed from the largest to the smallest. The plane of each remaining facet replaces all others whose
    normals and depths below it are within the limits. The result is the intersection of the half-spaces of these
    planes. All of them touch the hull.

    Args:
        hull: Convex mesh [m].
        angle: Maximum angle between the normals of a facet and of the one that replaces it [degrees].
        tolerance: Maximum depth of a facet below the plane that replaces it [m].
    """
    outline = ConvexHull(np.asarray(hull.vertices, dtype=np.float64))
    corners = outline.points[outline.simplices]
    normals, offsets = outline.equations[:, :3], outline.equations[:, 3]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    remaining, chosen = np.ones(len(areas), dtype=bool), []
    for facet in np.argsort(-areas, kind="stable"):
        if not remaining[facet]:
            continue
        chosen.append(facet)
        near = np.flatnonzero(remaining & (np.einsum("fi,i->f", normals, normals[facet]) > np.cos(np.radians(angle))))
        depths = -np.einsum("fvi,i->fv", corners[near], normals[facet]).min(axis=1) - offsets[facet]
        remaining[near[depths < tolerance]] = False
        remaining[facet] = False
    if len(chosen) == len(areas):
        return hull
    inside = outline.points[outline.vertices].mean(axis=0)
    return trimesh.convex.convex_hull(HalfspaceIntersection(outline.equations[chosen], inside).intersections)


def contact_pieces(pieces: Sequence[trimesh.Trimesh]) -> tuple[trimesh.Trimesh, ...]:
    """Return convex pieces with merged facets where they are hulls of scans."""
    size = max(float(np.ptp(piece.vertices, axis=0).max()) for piece in pieces)
    depth = min(_FACET_DEPTH, _FACET_DEPTH_SHARE * size)
    return tuple(
        merge_facets(piece, angle=_FACET_ANGLE, tolerance=depth) if _facet_count(piece) > _SCAN_FACETS else piece
        for piece in pieces
    )


def _facet_count(piece: trimesh.Trimesh) -> int:
    """Return the number of facets of a convex mesh; coplanar triangles are one."""
    return len(np.unique(np.round(piece.face_normals, 6), axis=0)) if len(piece.faces) > _SCAN_FACETS else 0
