"""Mass and inertia against closed forms, and invalid meshes."""

import numpy as np
import pytest
import trimesh

from mitsplat.errors import InputError
from mitsplat.geometry.mesh import contact_points, is_closed, mass_properties, prepare_mesh
from mitsplat.geometry.mesh_distance import DistanceSurface


def test_mass_and_inertia_of_a_box_equal_their_closed_forms():
    # I_xx = m (b^2 + c^2) / 12
    a, b, c = 0.02, 0.03, 0.05
    box = trimesh.creation.box((a, b, c))
    box.apply_translation((1.0, 2.0, 3.0))
    found = mass_properties(box, (), density=2700.0)
    mass = 2700.0 * a * b * c
    assert found.mass == pytest.approx(mass)
    np.testing.assert_allclose(found.centre, (1, 2, 3))
    expected = mass / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(found.inertia, expected, rtol=1e-6, atol=1e-12 * mass)


def test_a_given_mass_overrules_density():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    found = mass_properties(box, (), density=1.0, mass=3.0)
    assert found.mass == pytest.approx(3.0)
    np.testing.assert_allclose(np.diag(found.inertia), 3.0 * 0.02 / 12)
    box.density = 7800.0  # a density that the mesh itself states is ignored
    np.testing.assert_allclose(mass_properties(box, (), density=1.0, mass=3.0).inertia, found.inertia)


def test_an_open_mesh_has_the_mass_of_its_pieces():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    lidless = box.copy()
    lidless.update_faces(lidless.face_normals[:, 2] < 0.5)
    assert not lidless.is_watertight
    assert mass_properties(lidless, (box,), density=1000.0).mass == pytest.approx(1.0)


def test_an_inverted_mesh_is_repaired():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.invert()
    assert prepare_mesh(box, "box").volume == pytest.approx(1e-3)


def test_a_missing_triangle_is_restored():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.update_faces(np.arange(len(box.faces)) != 3)
    assert prepare_mesh(box, "box").is_volume


def test_an_open_mesh_far_from_its_origin_keeps_its_faces(caplog):
    lidless = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide()  # a hole of eight edges is not filled
    lidless.update_faces(lidless.face_normals[:, 2] < 0.5)
    lidless.apply_translation((0.2, 0, 1))
    np.testing.assert_allclose(prepare_mesh(lidless, "box").face_normals, lidless.face_normals, atol=1e-12)
    assert "inside out" not in caplog.text


def test_scanned_surroundings_keep_their_faces():
    """A recess below z = 0 and a plane at z = 0, seen from above, are open; a closed slab has an outer side.

    Both openings have four edges, as those of removed slivers, but are not filled.
    """
    table = trimesh.creation.box((1, 1, 0.1))
    recess = trimesh.Trimesh(table.vertices - (0, 0, 0.05), table.faces[table.face_normals[:, 2] < 0.5][:, ::-1])
    plane = trimesh.Trimesh(table.vertices - (0, 0, 0.05), table.faces[table.face_normals[:, 2] > 0.5])
    for scan in (recess, plane):
        found = prepare_mesh(scan, "scan", solid=False)
        np.testing.assert_allclose(found.face_normals, scan.face_normals, atol=1e-12)
    np.testing.assert_array_less(
        0,
        DistanceSurface(prepare_mesh(recess, "scan", solid=False)).signed_distances(
            np.array([[0, 0, -0.09], [0.4, 0.4, -0.05]])
        ),
    )
    table.invert()
    assert prepare_mesh(table, "slab", solid=False).volume == pytest.approx(0.1)


def test_each_repair_is_logged_in_one_sentence(caplog):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.invert()
    box.update_faces((box.face_normals[:, 2] < 0.5) & (box.face_normals[:, 0] < 0.5))
    prepare_mesh(box, "box")
    assert [record.message for record in caplog.records] == [
        "box: the mesh is inside out; physics flips its faces",
        "box: the mesh is not closed; mass and inertia are those of its convex pieces",
    ]


def test_a_mesh_of_too_many_triangles_is_simplified(caplog):
    """A ball of 328,000 triangles keeps its volume within 0.1 %."""
    ball = trimesh.creation.icosphere(7, 0.05)
    simple = prepare_mesh(ball, "ball")
    assert len(simple.faces) <= 200_000
    assert simple.volume == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=1e-3)
    assert caplog.records[-1].message == "ball: physics simplifies the mesh of 327680 to 200000 triangles"


def test_unwelded_triangles_are_welded():
    soup = trimesh.creation.box((0.1, 0.1, 0.1))
    soup = trimesh.Trimesh(soup.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    assert not soup.is_watertight
    assert prepare_mesh(soup, "soup").is_watertight


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (trimesh.Trimesh(), "must have faces"),
        (trimesh.creation.box((200.0, 10.0, 10.0)), "got 200 m: wrong units"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "must enclose a volume"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False), "nan.* at vertex 2"),
    ],
)
def test_unusable_meshes_are_refused_by_name(mesh, message):
    with pytest.raises(InputError, match=f"nut: .*{message}"):
        prepare_mesh(mesh, "nut")


def test_contact_points_are_dense_along_edges():
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    points = contact_points(box)
    assert len(points) == 8 + 12 * 39  # one value per 0.5 mm of 20 mm
    at_edge = (np.abs(np.abs(points) - 0.01) < 1e-12).sum(axis=1)
    assert (at_edge >= 2).all()
    along = np.sort(points[np.linalg.norm(points[:, :2] - 0.01, axis=1) < 1e-9, 2])
    np.testing.assert_allclose(np.diff(along), 0.0005)


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
