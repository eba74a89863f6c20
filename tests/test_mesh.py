"""Convex pieces, mass and inertia against closed forms."""

from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh

from mitsplat import mesh as mesh_module
from mitsplat.errors import InputError
from mitsplat.mesh import contact_points, convex_pieces, mass_properties, prepare_mesh, simplify_solid
from mitsplat.mesh_distance import Surface, standoff

PARTS = Path(__file__).parents[1] / "scenes/assets"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mitsplat/pieces"


@pytest.fixture(scope="module")
def bracket():
    """An L of two plates, 40 x 20 x 4 and 4 x 20 x 30 mm."""
    floor, wall = trimesh.creation.box((0.04, 0.02, 0.004)), trimesh.creation.box((0.004, 0.02, 0.03))
    wall.apply_translation((-0.018, 0, 0.013))
    return trimesh.boolean.union([floor, wall])


def _inside(hull, point):
    return bool((np.einsum("ij,ij->i", hull.face_normals, point - hull.triangles[:, 0]) < 0).all())


def test_a_convex_solid_is_its_own_piece():
    box = trimesh.creation.box((0.01, 0.02, 0.03))
    (piece,) = convex_pieces(box)
    assert piece.volume == pytest.approx(box.volume, rel=1e-9)


def test_pieces_fill_a_concave_solid_and_nothing_else(bracket):
    pieces = convex_pieces(bracket)
    assert len(pieces) >= 2
    assert all(piece.is_convex for piece in pieces)
    assert sum(piece.volume for piece in pieces) == pytest.approx(bracket.volume, rel=0.03)
    # The hull is three times the volume: its middle must stay free.
    middle = np.array([0.0, 0.0, 0.005])
    assert _inside(bracket.convex_hull, middle)
    assert not any(_inside(piece, middle) for piece in pieces)


def test_separate_parts_are_split_apart():
    apart = trimesh.util.concatenate([trimesh.creation.box((0.01,) * 3), trimesh.creation.icosphere(2, 0.01)])
    apart.vertices[:8] += 0.05
    assert len(convex_pieces(apart)) == 2


def test_pieces_are_kept_on_disk_and_damaged_files_made_anew(cache, bracket, caplog):
    shifted = bracket.copy().apply_translation((0.001, 0, 0))  # not yet in memory
    first = convex_pieces(shifted)
    (path,) = cache.iterdir()
    again = np.load(path)
    assert len(again.files) == 2 * len(first)
    np.testing.assert_array_equal(again["vertices_0"], first[0].vertices)

    from mitsplat.mesh import _cached_pieces

    _cached_pieces.cache_clear()
    path.write_bytes(path.read_bytes()[:100])
    assert [piece.volume for piece in convex_pieces(shifted)] == [piece.volume for piece in first]
    assert "made anew" in caplog.text


def test_mass_and_inertia_of_a_box():
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


def test_an_open_mesh_takes_its_mass_from_its_pieces():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    lidless = box.copy()
    lidless.update_faces(lidless.face_normals[:, 2] < 0.5)
    assert not lidless.is_watertight
    assert mass_properties(lidless, (box,), density=1000.0).mass == pytest.approx(1.0)


def test_a_mesh_inside_out_is_turned():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.invert()
    assert prepare_mesh(box, "box").volume == pytest.approx(1e-3)


def test_a_missing_triangle_is_put_back():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.update_faces(np.arange(len(box.faces)) != 3)
    assert prepare_mesh(box, "box").is_volume


def test_repairs_are_told_in_a_sentence_each(caplog):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.invert()
    box.update_faces((box.face_normals[:, 2] < 0.5) & (box.face_normals[:, 0] < 0.5))
    prepare_mesh(box, "box")
    assert [record.message for record in caplog.records] == [
        "box: the mesh is wound inside out; physics turns its faces",
        "box: the mesh is not closed; mass and inertia are those of its convex pieces",
    ]


@pytest.mark.slow
def test_a_million_triangles_are_simplified(caplog):
    """The volume of a ball of 1.3 M triangles stays within 0.1 %."""
    ball = trimesh.creation.icosphere(8, 0.05)
    assert len(ball.faces) > 1e6
    simple = prepare_mesh(ball, "ball")
    assert len(simple.faces) <= 200_000
    assert simple.volume == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=1e-3)
    assert caplog.records[-1].message == "ball: physics simplifies the mesh of 1310720 to 200000 triangles"


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
def test_useless_meshes_are_refused_by_name(mesh, message):
    with pytest.raises(InputError, match=f"nut: .*{message}"):
        prepare_mesh(mesh, "nut")


def test_contact_points_are_dense_along_edges():
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    points = contact_points(box)
    assert len(points) == 8 + 12 * 39  # every 0.5 mm of 20
    at_edge = (np.abs(np.abs(points) - 0.01) < 1e-12).sum(axis=1)
    assert (at_edge >= 2).all()
    along = np.sort(points[np.linalg.norm(points[:, :2] - 0.01, axis=1) < 1e-9, 2])
    np.testing.assert_allclose(np.diff(along), 0.0005)


def test_scan_that_lacks_a_triangle_is_closed_first():
    """CoACD would rebuild an open mesh of voxels: slowly, and too thick."""
    ball = trimesh.creation.icosphere(3, 0.05)
    torn = trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False)
    (piece,) = convex_pieces(torn)
    assert piece.volume == pytest.approx(ball.volume, rel=1e-6)


def scanned_angle() -> trimesh.Trimesh:
    """An L of two plates as a scanner sees it: 7168 triangles, 0.02 mm of noise."""
    outline = shapely.box(0, 0, 0.06, 0.01).union(shapely.box(0, 0, 0.01, 0.05))
    solid = trimesh.creation.extrude_polygon(outline, 0.03)
    for _ in range(4):
        solid = solid.subdivide()
    noise = np.random.default_rng(0).normal(size=solid.vertices.shape) * 2e-5
    return trimesh.Trimesh(solid.vertices + noise, solid.faces, process=False)


def test_scan_is_thinned_before_it_is_split_and_its_pieces_follow_it():
    scan = scanned_angle()
    assert scan.is_volume
    assert len(scan.faces) > 5000
    thin = simplify_solid(scan, 1e-4)
    assert thin.is_volume
    assert len(thin.faces) < 0.1 * len(scan.faces)
    truth = Surface(scan)
    assert np.abs(truth.signed_distances(np.concatenate([thin.vertices, thin.sample(2000, seed=0)]))).max() < 2e-4
    pieces = convex_pieces(scan)
    assert standoff(truth, pieces) < 6.4e-4
    # Nor does the scan reach out of its pieces by more than objects may sink into a table.
    outside = [
        np.einsum("fvd,fd->vf", scan.vertices - piece.triangles[:, :1], piece.face_normals).max(axis=1)
        for piece in pieces
    ]
    assert np.min(outside, axis=0).max() < 3e-4


def test_what_is_ragged_is_followed_coarsely(caplog):
    """In fine pieces it has more than 300, which take minutes."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    factors = 1 + np.random.default_rng(1).uniform(-0.2, 0.2, (len(ball.vertices), 1))
    pieces = convex_pieces(trimesh.Trimesh(ball.vertices * factors, ball.faces, process=False))
    assert 8 < len(pieces) < 64
    assert "a mesh of 320 faces is ragged" in caplog.text


@pytest.mark.parametrize("name", ["hex_bolt", "proximity_sensor", "spur_gear"])
def test_parts_are_not_ragged(name):
    assert mesh_module._valleys(trimesh.load_mesh(PARTS / name / "mesh.ply")) < 0.15
