"""Closing of small holes of meshes: volumes against closed forms, and openings that stay open."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
import trimesh

from mitsplat.geometry.mesh import prepare_mesh
from mitsplat.geometry.mesh_holes import close_holes


def fine_box() -> trimesh.Trimesh:
    """Build a box of 12,288 faces with edges of 0.1 m."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    for _ in range(5):
        box = box.subdivide()
    return box


def without(mesh: trimesh.Trimesh, faces: object) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, np.delete(mesh.faces, faces, axis=0))


def inner_faces(box: trimesh.Trimesh) -> np.ndarray:
    """Return the faces that touch no edge of the box. Holes of these are flat."""
    sides = (np.abs(box.vertices) > 0.0499).sum(axis=1)
    return np.flatnonzero((sides[box.faces] == 1).all(axis=1))


@pytest.mark.parametrize("seed", range(5))
def test_holes_of_neighbouring_triangles_are_closed(seed: int) -> None:
    """Of 1200 missing triangles, some are neighbours. Their holes have five edges or more, or touch at a vertex."""
    box = fine_box()
    scan = without(box, np.random.default_rng(seed).choice(inner_faces(box), 1200, replace=False))
    simple = scan.copy()
    assert not simple.fill_holes()  # only holes of three and four edges
    closed = close_holes(scan)
    assert closed.is_volume
    assert closed.volume == pytest.approx(1e-3, rel=1e-9)
    assert closed.area == pytest.approx(0.06, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_faces_without_area_that_touch_leave_no_holes(seed: int, dtype: type) -> None:
    """The sides of the hole that such a face leaves have the same direction, apart from rounding errors."""
    ball = trimesh.creation.icosphere(3, 0.05)
    vertices, faces = ball.vertices.tolist(), ball.faces.tolist()
    rng = np.random.default_rng(seed)
    for face in rng.permutation(len(faces))[:40]:  # gets a vertex on its first side, and a neighbour without area
        a, b, c = faces[face]
        middle = len(vertices)
        vertices.append(np.mean([vertices[a], vertices[b]], axis=0).tolist())
        faces[face] = [a, middle, c]
        faces += [[middle, b, c], [a, b, middle]]
    turned = trimesh.transform_points(vertices, trimesh.transformations.random_rotation_matrix(rng.random(3)))
    scan = trimesh.Trimesh(turned.astype(dtype), faces, process=False)
    prepared = prepare_mesh(scan, "ball")
    assert prepared.is_volume
    assert prepared.volume == pytest.approx(ball.volume)


def test_a_hole_that_is_not_convex_is_closed_within_its_outline() -> None:
    """An L of 18 triangles in a side. A fan from one of its corners would cover more than the hole."""
    box = fine_box()
    x, y, z = (box.triangles_center / (0.1 / 32)).T  # squares of one unit, two triangles each
    top = z > 15.9
    hole = top & (((x > 0) & (x < 5) & (y > 0) & (y < 1)) | ((x > 0) & (x < 1) & (y > 0) & (y < 5)))
    assert hole.sum() == 18
    closed = close_holes(without(box, hole))
    assert closed.is_volume
    assert closed.area == pytest.approx(0.06, rel=1e-9)


def test_a_long_hole_is_closed() -> None:
    """A scratch of 118 triangles in a side of 49,152 / 6 has 120 edges and 0.24 % of the area."""
    box = fine_box().subdivide()
    x, y, z = (box.triangles_center / (0.1 / 64)).T  # squares of one unit, two triangles each
    hole = (z > 31.9) & (np.abs(x) < 29.5) & (y > 0) & (y < 1)
    scan = without(box, hole)
    assert len(trimesh.grouping.group_rows(scan.edges_sorted, require_count=1)) > 100
    closed = close_holes(scan)
    assert closed.is_volume
    assert closed.area == pytest.approx(0.06, rel=1e-9)


def test_a_lost_triangle_of_a_coarse_mesh_is_restored() -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    assert close_holes(without(box, [3])).volume == pytest.approx(1e-3)


def test_cracks_along_edges_are_closed() -> None:
    """The sides of a box are divided and its top is not: four holes of five edges without area."""
    corners = np.array([(0, 0), (0.1, 0), (0.1, 0.1), (0, 0.1)])
    outline = [
        (1 - share) * corner + share * after
        for corner, after in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        for share in (0, 0.25, 0.5, 0.75)
    ]
    box = trimesh.creation.extrude_polygon(shapely.Polygon(outline), 0.1, engine="earcut")
    top = [np.flatnonzero((box.vertices == (*corner, 0.1)).all(axis=1))[0] for corner in corners]
    sides = box.faces[box.face_normals[:, 2] < 0.5]
    cracked = trimesh.Trimesh(box.vertices, [*sides, [top[0], top[1], top[2]], [top[0], top[2], top[3]]], process=False)
    assert not cracked.is_watertight
    closed = close_holes(cracked)
    assert closed.is_watertight
    assert len(closed.faces) == len(cracked.faces) + 4 * 3
    assert closed.volume == pytest.approx(1e-3, rel=1e-9)


@pytest.mark.parametrize("divisions", range(3))
def test_a_box_without_a_lid_stays_open(divisions: int) -> None:
    """The opening has four edges, or more if the sides are divided. Parts fall into it in either case."""
    box = trimesh.creation.box((0.3, 0.2, 0.1))
    for _ in range(divisions):
        box = box.subdivide()
    crate = without(box, box.face_normals[:, 2] > 0.5)
    np.testing.assert_allclose(close_holes(crate).area, crate.area)
    np.testing.assert_allclose(prepare_mesh(crate, "crate").area, crate.area)


@pytest.mark.parametrize("small", ["crate", "cup", "leaf", "bent leaf", "triangle"])
def test_small_open_bodies_beside_a_large_one_stay_open(small: str) -> None:
    """The opening of the small body, or the whole sheet, is less than 0.5 % of the area of both."""
    large = trimesh.creation.box((1, 1, 0.02))
    if small in ("crate", "cup"):
        body = trimesh.creation.box((0.04, 0.04, 0.04)) if small == "crate" else trimesh.creation.cylinder(0.02, 0.03)
        body = without(body, body.face_normals[:, 2] > 0.5)
    else:
        body = trimesh.Trimesh([(0, 0, 0), (0.02, 0, 0), (0, 0.02, 0)], [(0, 1, 2)])
        body = body if small == "triangle" else body.subdivide().subdivide()
        body.vertices[:, 2] += (small == "bent leaf") * 10 * (body.vertices[:, 0] - 0.01) ** 2
    both = trimesh.util.concatenate([large, body.apply_translation((0, 0, 0.2))])
    assert close_holes(both) is both
    lost = trimesh.util.concatenate([without(large, [3]), body])
    assert close_holes(lost).area == pytest.approx(both.area)


def test_fragments_of_a_scan_are_removed() -> None:
    """A loose triangle beside the box, and one in the middle of a hole, would make the box open."""
    box = fine_box()
    middle = int(np.linalg.norm(box.triangles_center - (0.001, 0.001, 0.05), axis=1).argmin())
    around = np.isin(box.faces, box.faces[middle]).any(axis=1)
    around[middle] = False
    loose = trimesh.Trimesh([(0.1, 0, 0), (0.101, 0, 0), (0.1, 0.001, 0)], [(0, 1, 2)])
    closed = close_holes(trimesh.util.concatenate([without(box, around), loose]))
    assert closed.is_volume
    assert closed.volume == pytest.approx(1e-3, rel=1e-9)
    assert closed.vertices[:, 0].max() < 0.06


def test_many_small_sheets_are_no_fragments() -> None:
    """The leaves of a plant: 0.02 % of the faces each, but a tenth of the area."""
    leaf = trimesh.Trimesh([(0, 0, 0), (0.02, 0, 0), (0, 0.02, 0)], [(0, 1, 2)])
    leaves = [leaf.copy().apply_translation((0.1, 0, 0.005 * number)) for number in range(30)]
    plant = trimesh.util.concatenate([fine_box(), *leaves])
    assert close_holes(plant) is plant


def test_large_openings_are_not_triangulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each triangulation of the ends of the tube, 400 edges, takes 2 s."""
    monkeypatch.delattr("mitsplat.geometry.mesh_holes._smallest_patch")
    cylinder = trimesh.creation.cylinder(0.005, 0.05, sections=400)
    tube = without(cylinder, np.abs(cylinder.face_normals[:, 2]) > 0.5)
    assert close_holes(tube) is tube


def test_a_closed_mesh_is_returned_unchanged() -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    assert close_holes(box) is box
