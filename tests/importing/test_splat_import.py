"""Import of splat files from other programs, with planted axes, units and floaters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gaussforge
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mitsplat.asset import Asset
from mitsplat.cli import app
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import default_up_axis
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.importing.import_report import write_import_report, write_scene
from mitsplat.importing.import_result import Imported
from mitsplat.importing.splat_import import ImportSettings, import_splats
from mitsplat.importing.standing import cut_base, topples
from mitsplat.importing.upright import axis_vector, cut_support, find_up, rotation_to_z
from mitsplat.quality import KernelName
from mitsplat.reconstruct.surface import SurfaceSettings
from mitsplat.scene.loading.scene_loading import load_scene

COARSE = SurfaceSettings(voxels=48, faces=2000, blur=1.0)


def splats_on(mesh: trimesh.Trimesh, count: int, opacity: float = 0.98) -> Splats:
    surfels = place_surfels(mesh, 1.0, count, np.random.default_rng(0))
    return Splats(
        means=surfels.points,
        quats=surfels.quats,
        scales=surfels.scales,
        opacities=np.full(len(surfels), opacity),
        sh=np.zeros((len(surfels), 1, 3)),
    )


@pytest.fixture(scope="module")
def pin() -> trimesh.Trimesh:
    """Return a column on a foot, 0.5 high, starting at z = 0."""
    foot = trimesh.creation.box(bounds=[[-0.1, -0.15, 0], [0.1, 0.15, 0.1]])
    column = trimesh.creation.box(bounds=[[-0.05, -0.05, 0.05], [0.05, 0.05, 0.5]])
    return trimesh.boolean.union([foot, column], engine="manifold")


@pytest.fixture(scope="module")
def on_mat(pin: trimesh.Trimesh) -> Splats:
    """Return the pin on a mat of half a unit, z up."""
    mat = trimesh.creation.box(bounds=[[-0.25, -0.25, -0.001], [0.25, 0.25, 0.0]])
    return Splats.concatenate([splats_on(pin, 2500), splats_on(mat, 1500)])


def turned(splats: Splats, rotation: Rotation) -> Splats:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    return splats.transformed(matrix)


def test_the_smallest_rotation_takes_every_axis_up() -> None:
    for axis in ("x", "-x", "y", "-y", "z", "-z"):
        rotation = rotation_to_z(axis_vector(axis))
        assert np.allclose(rotation @ axis_vector(axis), (0, 0, 1))
        assert np.isclose(np.linalg.det(rotation), 1)
    with pytest.raises(InputError, match="got 'w'"):
        axis_vector("w")


@pytest.mark.parametrize("tilt", [0.0, 17.0])
def test_the_up_direction_of_a_tilted_capture_is_that_of_its_table(on_mat: Splats, tilt: float) -> None:
    rotation = Rotation.from_euler("zx", [tilt, 90], degrees=True)  # z up to -y, then tilted
    found = find_up(turned(on_mat, rotation), "object", "-y")
    assert np.degrees(np.arccos(found.up @ rotation.apply((0, 0, 1)))) < 0.5
    assert found.support is not None


def test_without_a_plane_the_up_direction_is_the_stated_one() -> None:
    ball = splats_on(trimesh.creation.icosphere(3, 0.1), 500)
    found = find_up(ball, "object", "y")
    assert np.allclose(found.up, (0, 1, 0))
    assert "as is usual" in found.reason
    assert np.allclose(find_up(ball, "object", "y", "-x").up, (-1, 0, 0))


@pytest.mark.parametrize(("comment", "up"), [("comment Vertical Axis: z\n", "z"), ("", "-y")])
def test_the_up_axis_that_nerfstudio_states_is_used(tmp_path: Path, comment: str, up: str) -> None:
    splats_on(trimesh.creation.icosphere(3, 0.1), 50).save(tmp_path / "a.ply")
    stored = (tmp_path / "a.ply").read_bytes().replace(b" 1.0\n", b" 1.0\n" + comment.encode(), 1)
    (tmp_path / "a.ply").write_bytes(stored)
    assert default_up_axis(tmp_path / "a.ply") == up


def test_the_floor_supports_surroundings_with_a_larger_wall() -> None:
    floor = trimesh.creation.box(bounds=[[-1, -1, -0.01], [1, 1, 0]])
    wall = trimesh.creation.box(bounds=[[-1, 1, 0], [1, 1.01, 3]])
    room = Splats.concatenate([splats_on(floor, 1500), splats_on(wall, 2500)])
    rotation = Rotation.from_euler("xy", [100, 5], degrees=True)
    found = find_up(turned(room, rotation), "environment", "-y")
    assert np.degrees(np.arccos(found.up @ rotation.apply((0, 0, 1)))) < 0.5


def test_the_table_is_removed_and_the_object_on_it_is_kept(on_mat: Splats) -> None:
    support = find_up(on_mat, "object", "z").support
    assert support is not None
    kept = cut_support(on_mat, support)
    means = on_mat.means
    beside = (np.abs(means[:, :2]) > (0.12, 0.17)).any(axis=1)
    assert not kept[beside].any()
    assert kept[means[:, 2] > 0.02].all()


@pytest.fixture(scope="module")
def file(on_mat: Splats, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the pin on its mat with y down, in units of 2, among floaters."""
    rotation = Rotation.from_euler("x", 90, degrees=True)
    lone = splats_on(trimesh.creation.icosphere(1, 0.01), 20)
    lone = replace(lone, means=lone.means + np.float32([0.2, 0.2, 0.45]))
    haze = replace(lone.select([0]), means=[[0, 0, 0.3]], scales=[[0.4, 0.4, 0.4]], opacities=[0.05])
    faint = replace(lone.select([0, 1]), opacities=[0.001, 0.0])
    scene = turned(Splats.concatenate([on_mat, lone, haze, faint]), rotation)
    path = tmp_path_factory.mktemp("file") / "pin.ply"
    scene.transformed(np.diag([2.0, 2.0, 2.0, 1.0])).save(path)
    return path


@pytest.fixture(scope="module")
def imported(file: Path) -> Imported:
    settings = ImportSettings(size=0.25, without_table=True, views=24, view_size=160, surface=COARSE)
    return import_splats(file, name="pin", settings=settings, mass=0.3)


def test_an_import_prints_on_one_line_without_arrays(imported: Imported) -> None:
    assert "\n" not in repr(imported) and "array" not in repr(imported)
    assert "Asset('pin'" in repr(imported)


def test_an_imported_object_is_upright_clean_and_to_scale(imported: Imported, pin: trimesh.Trimesh) -> None:
    asset = imported.asset
    assert imported.removed["invisible"] == 2
    assert imported.removed["haze and needles"] == 1
    assert imported.removed["floaters"] >= 15
    assert imported.removed["table"] > 1000
    assert len(imported.removed_splats) + len(asset.splats) == imported.found
    assert asset.mesh is not None
    assert asset.mesh.is_volume
    truth = pin.copy().apply_scale(0.5)
    assert np.allclose(asset.mesh.bounds, truth.bounds, atol=0.006)
    assert float(asset.mesh.extents.max()) == pytest.approx(0.25)
    assert abs(asset.mesh.volume / truth.volume - 1) < 0.15
    assert asset.units == "metre"
    assert asset.mass == 0.3
    assert asset.pieces
    assert not imported.topples
    assert imported.mesh_iou is not None
    assert imported.mesh_iou > 0.9


def test_asset_report_and_scene_of_an_import_are_complete(imported: Imported, tmp_path: Path) -> None:
    folder = tmp_path / "assets" / "pin"
    imported.asset.save(folder)
    assert len(Asset.load(folder).splats) == len(imported.asset.splats)
    page = write_import_report(folder, imported).read_text()
    assert "removed in red" in page
    assert "as is usual for such files" in page
    write_scene(tmp_path / "table.yaml", folder, imported)
    assert [asset.name for asset in load_scene(tmp_path / "table.yaml").assets] == ["pin"]
    for name in ("1001", "bolt: M8", "a, b", "#5", "yes", "-", "größe 'x\""):
        named = replace(imported, asset=replace(imported.asset, name=name))
        named.asset.save(folder.parent / name)
        write_scene(tmp_path / f"{name}.yaml", folder.parent / name, named)
        scene = load_scene(tmp_path / f"{name}.yaml")
        assert [asset.name for asset in scene.assets] == [scene.spec.name] == [name]
    with pytest.raises(InputError, match="must not exist yet"):
        write_scene(tmp_path / "table.yaml", folder, imported)
    with pytest.raises(InputError, match="below its own folder"):
        write_scene(tmp_path / "elsewhere" / "table.yaml", folder, imported)


def test_parts_below_the_base_are_removed(pin: trimesh.Trimesh) -> None:
    bulge = trimesh.creation.icosphere(3, 0.03)
    bulge.apply_translation((0.02, 0, 0.015))
    swollen = trimesh.boolean.union([pin, bulge], engine="manifold")
    assert topples(swollen)
    assert not topples(pin)
    cut, height = cut_base(Path("pin.ply"), swollen)
    assert cut.is_volume
    assert -0.01 < height <= cut.bounds[0, 2] + 1e-9 < 0.01
    assert not topples(cut)
    with pytest.raises(InputError, match="no base to stand on"):
        cut_base(Path("ball.ply"), trimesh.creation.cone(0.05, 0.5, transform=np.diag([1, -1, -1, 1])))


def test_imported_surroundings_get_a_support(tmp_path: Path) -> None:
    table = trimesh.creation.box(bounds=[[-0.6, -0.4, -0.02], [0.6, 0.4, 0]])
    box = trimesh.creation.box(bounds=[[0.3, 0.1, 0], [0.5, 0.3, 0.2]])
    rotation = Rotation.from_euler("zx", [30, 90], degrees=True)
    turned(Splats.concatenate([splats_on(table, 2500), splats_on(box, 500)]), rotation).save(tmp_path / "cell.ply")
    settings = ImportSettings(units=1.0, views=8, view_size=120, surface=COARSE)
    done = import_splats(tmp_path / "cell.ply", name="cell", kind="environment", settings=settings)
    assert done.support is not None
    assert sorted(done.support.size) == pytest.approx([0.8, 1.2], rel=0.08)
    top = np.abs(done.asset.splats.means[:, 2]) < 0.003
    assert np.ptp(done.asset.splats.means[top], axis=0)[:2] == pytest.approx([1.2, 0.8], abs=0.06)
    assert np.abs(done.asset.splats.means[top].mean(axis=0)).max() < 0.08
    assert done.asset.capture_light == "scene"
    done.asset.save(tmp_path / "assets" / "cell")
    write_scene(tmp_path / "cell.yaml", tmp_path / "assets" / "cell", done)
    scene = load_scene(tmp_path / "cell.yaml")
    assert scene.environments[0].name == "cell"
    assert scene.spec.region.max[0] <= 0.3


SMALL = ImportSettings(
    up="-y", units=0.1, views=8, view_size=64, surface=SurfaceSettings(voxels=24, faces=500, blur=1.0)
)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Imported]:
    """Write a hundred Gaussians on a block as .ply, imported as surroundings, which need no convex decomposition."""
    path = tmp_path_factory.mktemp("block") / "block.ply"
    splats_on(trimesh.creation.box((1.0, 0.8, 0.5)), 100).save(path)
    return path, import_splats(path, name="block", kind="environment", settings=SMALL)


@pytest.mark.parametrize(
    ("form", "precision"), [("spz", 2e-4), ("sog", 1e-4), ("ksplat", 1e-6), ("compressed.ply", 1e-3)]
)
def test_other_formats_import_as_ply_files_do(
    block: tuple[Path, Imported], tmp_path: Path, form: str, precision: float
) -> None:
    source, one = block
    path = tmp_path / f"block.{form}"
    path.write_bytes(gaussforge.GaussForge().convert(source.read_bytes(), "ply", form)["data"])
    other = import_splats(path, name="block", kind="environment", settings=SMALL)
    assert other.found == one.found and other.removed == one.removed
    splats, expected = other.asset.splats, one.asset.splats
    means, expected_means = (each.means - each.means.mean(axis=0) for each in (splats, expected))
    away, nearest = cKDTree(means).query(expected_means)  # some formats sort the Gaussians
    assert sorted(nearest) == list(range(len(expected)))
    assert away.max() < 0.1 * precision
    assert np.abs(splats.opacities[nearest] - expected.opacities).max() < 0.005
    assert one.support is not None and other.support is not None
    assert other.support.size == pytest.approx(one.support.size, abs=0.1 * precision * 4)


def test_surroundings_without_a_plane_are_imported_with_a_warning(tmp_path: Path) -> None:
    ball = splats_on(trimesh.creation.icosphere(3, 0.5), 100)
    ball.save(tmp_path / "ball.ply")
    settings = replace(SMALL, material={"metallic": 1.0})
    found = import_splats(tmp_path / "ball.ply", name="ball", kind="environment", settings=settings)
    splats = found.asset.splats
    assert splats.materials is not None
    assert (splats.sh_degree, splats.materials.metallic.min(), splats.materials.roughness[0]) == (0, 1, 0.5)
    np.testing.assert_allclose(splats.sh[:, 0].mean(axis=0), ball.sh[:, 0].mean(axis=0), atol=0.05)
    assert found.support is None
    assert any(miss.startswith("no horizontal surface was found") for miss in found.misses)


@pytest.mark.parametrize(
    ("kernel", "text"),
    [
        ("mip", "with antialiasing; scenes render it with `rendering: {kernel: mip}`"),
        ("gsplat", "{kernel: gsplat}"),
        (None, None),
    ],
)
def test_the_kernel_of_the_training_is_reported(
    imported: Imported, tmp_path: Path, kernel: KernelName | None, text: str | None
) -> None:
    asset = replace(imported.asset, splats=replace(imported.asset.splats, kernel=kernel))
    found = replace(imported, asset=asset, views=[])
    assert (found.training is None) == (text is None)
    page = write_import_report(tmp_path, found).read_text()
    assert ("Trained" in page) == (text is not None)
    assert text is None or text in (found.training or "")
    asset.save(tmp_path)
    assert Asset.load(tmp_path).splats.kernel == kernel


@pytest.mark.parametrize("form", ["spz", "sog", "ksplat", "compressed.ply"])
def test_truncated_files_are_refused_in_one_sentence(tmp_path: Path, form: str) -> None:
    splats_on(trimesh.creation.icosphere(2, 0.5), 100).save(tmp_path / "a.ply")
    data = gaussforge.GaussForge().convert((tmp_path / "a.ply").read_bytes(), "ply", form)["data"]
    path = tmp_path / f"torn.{form}"
    for torn in (b"", data[:30], data[: len(data) // 2], b"\0" * len(data)):
        path.write_bytes(torn)
        with pytest.raises(InputError, match=f"torn.{form}: ") as raised:
            import_splats(path, name="a")
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["empty.ply"], "empty.ply: the file is empty"),
        (["none.ply"], "none.ply: must hold at least one Gaussian (got 0)"),
        (["torn.splat"], "torn.splat: a .splat file must hold 32 bytes per Gaussian (got 100 bytes)"),
        (["mesh.obj"], "mesh.obj: splats must be"),
        (["missing.ply"], "missing.ply: cannot be read"),
        (["pin.ply", "--crop", "5", "5", "5", "6", "6", "6"], "pin.ply: crop keeps nothing: the file has x -"),
        (["pin.ply", "--crop", "1", "0", "0", "0", "1", "1"], "crop must be a lower and an upper corner"),
        (["pin.ply", "--size", "0"], "size must be finite and > 0 (got 0)"),
        (["pin.ply", "--size", "1", "--units", "1"], "units and size must not both"),
        (["pin.ply", "--mass", "1", "--density", "1"], "density and mass must not both"),
        (["pin.ply", "--scene", "x.yaml"], "x.yaml: a scene is in metres: give --size or --units"),
    ],
)
def test_invalid_arguments_are_refused_in_one_sentence(
    arguments: list[str], sentence: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.ply").touch()
    Splats.load(file).select(slice(0)).save(tmp_path / "none.ply")
    (tmp_path / "torn.splat").write_bytes(bytes(100))
    (tmp_path / "mesh.obj").write_text("v 0 0 0\n")
    (tmp_path / "pin.ply").symlink_to(file)
    with pytest.raises(InputError) as raised:
        app(["import", *arguments, "-o", "assets/pin"], standalone_mode=False)
    assert sentence in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "assets").exists()
