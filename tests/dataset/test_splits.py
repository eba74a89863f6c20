"""Datasets with a test split and with folds: disjoint layouts, evenly spread classes, and readable list files."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from ruamel.yaml import YAML

from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.folds import assign_folds, write_folds
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.spec.scene_spec import FORMATS, HoldOut
from tests.cli.typed import run
from tests.conftest import box_asset, small_scene
from tests.dataset.test_distractors import scatter_drawn
from tests.drawn import large_boxes, render_boxes
from tests.manifests import records_of, store

FORMATS_HERE = [name for name in FORMATS if name != "colmap"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("splits")
    objects = [{"pool": ["assets/nut", "assets/bolt", "assets/crate"], "count": [2, 4]}]
    assets = [*large_boxes(), box_asset("crate", (0.1, 0.1, 0.1))]
    small_scene(folder, assets, objects, layouts=8, views=2, formats=FORMATS_HERE, validation=0.25, test=0.25)
    scene = load_scene(folder / "scene.yaml")
    scene = replace(scene, spec=scene.spec.model_copy(update={"hold_out": HoldOut(assets=("assets/crate",))}))
    return write_dataset(scene, folder / "out", render=render_boxes, settle=scatter_drawn).path


def test_three_splits_have_no_violations_in_every_format(made: Path) -> None:
    records = records_of(made)
    assert Counter(record["split"] for record in records) == {"train": 8, "val": 4, "test": 4}
    assert audit_dataset(made).violations == ()
    for name in ("instances", "polygons", "amodal", "panoptic", "poses"):
        assert (made / f"annotations/{name}_test.json").is_file()
    assert len(COCO(made / "annotations/instances_test.json").imgs) == 4
    assert YAML(typ="safe").load(made / "data.yaml")["test"] == "images/test"
    assert {record["split"] for record in records if shows_a_crate(record)} == {"test"}


def shows_a_crate(record: dict[str, Any]) -> bool:
    return any(label["class"] == "crate" for label in record["labels"]["instances"])


def test_a_held_out_asset_in_another_split_is_a_violation(made: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    records = records_of(copy)
    next(record for record in records if shows_a_crate(record))["split"] = "train"
    store(copy, records)
    found = [text for _, text in audit_dataset(copy).violations]
    assert any("is of an asset that is held out for the test split" in text for text in found)
    assert any("are in both train and test" in text for text in found)


def test_folds_list_existing_images_and_labels(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("split", made, "--folds", 3) == 0
    assert capsys.readouterr().out.count("validates with 4 images of 2 layouts") == 3
    records = [record for record in records_of(made) if record["split"] != "test"]
    images = {next(file for file in record["files"] if file.startswith("images/")): record for record in records}
    validated = []
    for fold in ("fold1", "fold2", "fold3"):
        for task in ("", "yolo-detect/", "yolo-obb/", "yolo-pose/"):
            described = made / task / "folds" / f"{fold}.yaml"
            data = YAML(typ="safe").load(described)
            assert data["names"] == {0: "bolt", 1: "crate", 2: "nut"} and ("kpt_shape" in data) == (
                task == "yolo-pose/"
            )
            lists = {split: (described.parent / data[split]).resolve() for split in ("train", "val")}
            named = {split: [str(line) for line in path.read_text().splitlines()] for split, path in lists.items()}
            assert sorted(named["train"] + named["val"]) == sorted(f"./{image}" for image in images)
            for split, path in lists.items():
                for line in named[split]:
                    image = Path(line.replace("./", f"{path.parent}/"))  # the path rule of Ultralytics
                    assert image.is_file()
                    assert Path(str(image).replace("/images/", "/labels/")).with_suffix(".txt").is_file()
        layouts = {s: {images[line.removeprefix("./")]["layout"] for line in lines} for s, lines in named.items()}
        assert not layouts["train"] & layouts["val"]
        validated += sorted(layouts["val"])
        for split in ("train", "val"):
            coco = COCO(made / f"folds/{fold}_{split}.json")
            assert [f"./images/{image['file_name']}" for image in coco.imgs.values()] == named[split]
            shown = [images[line.removeprefix("./")] for line in named[split]]
            assert len(coco.anns) == sum(len(record["labels"]["instances"]) for record in shown)
    assert sorted(validated) == sorted({record["layout"] for record in records})
    assert audit_dataset(made).violations == ()
    for folds in (1, 7):
        with pytest.raises(InputError, match=rf"folds must be 2 to 6, the layouts of .* \(got {folds}\)"):
            write_folds(made, folds)


def test_folds_state_their_images_and_instances(made: Path) -> None:
    for number, fold in enumerate(write_folds(made, 4), start=1):
        names = (made / f"fold{number}_val.txt").read_text().split()
        shown = [record for record in records_of(made) if any(f"./{file}" in names for file in record["files"])]
        classes = Counter(label["class"] for record in shown for label in record["labels"]["instances"])
        assert (fold.images, fold.instances) == (len(names), dict(classes))
        assert fold.layouts == len({record["layout"] for record in shown})


def test_folds_of_four_layouts_have_equal_counts() -> None:
    """Large layouts are assigned first and small ones complete them; without a difference, the first fold is taken."""
    layouts = {
        0: Counter({"rare": 1, "common": 1}),
        1: Counter({"rare": 1, "common": 3}),
        2: Counter({"common": 3}),
        3: Counter({"common": 1}),
    }
    assert assign_folds(layouts, 2) == {1: 0, 0: 1, 2: 1, 3: 0}


def test_a_dataset_of_one_layout_has_no_folds(tmp_path: Path) -> None:
    scene = small_scene(
        tmp_path, large_boxes(), [{"asset": "assets/nut"}, {"asset": "assets/bolt"}], layouts=1, views=1
    )
    out = write_dataset(scene, tmp_path / "out", render=render_boxes, settle=scatter_drawn).path
    with pytest.raises(InputError, match=r"must have at least 2 layouts to be divided into folds \(got 1\)"):
        write_folds(out, 2)


def test_overwriting_removes_folds(tmp_path: Path) -> None:
    scene = small_scene(
        tmp_path, large_boxes(), [{"asset": "assets/nut"}, {"asset": "assets/bolt"}], layouts=2, views=1
    )
    out = write_dataset(scene, tmp_path / "out", render=render_boxes, settle=scatter_drawn).path
    write_folds(out, 2)
    (out / "notes.txt").write_text("mine")
    write_dataset(scene, out, render=render_boxes, settle=scatter_drawn, overwrite=True)
    assert not list(out.glob("fold*")) and (out / "notes.txt").is_file()


@pytest.mark.parametrize("folds", [2, 5, 7])
def test_folds_distribute_classes_and_keep_layouts_together(folds: int) -> None:
    """Fold sizes differ by at most one layout.

    A class that is in as many layouts as there are folds is in each fold. Counts of the other classes
    differ by at most 6.
    """
    rng = np.random.default_rng(folds)
    layouts = {i: Counter({"nut": int(rng.integers(0, 4)), "bolt": int(rng.integers(1, 3))}) for i in range(101)}
    for number in rng.choice(101, folds, replace=False):
        layouts[int(number)]["gear"] = 1
    fold_of = assign_folds(layouts, folds)
    assert sorted(fold_of) == list(range(101))
    sizes = Counter(fold_of.values())
    assert max(sizes.values()) - min(sizes.values()) <= 1
    counts = {
        name: [sum(layouts[i][name] for i in layouts if fold_of[i] == fold) for fold in range(folds)]
        for name in ("nut", "bolt", "gear")
    }
    assert counts["gear"] == [1] * folds
    for name in ("nut", "bolt"):
        assert max(counts[name]) - min(counts[name]) <= 6
    assert assign_folds(dict(reversed(layouts.items())), folds) == fold_of


@pytest.mark.parametrize("folds", [2, 3])
def test_folds_of_unequal_layouts_have_equal_sizes(folds: int) -> None:
    """Some layouts are empty, and others have 50 instances of a class that is in few layouts."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        counts = rng.integers(0, 2, (6, 3)) * rng.integers(1, 50, (6, 3))
        layouts = {
            i: Counter({name: int(n) for name, n in zip("abc", row, strict=True) if n}) for i, row in enumerate(counts)
        }
        sizes = Counter(assign_folds(layouts, folds).values())
        assert [sizes[fold] for fold in range(folds)] == [6 // folds] * folds
