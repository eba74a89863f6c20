"""Audit of BOP files: each number is compared, by the definitions of the BOP toolkit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mitsplat.audit.bop_check import BopCheck, _box_iou
from mitsplat.audit.dataset_check import Violation
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.dataset.write import write_dataset
from mitsplat.scene.spec.camera_spec import Intrinsics
from tests.conftest import BOTH, box_asset, small_scene
from tests.drawn import render_boxes, scatter_boxes
from tests.manifests import records_of

SCENE = "bop/train/000000/scene_"
MODELS = "bop/models/models_info.json"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bop")
    rods = [box_asset("nut", (0.3, 0.06, 0.05)), box_asset("bolt", (0.05, 0.06, 0.3))]
    scene = small_scene(folder, rods, BOTH, layouts=3, views=2, formats=["bop"])
    lens = scene.spec.camera.model_copy(update={"intrinsics": Intrinsics(fx=58.0, fy=66.0, cx=30.0, cy=26.0)})
    scene = replace(scene, spec=scene.spec.model_copy(update={"camera": lens}))
    return write_dataset(scene, folder / "out", render=render_boxes, settle=scatter_boxes).path


@pytest.fixture
def dataset(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "out"))


def violations_of(root: Path) -> list[Violation]:
    """Return the violations of the BOP files alone."""
    content = json.loads((root / "dataset.json").read_text())
    check = BopCheck(root, content)
    found: list[Violation] = []
    for record in records_of(root):
        found += check.check(DecodedFrame(root, record, content))
    return [*found, *check.finish()]


def numbers_in(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the container and the key of every number."""
    for key, part in value.items() if isinstance(value, dict) else enumerate(value):
        if isinstance(part, list | dict):
            yield from numbers_in(part)
        else:
            yield value, key


def edit(file: Path, change: Callable[[Any], object]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize("file", [f"{SCENE}camera.json", f"{SCENE}gt.json", f"{SCENE}gt_info.json"])
def test_every_changed_number_of_a_frame_is_a_violation(dataset: Path, file: str) -> None:
    assert violations_of(dataset) == []
    content = json.loads((dataset / file).read_text())
    for owner, key in list(numbers_in(content["1"])):
        value = owner[key]
        owner[key] += 0.001 if isinstance(value, float) else 1
        (dataset / file).write_text(json.dumps(content))
        assert [where for where, text in violations_of(dataset) if "frame 1" in text] == [file], key
        owner[key] = value


@pytest.mark.parametrize(("file", "amount"), [("bop/camera.json", 1e-6), (MODELS, 0.1)])
def test_every_changed_number_of_a_dataset_is_a_violation(dataset: Path, file: str, amount: float) -> None:
    content = json.loads((dataset / file).read_text())
    for owner, key in list(numbers_in(content)):
        value = owner[key]
        owner[key] += amount
        (dataset / file).write_text(json.dumps(content))
        assert [where for where, _ in violations_of(dataset)] == [file], key
        owner[key] = value


def test_rounding_of_model_files_is_no_violation(dataset: Path) -> None:
    """Model files of other writers may have two decimals [mm]."""
    edit(dataset / MODELS, lambda info: info["1"].update(diameter=info["1"]["diameter"] + 0.009))
    assert violations_of(dataset) == []


def test_a_model_without_labelled_object_is_a_violation(dataset: Path) -> None:
    edit(dataset / MODELS, lambda info: info.update({"3": info["1"]}))
    assert violations_of(dataset) == [(MODELS, "has an entry 3, which is no labelled object")]


@pytest.mark.parametrize(("scale", "bound"), [(0.73, ""), (0.6, "0.40"), (1.7, "0.35")])
def test_models_of_another_size_do_not_fit_their_silhouettes(dataset: Path, scale: float, bound: str) -> None:
    """A box scaled by s has an IoU of s² or 1 / s² with the original; half is the limit."""
    model = dataset / "bop/models/obj_000001.ply"
    head, body = model.read_text().split("end_header\n")
    rows = [line.split() for line in body.splitlines()]
    scaled = [[*(str(scale * float(value)) for value in row[:3]), *row[3:]] if len(row) == 6 else row for row in rows]
    model.write_text(f"{head}end_header\n" + "".join(" ".join(row) + "\n" for row in scaled))
    edit(dataset / MODELS, lambda info: info.update({"1": {key: scale * value for key, value in info["1"].items()}}))
    found = violations_of(dataset)
    assert [file for file, _ in found] == ["bop/models/obj_000001.ply"] * bool(bound)
    assert all(text.endswith(f"boxes have an IoU below {bound}") for _, text in found)


def test_valid_pixels_are_those_of_the_silhouette_with_depth(dataset: Path) -> None:
    """As in ``calc_gt_info.py``: pixels of the silhouette, also occluded ones, where the depth is not 0."""
    file = dataset / "bop/train/000000/depth/000000.png"
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    depth[::2] = 0
    cv2.imwrite(str(file), depth)
    info = json.loads((dataset / f"{SCENE}gt_info.json").read_text())
    for position, entry in enumerate(info["0"]):
        mask = cv2.imread(str(dataset / f"bop/train/000000/mask/000000_{position:06d}.png"), cv2.IMREAD_UNCHANGED)
        entry["px_count_valid"] = int(np.count_nonzero(depth[mask > 0]))
    (dataset / f"{SCENE}gt_info.json").write_text(json.dumps(info))
    assert violations_of(dataset) == []


@pytest.mark.parametrize("wrong", [None, "x", [1.0] * 8, {}])
def test_malformed_matrices_are_violations(dataset: Path, wrong: Any) -> None:
    edit(dataset / f"{SCENE}gt.json", lambda content: content["0"][0].update(cam_R_m2c=wrong))
    edit(dataset / f"{SCENE}camera.json", lambda content: content["1"].update(cam_K=wrong))
    found = {where for where, text in violations_of(dataset) if "cam_R_m2c is" in text or "cam_K is" in text}
    assert found == {f"{SCENE}gt.json", f"{SCENE}camera.json"}


@pytest.mark.parametrize("change", [lambda entries: entries.append(entries[0]), lambda entries: entries.pop()])
def test_an_instance_too_many_or_too_few_is_a_violation(dataset: Path, change: Callable[[list[Any]], object]) -> None:
    edit(dataset / f"{SCENE}gt.json", lambda content: change(content["1"]))
    found = violations_of(dataset)
    assert [where for where, _ in found] == [f"{SCENE}gt.json"] and "frame 1 must have" in found[0][1]


def test_entries_after_the_last_frame_of_each_scene_are_violations(dataset: Path) -> None:
    files = sorted(dataset.glob("bop/*/*/scene_gt.json"), key=lambda file: file.parent.name)
    for file in files:
        edit(file, lambda content: content.update({"9": next(iter(content.values()))}))
    assert [where for where, _ in violations_of(dataset)] == [str(file.relative_to(dataset)) for file in files]


@pytest.mark.parametrize(
    ("other", "expected"),
    [((5, 5, 15, 15), 25 / 175), ((12, 12, 14, 14), 0), ((12, 0, 14, 10), 0), ((0, 0, 10, 10), 1)],
)
def test_the_iou_of_boxes_is_that_of_their_areas(other: tuple[int, ...], expected: float) -> None:
    assert _box_iou(np.array([0, 0, 10, 10]), np.array(other)) == pytest.approx(expected)
