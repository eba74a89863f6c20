"""Comparison of rendered images with photographs: measured properties and advice."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mitsplat.cli import app
from mitsplat.detector.labelled_sets.labelled_set import LabelledObject, Sample
from mitsplat.detector.likeness import BRIGHTNESS, Likeness, Trait, _object_pixels, _trait, compare_with_photographs
from mitsplat.errors import InputError
from tests.detector.painted import HEIGHT, HUES, WIDTH, write_coco, write_yolo, yolo_text


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_yolo(tmp_path_factory.mktemp("rendered") / "set", {"train": 40})


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    return write_coco(tmp_path / "photographs", 20, first=1000)


def trait(found: Likeness, name: str) -> Trait:
    (one,) = [one for one in found.traits if one.name == name]
    return one


def change(photographs: Path, do: object) -> None:
    for path in (photographs / "photos").iterdir():
        cv2.imwrite(str(path), np.clip(do(cv2.imread(str(path)).astype(float)), 0, 255).astype(np.uint8))  # type: ignore[operator]


def test_equal_distributions_get_no_advice(rendered: Path, photographs: Path) -> None:
    found = compare_with_photographs([rendered], photographs, size=WIDTH)
    assert (found.images, found.photographs) == (40, 20)
    assert [one.name for one in found.traits if one.advice] == []
    assert not any(one.advice for traits in found.classes.values() for one in traits)


def test_measured_colours_equal_the_painted_ones(rendered: Path, photographs: Path) -> None:
    found = compare_with_photographs([rendered], photographs, size=WIDTH)
    for name, hue in HUES.items():
        bright, saturation = found.classes[name]
        assert bright.rendered == bright.real == (max(hue),) * 3
        assert saturation.real == pytest.approx((100 * (1 - min(hue) / max(hue)),) * 3)
    size = trait(found, "size of objects")
    assert 10 < size.rendered[0] < size.rendered[2] < 33
    assert trait(found, "objects of an image").real[::2] == (1, 2)


@pytest.mark.parametrize("turn", [0, -21, 15])
def test_a_hue_shift_of_the_camera_is_reported(rendered: Path, photographs: Path, turn: int) -> None:
    def turned(image: np.ndarray) -> np.ndarray:
        hsv = cv2.cvtColor((image / 255).astype(np.float32), cv2.COLOR_BGR2HSV)
        hsv[..., 0] = (hsv[..., 0] + turn) % 360
        return 255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)

    change(photographs, turned)
    found = compare_with_photographs([rendered], photographs, size=WIDTH)
    assert found.hues == {name: pytest.approx(turn, abs=3) for name in HUES}
    assert bool(found.hue_advice) == (turn != 0)


def test_photographs_with_small_objects_get_a_larger_search_size(tmp_path: Path, rendered: Path) -> None:
    photographs = write_coco(tmp_path / "photographs", 20, form="boxes", first=1000)
    labels = json.loads((photographs / "labels.json").read_text())
    for image in labels["images"]:  # puts each in the corner of an image of twice the size
        path = photographs / "photos" / image["file_name"]
        cv2.imwrite(str(path), np.pad(cv2.imread(str(path)), ((0, HEIGHT), (0, WIDTH), (0, 0))))
        image.update(width=2 * WIDTH, height=2 * HEIGHT)
    (photographs / "labels.json").write_text(json.dumps(labels))
    found = compare_with_photographs([rendered], photographs, size=640)
    assert found.same_size == pytest.approx(1280, abs=130)
    assert found.same_sizes is not None and found.same_sizes[0] <= found.same_size <= found.same_sizes[1]
    assert compare_with_photographs([rendered], photographs, size=640, max_images=4).same_size is None  # too few images


@pytest.mark.parametrize(
    ("name", "do", "says"),
    [
        ("brightness of objects", lambda image: image * 0.4, "lower randomise.exposure"),
        (
            "saturation of objects",
            lambda image: image.mean(axis=2, keepdims=True) + 0 * image,
            "lower randomise.saturation",
        ),
        ("noise of images", lambda image: cv2.GaussianBlur(image, (0, 0), 3), "lower randomise.iso"),
        ("brightness of images", lambda image: image + 60, "brighten the backdrop"),
    ],
)
def test_each_difference_is_named_with_the_key_that_changes_it(
    rendered: Path, photographs: Path, name: str, do: object, says: str
) -> None:
    change(photographs, do)
    found = trait(compare_with_photographs([rendered], photographs, size=WIDTH), name)
    assert says in found.advice
    assert max(found.below, found.above) > 0.9


def test_photographs_that_differ_both_ways_get_advice_for_a_wider_range(rendered: Path, photographs: Path) -> None:
    for number, path in enumerate(sorted((photographs / "photos").iterdir())):
        image = cv2.imread(str(path)).astype(float) * (0.5 if number % 2 else 1.1)
        cv2.imwrite(str(path), np.clip(image, 0, 255).astype(np.uint8))
    found = trait(compare_with_photographs([rendered], photographs, size=WIDTH), "brightness of objects")
    assert "widen the range at both ends" in found.advice
    assert found.below > 0.3 and found.above > 0.3


def test_a_difference_of_one_class_is_reported(rendered: Path, photographs: Path) -> None:
    """Discs are red and boxes are blue. Boxes become dark if half of the blue is removed."""
    change(photographs, lambda image: image * (0.5, 1, 1))
    found = compare_with_photographs([rendered], photographs, size=WIDTH)
    assert "lower" in found.classes["box"][0].advice
    assert not found.classes["disc"][0].advice


def test_object_size_is_that_in_the_scaled_image(rendered: Path, photographs: Path) -> None:
    once, twice = (
        trait(compare_with_photographs([rendered], photographs, size=size), "size of objects")
        for size in (WIDTH, 2 * WIDTH)
    )
    assert np.allclose(twice.real, 2 * np.array(once.real))


def test_all_forms_of_labels_give_the_same_traits(rendered: Path, tmp_path: Path) -> None:
    """In images of twice the size, the middle half of each box is large enough to be measured."""
    found = [
        compare_with_photographs([rendered], write_coco(tmp_path / form, 12, form=form), size=2 * WIDTH)
        for form in ("polygons", "lengths", "compressed", "boxes")
    ]
    for other in found[1:]:
        assert other.classes == found[0].classes


@pytest.mark.parametrize("scale", [0.5, 1, 3])
def test_colours_in_boxes_are_those_of_their_middle_half(scale: float) -> None:
    """The middle half of a box from 8 to 48 by 12 to 36 px is 18 to 38 by 18 to 30 px."""
    box = LabelledObject(0, (8.0, 12.0, 48.0, 36.0))
    sample = Sample(Path("a.png"), "a.png", 64, 80, (box,), "")
    expected = np.zeros((int(80 * scale), int(64 * scale)), dtype=bool)
    expected[int(18 * scale) : int(30 * scale), int(18 * scale) : int(38 * scale)] = True
    assert (_object_pixels(box, sample, *expected.shape[::-1], as_box=True) == expected).all()


def _write_rings(root: Path, count: int, *, first: int, boxes: bool) -> Path:
    """Write a YOLO folder of red rings on grey, with masks or boxes as labels."""
    (root / "images/train").mkdir(parents=True)
    (root / "labels/train").mkdir(parents=True)
    for number in range(count):
        rng = np.random.default_rng(first + number)
        image = np.clip(rng.normal(110, 20, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
        mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        cv2.circle(mask, (int(rng.integers(30, 60)), 32), int(rng.integers(20, 24)), 1, 4)
        image[mask > 0] = HUES["disc"][::-1]
        cv2.imwrite(str(root / f"images/train/{number}.png"), image)
        (root / f"labels/train/{number}.txt").write_text(yolo_text([("disc", mask > 0)], boxes=boxes))
    (root / "data.yaml").write_text("train: images/train\nnames: [disc, box]\n")
    return root


def test_boxes_of_one_side_make_both_sides_measured_within_boxes(tmp_path: Path) -> None:
    """The middle of the box of a ring shows what lies behind it, which the masks of the other side exclude."""
    masks = _write_rings(tmp_path / "masks", 30, first=0, boxes=False)
    boxes = _write_rings(tmp_path / "boxes", 20, first=100, boxes=True)
    found = compare_with_photographs([masks], boxes, size=WIDTH)
    assert [one.name for one in (*found.traits, *found.classes["disc"]) if one.advice] == []
    bright = found.classes["disc"][0]
    assert np.allclose(bright.rendered, bright.real, atol=10) and bright.real[1] == pytest.approx(120, abs=20)
    whole = _write_rings(tmp_path / "whole", 20, first=100, boxes=False)
    assert compare_with_photographs([masks], whole, size=WIDTH).classes["disc"][0].real == (220,) * 3


def test_photographs_of_another_size_are_compared(rendered: Path, photographs: Path, tmp_path: Path) -> None:
    change(photographs, lambda image: image)
    larger = write_coco(tmp_path / "larger", 20, first=1000)
    labels = json.loads((larger / "labels.json").read_text())
    for image in labels["images"]:
        path = larger / "photos" / image["file_name"]
        image |= {"width": 3 * WIDTH, "height": 3 * HEIGHT}
        cv2.imwrite(str(path), np.kron(cv2.imread(str(path)), np.ones((3, 3, 1), dtype=np.uint8)))
    for one in labels["annotations"]:
        one["bbox"] = [3 * value for value in one["bbox"]]
        one["segmentation"] = [[3 * value for value in ring] for ring in one["segmentation"]]
    (larger / "labels.json").write_text(json.dumps(labels))
    once, other = (compare_with_photographs([rendered], one, size=WIDTH) for one in (photographs, larger))
    for name in ("size of objects", "brightness of objects", "noise of images"):
        assert np.allclose(trait(other, name).real, trait(once, name).real, rtol=0.02), name


def test_most_limits_both_image_counts(rendered: Path, photographs: Path) -> None:
    told: list[tuple[int, int, str]] = []
    found = compare_with_photographs(
        [rendered], photographs, size=WIDTH, max_images=7, progress=lambda *step: told.append(step)
    )
    assert [step[:2] for step in told] == [(number, 14) for number in range(1, 15)]
    assert (found.images, found.photographs) == (7, 7)


def _rename(root: Path, **names: str) -> Path:
    """Rename classes of a YOLO folder."""
    text = (root / "data.yaml").read_text()
    for old, new in names.items():
        text = text.replace(old, new)
    (root / "data.yaml").write_text(text)
    return root


def _without(root: Path, index: int) -> Path:
    """Remove the labels of a class from a YOLO folder, and images that had no others."""
    for path in root.glob("labels/*/*.txt"):
        lines = [line for line in path.read_text().splitlines(keepends=True) if not line.startswith(f"{index} ")]
        path.write_text("".join(lines))
        if not lines:
            next(root.glob(f"images/*/{path.stem}.png")).unlink()
            path.unlink()
    return root


def test_common_classes_are_compared_and_others_are_named(rendered: Path, tmp_path: Path) -> None:
    """Classes that one side does not have change no value: the result is that of the common labels alone."""
    other = _rename(write_yolo(tmp_path / "other", {"train": 20}, first=1000), box="cone")
    cones = sum(line.startswith("1 ") for path in other.glob("labels/*/*") for line in path.read_text().splitlines())
    boxes = sum(line.startswith("1 ") for path in rendered.glob("labels/*/*") for line in path.read_text().splitlines())
    found = compare_with_photographs([rendered], other, size=WIDTH)
    assert (found.only_rendered, found.only_photographed) == ({"box": boxes}, {"cone": cones})
    assert list(found.classes) == ["disc"]
    discs = _without(write_yolo(tmp_path / "discs", {"train": 20}, first=1000), 1)
    rendered_discs = _without(write_yolo(tmp_path / "rendered", {"train": 40}), 1)
    alone = compare_with_photographs([rendered_discs], discs, size=WIDTH)
    assert (alone.only_rendered, alone.only_photographed, alone.skipped) == ({}, {}, (0, 0))
    assert (found.traits, found.classes, found.hues) == (alone.traits, alone.classes, alone.hues)
    assert found.skipped == (40 - alone.images, 20 - alone.photographs) and all(found.skipped)
    done = CliRunner().invoke(app, ["compare", str(rendered), str(other), "--size", str(WIDTH)])
    assert done.stdout.startswith(
        f"not compared: labels in rendered images of classes that photographs do not have: {boxes} box; "
        f"{found.skipped[0]} rendered images have no other labels and are left out\n"
        f"not compared: labels in photographs of classes that rendered images do not have: {cones} cone; "
    )


def test_sides_without_a_common_label_are_refused(rendered: Path, tmp_path: Path) -> None:
    other = _rename(write_yolo(tmp_path / "other", {"train": 2}), box="cone", disc="ring")
    with pytest.raises(
        InputError, match=r"must have a class of the rendered images, which are box, disc \(got ring, co"
    ):
        compare_with_photographs([rendered], other)
    cones = _rename(_without(write_yolo(tmp_path / "cones", {"train": 9}), 0), box="cone")
    with pytest.raises(InputError, match=r"cones: must have labels of a class that both sides have, disc \(got cone\)"):
        compare_with_photographs([rendered], cones)
    with pytest.raises(InputError, match="at least 1"):
        compare_with_photographs([rendered], rendered, max_images=0)


def test_the_compare_command_prints_and_writes_the_traits(rendered: Path, photographs: Path, tmp_path: Path) -> None:
    change(photographs, lambda image: image * 0.4)
    out = tmp_path / "likeness.json"
    done = CliRunner().invoke(app, ["compare", str(rendered), str(photographs), "--size", str(WIDTH), "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert "40 rendered images, 20 photographs" in done.output
    assert "brightness of objects [of 255]: rendered 220 220 220; photographs 88 88 88" in done.output
    assert "photographs: 100% below, 0% above the rendered range: lower randomise.exposure" in done.output
    kept = json.loads(out.read_text())
    assert kept["traits"][0]["real"] == [88, 88, 88]
    assert CliRunner().invoke(app, ["compare", str(rendered)]).exit_code != 0


def test_equal_distributions_get_advice_rarely() -> None:
    """Objects of one image share its light, so they are not independent samples."""
    rng, advised = np.random.default_rng(3), 0
    for _ in range(100):
        lights = rng.normal(100, 20, 42)
        values = [(image, light + rng.normal(0, 5)) for image, light in enumerate(lights) for _ in range(6)]
        advised += bool(_trait(BRIGHTNESS, values[: 30 * 6], values[30 * 6 :]).advice)
    assert advised <= 6
    darker = [(image, value - 60) for image, value in values[30 * 6 :]]
    assert _trait(BRIGHTNESS, values[: 30 * 6], darker).advice.startswith("lower randomise.exposure")
    assert _trait(BRIGHTNESS, values[: 30 * 6], darker[:4]).advice == ""  # too few images
