"""Labelled images read from folders, and refused input."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from pycocotools import mask as coco_mask

from mitsplat.detector.labelled_sets.coco_annotations import _run_lengths
from mitsplat.detector.labelled_sets.labelled_set import LabelledSet, check_masks, reorder_classes
from mitsplat.detector.labelled_sets.pictures import read_upright
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.training import read_sets, write_data
from mitsplat.errors import InputError
from tests.detector.painted import CLASSES, HEIGHT, WIDTH, paint, write_coco, write_yolo


def masks_of(found: LabelledSet) -> list[list[tuple[str, np.ndarray]]]:
    return [
        [
            (found.class_names[one.class_index], coco_mask.decode(one.encode_mask(sample.width, sample.height)) > 0)
            for one in sample.instances
        ]
        for sample in found.samples
    ]


@pytest.mark.parametrize("kind", ["mitsplat", "yolo", "polygons", "compressed", "lengths"])
def test_masks_are_read_from_every_kind_of_folder(tmp_path: Path, kind: str) -> None:
    if kind in ("mitsplat", "yolo"):
        write_yolo(tmp_path, {"train": 4}, mitsplat=kind == "mitsplat")
    else:
        write_coco(tmp_path, 4, form=kind)
    found = read_set(tmp_path, "train")
    assert found.kind == (kind if kind in ("mitsplat", "yolo") else "coco")
    assert [(s.width, s.height) for s in found.samples] == [(WIDTH, HEIGHT)] * 4
    for seed, shown in enumerate(masks_of(found)):
        _, truth = paint(seed)
        assert [name for name, _ in shown] == [name for name, _ in truth]
        for (_, mask), (_, expected) in zip(shown, truth, strict=True):
            iou = np.count_nonzero(mask & expected) / np.count_nonzero(mask | expected)
            assert iou > 0.98


def test_the_requested_split_is_read(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 3, "val": 2, "test": 1})
    assert [len(read_set(root, split).samples) for split in ("train", "val", "test", "all")] == [3, 2, 1, 6]  # type: ignore[arg-type]
    alone = write_yolo(tmp_path / "mitsplat", {"train": 3}, mitsplat=True)
    assert "val: images/train" in (alone / "data.yaml").read_text()  # Ultralytics requires an entry
    with pytest.raises(InputError, match=r"there are no images for val \(it has 3 for train\)"):
        read_set(alone, "val")


def test_the_current_folder_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_yolo(tmp_path, {"train": 2})
    monkeypatch.chdir(tmp_path)
    assert [sample.name for sample in read_set(".", "train").samples] == [f"images/train/00000{i}.png" for i in (0, 1)]


def test_a_list_of_images_and_a_path_are_followed(tmp_path: Path) -> None:
    root = write_yolo(tmp_path / "all", {"train": 3})
    (root / "chosen.txt").write_text("./images/train/000001.png\n")
    other = tmp_path / "other"
    other.mkdir()
    (other / "data.yaml").write_text("path: ../all\ntrain: [chosen.txt]\nnames: [disc, box]\n")
    assert [sample.path.name for sample in read_set(other, "train").samples] == ["000001.png"]


def test_coco_files_are_chosen_by_split_and_images_found_below(tmp_path: Path) -> None:
    root = write_coco(tmp_path, 3)
    (root / "annotations").mkdir()
    for split in ("train", "val"):
        (root / f"annotations/instances_{split}.json").write_bytes((root / "labels.json").read_bytes())
    (root / "labels.json").unlink()
    assert len(read_set(root, "val").samples) == 3
    with pytest.raises(InputError, match="must have test in its name"):
        read_set(root, "test")


def test_a_supercategory_that_one_coco_file_labels_is_a_class_of_all(tmp_path: Path) -> None:
    for split, first in (("train", 10), ("val", 20)):
        path = write_coco(tmp_path / split, 3, first=first) / "labels.json"
        labels = json.loads(path.read_text())
        labels["categories"] = [one | {"supercategory": "part"} for one in labels["categories"]]
        labels["categories"].append({"id": 70, "name": "part"})
        if split == "train":
            labels["annotations"].append(labels["annotations"][0] | {"id": 70, "category_id": 70})
        path.write_text(json.dumps(labels))
    found = read_set(tmp_path, "all")
    assert found.class_names == ("box", "disc", "part") and len(found.samples) == 6
    assert read_set(tmp_path, "val").class_names == ("box", "disc")


@pytest.mark.parametrize("folder", ["", "images"])
def test_images_of_one_name_are_found_in_the_folder_of_their_split(tmp_path: Path, folder: str) -> None:
    (tmp_path / "annotations").mkdir()
    for number, split in enumerate(("train2017", "val2017")):
        made = write_coco(tmp_path / "made" / split, 3, first=10 * number)
        shutil.copytree(made / "photos", tmp_path / folder / split)
        (made / "labels.json").rename(tmp_path / f"annotations/instances_{split}.json")
    shutil.rmtree(tmp_path / "made")
    for number, split in enumerate(("train", "val")):
        for sample, seed in zip(read_set(tmp_path, split).samples, range(10 * number, 10 * number + 3), strict=True):  # type: ignore[arg-type]
            np.testing.assert_array_equal(read_upright(sample.path), paint(seed)[0])
    assert len(read_set(tmp_path, "all").samples) == 6
    shutil.copytree(tmp_path / folder / "val2017", tmp_path / "more/val")
    with pytest.raises(InputError, match=r"p0.png must be one image in .* \(got 2\)"):
        read_set(tmp_path, "val")


def test_classes_are_matched_by_name(tmp_path: Path) -> None:
    found = read_set(write_coco(tmp_path, 3), "train")
    assert found.class_names == ("box", "disc")  # ordered by the ids of the file
    turned = reorder_classes(found, CLASSES, "out/cell")
    assert turned.class_names == CLASSES
    for sample, seed in zip(turned.samples, range(3), strict=True):
        assert [CLASSES[i.class_index] for i in sample.instances] == [name for name, _ in paint(seed)[1]]
    with pytest.raises(InputError, match=r"it also has box \(2 labels\) and it lacks gear, nut"):
        reorder_classes(found, ("disc", "nut", "gear"), "out/cell")


@pytest.mark.parametrize("boxes", [False, True])
def test_data_written_for_ultralytics_equals_the_data_read(tmp_path: Path, boxes: bool) -> None:
    write_yolo(tmp_path / "a", {"train": 2}, mitsplat=True, boxes=boxes)
    write_coco(tmp_path / "b", 2, first=50, form="compressed")
    sets, real = read_sets([tmp_path / "a"], tmp_path / "b", masks=not boxes)
    assert real is not None
    listing = write_data([*sets, real], tmp_path / "data")
    images = [Path(line) for line in listing.read_text().splitlines()]
    assert images == sorted(images) and len(images) == 4
    (tmp_path / "data/data.yaml").write_text("train: images.txt\nnames: [disc, box]\n")
    again = read_set(tmp_path / "data", "train")
    for sample, seed in zip(again.samples, (0, 1, 50, 51), strict=True):
        image, truth = paint(seed)
        assert np.array_equal(cv2.imread(str(sample.path)), image)
        for instance, (name, mask) in zip(sample.instances, truth, strict=True):
            assert CLASSES[instance.class_index] == name
            x0, y0, w, h = coco_mask.toBbox(coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8)))
            assert np.abs(np.subtract(instance.box, (x0, y0, x0 + w, y0 + h))).max() < 0.05
            assert instance.has_mask != boxes


def test_masks_from_datasets_with_boxes_are_refused(tmp_path: Path) -> None:
    found = read_set(write_yolo(tmp_path, {"train": 2}, boxes=True), "train")
    with pytest.raises(InputError, match=r"images/train/000000.png has only boxes: .* such as yolo11n"):
        check_masks(found)
    assert check_masks(read_set(write_yolo(tmp_path / "b", {"train": 2}), "train")) is None


def test_crowds_are_not_written_as_labels(tmp_path: Path) -> None:
    found = read_set(write_coco(tmp_path / "c", 1, form="compressed", crowd=True), "train")
    write_data([found], tmp_path / "data")
    assert (tmp_path / "data/labels/0000000.txt").read_text() == ""


def test_a_photograph_with_exif_rotation_has_its_displayed_size(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 1})
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(paint(0)[0]).save(root / "images/train/000000.jpg", exif=exif)
    (root / "images/train/000000.png").unlink()
    (sample,) = read_set(root, "train").samples
    assert (sample.width, sample.height) == (HEIGHT, WIDTH) == cv2.imread(str(sample.path)).shape[1::-1]


def _line(text: str) -> Callable[[Path], object]:
    return lambda root: (root / "labels/train/000001.txt").write_text(text)


YOLO_FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "class": (_line("2 0.1 0.1 0.2 0.1 0.2 0.2\n"), r"000001.txt:1: the class must be 0 to 1 \(got 2\)"),
    "fraction": (_line("0.5 0.1 0.1 0.2 0.1 0.2 0.2\n"), r"the class must be 0 to 1 \(got 0.5\)"),
    "beyond": (_line("0 0.1 0.1 0.2 0.1 1.2 0.2\n"), r"must lie in the image, .* \(got 1.2\)"),
    "nan": (_line("0 0.1 0.1 0.2 nan 0.2 0.2\n"), r"must lie in the image, .* \(got nan\)"),
    "torn": (
        _line("0 0.1 0.1 0.2 0.1 0.2\n"),
        r"000001.txt:1: must be a class and a box .* \(got 6 numbers\): is the last one a",
    ),
    "pixels": (_line("0 50 40 40 40\n"), r"must lie in the image, .* \(got 70\): are they pixels\?"),
    "word": (_line("0 0.1 0.1 o.2 0.1 0.2 0.2\n"), r"000001.txt:1: must be numbers"),
    "negative": (_line("0 0.5 0.5 -0.1 0.2\n"), r"000001.txt:1: must have a width and a height of at least 0"),
    "count": (
        lambda root: (root / "data.yaml").write_text("train: images/train\nnc: 3\nnames: [disc, box]\n"),
        r"data.yaml: nc must be the number of names, 2 \(got 3\)",
    ),
    "flat": (_line("0 0.1 0.1 0.2 0.1 0.3 0.1\n"), r"must have a width and a height"),
    "image": (
        lambda root: (root / "images/train/000001.png").write_bytes(
            (root / "images/train/000001.png").read_bytes()[:-20]
        ),
        r"000001.png: cannot be read as an image",
    ),
    "jpeg": (
        lambda root: (root / "images/train/000009.jpg").write_bytes(
            cv2.imencode(".jpg", paint(1)[0])[1].tobytes()[:-9]
        ),
        r"000009.jpg: is truncated",
    ),
    "no end": (
        lambda root: (root / "images/train/000009.jpg").write_bytes(
            cv2.imencode(".jpg", paint(1)[0])[1].tobytes()[:-2]
        ),
        r"000009.jpg: is truncated",
    ),
    "trailer": (
        lambda root: (root / "images/train/000009.jpg").write_bytes(
            cv2.imencode(".jpg", paint(1)[0])[1].tobytes() + b"trailer"
        ),
        r"000009.jpg: has 7 bytes after its end marker",
    ),
    "bmp": (
        lambda root: (root / "images/train/000009.bmp").write_bytes(
            cv2.imencode(".bmp", paint(1)[0])[1].tobytes()[:9000]
        ),
        r"000009.bmp: (cannot be read as an image|OpenCV must decode it to)",
    ),
    "gif": (
        lambda root: Image.fromarray(paint(1)[0]).save(root / "images/train/000001.png", format="GIF"),
        r"000001.png: must be a JPEG, PNG, BMP, TIFF or WebP file \(got GIF\)",
    ),
    "link": (
        lambda root: (
            (root / "labels/train/000001.txt").unlink(),
            (root / "labels/train/000001.txt").symlink_to(root / "elsewhere.txt"),
        ),
        r"000001.txt: must be a file \(got a link to nothing\)",
    ),
    "keypoints": (
        lambda root: (root / "data.yaml").write_text("train: images/train\nnames: [disc, box]\nkpt_shape: [2, 2]\n"),
        r"data.yaml: labels must be boxes or masks \(got keypoints, kpt_shape\)",
    ),
    "latin": (
        lambda root: (
            (root / "data.yaml").write_text("train: some.txt\nnames: [disc, box]\n"),
            (root / "some.txt").write_bytes("./images/train/caf\u00e9.png\n".encode("latin-1")),
        ),
        r"some.txt: must be lines of text in UTF-8",
    ),
    "nowhere": (
        lambda root: (root / "data.yaml").write_text("train: pictures\nnames: [disc, box]\n"),
        r"there are no images for train in .*/pictures",
    ),
    "labels": (lambda root: [path.unlink() for path in root.glob("labels/*/*")], "its images have no labels"),
    "listed": (
        lambda root: (
            (root / "data.yaml").write_text("train: some.txt\nnames: [disc, box]\n"),
            (root / "some.txt").write_text("./images/train/000000.png\n./images/train/none.png\n"),
        ),
        r"images/train/none.png: cannot be read \(No such file",
    ),
    "bytes": (
        lambda root: (root / "images/train" / os.fsdecode(b"caf\xe9.png")).write_bytes(b""),
        r"names of files and folders must be UTF-8 \(got b'.*caf\\xe9\.png'\)$",
    ),
    "names": (lambda root: (root / "data.yaml").write_text("train: images/train\nnames: [a, a]\n"), "names must be"),
    "yaml": (lambda root: (root / "data.yaml").write_text("train: [\n"), "data.yaml: cannot be read as YAML"),
    "nothing": (lambda root: [path.write_text("") for path in root.glob("labels/*/*")], "images have no labels"),
}


@pytest.mark.parametrize("fault", YOLO_FAULTS)
def test_each_fault_of_a_yolo_folder_is_one_sentence(tmp_path: Path, fault: str) -> None:
    root = write_yolo(tmp_path, {"train": 2})
    spoil, message = YOLO_FAULTS[fault]
    spoil(root)
    with pytest.raises(InputError, match=message) as told:
        read_set(root, "train")
    assert "\n" not in str(told.value) and "run lengths (" not in str(told.value)


def test_an_unfinished_dataset_is_refused_with_its_remedy(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 2}, mitsplat=True)
    (root / "data.yaml").unlink()
    with pytest.raises(
        InputError, match=r"must be a finished dataset \(there is no data\.yaml yet\): continue its `mi"
    ):
        read_set(root, "train")


def test_a_dataset_that_lacks_a_label_is_refused(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 2}, mitsplat=True)
    (root / "labels/train/000001.txt").unlink()
    with pytest.raises(InputError, match=r"000001\.txt: is missing, but its image exists"):
        read_set(root, "train")
    (root / "labels/train/000000.txt").unlink()
    (root / "labels/train").rmdir()
    (root / "labels").rmdir()
    with pytest.raises(InputError, match=r"add yolo to output\.formats"):
        read_set(root, "train")


COCO_FAULTS: dict[str, tuple[Callable[[dict], object], str]] = {  # type: ignore[type-arg]
    "class": (lambda c: c["annotations"][0].update(category_id=9), r"category_id must be in the file \(got 9\)"),
    "image": (lambda c: c["annotations"][0].update(image_id=9), r"image_id must be in the file \(got 9\)"),
    "missing": (lambda c: c["images"][0].update(file_name="none.png"), r"none.png must be one image in .* \(got 0\)"),
    "outside": (lambda c: c["images"][0].update(file_name="../../x.png"), "file_name must be of an image in"),
    "size": (lambda c: c["images"][0].update(width=64, height=96), r"the size in labels.json, 64 x 96 px"),
    "beyond": (lambda c: c["annotations"][0].update(bbox=[0, 0, 200, 10]), r"bbox: positions must lie in the image"),
    "bbox": (lambda c: c["annotations"][0].update(bbox=[0, 0, 10]), r"bbox must be x, y, width, height"),
    "empty": (lambda c: c["annotations"][0].update(bbox=[0, 0, 0, 10]), r"bbox must have a width and a height"),
    "fractions": (
        lambda c: [one.update(bbox=[0.1, 0.1, 0.2, 0.3], segmentation=[]) for one in c["annotations"]],
        r"labels.json: bbox must be in pixels \(got at most 1 in every annotation",
    ),
    "elsewhere": (
        lambda c: c["annotations"][0].update(bbox=[2, 2, 10, 10], segmentation=[[60, 40, 80, 40, 80, 50]]),
        r"bbox must enclose its segmentation, which spans \[61, 40, 19, 10\]",
    ),
    "corners": (
        lambda c: c["annotations"][0].update(bbox=[10, 20, 40, 35], segmentation=[[10, 20, 40, 20, 40, 35, 10, 35]]),
        r"bbox must be x, y, width, height, not its two corners \(got \[10, 20, 40, 35\]",
    ),
    "centre": (
        lambda c: c["annotations"][0].update(bbox=[25, 27.5, 30, 15], segmentation=[[10, 20, 40, 20, 40, 35, 10, 35]]),
        "not its centre and size",
    ),
    "area": (
        lambda c: c["annotations"][0].update(bbox=[10, 20, 40, 35], area=450, segmentation=[]),
        r"bbox must be x, y, width, height, not its two corners \(got \[10, 20, 40, 35\], area 450\)",
    ),
    "rotation": (
        lambda c: c["annotations"][0].update(attributes={"rotation": 30.0}, segmentation=[]),
        r"bbox must not be rotated \(got rotation 30.0\)",
    ),
    "polygon": (
        lambda c: c["annotations"][0].update(segmentation=[[1, 2]]),
        "segmentation must be polygons of 3 points",
    ),
    "rle": (
        lambda c: c["annotations"][0].update(segmentation={"size": [9, 9], "counts": "1"}),
        "segmentation must be of 64 x 96 px",
    ),
    "short": (
        lambda c: c["annotations"][0].update(segmentation={"size": [64, 96], "counts": [100, 20]}),
        r"run lengths must be of 64 x 96 px, 6144 \(got 120\)",
    ),
    "short code": (
        lambda c: c["annotations"][0].update(segmentation={"size": [64, 96], "counts": "zzzz"}),
        "run lengths must be of 64 x 96 px",
    ),
    "crowd": (lambda c: c["annotations"][0].update(iscrowd="0"), "iscrowd must be 0 or 1 \\(got '0'\\)"),
    "key": (lambda c: c["annotations"][0].pop("image_id"), "key 'image_id' is missing"),
    "names": (lambda c: c["categories"][0].update(name="box"), r"names of categories must differ \(got 'box' twice\)"),
    "ids": (
        lambda c: [one.update(id=1) for one in c["categories"]] + [a.update(category_id=1) for a in c["annotations"]],
        r"ids of categories must differ \(got 1 twice\)",
    ),
    "image ids": (
        lambda c: c["images"][1].update(id=c["images"][0]["id"]),
        r"ids of images must differ \(got \d+ twice",
    ),
    "two points": (
        lambda c: c["annotations"][0].update(segmentation=[[1, 1, 5, 5]]),
        r"labels\.json: annotation \d+: segmentation must be polygons of 3 points or more \(got 4 numbers\)$",
    ),
    "mask size": (
        lambda c: c["annotations"][0].update(segmentation={"size": [96, 64], "counts": [96 * 64]}),
        r"labels\.json: annotation \d+: segmentation must be of 64 x 96 px \(got \[96, 64\]\)$",
    ),
    "nothing": (lambda c: c.update(images=[], annotations=[]), "there are no images"),
}


@pytest.mark.parametrize("fault", COCO_FAULTS)
def test_each_fault_of_a_coco_folder_is_one_sentence(tmp_path: Path, fault: str) -> None:
    root = write_coco(tmp_path, 2)
    content = json.loads((root / "labels.json").read_text())
    spoil, message = COCO_FAULTS[fault]
    spoil(content)
    (root / "labels.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as told:
        read_set(root, "train")
    assert "\n" not in str(told.value) and "run lengths (" not in str(told.value)


def test_an_empty_or_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must be a dataset of mitsplat \(dataset.json\), a YOLO folder"):
        read_set(tmp_path, "train")
    with pytest.raises(InputError, match=r"must be the folder of a dataset \(got nothing\)"):
        read_set(tmp_path / "none", "train")


def test_run_lengths_agree_with_pycocotools() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        height, width = rng.integers(1, 300, 2).tolist()
        mask = np.asfortranarray(cv2.blur(rng.random((height, width)), (9, 9)) > rng.uniform(0.4, 0.6), dtype=np.uint8)
        code = coco_mask.encode(mask)
        lengths = _run_lengths(code["counts"].decode())
        assert sum(lengths) == height * width
        again = coco_mask.frPyObjects({"size": [height, width], "counts": lengths}, height, width)
        assert again["counts"] == code["counts"]


def test_a_run_length_without_end_is_refused() -> None:
    """The time to read it would grow with the square of its characters."""
    with pytest.raises(ValueError, match="a run length has too many characters"):
        _run_lengths("o" * 100 + "0")


def test_linked_folders_are_followed_once(tmp_path: Path) -> None:
    root, other = write_yolo(tmp_path / "root", {"train": 2}), write_yolo(tmp_path / "other", {"train": 3})
    for kind in ("images", "labels"):
        (root / kind / "train/more").symlink_to(other / kind / "train")
    (other / "images/train/back").symlink_to(root / "images/train")
    assert len(read_set(root, "train").samples) == 5


@pytest.mark.parametrize("where", ["absolute", "beside"])
def test_image_folders_of_data_yaml_are_found(tmp_path: Path, where: str) -> None:
    root = write_yolo(tmp_path / "root", {"train": 2})
    entry = {"absolute": root / "images/train", "beside": "../images/train"}[where]
    (root / "data.yaml").write_text(f"train: {entry}\nnames: [disc, box]\n")
    assert len(read_set(root, "train").samples) == 2


def test_the_split_all_of_coco_reads_all_files(tmp_path: Path) -> None:
    root = write_coco(tmp_path, 4)
    content = json.loads((root / "labels.json").read_text())
    (root / "labels.json").unlink()
    for name, images in (
        ("instances_train2017", content["images"][:3]),
        ("constrained_val2017", content["images"][3:]),
    ):
        ids = {image["id"] for image in images}
        some = [annotation for annotation in content["annotations"] if annotation["image_id"] in ids]
        (root / f"{name}.json").write_text(json.dumps(content | {"images": images, "annotations": some}))
    assert [len(read_set(root, split).samples) for split in ("train", "val", "all")] == [3, 1, 4]  # type: ignore[arg-type]
    (root / "old_train.json").write_text((root / "instances_train2017.json").read_text())
    with pytest.raises(InputError, match="each image must be listed once in its COCO files"):
        read_set(root, "all")


def test_image_files_are_read_with_any_name(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.jpg"))
    turned = Image.Exif()
    turned[274] = 6
    Image.fromarray(paint(0)[0]).save(path, exif=turned)
    assert read_upright(path).shape == (WIDTH, HEIGHT, 3)
    with pytest.raises(InputError, match=r"none\.png: cannot be read \(No such file"):
        read_upright(tmp_path / "none.png")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty\.png: cannot be read as an image"):
        read_upright(tmp_path / "empty.png")


def test_the_digest_changes_with_images_and_labels(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 2})
    first = read_set(root, "train").to_record()
    assert first == read_set(root, "train").to_record()
    assert first["images"] == 2 and sum(first["instances"].values()) == sum(len(paint(seed)[1]) for seed in (0, 1))
    label = root / "labels/train/000001.txt"
    label.write_text(
        label.read_text().replace("0 ", "1 ", 1) if label.read_text()[0] == "0" else "0" + label.read_text()[1:]
    )
    assert read_set(root, "train").to_record()["digest"] != first["digest"]


def test_exact_duplicates_of_a_label_line_count_once(tmp_path: Path) -> None:
    """As in Ultralytics, which compares class and positions in single precision."""
    root = write_yolo(tmp_path, {"train": 1})
    box, polygon = "0 0.5 0.5 0.2 0.2\n", "1 0.1 0.1 0.3 0.1 0.3 0.3\n"
    same_box = "1 0.1 0.1 0.3 0.1 0.3 0.3 0.1 0.3\n"
    other_class, rounded, moved = "1 0.5 0.5 0.2 0.2\n", "0 0.50 0.500000001 0.2 0.2\n", "0 0.5 0.50001 0.2 0.2\n"
    text = box + polygon + box + same_box + polygon + other_class + rounded + moved
    (root / "labels/train/000000.txt").write_text(text)
    (sample,) = read_set(root, "train").samples
    assert [one.class_index for one in sample.instances] == [0, 1, 1, 1, 0]
    assert [one.polygon is None for one in sample.instances] == [True, False, False, True, True]


def edit_coco(root: Path, edit: Callable[[dict], object]) -> Path:  # type: ignore[type-arg]
    content = json.loads((root / "labels.json").read_text())
    edit(content)
    (root / "labels.json").write_text(json.dumps(content))
    return root


def test_exact_duplicates_of_a_coco_annotation_count_once(tmp_path: Path) -> None:
    root = write_coco(tmp_path, 2)
    once = read_set(root, "train").to_record()["instances"]

    def repeat(content: dict) -> None:  # type: ignore[type-arg]
        content["annotations"] += [one | {"id": one["id"] + 100} for one in content["annotations"]]

    assert read_set(edit_coco(root, repeat), "train").to_record()["instances"] == once


def parent(name: str, above: str, number: int = 0) -> dict[str, object]:
    return {"id": number, "name": name, "supercategory": above}


def test_an_unlabelled_supercategory_is_no_class(tmp_path: Path) -> None:
    """Roboflow writes the project as category 0, above all classes."""
    root = write_coco(tmp_path, 2)
    edit_coco(root, lambda c: [one.update(supercategory="parts") for one in c["categories"]])
    edit_coco(root, lambda c: c["categories"].append(parent("parts", "none")))
    edit_coco(root, lambda c: c["categories"].append(parent("__background__", "none") | {"id": 99}))
    found = read_set(root, "train")
    assert found.class_names == ("box", "disc") and found.samples[0].instances
    reorder_classes(found, CLASSES, "the dataset")


def test_a_labelled_supercategory_stays_a_class_and_has_a_remedy(tmp_path: Path) -> None:
    root = write_coco(tmp_path, 2)
    edit_coco(root, lambda c: [one.update(supercategory="parts") for one in c["categories"]])
    edit_coco(root, lambda c: c["categories"].append(parent("parts", "none")))
    edit_coco(root, lambda c: c["annotations"][0].update(category_id=0))
    found = read_set(root, "train")
    assert found.class_names == ("parts", "box", "disc")
    with pytest.raises(
        InputError, match=r"also has parts \(1 labels\); rename its classes, or remove those without lab"
    ):
        reorder_classes(found, CLASSES, "the dataset")


def test_an_unlabelled_class_above_itself_stays_a_class(tmp_path: Path) -> None:
    root = edit_coco(write_coco(tmp_path, 2), lambda c: c["categories"].append(parent("person", "person", 9)))
    edit_coco(root, lambda c: c["categories"].append(parent("child", "person", 12)))
    assert read_set(root, "train").class_names == ("box", "disc", "person", "child")


def test_a_coco_export_with_folders_of_splits_is_read(tmp_path: Path) -> None:
    """Roboflow: train/_annotations.coco.json, valid/_annotations.coco.json, beside the images."""
    for number, split in enumerate(("train", "valid")):
        other = write_coco(tmp_path / f"made {split}", 2 + number, first=10 * number)
        (tmp_path / "export" / split).mkdir(parents=True)
        for image in (other / "photos").iterdir():
            image.rename(tmp_path / "export" / split / f"{split}_{image.name}")
        edit_coco(other, lambda c, split=split: [i.update(file_name=f"{split}_{i['file_name']}") for i in c["images"]])
        (other / "labels.json").rename(tmp_path / "export" / split / "_annotations.coco.json")
    assert [len(read_set(tmp_path / "export", split).samples) for split in ("train", "val", "all")] == [2, 3, 5]


def test_a_coco_export_without_sizes_and_with_backslashes_is_read(tmp_path: Path) -> None:
    root = write_coco(tmp_path, 2)

    def edit(content: dict) -> None:  # type: ignore[type-arg]
        for image in content["images"]:
            image["file_name"] = "photos\\" + image["file_name"]
            del image["width"], image["height"]

    assert [sample.name for sample in read_set(edit_coco(root, edit), "train").samples] == [
        "photos/p0.png",
        "photos/p1.png",
    ]


def test_images_without_labels_are_read_as_empty(tmp_path: Path) -> None:
    coco = write_coco(tmp_path / "coco", 3)
    edit_coco(coco, lambda c: c.update(annotations=[a for a in c["annotations"] if a["image_id"] == 10]))
    assert [bool(sample.instances) for sample in read_set(coco, "train").samples] == [False, True, False]
    yolo = write_yolo(tmp_path / "yolo", {"train": 3})
    (yolo / "labels/train/000000.txt").unlink()
    (yolo / "labels/train/000002.txt").write_text("\n")
    assert [bool(sample.instances) for sample in read_set(yolo, "train").samples] == [False, True, False]


def test_polygons_mixed_with_boxes_are_read_line_by_line(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 1})
    (root / "labels/train/000000.txt").write_text("0 0.5 0.5 0.2 0.4\n1 0.1 0.1 0.3 0.1 0.3 0.3\n")
    (sample,) = read_set(root, "train").samples
    np.testing.assert_allclose(sample.instances[0].box, (0.4 * WIDTH, 0.3 * HEIGHT, 0.6 * WIDTH, 0.7 * HEIGHT))
    assert [one.has_mask for one in sample.instances] == [False, True]


def test_a_yolo_export_of_label_studio_is_read(tmp_path: Path) -> None:
    made = write_yolo(tmp_path / "made", {"train": 3})
    root = tmp_path / "export"
    root.mkdir()
    for folder in ("images", "labels"):
        (made / folder / "train").rename(root / folder)
    (root / "classes.txt").write_text("disc\nbox\n")
    for split in ("train", "val", "all"):
        found = read_set(root, split)  # type: ignore[arg-type]
        assert found.class_names == ("disc", "box") and len(found.samples) == 3


def test_a_list_of_cvat_is_followed(tmp_path: Path) -> None:
    root = write_yolo(tmp_path, {"train": 2})
    (root / "train.txt").write_text("data/images/train/000000.png\ndata/images/train/000001.png\n")
    (root / "data.yaml").write_text("path: .\ntrain: train.txt\nnames:\n  0: disc\n  1: box\n")
    assert len(read_set(root, "train").samples) == 2


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_images_of_12_bits_in_16_are_refused(tmp_path: Path, suffix: str, channels: tuple[int, ...]) -> None:
    """Ultralytics keeps the upper 8 of 16 bits, so that such an image would be almost black."""
    values = np.random.default_rng(0).integers(0, 4096, (HEIGHT, WIDTH, *channels), dtype=np.uint16)
    root = write_yolo(tmp_path, {"train": 1})
    (root / "images/train/000000.png").unlink()
    path = root / f"images/train/000000{suffix}"
    for factor in (1, 16):
        cv2.imwrite(str(path), values * np.uint16(factor))
        if factor == 1:
            with pytest.raises(
                InputError, match=r"is too dark \(its brightest pixel has 1[56] of 255\): multiply 12-bit"
            ):
                read_set(root, "train")
        else:
            assert len(read_set(root, "train").samples) == 1
    cv2.imwrite(str(path), values * np.uint16(0))
    assert len(read_set(root, "train").samples) == 1  # a covered lens
