"""The time of a dataset, estimated from its first layout and images."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from mitsplat.checks import path_checks, time_check
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.findings import Finding
from mitsplat.frames import time_estimate
from mitsplat.geometry.camera import Camera
from mitsplat.scene.scene import Scene
from tests.cli.typed import run
from tests.conftest import BOTH, WriteScene, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (99, "99 s"), (100, "2 min"), (5999, "100 min"), (7200, "2.0 h")]
)
def test_durations_have_a_readable_unit(seconds: float, text: str) -> None:
    assert time_estimate.format_time(seconds) == text


def test_the_time_is_that_of_all_layouts_and_images() -> None:
    assert time_estimate.describe_time(10, 8.0, 200, 1.4) == (
        "about 6 min in one process: 200 images of 1.4 s, and 10 layouts that settle in 8 s"
    )
    assert time_estimate.describe_time(0, 8.0, 20, 1.4).startswith("about 28 s in one process: 20 images")
    assert time_estimate.describe_time(3, None, 20, 1.4).endswith("20 images of 1.4 s, without settling 3 layouts")
    assert time_estimate.describe_time(1, None, 2, 1.4).endswith("2 images of 1.4 s, without settling 1 layout")
    assert time_estimate.describe_time(1, 8.0, 1, 1.4).endswith("1 image of 1.4 s, and 1 layout that settles in 8 s")


def test_a_check_measures_one_layout_and_the_second_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first image takes longer, because it compiles kernels, and does not count."""
    scene = small_scene(tmp_path, large_boxes(), BOTH, layouts=4, views=3)
    rendered: list[int] = []

    def settle(scene: Scene, index: int) -> Any:
        time.sleep(0.3)
        return scatter_boxes(scene, index, progress=None)

    def render(scene: Scene, index: int, *, layout: Any) -> Any:
        time.sleep(0.1 if rendered else 2.0)
        rendered.append(index)
        return render_boxes(scene, index, layout=layout)

    monkeypatch.setattr(time_check, "settle_layout", settle)
    monkeypatch.setattr(time_check, "render_frame", render)
    monkeypatch.setattr(time_check, "is_cached", lambda scene, index: index == 0)
    (found,) = time_check.measure_run(scene)
    assert found.ok and found.name == "time" and rendered == [3, 4]
    assert re.search(r"12 images of .* and 3 layouts that settle in 0\.[3-9]", found.text)
    assert 1 < float(found.text.split()[1]) < 12


@pytest.mark.parametrize(
    ("height", "cause"), [(1.0, "`mitsplat preview` shows"), (-1.0, "below all objects, at z = -1")]
)
def test_a_check_reports_images_without_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height: float, cause: str
) -> None:
    """A table may hide all objects from a camera that is directed at them."""
    scene = small_scene(tmp_path, large_boxes(), BOTH, layouts=1, views=1)
    camera = Camera.look_at((0.1, 0, height), (0, 0, 9 * height), width=64, height=48, fov_x=40)

    def render(scene: Scene, index: int, *, layout: Any) -> Any:
        frame = render_boxes(scene, index, layout=layout)
        labels = replace(frame.labels, instances=(), dropped={"hidden": 2, "small": 0})
        return replace(frame, labels=labels, plan=replace(frame.plan, camera=camera))

    monkeypatch.setattr(time_check, "settle_layout", partial(scatter_boxes, progress=None))
    monkeypatch.setattr(time_check, "render_frame", render)
    found, _ = time_check.measure_run(scene)
    assert not found.ok and "no label (not labelled: 4 hidden)" in found.text and cause in found.remedy


def test_a_run_states_its_time_after_three_images(tmp_path: Path) -> None:
    """The first image takes longer, because it compiles kernels, and does not count."""
    scene = small_scene(tmp_path, large_boxes(), BOTH, layouts=3, views=2)
    notes: list[str] = []

    def render(scene: Scene, index: int, *, layout: Any) -> Any:
        frame = render_boxes(scene, index, layout=layout)
        return replace(frame, seconds={"trace": 50.0 if index == 0 else 2.0})

    write_dataset(
        scene,
        tmp_path / "out",
        render=render,
        settle=scatter_boxes,
        progress=lambda done, total, text: notes.append(text),
    )
    (stated,) = (note for note in notes if note.startswith("time: about "))
    assert "about 12 s in one process: 6 images of 2 s, and 3 layouts" in stated
    assert notes.index(stated) == notes.index("frame 2") + 1


def test_an_estimate_from_first_images_of_several_processes_is_corrected_later() -> None:
    run = time_estimate.RunTime(0, 100, settles_first=False)
    texts = [run.add({"trace": seconds}) for seconds in (50.0, 52.0, 51.0, 48.0, 2.0, 1.9, 2.0)]
    assert [bool(text) for text in texts] == [False, False, True, False, True, False, False]
    assert texts[4].startswith("about 3 min in one process: 100 images of 2 s")


def test_the_reason_why_trial_images_failed_is_reported(
    scene_data: dict[str, Any], write_scene: WriteScene, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    path = write_scene(scene_data)

    def fail(scene: Scene) -> Iterator[Finding]:
        raise InputError(f"{path}: camera: the eye of frame 0 must not be in a solid")
        yield

    monkeypatch.setattr(path_checks, "check_path", lambda path, allow_outside: iter(()))
    monkeypatch.setattr(time_check, "measure_run", fail)
    assert run("check", path) == 1
    assert "look  trial run: camera: the eye of frame 0 must not be in a solid" in capsys.readouterr().out
