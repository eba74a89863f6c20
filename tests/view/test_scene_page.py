"""Scene page without a browser: the test sets the controls like a browser."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from mitsplat.arrays import ByteImage
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.scene.planning.viewpoints import viewpoint_of
from mitsplat.view.page import Address, Page
from mitsplat.view.previews import SceneRenders, ViewRequest
from mitsplat.view.scene_page import ScenePage
from tests.cli.typed import run
from tests.conftest import WriteScene, box_asset, small_scene
from tests.view.test_client_messages import CAMERA, joined, packed

LONG = 60


@dataclass
class Told:
    """Records pictures and alerts of the page."""

    pictures: list[tuple[ByteImage, str]] = field(default_factory=list)
    alerts: list[str | None] = field(default_factory=list)


@dataclass
class Shown:
    page: Page
    scene_page: ScenePage
    told: Told
    path: Path

    def wait(self, what: Callable[[], Any]) -> Any:
        """Return the first true answer, within a time limit."""
        for _ in range(20 * LONG):
            self.scene_page.check()
            if answer := what():
                return answer
            time.sleep(0.05)
        raise TimeoutError(what, self.told.alerts, self.page._caption.content)

    def picture(self) -> ByteImage:
        """Return the picture of the current view."""
        self.scene_page._request_render()
        asked = self.scene_page._last_request
        self.wait(lambda: self.scene_page._preview and self.scene_page._preview[0] is asked)
        return self.told.pictures[-1][0]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    folder = tmp_path_factory.mktemp("view")
    small_scene(
        folder,
        [box_asset("nut", (0.08, 0.06, 0.04)), box_asset("bolt", (0.04, 0.04, 0.1))],
        [{"asset": "assets/nut"}, {"asset": "assets/bolt"}],
        layouts=2,
        views=2,
    )
    path = folder / "scene.yaml"
    data = YAML(typ="safe").load(path)
    data["shapes"] = [{"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True}]
    data["lights"] = [{"kind": "area", "position": [0.5, 0, 1]}]
    write(path, data)
    page = Page("test", Address(port=0), gaussians=100)
    told = Told()
    show, alert = page.show_picture, page.alert
    page.show_picture = lambda image, text: (told.pictures.append((image, text)), show(image, text))
    page.alert = lambda sentence: (told.alerts.append(sentence), alert(sentence))
    scene_page = ScenePage(page, path)
    scene_page._width.value, scene_page._finest.value = "320", "fast"
    yield Shown(page, scene_page, told, path)
    scene_page.close()
    page.close()


def write(path: Path, data: dict[str, Any]) -> None:
    YAML(typ="safe", pure=True).dump(data, path)


def look(pose: np.ndarray) -> Any:
    """Return a camera message as viser reports it."""
    wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    return SimpleNamespace(wxyz=wxyz, position=pose[:3, 3], look_at=np.zeros(3))


def poses(shown: Shown) -> dict[str, np.ndarray]:
    return {name: part.pose for name, part in shown.page._shown.items() if part.group == "splats"}


def test_the_view_is_rendered_in_the_requested_size(shown):
    first = shown.picture()
    assert first.shape == (240, 320, 3)
    assert first.std() > 10
    assert sorted(poses(shown)) == ["/splats/0-nut-0", "/splats/1-bolt-0"]


def test_a_frame_is_shown_until_the_camera_moves(shown):
    first = shown.picture()
    shown.scene_page._frame.value = 1
    second = shown.picture()
    assert np.abs(second.astype(int) - first).mean() > 2
    own = viewpoint_of(shown.scene_page._scene, 1, shown.scene_page._layout).camera.world_from_camera
    shown.scene_page._moved(look(own))
    assert shown.scene_page._pose is None  # the page moved the camera there
    shown.scene_page._moved(look(look_at_pose((0, 0.3, 0.3), (0, 0, 0))))
    shown.scene_page._moved(look(own))
    assert shown.scene_page._pose is None  # back at the frame's pose
    shown.scene_page._moved(look(look_at_pose((0, 0.2, 0.9), (0, 0, 0))))
    assert shown.scene_page._pose is not None
    above = shown.picture()
    assert np.abs(above.astype(int) - second).mean() > 2
    assert YAML(typ="safe").load(shown.scene_page._camera_yaml.value)["camera"]["eye"] == [0.0, 0.2, 0.9]
    shown.scene_page._look_at_frame(0)
    assert np.abs(shown.picture().astype(int) - first).mean() < 1


def test_layers_belong_to_the_shown_picture(shown):
    shown.picture()
    for layer in ("labels", "ids", "depth", "light", "highlight", "picture"):
        shown.scene_page._layer.value = layer
        assert layer in shown.told.pictures[-1][1]


def test_a_moved_light_is_shown_as_yaml(shown):
    shown.scene_page._look_at_frame(0)
    before = shown.picture()
    shown.scene_page._light.value = "0: area"
    assert shown.scene_page._position.value == pytest.approx((0.5, 0, 1))
    shown.scene_page._position.value = (-0.2, 0.1, 0.3)
    line = YAML(typ="safe").load(shown.scene_page._light_yaml.value)[0]
    assert line["position"] == [-0.2, 0.1, 0.3]
    after = shown.picture()
    assert np.abs(after.astype(int) - before).mean() > 2
    shown.scene_page._reset_lights()
    assert np.abs(shown.picture().astype(int) - before).mean() < 1


@pytest.mark.parametrize(
    "changed",
    [
        {"position": (0.1, 0.2)},
        {"target": (0.1, float("nan"), 0)},
        {"strength": -1.0},
        {"strength": float("inf")},
        {"strength": 0.0},
    ],
    ids=str,
)
def test_an_invalid_light_is_not_applied(shown, changed):
    shown.scene_page._light.value = "0: area"
    before = shown.scene_page._lights_now()
    shown.scene_page._move_light(**changed)
    assert shown.scene_page._lights_now() == before
    shown.scene_page._light.value = "no light"
    assert shown.scene_page._chosen is None
    shown.scene_page._light.value = "none"


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA | {"look_at": [float("nan"), 0, 0]},
        CAMERA | {"look_at": CAMERA["position"]},
        CAMERA | {"up_direction": [0, 0, 0]},
        CAMERA | {"wxyz": [0, 0, 0, 0]},
        CAMERA | {"position": [1e300, 0, 0]},
        CAMERA | {"position": [1e6, -1e6, 1e6], "look_at": [1e6, -1e6, 1e6 - 0.01]},  # accepted, and far away
    ],
    ids=str,
)
def test_invalid_cameras_of_a_browser_do_not_end_the_page(shown, camera):
    shown.scene_page._look_at_frame(0)
    shown.picture()
    with joined(shown.page) as browser:
        shown.wait(shown.page._server.get_clients)
        browser.send(packed(camera))
        time.sleep(0.2)
        shown.picture()
        shown.scene_page._look_at_frame(1)  # moves the browser's camera
        shown.picture()
    shown.wait(lambda: not shown.page._server.get_clients())
    shown.scene_page._look_at_frame(0)


def test_another_layout_moves_objects(shown):
    shown.picture()
    before = poses(shown)
    shown.scene_page._drop_again()
    assert shown.scene_page._seed.value == "seed: 1\n"
    shown.wait(lambda: not np.allclose(before["/splats/0-nut-0"], poses(shown)["/splats/0-nut-0"]))
    assert len(poses(shown)) == 2
    shown.scene_page._step(1)
    assert shown.scene_page._index == 2
    shown.wait(lambda: shown.scene_page._layout is not None and shown.scene_page._layout.index == 1)


def test_the_drop_of_a_layout_is_played(shown):
    shown.scene_page._look_at_frame(0)
    shown.picture()
    seen = []
    show = shown.scene_page._show
    shown.scene_page._show = lambda layout: (seen.append(layout), show(layout))
    shown.scene_page._play()
    shown.wait(lambda: not shown.scene_page._playing)
    heights = [max(instance.world_from_object[2, 3] for instance in layout.instances) for layout in seen]
    assert len(heights) > 5
    assert max(heights[:3]) > heights[-1] + 0.01


def test_the_file_is_reloaded_and_an_invalid_one_keeps_the_last_scene(shown):
    data = YAML(typ="safe").load(shown.path)
    write(shown.path, {**data, "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, -1]}})
    sentence = shown.wait(lambda: shown.told.alerts and shown.told.alerts[-1])
    assert sentence.startswith(str(shown.path))
    assert "must be above min along z (got -1, min is 0.02)" in sentence
    kept = set(shown.page._shown)
    assert not shown.scene_page._plain.visible
    drawn = [{"kind": "checker"}, {"kind": "noise"}]
    post = {"name": "post", "box": {"size": [0.1, 0.1, 0.5]}, "visible": True, "materials": drawn}
    data["shapes"].append(post)
    write(shown.path, data)
    shown.wait(lambda: "/shapes/post" in shown.page._shown)
    assert shown.scene_page._plain.visible  # a notice: the browser shows no appearances
    assert shown.told.alerts[-1] is None
    assert "/shapes/table" in kept
    shown.picture()


def test_another_view_compiles_no_new_kernels(shown):
    """Materials of earlier tests are freed first, because kernels cover all kinds of materials that exist."""
    import drjit as dr

    gc.collect()
    scene = shown.scene_page._scene
    renders = SceneRenders(lambda text: None)
    views = [ViewRequest(scene, 0, look_at_pose((x, 0.3, 0.5), (0, 0, 0)), width=320) for x in (0.1, 0.2, -0.3)]
    for view in views[:2]:
        renders.render(view, "fast")
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        renders.render(views[2], "fast")
        kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    assert len(kernels) > 5
    assert all(kernel["cache_hit"] for kernel in kernels)


def test_a_scene_with_files_outside_of_its_folder_is_refused(
    scene_data: dict[str, Any], write_scene: WriteScene, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(scene_data | {"lights": [{"kind": "environment", "image": "../sky.png"}]})
    assert run("view", path, "--port", 0) == 2
    assert "lights[0].image: must be inside the scene's folder" in capsys.readouterr().err
