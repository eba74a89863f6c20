"""Mass and inertia against closed forms, and invalid meshes."""

import numpy as np
import pytest
import trimesh

from mitsplat.errors import InputError
from mitsplat.geometry.mesh import contact_points, mass_properties, prepare_mesh
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
