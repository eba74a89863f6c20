"""Proxy mesh of an asset, shared by physics and shadows."""

from __future__ import annotations

import numpy as np
import trimesh

from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.bake.proxy_mesh import make_proxy
from mitsplat.geometry.mesh_distance import DistanceSurface


def test_the_proxy_of_a_scan_with_many_faces_is_watertight() -> None:
    """Quadric decimation tears holes into this scan. Rebuilding its surface from voxels would take physics minutes."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    factors = 1 + 0.005 * np.random.default_rng(0).normal(size=(len(ball.vertices), 1))
    scan = trimesh.Trimesh(ball.vertices * factors, ball.faces, process=False)
    assert scan.is_volume and not scan.simplify_quadric_decimation(face_count=4000).is_volume
    proxy = make_proxy(
        [MeshPart("scan", scan, np.full((len(scan.faces), 3, 3), 0.5), None, 0.0, None, True, 0.04, ())], 4000
    )
    assert proxy.is_volume
    assert 1000 < len(proxy.faces) <= 4000
    assert np.abs(DistanceSurface(scan).signed_distances(proxy.sample(2000, seed=0))).max() < 0.01 * scan.scale
