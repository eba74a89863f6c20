"""Removal of objects from surroundings: removed and remaining splats, and the fill of unobserved areas."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.asset_evaluation import show_asset
from mitsplat.reconstruct.pipeline import asset_pipeline
from mitsplat.reconstruct.reconstruct import AssetJob, ImportedMesh
from mitsplat.surroundings.depth_views import SurfacePoints, depth_views, surface_points
from mitsplat.surroundings.removal import remove_objects
from mitsplat.surroundings.supports import find_supports, find_walls
from mitsplat.surroundings.texture_fill import fill_texture
from tests.surroundings.test_surroundings import (
    BOX,
    HEIGHT,
    SMALL,
    TABLE,
    UP,
    cameras,
    photographed,
    place,
    placed,
    sheet,
)

CUBE = 0.1
"""Edge of a second box [m] at the position :data:`BESIDE`."""
BESIDE = (-0.2, 0.1)
DEPTH = 0.9


def cube() -> Splats:
    x, y = BESIDE
    sides = [
        placed(sheet((CUBE, CUBE), 0.01, 11), (x, y, HEIGHT + CUBE)),
        *(placed(sheet((CUBE, CUBE), 0.01, 12), (x + s * CUBE / 2, y, HEIGHT + CUBE / 2), 0) for s in (-1, 1)),
        *(placed(sheet((CUBE, CUBE), 0.01, 13), (x, y + s * CUBE / 2, HEIGHT + CUBE / 2), 1) for s in (-1, 1)),
    ]
    return Splats.concatenate(sides)


def shaded(splats: Splats) -> Splats:
    """Return the splats with a colour that changes linearly with x and y."""
    colour = np.stack(
        [0.5 + 0.3 * splats.means[:, 0], 0.5 + 0.4 * splats.means[:, 1], np.full(len(splats), 0.5)], axis=1
    )
    return replace(splats, sh=((colour - 0.5) / SH_C0)[:, None].astype(np.float32))


def table_and_box() -> tuple[Splats, Splats]:
    """Return table and floor in linear colour gradients, and the box in the corner."""
    whole = place()
    low = whole.means[:, 2] < HEIGHT + 1e-3
    return shaded(whole.select(low)), whole.select(~low)


def pick(photo: int, spot: tuple[float, float, float]) -> str:
    x, y = cameras()[photo].project(np.array([spot]))[0][0]
    return f"photo{photo:02}.png:{x:.1f},{y:.1f}"


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return photographed(Splats.concatenate([place(), cube()]), tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def points(captured: Capture) -> SurfacePoints:
    """Return points on the surfaces of the place and the cube."""
    return seen_points(Splats.concatenate([place(), cube()]), captured)


def seen_points(splats: Splats, capture: Capture) -> SurfacePoints:
    return surface_points(depth_views(splats, [photo.camera for photo in capture.training]))


@pytest.fixture(scope="module")
def shaded_points(captured: Capture) -> SurfacePoints:
    """Return points on the surfaces of table, floor, box and cube with colour gradients."""
    return seen_points(Splats.concatenate([*table_and_box(), cube()]), captured)


def removed(splats: Splats, capture: Capture, points: SurfacePoints, *what: str) -> Splats:
    return remove_objects(splats, what, capture, find_supports(points, UP, DEPTH, within=5), points, DEPTH)[0]


def above(splats: Splats, low: tuple[float, float], high: tuple[float, float]) -> BoolArray:
    """Return a mask of the Gaussians above the table in a rectangle."""
    inside = ((splats.means[:, :2] > low) & (splats.means[:, :2] < high)).all(axis=1)
    return np.asarray(inside & (splats.means[:, 2] > HEIGHT + 0.012))


def test_a_picked_object_is_removed_and_another_kept(captured: Capture, shaded_points: SurfacePoints) -> None:
    bare, box = table_and_box()
    whole = Splats.concatenate([bare, box, cube()])
    left = removed(whole, captured, shaded_points, pick(12, (BESIDE[0], BESIDE[1], HEIGHT + CUBE)))
    around = np.array(BESIDE)
    assert not above(left, tuple(around - 0.1), tuple(around + 0.1)).any()
    corner = (TABLE[0] / 2 - BOX[0] - 0.02, TABLE[1] / 2 - BOX[1] - 0.02)
    assert above(left, corner, (1, 1)).sum() == above(whole, corner, (1, 1)).sum() > 0.9 * len(box)
    below = np.abs(left.means[:, 2] - HEIGHT + 0.8) < 0.01
    assert below.sum() == (np.abs(whole.means[:, 2] - HEIGHT + 0.8) < 0.01).sum()  # the floor
    from_near = Camera.look_at((-0.2, -0.3, 0.6), (*BESIDE, HEIGHT), width=160, height=120, fov_x=40)
    for camera in (cameras()[4], cameras()[12], from_near):
        (shown,), (true,) = (show_asset(splats, None, [camera]) for splats in (left, Splats.concatenate([bare, box])))
        assert np.abs(shown.picture - true.picture).max() < 0.03
        assert np.abs(shown.alpha - true.alpha).max() < 0.05


def test_all_picked_objects_are_removed(captured: Capture, shaded_points: SurfacePoints) -> None:
    """The colour gradient of the table continues below the removed objects."""
    bare, box = table_and_box()
    on_box = (TABLE[0] / 2 - 0.7 * BOX[0], TABLE[1] / 2 - BOX[1], HEIGHT + BOX[2] / 2)
    whole = Splats.concatenate([bare, box, cube()])
    left = removed(whole, captured, shaded_points, pick(12, (*BESIDE, HEIGHT + CUBE)), pick(8, on_box))
    assert not (left.means[:, 2] > HEIGHT + 0.03).any()
    for camera in cameras()[::6]:
        (shown,), (true,) = (show_asset(splats, None, [camera]) for splats in (left, bare))
        inside = true.alpha > 0.99
        assert np.abs(shown.picture - true.picture)[inside].max() < 0.05
        assert shown.alpha[inside].min() > 0.9


def wall(y: float) -> tuple[Splats, Splats]:
    """Return a wall across the table at ``y`` in linear colour gradients.

    The part hidden by the cube before it is missing.
    """
    whole = placed(sheet((0.6, 1.2), 0.02, 31), (0, y, HEIGHT + 0.3), 1)
    colour = np.column_stack([0.5 + 0.3 * whole.means[:, 0], 0.3 + 0.4 * whole.means[:, 2], np.full(len(whole), 0.6)])
    whole = replace(whole, sh=((colour - 0.5) / SH_C0)[:, None].astype(np.float32))
    hidden = (np.abs(whole.means[:, 0] - BESIDE[0]) < 0.4 * CUBE) & (whole.means[:, 2] < HEIGHT + 0.85 * CUBE)
    return whole, whole.select(~hidden)


@pytest.mark.parametrize("gap", [0.0, pytest.param(0.03, marks=pytest.mark.extended)])
def test_a_wall_close_behind_an_object_is_filled(gap: float, tmp_path: Path) -> None:
    """The object may touch the wall; the wall stays, and its hidden part is filled."""
    bare, _ = table_and_box()
    y = BESIDE[1] + CUBE / 2 + gap
    true, seen = wall(y)
    capture = photographed(Splats.concatenate([bare, true, cube()]), tmp_path)
    fitted = Splats.concatenate([bare, seen, cube()])
    points = seen_points(fitted, capture)
    supports, what = find_supports(points, UP, DEPTH, within=5), pick(12, (*BESIDE, HEIGHT + CUBE))
    left, (thing,) = remove_objects(fitted, (what,), capture, supports, points, DEPTH)
    assert 0.5 * CUBE**2 < thing.behind < 2 * CUBE**2 and thing.copied == 1
    assert not above(left, (BESIDE[0] - 0.1, BESIDE[1] - 0.1), (BESIDE[0] + 0.1, y - 0.015)).any()
    from_near = Camera.look_at((-0.2, -0.4, 0.3), (BESIDE[0], y, HEIGHT + 0.05), width=160, height=120, fov_x=40)
    for camera in (cameras()[4], cameras()[12], from_near):
        (shown,), (whole,) = (show_asset(one, None, [camera]) for one in (left, Splats.concatenate([bare, true])))
        off = np.abs(shown.picture - whole.picture)
        assert off.mean() < 2e-3 and (off > 0.05).mean() < 2e-3
        assert np.abs(shown.alpha - whole.alpha).max() < 0.05


def test_sides_of_objects_are_not_taken_for_walls(points: SurfacePoints) -> None:
    assert find_walls(points, DEPTH) == []


def test_picks_without_an_object_on_a_surface_are_refused(captured: Capture, points: SurfacePoints) -> None:
    splats, supports = Splats.concatenate([place(), cube()]), find_supports(points, UP, DEPTH, within=5)

    def remove(spot: str) -> None:
        remove_objects(splats, (spot,), captured, supports, points, DEPTH)

    on_table, on_floor = (pick(5, spot) for spot in ((0.1, -0.1, HEIGHT), (0.0, -1.2, HEIGHT - 0.8)))
    for spot in (on_table, on_floor, "photo05.png:3,1", "photo05.png:-50,900"):  # and pixels without splats
        with pytest.raises(
            InputError, match=r"photo05\.png:.*: an object to remove must stand on one of the detected level surfaces"
        ):
            remove(spot)
    with pytest.raises(InputError, match=r"none\.png:3,4: a pick must be PHOTO:X,Y of a photo with a camera"):
        remove("none.png:3,4")
    with pytest.raises(InputError, match=r"a pixel must be given as X,Y \(got 3\)"):
        remove("photo05.png:3")
    with pytest.raises(InputError, match="removed only from an environment"):
        AssetJob(name="mug", remove=("photo05.png:3,4",))
    mesh = ImportedMesh(trimesh.creation.box((1, 1, 1)))
    with pytest.raises(InputError, match="cannot be removed from an imported mesh"):
        AssetJob(name="cell", kind="environment", imported=mesh, remove=("photo05.png:3,4",))
    with pytest.raises(InputError, match=r"photo05\.png:1_0,4: a pixel must be given as X,Y"):
        AssetJob(name="cell", kind="environment", remove=("photo05.png:1_0,4",))


def test_an_environment_records_removed_objects(
    captured: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = captured.save(tmp_path / "capture")
    (tmp_path / "fit").mkdir()
    Splats.concatenate([place(), cube()]).save(tmp_path / "fit" / "splats.ply")
    (tmp_path / "fit" / "fit.json").write_text('{"psnr": 31.5}')
    what = pick(12, (*BESIDE, HEIGHT + CUBE))
    job = AssetJob(name="cell", kind="environment", settings=SMALL, remove=(what,))
    done = asset_pipeline.make_asset(capture, tmp_path / "fit", tmp_path / "cell", job)
    size = done.verdict.rows["Removed objects"].split(" m around x -0.")[0]
    assert [float(edge) for edge in size.split(" x ")] == pytest.approx([CUBE, CUBE, CUBE], abs=0.015)
    assert what in done.verdict.rows["Removed objects"] and "are synthesised" in done.verdict.rows["Removed objects"]
    assert "was hidden by removed objects" in (tmp_path / "cell" / "report.html").read_text()
    (record,) = json.loads((tmp_path / "cell" / "verdict.json").read_text())["removed_objects"]
    assert record["pick"] == what and CUBE**2 < record["filled"] < 3 * CUBE**2 and record["copied"] == 1
    assert done.verdict.psnr is not None and done.verdict.psnr > 35  # without pixels of the removed object
    asset = Asset.load(tmp_path / "cell")
    assert asset.mesh is not None
    near = np.linalg.norm(asset.mesh.vertices[:, :2] - BESIDE, axis=1) < 0.08
    level = asset.mesh.vertices[near & (np.abs(asset.mesh.vertices[:, 2]) < 0.5), 2]
    assert len(level) and np.abs(level).max() < 0.01
    monkeypatch.setattr(asset_pipeline, "reconstruct_environment", None)
    again = asset_pipeline.make_asset(capture, tmp_path / "fit", tmp_path / "cell", job)
    assert again.kept
    with pytest.raises(TypeError, match="not callable"):  # other removals require a new asset
        asset_pipeline.make_asset(capture, tmp_path / "fit", tmp_path / "cell", replace(job, remove=()))


@pytest.mark.extended
def test_the_mesh_command_removes_picked_objects(captured: Capture, tmp_path: Path) -> None:
    captured.save(tmp_path / "capture")
    Splats.concatenate([place(), cube()]).save(tmp_path / "splats.ply")
    what = pick(12, (*BESIDE, HEIGHT + CUBE))
    words = ["mesh", "capture", "splats.ply", "-o", "cell", "--kind", "environment", "--remove", what, "--voxels", "64"]
    done = subprocess.run(
        [Path(sys.executable).with_name("mitsplat"), *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 4), done.stderr
    assert "removed objects: 0.1" in done.stdout and what in done.stdout
    left = Asset.load(tmp_path / "cell").splats.means  # the origin is the table's centre
    over = (np.abs(left[:, :2] - BESIDE) < 0.7 * CUBE).all(axis=1) & (left[:, 2] > 0.3 * CUBE)
    assert not over.any()


class TestFill:
    """Filling of textures of 60 x 50 cells with a hole of 14 x 12."""

    @staticmethod
    def hole() -> BoolArray:
        hole = np.zeros((60, 50), dtype=bool)
        hole[24:38, 20:32] = True
        return hole

    @staticmethod
    def filled(texture: Float64Array, known: BoolArray | None = None) -> tuple[Float64Array, float]:
        hole = TestFill.hole()
        broken = np.where(hole[..., None], 7.0, texture)
        result, copied = fill_texture(broken, ~hole if known is None else known & ~hole, hole)
        outside = ~hole if known is None else known & ~hole
        assert (result[outside] == broken[outside]).all()
        return result, copied

    def test_a_plain_colour_is_continued(self) -> None:
        texture = np.broadcast_to([0.2, 0.5, 0.7], (60, 50, 3))
        result, copied = self.filled(texture)
        np.testing.assert_allclose(result, texture, atol=1e-6)
        assert copied == 1

    def test_a_colour_gradient_is_continued(self) -> None:
        x, y = np.mgrid[0:60, 0:50] / 60
        texture = np.stack([0.2 + 0.5 * x, 0.8 - 0.4 * y, 0.3 + 0.3 * x * y], axis=-1)
        np.testing.assert_allclose(self.filled(texture)[0], texture, atol=0.01)

    def test_a_periodic_pattern_is_continued_in_phase(self) -> None:
        x, y = np.mgrid[0:60, 0:50]
        pattern = 0.5 + 0.2 * np.sin(2 * np.pi * x / 7) * np.cos(2 * np.pi * y / 5) + 0.002 * x
        texture = np.repeat(pattern[..., None], 3, axis=2)
        result, copied = self.filled(texture)
        assert copied == 1
        np.testing.assert_allclose(result, texture, atol=0.02)

    def test_a_hole_without_large_surroundings_is_filled_smoothly(self) -> None:
        """Only a frame of three cells around the hole is known."""
        hole = self.hole()
        known = np.zeros_like(hole)
        known[21:41, 17:35] = True
        x, _ = np.mgrid[0:60, 0:50] / 60
        texture = np.repeat((0.2 + 0.5 * x)[..., None], 3, axis=2)
        result, copied = self.filled(texture, known & ~hole)
        assert copied < 1
        np.testing.assert_allclose(result[hole], texture[hole], atol=0.02)

    def test_a_texture_without_known_cells_is_filled_with_finite_values(self) -> None:
        hole = self.hole()
        result, copied = fill_texture(np.full((60, 50, 3), 0.4), np.zeros_like(hole), hole)
        assert copied == 0 and np.isfinite(result).all()
