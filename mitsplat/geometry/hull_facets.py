"""Convex hulls of scans with fewer facets: facets that are almost coplanar become one."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection


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
