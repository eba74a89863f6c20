"""Merging of the facets of convex hulls."""

import numpy as np
import pytest
import trimesh

from mitsplat.geometry.hull_facets import merge_facets
from tests.bodies import scanned_box


def heights(points, hull):
    """Return the largest distance of each point above a facet of a hull [m]."""
    return ((points[:, None] - hull.triangles_center) * hull.face_normals).sum(axis=-1).max(axis=1)


@pytest.mark.parametrize("angle", [1.5, 3.0])
@pytest.mark.parametrize("tolerance", [5e-5, 3e-4])
def test_merged_facets_contain_the_hull_and_keep_their_limits(angle, tolerance):
    """Each new plane touches the hull, and each facet of the hull is near one of them in angle and depth."""
    hull = scanned_box()
    merged = merge_facets(hull, angle=angle, tolerance=tolerance)
    assert merged.is_convex
    assert heights(hull.vertices, merged).max() < 1e-9
    normals = np.unique(merged.face_normals.round(7), axis=0)
    supports = (merged.vertices @ normals.T).max(axis=0)
    np.testing.assert_allclose((hull.vertices @ normals.T).max(axis=0), supports, atol=1e-8)
    near = hull.face_normals @ normals.T > np.cos(np.radians(angle)) - 1e-9
    depths = (supports - hull.triangles @ normals.T).max(axis=1)
    assert np.where(near, depths, np.inf).min(axis=1).max() < tolerance + 1e-8
    assert len(normals) < 0.8 * len(np.unique(hull.face_normals.round(7), axis=0))


def test_facets_at_larger_angles_stay():
    cylinder = trimesh.creation.cylinder(radius=0.01, height=0.02, sections=128)
    merged = merge_facets(cylinder, angle=1.5, tolerance=3e-4)
    for first, second in [(cylinder, merged), (merged, cylinder)]:
        assert np.abs(heights(first.vertices, second)).max() < 1e-9
