"""Surroundings with known table, objects and gaps, from splats to an environment and a scene file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from ruamel.yaml import YAML

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.checks.path_checks import check_scene
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.reconstruct.asset_evaluation import show_asset
from mitsplat.reconstruct.pipeline.asset_pipeline import AssetResult, make_asset
from mitsplat.reconstruct.reconstruct import AssetJob, ImportedMesh, ReconstructSettings
from mitsplat.reconstruct.surface import SurfaceSettings
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.surroundings.coverage import MIN_PHOTOS, find_coverage, find_holes, free_rectangle
from mitsplat.surroundings.depth_views import depth_views, surface_points
from mitsplat.surroundings.environment_from_photos import _level_place, reconstruct_environment
from mitsplat.surroundings.floaters import find_unsupported, remove_floaters
from mitsplat.surroundings.ground import Grid
from mitsplat.surroundings.ready_scene import scene_text, write_recorded_scene
from mitsplat.surroundings.supports import Support, find_supports, fit_plane

TABLE, HEIGHT = (1.2, 0.7), 0.11
"""Size and height of the table [m]; its centre is above the origin, and the floor is 0.8 m below it."""
BOX = (0.3, 0.2, 0.2)
"""Size of the box [m] in the table's corner at +x, +y."""
UP = np.array([0.0, 0.0, 1.0])
SMALL = ReconstructSettings(surface=SurfaceSettings(voxels=64, faces=3000), view_size=160, verdict_size=160)


def sheet(size: tuple[float, float], step: float, seed: int) -> Splats:
    """Return flat Gaussians over a rectangle in z = 0, with mottled colours."""
    rng = np.random.default_rng(seed)
    x, y = (np.arange(-edge / 2 + step / 2, edge / 2, step) for edge in size)
    means = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    sh = rng.uniform(-0.8, 0.8, (len(means), 1, 3)).repeat(1, axis=1)
    return Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.array([0, 0, 0, 1], dtype=np.float32), (len(means), 1)),
        scales=np.tile(np.array([0.7 * step, 0.7 * step, 1e-3], dtype=np.float32), (len(means), 1)),
        opacities=np.full(len(means), 0.95, dtype=np.float32),
        sh=sh.astype(np.float32),
    )


def placed(splats: Splats, middle: tuple[float, float, float], axis: int = 2) -> Splats:
    matrix = np.eye(4)
    matrix[:3, :3] = np.roll(np.eye(3), axis - 2, axis=0)
    matrix[:3, 3] = middle
    return splats.transformed(matrix)


def place() -> Splats:
    """Return the table, a box on it, and the floor."""
    corner = (TABLE[0] / 2 - BOX[0] / 2, TABLE[1] / 2 - BOX[1] / 2)
    sides = [
        placed(sheet((BOX[1], BOX[2]), 0.02, 3), (corner[0] - BOX[0] / 2, corner[1], HEIGHT + BOX[2] / 2), 0),
        placed(sheet((BOX[2], BOX[0]), 0.02, 4), (corner[0], corner[1] - BOX[1] / 2, HEIGHT + BOX[2] / 2), 1),
        placed(sheet(BOX[:2], 0.02, 5), (*corner, HEIGHT + BOX[2])),
    ]
    table, floor = placed(sheet(TABLE, 0.02, 1), (0, 0, HEIGHT)), placed(sheet((3, 3), 0.06, 2), (0, 0, HEIGHT - 0.8))
    return Splats.concatenate([table, floor, *sides])


def cameras() -> list[Camera]:
    """Return cameras on the side of -y; none observes the area on the right beyond x = 0.45."""
    found = []
    for number in range(24):
        turn, height = np.radians(-150 + 5 * number), np.radians((30, 50, 70)[number % 3])
        eye = 0.9 * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        found.append(Camera.look_at(eye + np.array([0, 0, HEIGHT]), (-0.1, 0, HEIGHT), width=160, height=120, fov_x=65))
    return found


def photographed(splats: Splats, folder: Path) -> Capture:
    photos = []
    for number, view in enumerate(show_asset(splats, None, cameras())):
        file = folder / f"photo{number:02}.png"
        Image.fromarray(np.rint(255 * view.render.clip(0, 1)).astype(np.uint8)).save(file)
        photos.append(Photo(file.name, file, view.camera, seen=np.arange(4, dtype=np.int32)))
    points = np.array([[x, y, HEIGHT] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    return Capture(tuple(photos), points, np.full((4, 3), 128, dtype=np.uint8), units="metre", up="z")


@pytest.fixture(scope="module")
def splats() -> Splats:
    return place()


@pytest.fixture(scope="module")
def captured(splats: Splats, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return photographed(splats, tmp_path_factory.mktemp("photos"))


def test_the_table_is_found_with_its_edges(splats: Splats) -> None:
    found = find_supports(surface_points(depth_views(splats, cameras())), UP, 0.9, within=30)
    table = found[0]
    assert abs(table.height - HEIGHT) < 1e-3 and table.tilt < 0.2
    assert np.allclose(table.size, TABLE, atol=0.05)
    assert np.allclose(table.pose[:2, 3], 0, atol=0.03)
    assert table.central_share > 0.5


def test_an_inclined_table_is_found_with_its_inclination(splats: Splats) -> None:
    lean = np.eye(4)
    lean[1:3, 1:3] = [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]
    turned = [replace(camera, world_from_camera=lean @ camera.world_from_camera) for camera in cameras()]
    points = surface_points(depth_views(splats.transformed(lean), turned))
    assert find_supports(points, UP, 0.9, within=30)[0].pose[:3, 2] == pytest.approx(lean[:3, 2], abs=0.003)
    assert not [one for one in find_supports(points, UP, 0.9, within=5) if one.central_share > 0.1]


def test_a_plane_is_fitted_despite_clutter_on_it() -> None:
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.uniform(-1, 1, (4000, 2)), rng.normal(0, 1e-3, 4000)])
    clutter = np.column_stack([rng.uniform(0, 1, (1500, 2)), rng.uniform(0, 0.02, 1500)])
    normal, height, spread = fit_plane(np.concatenate([flat, clutter]), UP, 0.004, 0.02)
    assert np.degrees(np.arccos(normal[2])) < 0.1 and abs(height) < 5e-4
    assert spread < 3e-3


def test_coverage_marks_occupied_and_unseen_parts_of_the_table(splats: Splats) -> None:
    shown = [camera for camera in cameras() if camera.centre[0] < -0.2]
    views = depth_views(splats, shown)
    points = surface_points(depth_views(splats, cameras()))
    table = find_supports(points, UP, 0.9, within=5)[0]
    coverage = find_coverage(table, views, points, 0.9)
    middles = coverage.cell_centres(np.argwhere(np.ones(coverage.photos.shape))).reshape(*coverage.photos.shape, 2)
    x, y = middles[..., 0], middles[..., 1]
    inside = (x > TABLE[0] / 2 - BOX[0] + 0.03) & (y > TABLE[1] / 2 - BOX[1] + 0.03)
    assert coverage.covered[inside & (x < 0.54) & (y < 0.29)].mean() > 0.95
    assert not coverage.covered[(x < 0.1) & (y < 0)].any()
    assert coverage.photos[(np.abs(x + 0.1) < 0.1) & (np.abs(y) < 0.1)].min() >= MIN_PHOTOS
    named = [(str(number), camera) for number, camera in enumerate(cameras())]
    holes = find_holes(table, coverage, splats, named)
    if coverage.hidden.any():
        assert all(hole.nearest_photo is not None and hole.visible_share > 0.5 for hole in holes)
    behind = np.zeros_like(coverage.covered)
    behind[60:70, 5:20] = True
    gap = replace(
        coverage, photos=np.where(behind, 0, coverage.photos + MIN_PHOTOS), covered=coverage.covered & ~behind
    )
    (hole,) = find_holes(table, gap, splats, named)
    assert hole.area == pytest.approx(behind.sum() * coverage.cell.prod()) and hole.visible_share > 0.9


def test_cameras_below_a_thin_support_do_not_show_its_top() -> None:
    board = sheet((0.6, 0.4), 0.01, 1)
    support = Support(np.eye(4), (0.6, 0.4), 1e-3, 0.0, 0.9, 0.9)
    eyes = [(0.8 * np.cos(turn), 0.8 * np.sin(turn), 0.5) for turn in np.linspace(0, 5, 4)]
    above = [Camera.look_at(eye, (0, 0, 0), width=160, height=120, fov_x=60) for eye in eyes]
    below = [Camera.look_at(np.array(eye) * (1, 1, -1), (0, 0, 0), width=160, height=120, fov_x=60) for eye in eyes]
    points = surface_points(depth_views(board, above))
    assert find_coverage(support, depth_views(board, below), points, 1.0).photos.max() == 0
    grid = Grid.of(support, 0.02)
    colours, seen = grid.bare_colours(board, above, 0.003)
    also_below, still_seen = grid.bare_colours(board, above + below, 0.003)
    assert seen.mean() > 0.9
    np.testing.assert_array_equal(also_below, colours)
    np.testing.assert_array_equal(still_seen, seen)
    assert not grid.bare_colours(board, below, 0.003)[1].any()


def test_the_largest_free_rectangle_agrees_with_a_full_search() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        free = rng.random((7, 9)) < 0.7
        areas = [
            (b - a) * (d - c)
            for a in range(7) for b in range(a + 1, 8) for c in range(9) for d in range(c + 1, 10)
            if free[a:b, c:d].all()
        ]  # fmt: skip
        found = free_rectangle(free)
        assert found is not None and free[found[0] : found[1], found[2] : found[3]].all()
        assert (found[1] - found[0]) * (found[3] - found[2]) == max(areas)
    assert free_rectangle(np.zeros((3, 3), dtype=bool)) is None


def speck(place: Float64Array, size: float, opacity: float) -> Splats:
    one = sheet((0.02, 0.02), 0.02, 9)
    scales = np.full((1, 3), size, dtype=np.float32)
    return replace(one, means=np.float32(place[None]), scales=scales, opacities=np.float32([opacity]))


def test_floaters_and_haze_are_removed_and_surfaces_kept(splats: Splats, captured: Capture) -> None:
    camera = captured.photos[9].camera
    close, amid = camera.centre + 0.1 * camera.world_from_camera[:3, 2], np.array([-0.1, 0, HEIGHT + 0.3])
    dirty = Splats.concatenate(
        [splats, speck(close, 0.01, 0.9), speck(amid, 0.01, 0.4), speck(np.array([0, 0, 0.5]), 2.5, 0.9)]
    )
    cleaned, removed = remove_floaters(dirty, captured.training, 0.9)
    assert removed["haze"] == 1 and removed["specks"] >= 2
    for place in (close, amid):
        assert not (np.linalg.norm(cleaned.means - place, axis=1) < 1e-3).any()
    assert len(splats) - len(cleaned) < 0.02 * len(splats) + removed["in no photo"]
    floating, _ = find_unsupported(splats, depth_views(splats, [p.camera for p in captured.training]), 0.27)
    assert floating.mean() < 0.01


@pytest.fixture(scope="module")
def made(splats: Splats, captured: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AssetResult]:
    folder = tmp_path_factory.mktemp("made")
    captured.save(folder / "capture")
    (folder / "fit").mkdir()
    splats.save(folder / "fit" / "splats.ply")
    (folder / "fit" / "fit.json").write_text('{"psnr": 31.5}')
    job = AssetJob(name="cell", kind="environment", settings=SMALL)
    return folder, make_asset(Capture.load(folder / "capture"), folder / "fit", folder / "cell", job)


def test_the_table_of_the_asset_lies_at_height_0(made: tuple[Path, AssetResult]) -> None:
    folder, done = made
    asset = Asset.load(folder / "cell")
    record = json.loads((folder / "cell" / "verdict.json").read_text())
    support = record["supports"][0]
    assert np.allclose(support["pose"], np.eye(4), atol=1e-6) and np.allclose(support["size"], TABLE, atol=0.05)
    expected = np.eye(4)
    expected[2, 3] = -HEIGHT
    assert np.allclose(record["asset_from_capture"], expected, atol=0.03)
    assert record["asset_from_capture"][2][3] == pytest.approx(-HEIGHT, abs=1e-3)
    assert asset.mesh is not None and asset.kind == "environment" and asset.capture_light == "scene"
    middle = np.abs(asset.mesh.vertices[:, :2]).max(axis=1) < 0.2
    assert np.abs(asset.mesh.vertices[middle & (asset.mesh.vertices[:, 2] > -0.1), 2]).max() < 1e-6
    assert done.verdict.psnr is not None and done.verdict.psnr > 35  # its own renderings, not the fit's report
    assert "Removed objects" not in done.verdict.rows
    assert "Support" in done.verdict.rows and "Support" in (folder / "cell" / "report.html").read_text()


def test_the_frame_of_a_square_table_is_that_of_its_support() -> None:
    """Either side of a square can be found as the longer one, and the second search found another one."""
    table = sheet((0.8, 0.8), 0.02, 1)
    eyes = [0.9 * np.array([np.cos(turn), np.sin(turn), 1.0]) for turn in np.arange(0.1, 6, 0.7)]
    shown = [Camera.look_at(eye, (0, 0, 0), width=160, height=120, fov_x=65) for eye in eyes]
    photos = tuple(Photo(f"{number}.png", Path("none.png"), camera) for number, camera in enumerate(shown))
    capture = Capture(photos, np.zeros((0, 3)), np.zeros((0, 3)), units="metre", up="z")
    for turn in (0.0, 0.5, 1.3):
        motion = trimesh.transformations.rotation_matrix(turn, (0, 0, 1))
        place, found = _level_place(capture.transformed(motion), table.transformed(motion), 1.2)
        np.testing.assert_allclose(place.supports[0].pose, np.eye(4), atol=1e-6)
        np.testing.assert_allclose(place.capture.photos[3].camera.centre, (found @ motion @ [*eyes[3], 1])[:3])


def test_an_unknown_vertical_is_that_of_the_table(splats: Splats, captured: Capture) -> None:
    fallen = np.eye(4)
    fallen[:3, :3] = np.roll(np.eye(3), 1, axis=0)
    capture = replace(captured.transformed(fallen), up="unknown", units="unknown")
    job = AssetJob(name="cell", kind="environment", settings=SMALL)
    found = reconstruct_environment(capture, splats.transformed(fallen), job)
    assert (found.asset_from_capture @ fallen)[2] == pytest.approx([0, 0, 1, -HEIGHT], abs=2e-3)
    assert "scene" not in found.record
    assert any("the scale is unknown" in sentence for sentence in found.verdict.misses())


def test_an_imported_mesh_stays_on_the_table_of_its_capture(splats: Splats, captured: Capture) -> None:
    """Its given transform refers to the capture, whose origin is 11 cm from the table."""
    table = trimesh.creation.box((*TABLE, 0.02)).apply_translation((0, 0, HEIGHT - 0.01))
    capture_from_mesh = homogeneous_matrix(2 * np.eye(3), (1.0, 2.0, 3.0))
    drawing = table.copy().apply_transform(np.linalg.inv(capture_from_mesh))
    job = AssetJob("cell", kind="environment", settings=SMALL, imported=ImportedMesh(drawing, capture_from_mesh))
    found = reconstruct_environment(captured, splats, job)
    assert found.asset.mesh is not None
    expected = table.copy().apply_transform(found.asset_from_capture).bounds
    np.testing.assert_allclose(found.asset.mesh.bounds, expected, atol=1e-6)


def test_the_scene_of_surroundings_drops_objects_beside_the_box(made: tuple[Path, AssetResult]) -> None:
    folder, done = made
    assert done.scene == folder / "cell.yaml"
    scene = load_scene(folder / "cell.yaml")
    assert scene.spec.region.max[0] < TABLE[0] / 2 and scene.spec.region.min[0] > -TABLE[0] / 2
    corner = np.array([TABLE[0] / 2 - BOX[0], TABLE[1] / 2 - BOX[1]])
    assert (np.array(scene.spec.region.max[:2]) < corner).any()


@pytest.mark.parametrize("name", ["cell #2", "true", "007", "a: b"])
def test_names_of_any_text_stay_text_in_the_scene(tmp_path: Path, name: str) -> None:
    """YAML reads them as a comment, a truth value, a number or a mapping if they are not quoted."""
    support = Support(np.eye(4), (1.0, 0.8), 1e-3, 0.0, 0.9, 0.9)
    text = scene_text(name, [support], (-0.3, 0.3, -0.2, 0.2), cameras())
    (tmp_path / name).mkdir()
    (tmp_path / name / "verdict.json").write_text(json.dumps({"scene": text}))
    file, warning = write_recorded_scene(tmp_path / name, None)
    assert file is not None and warning is None
    scene = YAML(typ="safe").load(file)
    assert (scene["name"], scene["environment"]) == (name, name)


@pytest.mark.extended
def test_the_scene_of_surroundings_gets_no_warning(made: tuple[Path, AssetResult]) -> None:
    assert [finding for finding in check_scene(load_scene(made[0] / "cell.yaml")) if not finding.ok] == []


def test_an_edited_scene_is_kept_and_a_missing_one_written_again(made: tuple[Path, AssetResult]) -> None:
    folder, _done = made
    text = (folder / "cell.yaml").read_text()
    job = AssetJob(name="cell", kind="environment", settings=SMALL)
    arguments = Capture.load(folder / "capture"), folder / "fit", folder / "cell", job
    (folder / "cell.yaml").unlink()
    assert make_asset(*arguments).kept and (folder / "cell.yaml").read_text() == text
    (folder / "cell.yaml").write_text(text + "seed: 3\n")
    again = make_asset(*arguments)
    assert "was not replaced" in again.warnings[-1] and (folder / "cell.yaml").read_text().endswith("seed: 3\n")
    (folder / "cell.yaml").write_text(text)
