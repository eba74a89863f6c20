"""Closed meshes, bodies and cavities against closed forms."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import shapely
import trimesh

from mitsplat.geometry.mesh import mass_properties, prepare_mesh
from mitsplat.geometry.mesh_points import winding_numbers
from mitsplat.geometry.solids import is_closed, separate_solids, simplify_solid, turn_outwards, unite_bodies


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size, transform=trimesh.transformations.translation_matrix(centre))


def ball(radius: float, x: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3, radius).apply_translation((x, 0, 0))


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = mesh.copy()
    mesh.invert()
    return mesh


def welded(*meshes: trimesh.Trimesh, seed: int | None = None) -> trimesh.Trimesh:
    """Join meshes, merge equal vertices, and shuffle the faces."""
    joint = trimesh.Trimesh(*trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes]))
    if seed is not None:
        joint.faces = np.random.default_rng(seed).permutation(joint.faces)
    return joint


def _touching(case: str) -> trimesh.Trimesh:
    """Closed solids of one mesh whose equal vertices are merged, so that four faces share an edge."""
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    other = box.copy()
    match case:
        case "edge":
            other.apply_translation((0.05, 0.04, 0))
        case "face":
            other.apply_translation((0, 0, 0.03))
        case "lid":  # a ring and a disc on it, with other triangles on the faces where they touch
            box = trimesh.creation.annulus(0.018, 0.02, 0.008)
            other = trimesh.creation.cylinder(0.02, 0.0015, sections=32)
            other.apply_translation((0, 0, 0.00475))
    return trimesh.Trimesh(*trimesh.util.append_faces([box.vertices, other.vertices], [box.faces, other.faces]))


@pytest.mark.parametrize("case", ["edge", "face", "lid"])
def test_solids_that_touch_are_closed(case: str, caplog: pytest.LogCaptureFixture) -> None:
    mesh = _touching(case)
    assert not mesh.is_watertight
    assert is_closed(mesh)
    prepared = prepare_mesh(mesh, case)
    assert not caplog.records
    found = mass_properties(prepared, (), density=1000.0)
    assert found.mass == pytest.approx(1000.0 * mesh.volume)
    np.testing.assert_allclose(found.centre, mesh.center_mass, atol=1e-9)


def test_faces_listed_twice_turned_or_without_thickness_are_not_closed() -> None:
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    assert is_closed(box)
    twice = trimesh.Trimesh(box.vertices, np.concatenate([box.faces, np.roll(box.faces, 1, axis=1)]), process=False)
    turned = trimesh.Trimesh(box.vertices, np.concatenate([box.faces[:6], box.faces[6:, ::-1]]), process=False)
    corners = np.concatenate([box.vertices, [[0.1, 0, 0]]])
    first, second = box.edges_unique[0]
    fin = np.array([[first, second, 8], [second, first, 8]])  # both sides of a sheet on an edge of the box
    finned = trimesh.Trimesh(corners, np.concatenate([box.faces, fin]), process=False)
    for mesh in (twice, turned, finned):
        assert not is_closed(mesh)


@pytest.mark.parametrize("place", [(0.2, 0, 0), (0.05, 0.04, 0)], ids=["apart", "touching"])
def test_a_solid_whose_faces_are_also_listed_turned_is_not_closed(place: tuple[float, float, float]) -> None:
    """Its two volumes cancel each other, so that the mass would be that of the other solid alone."""
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    both_sides = np.concatenate([box.faces, box.faces[:, ::-1]])
    other = box.copy().apply_translation(place)
    joint = trimesh.Trimesh(*trimesh.util.append_faces([box.vertices, other.vertices], [both_sides, other.faces]))
    assert not is_closed(joint)


def test_a_body_inside_out_beside_another_is_flipped_and_a_cavity_is_not(caplog: pytest.LogCaptureFixture) -> None:
    body, beside = trimesh.creation.box((0.05, 0.04, 0.03)), trimesh.creation.box((0.02, 0.02, 0.02))
    cavity = trimesh.creation.box((0.01, 0.01, 0.01))
    beside.apply_translation((0.2, 0, 0))
    expected = body.volume + beside.volume - cavity.volume
    beside.invert()
    cavity.invert()
    joint = trimesh.util.concatenate([body, beside, cavity])
    assert prepare_mesh(joint, "part").volume == pytest.approx(expected)
    assert caplog.messages == ["part: bodies of the mesh are inside out; physics flips their faces (1 of 3 surfaces)"]


def test_a_body_and_its_equal_inside_out_have_a_volume() -> None:
    body = trimesh.creation.box((0.05, 0.04, 0.03))
    other = body.copy().apply_translation((0.2, 0, 0))
    other.invert()
    assert prepare_mesh(trimesh.util.concatenate([body, other]), "part").volume == pytest.approx(2 * body.volume)


def test_a_mesh_without_faces_is_not_closed() -> None:
    assert not is_closed(trimesh.Trimesh(np.eye(3), np.zeros((0, 3), dtype=int), process=False))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("place", [(0.05, 0.04, 0), (0, 0, 0.03)], ids=["edge", "face"])
def test_solids_that_touch_are_separated_whole(place: tuple[float, float, float], seed: int) -> None:
    """The order of the faces does not matter."""
    found = separate_solids(welded(box((0.05, 0.04, 0.03)), box((0.05, 0.04, 0.03), place), seed=seed))
    assert all(solid.is_volume for solid in found)
    assert [solid.volume for solid in found] == pytest.approx([6e-5, 6e-5])


@pytest.mark.parametrize("seed", range(5))
def test_a_disc_on_a_ring_is_separated_from_it(seed: int) -> None:
    """Their common faces have other triangles."""
    ring, disc = trimesh.creation.annulus(0.018, 0.02, 0.008), trimesh.creation.cylinder(0.02, 0.0015, sections=32)
    found = separate_solids(welded(ring, disc.apply_translation((0, 0, 0.00475)), seed=seed))
    assert all(solid.is_volume for solid in found)
    assert sorted(solid.volume for solid in found) == pytest.approx(sorted([ring.volume, disc.volume]))


def test_a_solid_that_touches_itself_keeps_its_volume() -> None:
    """A plate with a triangular hole whose corner is on the side of the plate."""
    outline, hole = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 1.5)], [(0, 1.5), (1.5, 1), (1.5, 2)]
    plate = trimesh.creation.extrude_polygon(shapely.Polygon(outline, [hole]), 1.0, engine="earcut")
    assert is_closed(plate) and not plate.is_watertight
    (found,) = separate_solids(plate)
    assert found.is_volume
    assert found.volume == pytest.approx(9 - 0.75)
    assert simplify_solid(plate, 1e-3).volume == pytest.approx(9 - 0.75)


BLOCK, BESIDE = (0.05, 0.04, 0.03), (0.2, 0, 0)
HOLLOW = trimesh.util.concatenate([box(BLOCK), inside_out(box((0.03, 0.02, 0.01)))])


@pytest.mark.parametrize(
    ("bodies", "turned", "volume"),
    [
        ([box(BLOCK), inside_out(box(BLOCK, (0.05, 0.04, 0)))], 1, 12e-5),  # touch at an edge
        ([box(BLOCK, BESIDE), inside_out(HOLLOW)], 2, 6e-5 + 5.4e-5),
        ([inside_out(HOLLOW)], 2, 5.4e-5),
        ([HOLLOW, box((0.01, 0.01, 0.005))], 0, 5.45e-5),  # a rattle
        ([HOLLOW, inside_out(box((0.01, 0.01, 0.005)))], 1, 5.45e-5),
        ([HOLLOW, box((0.02, 0.02, 0.005)), inside_out(box((0.01, 0.01, 0.002)))], 0, 5.4e-5 + 2e-6 - 2e-7),
        ([box(BLOCK, BESIDE), inside_out(box(BLOCK)), inside_out(box(BLOCK, (0.02, 0.01, 0.01)))], 2, 18e-5),
    ],
)
def test_bodies_inside_out_are_turned_and_cavities_stay(
    bodies: list[trimesh.Trimesh], turned: int, volume: float
) -> None:
    mesh = welded(*bodies)
    faces = mesh.faces.copy()
    found, count, _ = turn_outwards(mesh)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert count == turned
    assert found.volume == pytest.approx(volume)
    assert (found is mesh) == (turned == 0)
    assert prepare_mesh(mesh, "part").volume == pytest.approx(volume)


def test_overlapping_balls_count_their_common_volume_once() -> None:
    """Two balls of radius r at a distance d have the volume pi (4 r + d) (2 r - d)^2 / 12 in common."""
    r, d = 0.05, 0.04
    lens = np.pi * (4 * r + d) * (2 * r - d) ** 2 / 12
    balls = trimesh.util.concatenate([trimesh.creation.icosphere(5, r).apply_translation((x, 0, 0)) for x in (0, d)])
    expected = 2 * 4 / 3 * np.pi * r**3 - lens
    assert unite_bodies(balls).volume == pytest.approx(expected, rel=2e-3)
    found = mass_properties(balls, (), density=1000.0)
    assert found.mass == pytest.approx(1000 * expected, rel=2e-3)
    np.testing.assert_allclose(found.centre, (d / 2, 0, 0), atol=1e-6)


def test_the_inertia_of_overlapping_boxes_is_that_of_their_union() -> None:
    """Two boxes of a bar overlap by half: I_xx = m (b^2 + c^2) / 12."""
    bar = trimesh.util.concatenate([box((0.04, 0.02, 0.01)), box((0.04, 0.02, 0.01), (0.02, 0, 0))])
    a, b, c = 0.06, 0.02, 0.01
    found = mass_properties(bar, (), density=1000.0)
    expected = found.mass / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    assert found.mass == pytest.approx(1000 * a * b * c)
    np.testing.assert_allclose(found.inertia, expected, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(
    "bodies",
    [
        [box(BLOCK)],
        [box(BLOCK), box(BLOCK, BESIDE)],
        [HOLLOW],
        [ball(0.05), box((1e-4, 1e-4, 1e-4)), inside_out(box((1e-4, 1e-4, 1e-4), BESIDE))],  # debris of a scan
    ],
)
def test_bodies_that_are_apart_and_debris_are_returned_unchanged(bodies: list[trimesh.Trimesh]) -> None:
    mesh = trimesh.util.concatenate(bodies)
    assert turn_outwards(mesh)[0] is mesh
    assert unite_bodies(mesh) is mesh


def test_a_cavity_belongs_to_the_body_around_all_of_it() -> None:
    """A smaller box overlaps a corner of the cavity of 30 x 20 x 10 mm: by 10 x 10 x 5 mm."""
    corner = box((0.02, 0.02, 0.01), (0.015, 0.01, 0.005))
    mesh = trimesh.util.concatenate([HOLLOW, corner])
    assert unite_bodies(mesh).volume == pytest.approx(5.4e-5 + 0.5e-6, rel=1e-5)


def test_a_cavity_belongs_to_the_smallest_body_around_it() -> None:
    """The ball in the cavity of another ball has a cavity of its own."""
    radii = (0.05, 0.04, 0.03, 0.02)
    balls = [ball(radius) if number % 2 == 0 else inside_out(ball(radius)) for number, radius in enumerate(radii)]
    mesh = trimesh.util.concatenate(balls)
    assert turn_outwards(mesh)[1] == 0
    assert unite_bodies(mesh).volume == pytest.approx(mesh.volume, rel=1e-6)


def test_winding_numbers_count_the_bodies_around_a_point() -> None:
    mesh = trimesh.util.concatenate([ball(0.05), ball(0.04), inside_out(ball(0.01, x=0.1))])
    points = np.array([[0, 0, 0], [0.045, 0, 0], [0.1, 0, 0], [0, 0.2, 0]])
    np.testing.assert_allclose(winding_numbers(mesh, points), [2, 1, -1, 0], atol=1e-9)


def test_a_cavity_that_touches_the_surface_of_its_body_stays() -> None:
    """A tetrahedron with a corner on the top of a box, which touches another box."""
    corners = [(0, 0, 0.015), (0.005, 0, 0), (-0.005, 0.005, 0), (-0.005, -0.005, 0)]
    cavity = inside_out(trimesh.convex.convex_hull(np.array(corners)))
    mesh = trimesh.util.concatenate([box(BLOCK), cavity, box(BLOCK, (0.05, 0, 0))])
    assert unite_bodies(mesh).volume == pytest.approx(12e-5 + cavity.volume)


def test_cavities_that_overlap_are_united() -> None:
    """Their volume is larger than that of their body, which touches another one."""
    cavities = [inside_out(box((0.03, 0.03, 0.02), (x, 0, 0))) for x in (-0.005, 0, 0.005)]
    mesh = trimesh.util.concatenate([box(BLOCK), *cavities, box(BLOCK, (0.05, 0, 0))])
    assert unite_bodies(mesh).volume == pytest.approx(12e-5 - 0.04 * 0.03 * 0.02, rel=1e-6)


def test_uniting_many_bodies_needs_little_memory() -> None:
    """Arrays of all pairs of bodies would need 50 MB."""
    count = 2500
    places = np.stack(np.meshgrid(*[np.arange(14)] * 3), axis=-1).reshape(-1, 3)[:count]
    one = box((0.4, 0.4, 0.4))
    vertices = (one.vertices + places[:, None]).reshape(-1, 3)
    faces = (one.faces + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    tracemalloc.start()
    try:
        assert unite_bodies(mesh) is mesh
        assert tracemalloc.get_traced_memory()[1] < 25e6
    finally:
        tracemalloc.stop()
