"""COCO folders: JSON files of images, annotations and categories, and the images."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from mitsplat.detector.labelled_sets.coco_annotations import is_fraction, read_annotation
from mitsplat.detector.labelled_sets.labelled_set import (
    LabelledSet,
    Sample,
    Split,
    read_samples,
    relative_name,
    reorder_classes,
    warn_of_unlabelled,
)
from mitsplat.detector.labelled_sets.pictures import check_complete, images_below
from mitsplat.errors import InputError
from mitsplat.progress import Progress
from mitsplat.storage.files import SPLITS, JsonObject, is_inside, read_json

_MAX_COCO_BYTES = 1 << 32
"""Largest COCO file that is read [bytes]; the file of COCO's 118,287 training images has 0.45e9 bytes."""
_SPLIT_FOLDERS = {"train": "train", "val": "val", "valid": "val", "validation": "val", "test": "test"}
"""Folders of splits in COCO exports, and the split of each."""

_BACKGROUND = {"background", "_background_", "__background__"}
"""Categories that are no classes if they have no labels."""


def read_coco(root: Path, split: Split, progress: Progress | None) -> LabelledSet:
    """Read a COCO folder.

    Raises:
        InputError: As :func:`~mitsplat.detector.labelled_sets.set_reading.read_set`.
    """
    files = _coco_files(root, split)
    labelled = set[str]().union(*map(_labelled_categories, files.values()))
    parts = [_coco_part(root, split, labelled, *file, progress) for file in files.items()]
    parts = [reorder_classes(part, parts[0].class_names, str(root)) for part in parts]
    samples = tuple(sample for part in parts for sample in part.samples)
    twice = [name for name, count in Counter(sample.name for sample in samples).items() if count > 1]
    if twice:
        raise InputError(f"{root}: each image must be listed once in its COCO files (got {twice[0]} twice)")
    return replace(parts[0], samples=samples)


def _labelled_categories(content: JsonObject) -> set[str]:
    """Return the names of the categories that have labels; none if the content is no COCO dataset."""
    try:
        used = {annotation["category_id"] for annotation in content["annotations"]}
        return {category["name"] for category in content["categories"] if category["id"] in used}
    except (KeyError, TypeError):
        return set()


def _coco_part(
    root: Path, split: Split, labelled: set[str], path: Path, content: JsonObject, progress: Progress | None
) -> LabelledSet:
    """Return the labelled images of one COCO file; ``labelled`` are the categories with labels in any file."""
    try:
        above = {c["name"]: c.get("supercategory") for c in content["categories"]}
        parents = {parent for name, parent in above.items() if parent != name and above.get(parent) != parent}
        unlabelled = parents | _BACKGROUND
        categories = [c for c in content["categories"] if c["name"] in labelled or c["name"] not in unlabelled]
        categories.sort(key=lambda category: category["id"])
        names = tuple(str(category["name"]) for category in categories)
        index = {category["id"]: i for i, category in enumerate(categories)}
        by_image: dict[int | str, list[JsonObject]] = {image["id"]: [] for image in content["images"]}
        for what, values in (
            ("ids of images", [image["id"] for image in content["images"]]),
            ("ids of categories", [category["id"] for category in categories]),
            ("names of categories", names),
        ):
            if double := [value for value, count in Counter(values).items() if count > 1]:
                raise InputError(f"{path}: {what} must differ (got {double[0]!r} twice)")
        if not all(name.strip() for name in names):
            raise InputError(f"{path}: names of categories must be text (got {names})")
        for annotation in content["annotations"]:
            for key, known in (("image_id", by_image), ("category_id", index)):
                if annotation[key] not in known:
                    raise InputError(
                        f"{path}: annotation {annotation.get('id')}: {key} must be in the file (got "
                        f"{annotation[key]!r})"
                    )
            by_image[annotation["image_id"]].append(annotation)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: must be a COCO dataset of instances (key {error} is missing or wrong)") from error
    if not by_image:
        raise InputError(f"{root}: there are no images for {split}")
    boxes = [annotation.get("bbox") for annotation in content["annotations"]]
    if boxes and all(map(is_fraction, boxes)):
        raise InputError(f"{path}: bbox must be in pixels (got at most 1 in every annotation: are they fractions?)")
    find = _image_finder(root, path)

    def read(image: JsonObject) -> Sample:
        file = find(str(image.get("file_name")))
        width, height, shown = check_complete(file)
        if (image.get("width", width), image.get("height", height)) != (width, height):
            raise InputError(
                f"{file}: must have the size in {path.name}, {image.get('width')} x {image.get('height')} px, "
                f"after EXIF orientation (got {width} x {height})"
            )
        found = by_image[image["id"]]
        instances = {
            (one.class_index, one.box, one.rle and one.rle["counts"], one.crowd): one
            for one in (read_annotation(a, index[a["category_id"]], (width, height), path) for a in found)
        }
        shown.add_json([names, found])
        return Sample(file, relative_name(root, file), width, height, tuple(instances.values()), shown.hexdigest())

    images = sorted(content["images"], key=lambda image: str(image.get("file_name")))
    bare = [str(image.get("file_name")) for image in images if not by_image[image["id"]]]
    if len(bare) < len(images):
        warn_of_unlabelled(root, bare, len(images))
    return LabelledSet(root, "coco", split, names, read_samples(read, images, root, progress))


def _coco_files(root: Path, split: Split) -> dict[Path, JsonObject]:
    """Return the COCO files of a split and their contents: one file, or all files for the split ``all``."""
    folders = (root, *(root / name for name in ("annotations", *_SPLIT_FOLDERS)))
    paths = [path for folder in folders for path in sorted(folder.glob("*.json"))]
    files = {path: _read_json(path) for path in paths}
    files = {
        path: content
        for path, content in files.items()
        if isinstance(content, dict) and {"images", "annotations", "categories"} <= content.keys()
    }
    if len(files) > 1:
        named = {path: content for path, content in files.items() if split in _split_words(path.relative_to(root))}
        files = named or files
    if len(files) == 1 or (files and split == "all"):
        return files
    if files:
        names = ", ".join(path.name for path in files)
        raise InputError(f"{root}: one of its COCO files must have {split} in its name (got {names})")
    raise InputError(
        f"{root}: must be a dataset of mitsplat (dataset.json), a YOLO folder (data.yaml) or a COCO folder (a JSON "
        "file with images, annotations and categories)"
    )


def _split_words(path: Path) -> list[str]:
    """Return the words of a path; other names of a split, such as ``valid``, are replaced by the usual one."""
    return [_SPLIT_FOLDERS.get(word, word) for word in re.findall("[a-z]+", str(path.with_suffix("")).lower())]


def _read_json(path: Path) -> Any:
    try:
        return read_json(path, _MAX_COCO_BYTES)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from error


def _image_finder(root: Path, listing: Path) -> Callable[[str], Path]:
    """Return a function that finds the images named in an annotation file."""
    below: dict[str, list[Path]] = {}
    for path in images_below(root):
        below.setdefault(unicodedata.normalize("NFC", path.name), []).append(path)

    own = set(_split_words(listing.relative_to(root))) & set(SPLITS)

    def find(name: str) -> Path:
        name = name.replace("\\", "/")  # as Label Studio writes it on Windows
        if not is_inside(root, name):
            raise InputError(f"{listing}: file_name must be of an image in {root} (got {name})")
        for folder in (listing.parent, root):
            if (folder / name).is_file():
                return folder / name
        plain = unicodedata.normalize("NFC", name)  # macOS writes letters and their accents apart
        found = [
            path
            for path in below.get(Path(plain).name, ())
            if unicodedata.normalize("NFC", f"/{path}").endswith(f"/{plain}")
        ]
        if len(found) > 1:  # the folders of splits may hold images of equal names
            found = [path for path in found if own & set(_split_words(path.relative_to(root).with_name("-")))] or found
        if len(found) != 1:
            raise InputError(f"{listing}: {name} must be one image in {root} (got {len(found)})")
        return found[0]

    return find
