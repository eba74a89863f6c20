"""Image lists of a finished dataset for k-fold cross-validation.

::

    fold1_train.txt, fold1_val.txt, fold2_train.txt, ...        images, as ./images/train/000000.png
    folds/fold1.yaml                                            for Ultralytics; other tasks have both in their folders
    folds/fold1_train.json, fold1_val.json                      COCO, if the dataset has it; names are below images/

All views of a layout belong to the same fold, because they show the same objects in the same places; so do frames of
equal poses that were made in Python. The test split is left out. Ultralytics resolves paths that begin with ``./`` from
the folder of the list, so lists lie beside ``images/``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from mitsplat.dataset.dataset_files import hash_poses, layout_file, remove_folds
from mitsplat.dataset.dataset_folder import open_finished
from mitsplat.dataset.records.record_schema import read_content
from mitsplat.errors import InputError
from mitsplat.formats.coco import append_instances, create_instances_file, image_file
from mitsplat.formats.yolo import TASKS, names_yaml
from mitsplat.storage.files import GrowingFile, Record, read_json, storage_errors, write_text
from mitsplat.storage.json_stream import ListsFile


@dataclass(frozen=True)
class Fold:
    """Statistics of the validation part of one fold.

    Attributes:
        layouts: Number of layouts.
        images: Number of images of these layouts.
        instances: Number of labelled instances by class.
    """

    layouts: int
    images: int
    instances: dict[str, int]


def write_folds(root: str | Path, folds: int) -> list[Fold]:
    """Write the image lists of a dataset for cross-validation.

    Args:
        root: Dataset folder that no run is writing.
        folds: Number of folds. Layouts of each class are spread over them as evenly as whole layouts allow.

    Raises:
        InputError: If the folder is no dataset, is being written, or has fewer layouts than folds.
    """
    root = Path(root)
    content = read_content(root)
    formats = content["scene"]["output"]["formats"]
    classes, keypoints = content["classes"], content["keypoints"]
    tasks = [task for task in TASKS if task in formats]
    with open_finished(root, content, write=True) as records, storage_errors(root), ExitStack() as cleanup:
        first = _first_of_equal(root, records) if content.get("given", False) else {}
        layouts, images = _count(records, first)
        if not 2 <= folds <= len(layouts):
            parts = "layouts of different poses" if first else "layouts"
            if len(layouts) < 2:
                raise InputError(f"{root}: must have at least 2 {parts} to be divided into folds (got {len(layouts)})")
            raise InputError(f"folds must be 2 to {len(layouts)}, the {parts} of {root} (got {folds})")
        fold_of = assign_folds(layouts, folds)
        remove_folds(root)
        names = [f"fold{fold + 1}" for fold in range(folds)]
        folders = [TASKS[task].folder for task in tasks if TASKS[task].folder]
        lists = {
            (name, split): [GrowingFile(root / f"{folder}{name}_{split}.txt") for folder in ("", *folders)]
            for name in names
            for split in ("train", "val")
        }
        coco_files = {
            (name, split): create_instances_file(root / f"folds/{name}_{split}.json", classes, keypoints)
            for name, split in (lists if "coco" in formats else ())
        }
        files: list[GrowingFile | ListsFile] = [file for found in lists.values() for file in found]
        files += coco_files.values()
        for file in files:
            cleanup.callback(file.discard)
        for record in records:
            layout: int = record["layout"]
            for fold, name in enumerate(names) if record["split"] != "test" else ():
                key = name, "val" if fold_of[first.get(layout, layout)] == fold else "train"
                for image_list in lists[key]:
                    image_list.write(f"./{image_file(record)}\n")
                if coco_files:
                    append_instances(coco_files[key], record, keypoints, folders=True)
        for file in files:
            file.commit()
        for task in tasks:
            for name in names:
                text = f"# Paths are relative to this file.\ntrain: ../{name}_train.txt\nval: ../{name}_val.txt\n"
                text += names_yaml(classes, keypoints if task == "yolo-pose" else None)
                write_text(root / f"{TASKS[task].folder}folds/{name}.yaml", text)
    members = [[layout for layout in layouts if fold_of[layout] == fold] for fold in range(folds)]
    instances = [sum((layouts[layout] for layout in own), Counter[str]()) for own in members]
    return [
        Fold(len(own), sum(images[layout] for layout in own), dict(sorted(found.items())))
        for own, found in zip(members, instances, strict=True)
    ]


def _first_of_equal(root: Path, records: Iterable[Record]) -> dict[int, int]:
    """Return the first layout of equal poses for each layout of a dataset of frames made in Python."""
    found, first = dict[str, int](), dict[int, int]()
    for number in (record["layout"] for record in records):
        path = root / layout_file(number)
        try:
            first[number] = found.setdefault(hash_poses(read_json(path)), number)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: must be the layout of a finished dataset ({error!r})") from error
    return first


def _count(records: Iterable[Record], first: Mapping[int, int]) -> tuple[dict[int, Counter[str]], Counter[int]]:
    """Return the number of instances by class, and the number of images, of each layout; the test split is left out.

    A layout counts as the one that ``first`` names for it.
    """
    layouts, images = dict[int, Counter[str]](), Counter[int]()
    for record in records:
        if record["split"] != "test":
            classes = (label["class"] for label in record["labels"]["instances"])
            layout = first.get(record["layout"], record["layout"])
            layouts.setdefault(layout, Counter()).update(classes)
            images[layout] += 1
    return layouts, images


def assign_folds(layouts: Mapping[int, Counter[str]], folds: int) -> dict[int, int]:
    """Assign each layout to a fold, so that the sizes of the folds differ by at most one layout.

    Layouts with the rarest classes are assigned first, as in the iterative stratification of Sechidis et al. (2011, "On
    the stratification of multi-label data"). Each layout goes to the fold where it reduces the sum of squared deficits
    most. Deficits are those of the instances of each class and of the layouts, as fractions of the target size of a
    fold.

    Args:
        layouts: Number of instances by class, for each layout.
        folds: Number of folds.
    """
    free = [len(layouts) // folds + (fold < len(layouts) % folds) for fold in range(folds)]
    total = sum(layouts.values(), Counter[str]())
    deficits = [dict.fromkeys(total, 1.0) for _ in range(folds)]  # as fractions of the target of the fold
    rarity = {layout: min((total[name], name) for name in found) for layout, found in layouts.items() if found}
    most = (total.total() + 1, "")
    fold_of: dict[int, int] = {}
    for layout in sorted(layouts, key=lambda layout: (rarity.get(layout, most), -layouts[layout].total(), layout)):
        shares = {name: folds * count / total[name] for name, count in layouts[layout].items()}
        gains = [
            sum(share * deficits[fold][name] for name, share in shares.items())
            + free[fold] * (folds / len(layouts)) ** 2
            for fold in range(folds)
        ]
        best = max((fold for fold in range(folds) if free[fold]), key=lambda fold: (gains[fold], -fold))
        fold_of[layout] = best
        free[best] -= 1
        for name, share in shares.items():
            deficits[best][name] -= share
    return fold_of
