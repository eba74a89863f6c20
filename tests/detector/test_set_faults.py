"""Labelled sets that most readers accept with wrong or missing labels."""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsplat.detector.labelled_sets.labelled_set import match_classes
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.errors import InputError
from tests.detector.painted import write_coco, write_yolo

WIDTH, HEIGHT = 100, 80
LINE = "0 0.5 0.5 0.2 0.25\n"
NAME = unicodedata.normalize("NFC", "größe")


def yolo(root: Path, images: tuple[str, ...], labels: tuple[str, ...], names: str = "[nut, bolt]") -> Path:
    """Write a YOLO folder with one label in each label file."""
    for folder in ("images/train", "labels/train"):
        (root / folder).mkdir(parents=True)
    (root / "data.yaml").write_text(f"train: images/train\nnames: {names}\n")
    for name in images:
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(root / "images/train" / name)
    for name in labels:
        (root / "labels/train" / name).write_text(LINE)
    return root


def coco(root: Path, annotation: dict[str, Any], **more: Any) -> Path:
    """Write a COCO folder of one image with one annotation."""
    root.mkdir(exist_ok=True)
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(root / f"{NAME}.png")
    image = {"id": 1, "file_name": f"{NAME}.png", "width": WIDTH, "height": HEIGHT}
    given = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [40, 30, 20, 10], **annotation}
    categories = [{"id": 1, "name": "nut"}, {"id": 2, "name": "bolt"}]
    content = {"images": [image], "annotations": [given], "categories": categories, **more}
    (root / "train.json").write_text(json.dumps(content))
    return root


@pytest.mark.parametrize("label", [f"{unicodedata.normalize('NFD', NAME)}.txt", f"{NAME.upper()}.txt", f"{NAME}.TXT"])
@pytest.mark.parametrize("others", [(), ("other",)])
def test_labels_in_another_spelling_than_their_image_are_refused(
    tmp_path: Path, label: str, others: tuple[str, ...]
) -> None:
    """The image counted as one without objects if other images had labels."""
    images = (f"{NAME}.png", *(f"{name}.png" for name in others))
    root = yolo(tmp_path / "a", images, (label, *(f"{name}.txt" for name in others)))
    with pytest.raises(InputError, match=rf"must be named as its image {NAME} with \.txt \(got another letter case"):
        read_set(root, "train")


def test_images_without_labels_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """They may be images of which nobody has drawn the labels yet. An empty label file states that there are none."""
    root = write_yolo(tmp_path / "yolo", {"train": 6})
    for number in (1, 3, 4, 5):
        (root / f"labels/train/00000{number}.txt").unlink()
    (root / "labels/train/000002.txt").write_text("")
    assert [len(sample.instances) for sample in read_set(root, "train").samples][1:] == [0] * 5
    names = "images/train/000001.png, images/train/000003.png, images/train/000004.png and 1 more"
    told = "of 6 images have no labels and count as images without objects"
    assert caplog.messages == [f"{root}: 4 {told}; an empty label file confirms it: {names}"]
    caplog.clear()
    root = write_coco(tmp_path / "coco", 6)
    path = root / "labels.json"
    labels = json.loads(path.read_text())
    labels["annotations"] = [one for one in labels["annotations"] if one["image_id"] != 20]
    path.write_text(json.dumps(labels))
    read_set(root, "train")
    assert caplog.messages == [f"{root}: 1 {told}: p2.png"]
    caplog.clear()
    write_yolo(tmp_path / "whole", {"train": 2})
    read_set(tmp_path / "whole", "train")
    assert caplog.messages == []


def test_a_missing_folder_of_a_split_is_refused(tmp_path: Path) -> None:
    """The other folders of the split were read alone."""
    root = write_yolo(tmp_path / "a", {"train": 2, "val": 1})
    for train in ("[images/train, images/more]", "[images/more, images/train]"):
        (root / "data.yaml").write_text(f"train: {train}\nval: images/val\nnames: [disc, box]\n")
        for split in ("train", "all"):
            with pytest.raises(
                InputError, match=rf"data\.yaml: train must name folders or lists .* {root}/images/more\)"
            ):
                read_set(root, split)  # type: ignore[arg-type]
        assert len(read_set(root, "val").samples) == 1


def test_a_split_without_a_folder_is_named_if_all_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = write_yolo(tmp_path / "a", {"train": 2})
    (root / "data.yaml").write_text("train: images/train\nval: images/vall\nnames: [disc, box]\n")
    assert len(read_set(root, "all").samples) == 2
    assert caplog.messages == [f"{root}: there are no images for val in {root}/images/vall"]
    assert len(read_set(root, "train").samples) == 2 and len(caplog.messages) == 1


def test_labels_without_an_image_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = yolo(tmp_path / "a", ("a.png", "b.png"), ("a.txt", "c.txt", "d.txt"))
    assert [len(sample.instances) for sample in read_set(root, "train").samples] == [1, 0]
    folder = root / "labels/train"
    assert caplog.messages == [
        f"{folder}: c.txt and 1 more are not used, because {root / 'images/train'} has no image of these names",
        f"{root}: 1 of 2 images have no labels and count as images without objects; an empty label file confirms it: "
        "images/train/b.png",
    ]
    caplog.clear()
    (root / "chosen.txt").write_text("images/train/a.png\n")
    (root / "data.yaml").write_text("train: chosen.txt\nnames: [nut, bolt]\n")
    for name in ("c.txt", "d.txt"):
        (folder / name).unlink()
    (folder / "b.txt").write_text(LINE)
    assert len(read_set(root, "train").samples) == 1 and not caplog.messages


@pytest.mark.parametrize(
    ("names", "got"), [("[nut, null]", "None"), ("[[nut], bolt]", r"\['nut'\]"), ('["", bolt]', "''")]
)
def test_names_that_are_no_text_are_refused(tmp_path: Path, names: str, got: str) -> None:
    root = yolo(tmp_path / "a", ("a.png",), ("a.txt",), names)
    with pytest.raises(InputError, match=rf"data\.yaml: names must be text \(got {got}\)"):
        read_set(root, "train")


def run_lengths(mask: np.ndarray, order: Any) -> dict[str, Any]:
    values = mask.ravel(order=order)
    changes = np.flatnonzero(np.diff(values)) + 1
    return {"size": [HEIGHT, WIDTH], "counts": np.diff([0, *changes, values.size]).tolist()}


def test_run_lengths_that_are_stored_by_rows_are_refused(tmp_path: Path) -> None:
    """The mask was spread over other pixels, which include those of the box."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[30:40, 40:60] = 1
    (instance,) = read_set(coco(tmp_path, {"segmentation": run_lengths(mask, "F")}), "train").samples[0].instances
    assert instance.box == (40, 30, 60, 40)
    with pytest.raises(InputError, match=r"bbox must enclose its segmentation, .*: are run lengths stored by rows"):
        read_set(coco(tmp_path, {"segmentation": run_lengths(mask, "C")}), "train")


@pytest.mark.parametrize(
    ("annotation", "more", "sentence"),
    [
        ({"bbox": []}, {}, r"annotation 1: bbox must be x, y, width, height \(got \[\]\)"),
        ({"segmentation": [40, 30, 60, 30, 60, 40]}, {}, r"must be a list of polygons \(got a list of numbers\)"),
        ({}, {"categories": [{"id": 1, "name": ""}]}, r"names of categories must be text"),
        ({}, {"images": [{"id": k, "file_name": f"{NAME}.png"} for k in (1, 2)]}, r"must be listed once"),
    ],
)
def test_faults_of_a_coco_file_are_one_sentence(
    tmp_path: Path, annotation: dict[str, Any], more: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        read_set(coco(tmp_path, annotation, **more), "train")


def test_classes_of_several_coco_files_are_matched_by_name(tmp_path: Path) -> None:
    """Tools number the categories of each export in the order of their first label."""
    root = coco(tmp_path, {"category_id": 2})
    content = json.loads((root / "train.json").read_text())
    content["images"][0]["file_name"] = "other.png"
    content["categories"] = [{"id": 1, "name": "bolt"}, {"id": 2, "name": "nut"}]
    (root / "val.json").write_text(json.dumps(content))
    (root / "other.png").write_bytes((root / f"{NAME}.png").read_bytes())
    found = read_set(root, "all")
    names = {sample.name: found.class_names[sample.instances[0].class_index] for sample in found.samples}
    assert names == {f"{NAME}.png": "bolt", "other.png": "nut"}


def test_boxes_alone_count_once_each(tmp_path: Path) -> None:
    boxes = [[40, 30, 20, 10], [10, 30, 20, 10], [40, 30, 20, 10], [0, 0, 1, 1]]
    annotations = [{"id": i, "image_id": 1, "category_id": 1, "bbox": box} for i, box in enumerate(boxes)]
    (sample,) = read_set(coco(tmp_path / "four", {}, annotations=annotations), "train").samples
    assert [one.box for one in sample.instances] == [(40, 30, 60, 40), (10, 30, 30, 40), (0, 0, 1, 1)]
    (fewer,) = read_set(coco(tmp_path / "three", {}, annotations=annotations[:3]), "train").samples
    assert sample.digest != fewer.digest


def test_images_are_found_in_the_unicode_form_of_macos(tmp_path: Path) -> None:
    image = {"id": 1, "file_name": unicodedata.normalize("NFD", f"{NAME}.png")}
    assert len(read_set(coco(tmp_path, {}, images=[image]), "train").samples) == 1


def test_images_of_other_classes_alone_become_images_without_objects(tmp_path: Path) -> None:
    """Labels of other classes are left out, and the class index follows the order of the detector's classes."""
    root = yolo(tmp_path, ("a.png", "b.png", "c.png"), ("a.txt", "b.txt", "c.txt"))
    for name, classes in (("a", "0"), ("b", "1"), ("c", "01")):
        (root / f"labels/train/{name}.txt").write_text("".join(f"{one} 0.5 0.5 0.2 0.{one}5\n" for one in classes))
    found = read_set(root, "train")
    only = match_classes(found, ("bolt",), "the detector")
    assert [[one.class_index for one in sample.instances] for sample in only.samples] == [[], [0], [0]]
    assert dict(only.other_labels) == {"nut": 2}
    turned = match_classes(found, ("bolt", "nut"), "the detector")
    assert [[one.class_index for one in sample.instances] for sample in turned.samples] == [[1], [0], [1, 0]]
    assert dict(turned.other_labels) == {}


@pytest.mark.parametrize("side", [(0, -1), (1, -1), (0, 1), (1, 1)], ids=["left", "top", "right", "bottom"])
@pytest.mark.parametrize(
    ("length", "beyond", "is_refused"),
    [(40, 9, False), (40, 11, True), (32, 8, False), (4, 2, False), (4, 3, True), (40, 3, False)],
)
def test_a_mask_may_leave_its_box_by_two_pixels_or_a_quarter_of_its_side(
    tmp_path: Path, side: tuple[int, int], length: int, beyond: int, is_refused: bool
) -> None:
    """The mask is the box, extended on one side. The other side of the box has another length."""
    axis, sign = side
    low, size = np.array([20, 20]), np.full(2, 36)
    size[axis] = length
    start, end = low.copy(), low + size
    (start if sign < 0 else end)[axis] += sign * beyond
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[start[1] : end[1], start[0] : end[0]] = 1
    root = coco(tmp_path, {"bbox": [*low.tolist(), *size.tolist()], "segmentation": run_lengths(mask, "F")})
    if is_refused:
        with pytest.raises(InputError, match="bbox must enclose its segmentation"):
            read_set(root, "train")
    else:
        (instance,) = read_set(root, "train").samples[0].instances
        assert instance.box == (*low, *(low + size))
