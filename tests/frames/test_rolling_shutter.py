"""Images whose rows are exposed one after another, against an image for each row."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.remake import remake_frame
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.frames import rolling_shutter
from mitsplat.frames.rolling_shutter import Band, bands_of, project_by_row, stacked_silhouettes
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import Silhouette
from mitsplat.renderer.layers import Layers, render_layers
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from tests.conftest import WriteScene
from tests.frames.test_conveyor import belt_data as belt_data
from tests.frames.test_conveyor import lying

SceneData = dict[str, Any]
MOTION = {"exposure": 0.002, "velocity": [0.6, -0.3, 0.4], "rotation": [20.0, -30.0, 60.0], "readout": 0.04}
"""Some 10 pixels in an image of 64x48, seen from 0.5 m with a focal length of 100 px."""


def exact(camera: Camera, row: float) -> Camera:
    """The camera at the moment of a row: a straight way, and a turn about its own axes."""
    return rolling_shutter._moved(camera, MOTION, MOTION["readout"] * (row / camera.height - 0.5))


@pytest.fixture
def moving(scene_data: SceneData, write_scene: WriteScene) -> ms.Scene:
    """Nuts on a table before a camera that moves and turns."""
    scene_data |= {
        "objects": [{"asset": "assets/nut", "count": 5, "scale": 2}],
        "lights": [{"kind": "area", "position": [0.3, 0.2, 0.8], "size": [0.3, 0.3]}, {"kind": "environment"}],
        "composite": {"shadow_error": 0.02},
        "labels": {"min_pixels": 1, "min_fragment": 1},
    }
    scene_data["camera"] = {
        "kind": "path",
        "keys": [{"eye": [0, -0.3, 0.4], "target": [0, 0, 0]}],
        "intrinsics": {"fx": 100},
        "motion": {"exposure": [0.002, 0.002], "speed": [0.5, 0.5], "rotation": [50, 50], "readout": [0.04, 0.04]},
    }
    return ms.load_scene(write_scene(scene_data))


def lying_about(scene: ms.Scene) -> Layout:
    places = [(0, 0), (0.12, 0.05), (-0.13, -0.04), (-0.06, 0.1), (0.07, -0.09)]
    poses = [np.eye(4) for _ in places]
    for pose, place in zip(poses, places, strict=True):
        pose[:3, 3] = *place, 0.02
    return Layout(0, tuple(Instance(i, 0, scene.class_index(0), p) for i, p in enumerate(poses, 1)), NO_PHYSICS)


def test_every_row_is_that_of_an_image_of_its_moment(moving: ms.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    layout = lying_about(moving)
    with ms.Renderer(moving) as renderer:
        rolled = renderer.render(0, layout=layout)
        motion = dict(rolled.plan.viewpoint["motion"])
        assert motion["readout"] == 0.04
        monkeypatch.setattr(rolling_shutter, "MOST_BANDS", 1)
        still = renderer.render(0, layout=layout)
        differing = []
        for row in range(2, 48, 6):
            time = 0.04 * ((row + 0.5) / 48 - 0.5)
            at_row = rolling_shutter._moved(rolled.camera, motion, time)
            frame = renderer.render(0, layout=layout, camera=at_row)
            differing.append(
                [np.count_nonzero(frame.proxy_instance[row] != other.proxy_instance[row]) for other in (rolled, still)]
            )
            same = frame.proxy_instance[row] == rolled.proxy_instance[row]
            np.testing.assert_allclose(
                rolled.layers.proxy_depth[row][same], frame.layers.proxy_depth[row][same], rtol=0.02
            )
    ours, global_shutter = np.sum(differing, axis=0)
    assert ours <= 8  # of 512: a quarter of a pixel at some of the borders
    assert global_shutter > 4 * max(ours, 4)
    ids = {label.id: label for label in rolled.labels.instances}
    for number, label in ids.items():
        np.testing.assert_array_equal(Silhouette(label.box, label.mask).whole(64, 48), rolled.instance == number)


def test_bands_of_one_moment_are_the_image(moving: ms.Scene) -> None:
    """No seam: in bands, a picture with its light and shadows is what it is as a whole."""
    layout = lying_about(moving)
    with ms.Renderer(moving) as renderer:
        frame = renderer.render(0, layout=layout)
        camera, motion = frame.camera, {**MOTION, "velocity": [0.0] * 3, "rotation": [0.0] * 3}
        bands = bands_of(camera, motion, [np.full((48, 64), 0.15)] * 2)
        assert len(bands) == 6
        scene = mi.load_dict(renderer.describe(layout, frame.plan.lights))
        whole = render_layers(renderer.integrator, scene, camera)
        parts = [(render_layers(renderer.integrator, scene, band.camera), band.rows) for band in bands]
        stacked = Layers.stacked(parts)
        np.testing.assert_array_equal(stacked.instance, whole.instance)
        np.testing.assert_array_equal(stacked.proxy_instance, whole.proxy_instance)
        np.testing.assert_allclose(stacked.depth, whole.depth, atol=1e-5)
        np.testing.assert_allclose(stacked.light, whole.light, atol=2e-3)
        np.testing.assert_allclose(stacked.rgb, whole.rgb, atol=2e-3)


def test_bands_follow_the_motion() -> None:
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=64, height=50, fov_x=60)
    moved = np.zeros((50, 64))
    assert bands_of(camera, MOTION, [moved, moved + 0.02]) == []  # 0.4 px in 20 exposures
    assert bands_of(camera, {**MOTION, "readout": 0.0}, [moved, moved + 9]) == []
    bands = bands_of(camera, MOTION, [moved, moved - 0.06])
    assert [(band.first, band.end) for band in bands] == [(0, 17), (17, 33), (33, 50)]
    assert [band.time for band in bands] == pytest.approx([0.04 * (y / 50 - 0.5) for y in (8.5, 25, 41.5)])
    for band in bands:
        assert band.top % 8 == 0
        assert band.top == 0 or band.first - 16 < band.top <= band.first - 8
        point = band.camera.centre + band.camera.world_from_camera[:3, :3] @ (0.1, 0.05, 1.0)
        by_band = band.camera.project(point)[0][0] + (0, band.top)
        whole = replace(camera, world_from_camera=band.camera.world_from_camera)
        np.testing.assert_allclose(by_band, whole.project(point)[0][0])
    assert len(bands_of(camera, MOTION, [moved, moved + 1e6])) == 50


def test_points_are_projected_at_the_moment_of_their_row() -> None:
    camera = Camera.look_at((0.2, -0.4, 0.5), (0, 0, 0), width=64, height=48, fov_x=60, distortion=(0.1, 0, 0, 0))
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.12, 0.12, (40, 3))
    velocity = np.array([0.3, 0.1, 0.0])
    pixels, depth = project_by_row(camera, MOTION, points, velocity)
    inside = (pixels[:, 1] > 0) & (pixels[:, 1] < 48)
    assert np.count_nonzero(inside) > 20
    for pixel, z, point in zip(pixels[inside], depth[inside], points[inside], strict=True):
        time = 0.04 * (pixel[1] / 48 - 0.5)
        there, ahead = exact(camera, pixel[1]).project(point + time * velocity)
        np.testing.assert_allclose(there[0], pixel, atol=1e-4)
        assert ahead[0] == pytest.approx(z, abs=1e-6)


def test_silhouettes_are_taken_from_the_bands_and_from_beyond_the_image() -> None:
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=8, height=32, fov_x=60)
    bands = [Band(camera, 0, 16, 0, -1.0), Band(camera, 16, 32, 8, 1.0)]
    upper = Silhouette((2, -3, 4, 30), np.ones((33, 2), dtype=bool))
    lower = Silhouette((3, 0, 5, 29), np.ones((29, 2), dtype=bool))  # rows 8 to 37 of the whole image
    found = stacked_silhouettes(bands, [{1: upper, 2: lower}, {1: lower}])
    assert found[1].box == (2, -3, 5, 37)
    whole = found[1].mask
    assert whole[:19].tolist() == [[True, True, False]] * 19
    assert whole[19:].tolist() == [[False, True, True]] * 21
    assert found[2].box == (3, 0, 5, 16)


def test_what_runs_on_a_belt_is_sheared(belt_data: SceneData, write_scene: WriteScene, tmp_path: Path) -> None:
    """Each row shows the belt's nut where it is then, which leans; what lies beside it does not."""
    belt_data["labels"] = {"min_pixels": 1, "min_fragment": 1}
    belt_data["conveyor"]["speed"] = 2.0
    belt_data["conveyor"]["interval"] = 0.01
    belt_data["camera"]["motion"] = {"exposure": [0.001, 0.001], "readout": [0.048, 0.048]}
    belt_data["output"] |= {"layouts": 1, "views": 2, "formats": ["yolo", "coco", "poses", "depth"]}
    belt_data["composite"] = {"shadow": "traced"}
    scene = ms.load_scene(write_scene(belt_data))
    with ms.Renderer(scene) as renderer:
        frame = renderer.render(1, layout=lying(scene, 0))
    middle = {number: [] for number in (1, 2)}
    for number, found in middle.items():
        for row in range(48):
            columns = np.flatnonzero(frame.proxy_instance[row] == number)
            if len(columns) and columns[0] > 0 and columns[-1] < 63:
                found.append((row, columns.mean()))
    lean = {number: np.polyfit(*np.array(found).T, 1)[0] for number, found in middle.items()}
    # 2 m/s for 1 ms a row, seen with 100 px from some 0.47 m.
    assert lean[1] == pytest.approx(2.0 * 0.001 * 100 / 0.47, rel=0.15)
    assert abs(lean[2]) < 0.02
    out = write_dataset(scene, tmp_path / "out", settle=lying, workers=1).path
    assert audit_dataset(out).violations == ()
    again = remake_frame(scene, 1, tmp_path / "again", dataset=out, settle=lying)
    assert again.compared and not again.differing


@pytest.mark.parametrize("name", ["bop", "colmap", "flow"])
def test_formats_of_one_pose_are_refused(
    name: str, belt_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    belt_data["camera"]["motion"] = {"exposure": [0.001, 0.001], "readout": [0, 0.02]}
    belt_data["output"]["formats"] = ["yolo", name]
    scene = ms.load_scene(write_scene(belt_data))
    with pytest.raises(
        InputError, match=rf"output.formats: {name} must have a camera without rolling shutter .* \[0.0, 0.02\]"
    ):
        write_dataset(scene, tmp_path / "out", workers=1)
