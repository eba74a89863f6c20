"""Asset folders: units, axes and masses, round trips, and refused input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.mesh_files.mesh_reading import read_mesh

DATA = Path(__file__).parents[2] / "shared/data/splats"
SIZE = (0.06, 0.04, 0.02)
AXES = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1)}


def surface_splats(mesh: trimesh.Trimesh, count: int = 400, opacity: float = 0.9) -> Splats:
    rng = np.random.default_rng(0)
    points = np.vstack([mesh.vertices, trimesh.sample.sample_surface(mesh, count - len(mesh.vertices), seed=0)[0]])
    return Splats(
        means=points,
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(1e-4, 1e-3, (count, 3)),
        opacities=np.full(count, opacity),
        sh=rng.uniform(-0.5, 0.5, (count, 4, 3)),
    )


def with_materials(asset: Asset, *, normals: bool = False) -> Asset:
    """Return the asset with a base colour and a material per Gaussian; rows of materials are multiples of 1/255."""
    count, rng = len(asset.splats), np.random.default_rng(1)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = (np.float32(rng.integers(0, 256, count)) / 255 for _ in range(3))
    materials = SplatMaterials(*values, directions if normals else None)
    return replace(asset, splats=replace(asset.splats, sh=asset.splats.sh[:, :1], materials=materials))


@pytest.fixture(scope="module")
def asset() -> Asset:
    mesh = trimesh.creation.box(SIZE)
    left, right = (trimesh.creation.box((0.03, 0.04, 0.02)).apply_translation((x, 0, 0)) for x in (-0.015, 0.015))
    return Asset(
        "brick", "block", surface_splats(mesh), mesh, (left, right), density=2700.0, friction=0.7, roughness=0.2
    )


def write(folder: Path, text: str, **files: bytes) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "asset.yaml").write_text(text)
    for name, data in files.items():
        (folder / name.replace("_", ".")).write_bytes(data)
    return folder


def test_an_interrupted_save_leaves_the_earlier_or_the_new_asset(asset, tmp_path, monkeypatch):
    """Splats of one asset are never read with the mesh of the other."""
    asset.save(tmp_path)

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(trimesh.Trimesh, "export", stop)
    with pytest.raises(KeyboardInterrupt):
        asset.scaled(2.0).save(tmp_path)
    monkeypatch.undo()
    earlier = Asset.load(tmp_path)
    np.testing.assert_allclose(earlier.mesh.extents, asset.mesh.extents, rtol=1e-5)
    np.testing.assert_allclose(earlier.splats.scales, asset.splats.scales, rtol=1e-5)


class TestRoundTrip:
    @pytest.mark.parametrize(("splats", "tolerance"), [("splats.ply", 1e-8), ("splats.spz", 1e-8), ("a.splat", 1e-8)])
    def test_saved_assets_keep_splats_and_mesh(self, asset, tmp_path, splats, tolerance):
        asset.save(tmp_path / "a", splats=splats)
        loaded = Asset.load(tmp_path / "a")
        assert np.abs(loaded.splats.means - asset.splats.means).max() < tolerance
        assert np.abs(np.log(loaded.splats.scales / asset.splats.scales)).max() < 0.0313
        assert np.allclose(loaded.mesh.bounds, asset.mesh.bounds, atol=1e-8) and loaded.mesh.is_watertight
        assert len(loaded.pieces) == 2
        for piece, original in zip(sorted(loaded.pieces, key=lambda p: p.bounds[0, 0]), asset.pieces, strict=True):
            assert np.allclose(piece.bounds, original.bounds, atol=1e-8) and piece.is_watertight

    @pytest.mark.parametrize("splats", ["splats.ply", "splats.spz", "a.splat"])
    def test_saved_assets_keep_the_material_of_each_gaussian(self, asset, tmp_path, splats):
        given_asset = with_materials(asset, normals=True)
        given_asset.save(tmp_path, splats=splats)
        loaded = Asset.load(tmp_path).splats
        assert np.abs(loaded.means - asset.splats.means).max() < 1e-8  # the Gaussians keep their order
        for name in ("metallic", "roughness", "specular"):
            np.testing.assert_array_equal(getattr(loaded.materials, name), getattr(given_asset.splats.materials, name))
        np.testing.assert_allclose(loaded.materials.normals, given_asset.splats.materials.normals, atol=1e-6)
        assert loaded.materials.select([3]).metallic == given_asset.splats.materials.metallic[3]
        assert "roughness" not in (tmp_path / "asset.yaml").read_text()  # it would have no effect

    def test_scaled_and_turned_assets_keep_their_materials(self, asset, tmp_path):
        given_asset = replace(with_materials(asset, normals=True), units="unknown")
        given_asset.save(tmp_path)
        write(tmp_path, (tmp_path / "asset.yaml").read_text().replace("up: z", "up: y"))
        for changed in (Asset.load(tmp_path), Asset.load(tmp_path).resized(0.3), Asset.load(tmp_path).scaled(2.0)):
            found, expected = changed.splats.materials, given_asset.splats.materials
            np.testing.assert_array_equal(found.roughness, expected.roughness)
            x, y, z = expected.normals.T
            np.testing.assert_allclose(found.normals, np.stack([x, -z, y], axis=1), atol=1e-6)

    def test_saved_assets_keep_their_properties(self, asset, tmp_path):
        contact = {"restitution": 0.6, "rolling_friction": 1e-5, "torsional_friction": 0.0}
        environment = replace(asset, kind="environment", mesh=None, pieces=())
        for given_asset in (asset, environment, replace(asset, mass=0.3), replace(asset, **contact)):
            given_asset.save(tmp_path / "a")
            loaded = Asset.load(tmp_path / "a")
            properties = ("name", "class_name", "kind", "mass", "friction", "roughness", "specular", "capture_light")
            for name in (*properties, *contact):
                assert getattr(loaded, name) == getattr(given_asset, name)
            assert loaded.mass is not None or loaded.density == given_asset.density
            assert loaded.folder == tmp_path / "a"

    def test_pieces_that_share_a_face_stay_separate(self, asset, tmp_path):
        asset.save(tmp_path)
        assert [round(p.volume, 9) for p in Asset.load(tmp_path).pieces] == [round(p.volume, 9) for p in asset.pieces]

    def test_faces_of_a_piece_that_meet_only_in_vertices_are_one_piece(self, asset, tmp_path):
        """Qhull can leave such faces, on edges of more than two faces, in the hull of finely meshed curved parts."""
        one, other = (piece.copy() for piece in asset.pieces)
        stray = trimesh.Trimesh(one.vertices, [*one.faces, one.faces[0][::-1], one.faces[5]], process=False)
        assert len(stray.split(only_watertight=False, repair=False)) > 1
        replace(asset, pieces=(other, stray)).save(tmp_path)
        found = Asset.load(tmp_path).pieces
        assert [round(piece.volume, 9) for piece in found] == [round(piece.volume, 9) for piece in (other, one)]
        assert all(piece.is_watertight for piece in found)

    @pytest.mark.parametrize("stray", [False, True])
    @pytest.mark.parametrize("common", [1, 2])
    def test_closed_pieces_with_common_vertices_stay_apart(self, asset, tmp_path, common, stray):
        """Programs that merge equal vertices weld pieces that touch. One hull of both would fill the space between."""
        ball = trimesh.creation.icosphere(1, radius=0.01)
        middle = ball.vertices[ball.edges[0, :common]].mean(axis=0)
        both = trimesh.util.concatenate([ball, ball.copy().apply_translation(2 * middle)])
        both.merge_vertices()
        assert len(both.vertices) == 2 * len(ball.vertices) - common
        if stray:  # a face that shares no edge with others
            corners = [ball.vertices[np.argmin(ball.vertices @ axis)] for axis in np.eye(3) * np.sign(middle + 1e-9)]
            face = [int(np.argmin(np.linalg.norm(both.vertices - corner, axis=1))) for corner in corners]
            both = trimesh.Trimesh(both.vertices, [*both.faces, face], process=False)
        replace(asset, pieces=(ball,)).save(tmp_path)
        both.export(tmp_path / "pieces.ply")
        pieces = Asset.load(tmp_path).pieces
        assert [piece.volume for piece in pieces] == pytest.approx([ball.volume, ball.volume], rel=1e-4)

    def test_assets_that_could_not_be_read_are_not_saved(self, asset, tmp_path):
        for change, sentence in [
            ({"mesh": None, "pieces": ()}, "an object needs a mesh"),
            ({"friction": -1.0}, "friction: .*greater than or equal to 0"),
            ({"roughness": 0.0}, "roughness: .*greater than 0"),
        ]:
            with pytest.raises(InputError, match=f"asset 'brick' cannot be saved: {sentence}"):
                replace(asset, **change).save(tmp_path / "a")
        assert not (tmp_path / "a").exists()
        (tmp_path / "file").touch()
        with pytest.raises(InputError, match="cannot be written"):
            asset.save(tmp_path / "file")


class TestUnitsAndAxes:
    @pytest.mark.parametrize("up", AXES)
    def test_the_up_axis_is_rotated_to_z(self, asset, tmp_path, up):
        asset.save(tmp_path)
        text = (tmp_path / "asset.yaml").read_text()
        write(tmp_path, text.replace("up: z", f"up: {up}"))
        loaded = Asset.load(tmp_path)
        for turned, original in (
            (loaded.splats.means, asset.splats.means),
            (loaded.mesh.vertices, asset.mesh.vertices),
        ):
            assert np.allclose(turned[:, 2], original @ AXES[up], atol=1e-7)
        # Rotations preserve the sign of a triple product. A mirror image would change the sign.
        triple = np.linalg.det(asset.splats.means[8:11]), np.linalg.det(loaded.splats.means[8:11])
        assert triple[0] == pytest.approx(triple[1], rel=1e-3)

    def test_unknown_units_stay_unknown_until_a_size_is_given(self, asset, tmp_path):
        replace(asset, units="unknown").save(tmp_path, splats="splats.spz")
        loaded = Asset.load(tmp_path)
        assert loaded.units == "unknown"
        np.testing.assert_allclose(loaded.mesh.extents, asset.mesh.extents, rtol=1e-6)
        sized = loaded.resized(0.3)
        assert sized.units == "metre"
        assert sized.mesh.extents.max() == pytest.approx(0.3)
        assert sized.mass == asset.mass
        with pytest.raises(InputError, match="is in metres: it takes a scale, not a size"):
            sized.resized(0.3)
        write(tmp_path, (tmp_path / "asset.yaml").read_text() + "size: 0.2\n")
        assert Asset.load(tmp_path).mesh.extents.max() == pytest.approx(0.2)
        assert Asset.load(tmp_path).units == "metre"

    @pytest.mark.parametrize(("key", "factor"), [("units: 0.001", 0.001), ("size: 0.3", 0.3 / 0.06), ("", 1.0)])
    def test_units_and_size_scale_the_asset(self, asset, tmp_path, key, factor):
        asset.save(tmp_path)
        write(tmp_path, (tmp_path / "asset.yaml").read_text().replace("units: 1.0", key))
        loaded = Asset.load(tmp_path)
        assert np.allclose(loaded.mesh.extents, np.multiply(SIZE, factor))
        assert np.allclose(loaded.splats.means, factor * asset.splats.means)
        assert np.allclose(loaded.splats.scales, factor * asset.splats.scales)
        assert loaded.pieces[0].volume == pytest.approx(factor**3 * asset.pieces[0].volume)
        assert loaded.density == 2700.0

    def test_the_size_of_an_environment_is_that_of_its_opaque_splats(self, asset, tmp_path):
        asset.splats.save(tmp_path / "a.ply")
        write(tmp_path, "name: room\nkind: environment\nsplats: a.ply\nsize: 6\n")
        assert np.allclose(np.ptp(Asset.load(tmp_path).splats.bounds, axis=0), np.multiply(SIZE, 100), rtol=1e-3)

    def test_scaling_an_asset_scales_mass_mesh_and_splats(self, asset):
        heavy = replace(asset, mass=0.5).scaled(2.0)
        assert heavy.mass == 4.0 and np.allclose(heavy.mesh.extents, np.multiply(SIZE, 2))
        assert heavy.pieces[0].volume == pytest.approx(8 * asset.pieces[0].volume)
        assert np.allclose(heavy.splats.scales, 2 * asset.splats.scales)
        assert asset.scaled(2.0).density == asset.density and np.allclose(asset.mesh.extents, SIZE)
        for factor in (0.0, -1.0, np.nan, np.inf):
            with pytest.raises(ValueError, match="scale factor"):
                asset.scaled(factor)


class TestHull:
    def test_the_hull_omits_faint_splats_and_floaters(self, asset, tmp_path):
        box = trimesh.creation.box((1, 1, 1))
        faint = surface_splats(box, 50, opacity=0.3)
        floaters = surface_splats(box, 9, opacity=0.9).select(slice(3))
        splats = Splats.concatenate([surface_splats(asset.mesh, 2000), faint, floaters])
        splats.save(tmp_path / "a.ply")
        write(tmp_path, "name: brick\nsplats: a.ply\nmesh: hull\n")
        assert np.allclose(Asset.load(tmp_path).mesh.extents, SIZE, rtol=1e-5)

    def test_a_hull_without_volume_is_refused(self, asset, tmp_path):
        for splats in (asset.splats.select(slice(3)), replace(asset.splats, opacities=np.full(400, 0.1))):
            splats.save(tmp_path / "a.ply")
            write(tmp_path, "name: brick\nsplats: a.ply\nmesh: hull\n")
            with pytest.raises(InputError, match=r"asset.yaml:3: mesh: a hull needs points that span a volume"):
                Asset.load(tmp_path)

    @pytest.mark.skipif(not DATA.is_dir(), reason="the shared test data is not here")
    def test_a_published_capture_is_upright_with_its_size(self, tmp_path):
        (tmp_path / "plant.splat").symlink_to(DATA / "plant.splat")
        write(tmp_path, "name: plant\nsplats: plant.splat\nmesh: hull\nup: -y\nsize: 0.2\n")
        with pytest.raises(InputError, match=r"asset.yaml:2: splats: must be a file inside"):
            Asset.load(tmp_path)
        (tmp_path / "plant.splat").unlink()
        (tmp_path / "plant.splat").write_bytes((DATA / "plant.splat").read_bytes())
        plant = Asset.load(tmp_path)
        assert plant.mesh.extents.max() == pytest.approx(0.2) and plant.mesh.extents.argmax() == 2
        assert plant.mesh.is_watertight and plant.check() == ()
        # Green leaves above, brown soil and a pale pot below.
        opaque = plant.splats.select(plant.splats.opacities > 0.5)
        greenness, above = opaque.sh[:, 0, 1] - opaque.sh[:, 0, 0], opaque.means[:, 2] > 0
        assert greenness[above].mean() > 0.1 and greenness[~above].mean() < 0


class TestCheck:
    def test_a_consistent_asset_has_no_findings(self, asset):
        assert asset.check() == ()

    def test_inconsistent_assets_have_findings(self, asset):
        shifted = np.eye(4)
        shifted[0, 3] = 0.01
        assert (
            "bounds of splats and mesh differ by 0.01 m"
            in replace(asset, splats=asset.splats.transformed(shifted)).check()[0]
        )
        assert "bounds of pieces and mesh" in replace(asset, pieces=asset.pieces[:1]).check()[0]
        open_mesh = trimesh.Trimesh(asset.mesh.vertices, asset.mesh.faces[1:])
        assert "not closed" in replace(asset, mesh=open_mesh).check()[0]


class TestBadInput:
    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            ("name: a\nsplats: a.ply\n", r"asset.yaml(:\d+)?: mesh: an object needs a mesh"),
            ("name: a\nsplats: a.ply\nmesh: hull\nmas: 1\n", r"asset.yaml:4: mas: is not a known key.*'mass'"),
            ("splats: a.ply\nmesh: hull\n", "name: is required"),
            ("name: a\nsplats: a.ply\nmesh: hull\nunits: 1\nsize: 2\n", "asset.yaml:5: size: must not be .* units"),
            ("name: a\nsplats: a.ply\nmesh: hull\nmass: 1\ndensity: 2\n", "asset.yaml:4: mass: must not be .* density"),
            ("name: a\nsplats: a.ply\nmesh: hull\nmass: 0\n", r"asset.yaml:4: mass: must be > 0 \(got 0\)"),
            ("name: a\nsplats: a.ply\nmesh: hull\nsize: .inf\n", "asset.yaml:4: size: must be"),
            ("name: a\nsplats: a.ply\nmesh: hull\nroughness: 2\n", "asset.yaml:4: roughness: must be <= 1"),
            ("name: a\nsplats: a.ply\nmesh: hull\nup: w\n", r"asset.yaml:4: up: must be .* \(got \"w\"\)"),
            ("name: a\nsplats: ../a.ply\nmesh: hull\n", r"asset.yaml:2: splats: must be a file inside"),
            ("name: a\nsplats: /etc/passwd\nmesh: hull\n", r"asset.yaml:2: splats: must be a file inside"),
            ("name: a\nsplats: b.ply\nmesh: hull\n", r"asset.yaml:2: splats: no such file \(got b.ply\)"),
            ("name: a\nsplats: bad.ply\nmesh: hull\n", r"bad.ply: a PLY file must have a header"),
            ("name: a\nsplats: a.ply\nmesh: b.ply\n", r"asset.yaml:3: mesh: no such file"),
            ("name: a\nsplats: a.ply\nmesh: bad.ply\n", r"bad.ply: not a valid mesh file"),
            ("name: a\nsplats: a.ply\nmesh: a.ply\n", r"a.ply: a mesh must have triangles"),
            ("name: a\nsplats: a.ply\nmesh: asset.yaml\n", r"asset.yaml: not a valid mesh file"),
            ("name: a\nsplats: a.ply\nmesh: hull\npieces: flat.ply\n", "flat.ply: a hull needs points"),
            ("name: a\nsplats: a.ply\nkind: environment\nsize: 1\n", None),
            ("name: [\n", "asset.yaml:2: not YAML"),
        ],
    )
    def test_an_invalid_asset_is_refused_in_one_sentence_with_its_place(self, asset, tmp_path, text, sentence):
        asset.splats.save(tmp_path / "a.ply")
        flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        write(tmp_path, text, bad_ply=b"ply nonsense", flat_ply=flat.export(file_type="ply"))
        if sentence is None:
            assert Asset.load(tmp_path).mesh is None
            return
        with pytest.raises(InputError, match=sentence) as error:
            Asset.load(tmp_path)
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize(
        ("before", "after", "sentence"),
        [
            (b"uchar metallic", b"uchar metal___", "must have the uchar vertex properties metallic$"),
            (b"uchar roughness", b"char roughness ", "must have the uchar vertex properties roughness$"),
            (b"float ny", b"float xy", "must have the float vertex properties ny$"),
            (b"float nz", b"float nx", "nx"),
            (b"vertex 400", b"vertex 399", r"must have one vertex per Gaussian, 400 \(got 399\)"),
            (b"binary_little_endian", b"ascii", r"must be binary \(got ascii\)"),
            (
                b"end_header\n",
                b"end_header\n" + bytes(1 << 17),
                r"materials of 400 Gaussians must have at most \d+ bytes",
            ),
            (b"end_header\n", b"end_header\n\0\0\0" + bytes(12), r"normals must have length 1 \(got 0 at row 0\)"),
            (b"ply\n", b"pl\n", "a PLY file must have a header"),
        ],
    )
    def test_materials_that_break_a_rule_are_refused(self, asset, tmp_path, before, after, sentence):
        with_materials(asset, normals=True).save(tmp_path)
        stored = (tmp_path / "materials.ply").read_bytes()
        (tmp_path / "materials.ply").write_bytes(stored.replace(before, after, 1))
        with pytest.raises(InputError, match=f"materials.ply: .*{sentence}") as error:
            Asset.load(tmp_path)
        assert "\n" not in str(error.value)

    def test_materials_without_a_row_per_gaussian_or_with_higher_bands_are_refused(self, asset, tmp_path):
        with_materials(asset).save(tmp_path)
        stored = (tmp_path / "materials.ply").read_bytes()
        (tmp_path / "materials.ply").write_bytes(stored[:-1])
        with pytest.raises(InputError, match=r"states 400 Gaussians in at least 1200 bytes \(got 1199 bytes\)"):
            Asset.load(tmp_path)
        (tmp_path / "materials.ply").write_bytes(stored)
        asset.splats.save(tmp_path / "splats.ply")
        with pytest.raises(InputError, match=r"splats with materials must have SH degree 0 \(got 1\)"):
            Asset.load(tmp_path)
        (tmp_path / "materials.ply").unlink()
        with pytest.raises(InputError, match=r"asset.yaml:\d+: materials: no such file \(got materials.ply\)"):
            Asset.load(tmp_path)

    def test_a_missing_asset_folder_is_refused(self, tmp_path):
        with pytest.raises(InputError, match=r"none: no such folder"):
            Asset.load(tmp_path / "none")

    def test_mesh_vertices_that_are_not_finite_are_refused(self, tmp_path):
        (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n")
        with pytest.raises(InputError, match=r"a.obj: (vertices must be finite|a mesh must have triangles)"):
            read_mesh(tmp_path / "a.obj", merge=False)

    @settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(
        form=st.sampled_from(["ply", "stl", "obj", "glb", "off"]),
        keep=st.floats(0, 1),
        changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4),
    )
    def test_random_damage_of_meshes_is_refused_or_gives_valid_assets(self, tmp_path, form, keep, changes):
        """The test covers the reader itself, without the preceding check in a child process."""
        whole = trimesh.creation.box().export(file_type=form)
        data = bytearray(whole.encode() if isinstance(whole, str) else whole)
        for place, value in changes:
            data[int(place * len(data))] = value
        path = tmp_path / f"a.{form}"
        path.write_bytes(data[: int(keep * len(data))])
        try:
            mesh = read_mesh(path)
        except InputError as error:
            assert str(error).startswith(str(path))
        else:
            assert len(mesh.faces) and np.isfinite(mesh.vertices).all()
