"""Proxy mesh of an asset, shared by physics and shadows."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.bake.proxy_mesh import make_proxy
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.geometry.solids import is_closed


def part(mesh: trimesh.Trimesh) -> MeshPart:
    return MeshPart("part", mesh, np.full((len(mesh.faces), 3, 3), 0.5), None, 0.0, None, True, 0.04, ())


def test_the_proxy_of_a_scan_with_many_faces_is_watertight() -> None:
    """Quadric decimation tears holes into this scan. Rebuilding its surface from voxels would take physics minutes."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    factors = 1 + 0.005 * np.random.default_rng(0).normal(size=(len(ball.vertices), 1))
    scan = trimesh.Trimesh(ball.vertices * factors, ball.faces, process=False)
    assert scan.is_volume and not scan.simplify_quadric_decimation(face_count=4000).is_volume
    proxy = make_proxy([part(scan)], 4000)
    assert proxy.is_volume
    assert 1000 < len(proxy.faces) <= 4000
    assert np.abs(DistanceSurface(scan).signed_distances(proxy.sample(2000, seed=0))).max() < 0.01 * scan.scale


def _knurled(edge: float) -> trimesh.Trimesh:
    """A knurled knob of 41 mm with edges of at most ``edge`` [mm]."""
    mesh = trimesh.creation.cylinder(20, 30, sections=64).subdivide_to_size(edge)
    mesh.merge_vertices()
    x, y, z = mesh.vertices.T
    knurls = np.clip((np.hypot(x, y) - 18) / 2, 0, 1) * np.cos(40 * np.arctan2(y, x)) * np.cos(1.5 * z)
    factors = np.stack([1 + 0.02 * knurls, 1 + 0.02 * knurls, np.ones_like(z)], axis=1)
    return trimesh.Trimesh(1e-3 * factors * mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("most", [1000, 2000])
def test_the_proxy_of_a_knurled_knob_is_closed(most: int) -> None:
    """Quadric decimation tears the knurls, and other simplifications need more faces."""
    knob = _knurled(1.6)
    assert knob.is_volume and not knob.simplify_quadric_decimation(face_count=most).is_volume
    proxy = make_proxy([part(knob)], most)
    assert is_closed(proxy)
    assert proxy.volume == pytest.approx(knob.volume, rel=0.02)
    assert len(proxy.faces) < 3000


@pytest.mark.parametrize("turn", [(-np.pi / 2, 0, 0), (0.3, -0.7, 1.1)])
@pytest.mark.parametrize("sections", [80, 48, 37])
def test_touching_solids_form_a_closed_proxy(sections: int, turn: tuple[float, float, float]) -> None:
    """A knob of two parts. Its rotation rounds the positions of the faces in which the cap and the shaft touch."""
    outline = [(0, 0), (0.016, 0), (0.018, 0.003), (0.018, 0.018), (0.014, 0.022), (0, 0.022)]
    cap = trimesh.creation.revolve(outline, sections=sections)
    shaft = trimesh.creation.cylinder(0.004, 0.03, sections=48)
    shaft.apply_translation((0, 0, -0.015))
    for mesh in (cap, shaft):
        mesh.apply_transform(trimesh.transformations.compose_matrix(angles=turn))
    proxy = make_proxy([part(cap), part(shaft)], 10000)
    assert proxy.is_volume
    assert proxy.volume == pytest.approx(cap.volume + shaft.volume, rel=1e-6)
    assert proxy.extents == pytest.approx(trimesh.util.concatenate([cap, shaft]).extents, rel=1e-5)


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size, transform=trimesh.transformations.translation_matrix(centre))


def cavity(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = box(size, centre)
    mesh.invert()
    return mesh


BLOCK = (0.05, 0.04, 0.03)


@pytest.mark.parametrize(
    ("bodies", "volume"),
    [
        # The blocks have 30 x 30 x 20 mm in common.
        ([box(BLOCK), box(BLOCK, (0.02, 0.01, 0.01))], 2 * 60e-6 - 18e-6),
        ([box(BLOCK), box(BLOCK, (0.06, 0.0, 0.0))], 2 * 60e-6),
        ([box(BLOCK), cavity((0.03, 0.02, 0.01))], 60e-6 - 6e-6),
        # The second block is inside out.
        ([box(BLOCK), cavity((0.04, 0.03, 0.02), (0.06, 0, 0))], 60e-6 + 24e-6),
        # A ball of a rattle inside a cavity.
        ([box(BLOCK), cavity((0.03, 0.02, 0.01)), box((0.01, 0.01, 0.005))], 60e-6 - 6e-6 + 0.5e-6),
        # The second block is 10 mm high and covers the cavity of the first one at x > 10 mm: a third of it.
        ([box(BLOCK), cavity((0.03, 0.02, 0.01)), box((0.05, 0.04, 0.01), (0.03, 0, 0))], 60e-6 + 12e-6 - 4e-6),
    ],
)
def test_bodies_of_one_part_are_united(bodies: list[trimesh.Trimesh], volume: float) -> None:
    proxy = make_proxy([part(trimesh.util.concatenate(bodies))], 10000)
    assert proxy.is_volume
    assert proxy.volume == pytest.approx(volume, rel=1e-5)


def test_a_scan_without_some_neighbouring_faces_has_a_closed_proxy() -> None:
    """An open proxy would take the convex decomposition minutes, and have hundreds of pieces."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    lost = np.argsort(ball.triangles_center[:, 2])[:7]
    scan = trimesh.Trimesh(ball.vertices, np.delete(ball.faces, lost, axis=0))
    proxy = make_proxy([part(scan)], 4000)
    assert proxy.is_volume
    assert proxy.volume == pytest.approx(ball.volume, rel=0.002)


def test_flat_faces_of_many_triangles_are_simplified() -> None:
    """Quadric decimation keeps most of the 49,152 triangles, because its collapses on a plane would turn triangles."""
    plate = trimesh.creation.box((0.1, 0.1, 0.002))
    for _ in range(6):
        plate = plate.subdivide()
    proxy = make_proxy([part(plate)], 2000)
    assert proxy.is_volume
    assert len(proxy.faces) <= 2000
    assert proxy.volume == pytest.approx(plate.volume, rel=1e-4)


def test_the_proxy_of_a_box_without_a_lid_is_open() -> None:
    box = trimesh.creation.box((0.3, 0.2, 0.1))
    crate = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5])
    proxy = make_proxy([part(crate)], 4000)
    assert not proxy.is_watertight
    assert proxy.area == pytest.approx(crate.area)
