"""YOLO folders: ``data.yaml`` or ``classes.txt``, images, and one text file of labels for each image."""

from __future__ import annotations

import logging
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from mitsplat.arguments import list_first
from mitsplat.detector.labelled_sets.labelled_set import (
    LabelledObject,
    LabelledSet,
    Sample,
    Split,
    clip_points,
    read_samples,
    relative_name,
    warn_of_unlabelled,
)
from mitsplat.detector.labelled_sets.pictures import SUFFIXES, check_complete, images_below
from mitsplat.errors import InputError
from mitsplat.progress import Progress
from mitsplat.storage.files import SPLITS, JsonObject

_logger = logging.getLogger(__name__)

CLASSES_FILE = "classes.txt"
"""Class names in YOLO exports of Label Studio, one a line; all their images belong to every split."""


def read_yolo(root: Path, split: Split, progress: Progress | None) -> LabelledSet:
    """Read a folder with ``data.yaml``, or with ``classes.txt`` beside the folders ``images`` and ``labels``.

    Raises:
        InputError: As :func:`~mitsplat.detector.labelled_sets.set_reading.read_set`.
    """
    path = root / "data.yaml"
    if not path.is_file():
        names = _class_names({"names": _read_lines(root / CLASSES_FILE)}, root / CLASSES_FILE)
        return _read_images(root, "yolo", split, names, {name: ["images"] for name in SPLITS}, progress)
    content = _read_yaml(path)
    if "kpt_shape" in content:
        raise InputError(f"{path}: labels must be boxes or masks (got keypoints, kpt_shape)")
    base = str(content.get("path") or ".")
    entries = {name: content[name] for name in SPLITS if content.get(name)}
    listed = {
        name: [_split_entry(root, base, str(entry)) for entry in (given if isinstance(given, list) else [given])]
        for name, given in entries.items()
    }
    return _read_images(root, "yolo", split, _class_names(content, path), listed, progress)


def read_mitsplat(root: Path, split: Split, progress: Progress | None) -> LabelledSet:
    """Read a mitsplat dataset from its YOLO files.

    Raises:
        InputError: As :func:`~mitsplat.detector.labelled_sets.set_reading.read_set`.
    """
    if not (root / "labels").is_dir():
        raise InputError(f"{root}: detectors need YOLO labels: add yolo to output.formats of the scene")
    described = root / "data.yaml"
    if not described.is_file():
        remedy = "continue its `mitsplat render`, or join its shards with `mitsplat merge`"
        raise InputError(f"{root}: must be a finished dataset (there is no data.yaml yet): {remedy}")
    classes = _class_names(_read_yaml(described), described)
    return _read_images(root, "mitsplat", split, classes, {name: [f"images/{name}"] for name in SPLITS}, progress)


def _read_yaml(path: Path) -> JsonObject:
    try:
        content = YAML(typ="safe", pure=True).load(path)
    except (OSError, ValueError, RecursionError, YAMLError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({str(error).splitlines()[0]})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: must name the images and classes of a YOLO dataset")
    return content


def _class_names(content: JsonObject, path: Path) -> tuple[str, ...]:
    names = content.get("names")
    if isinstance(names, dict) and names.keys() == set(range(len(names))):
        names = [names[i] for i in range(len(names))]
    words = names if isinstance(names, list) else []
    if wrong := [name for name in words if name is None or isinstance(name, list | dict) or not str(name).strip()]:
        raise InputError(f"{path}: names must be text (got {wrong[0]!r:.80})")
    if not isinstance(names, list) or not names or len(set(map(str, names))) < len(names):
        raise InputError(f"{path}: names must be distinct classes, numbered from 0 (got {str(names)[:80]})")
    if content.get("nc", len(names)) != len(names):
        raise InputError(f"{path}: nc must be the number of names, {len(names)} (got {content['nc']!r})")
    return tuple(map(str, names))


def _read_images(
    root: Path,
    kind: Literal["mitsplat", "yolo"],
    split: Split,
    classes: tuple[str, ...],
    listed: dict[str, list[str]],
    progress: Progress | None,
) -> LabelledSet:
    wanted = [name for name in SPLITS if split in (name, "all") and name in listed]
    images = list(
        dict.fromkeys(path for name in wanted for entry in listed[name] for path in _listed_images(root, entry))
    )
    if not images:
        sought = ", ".join(str(root / entry) for name in wanted for entry in listed[name])
        raise InputError(f"{root}: there are no images for {split}" + (_split_counts(root, listed) or f" in {sought}"))
    if kind == "yolo":
        _check_entries(root, {name: listed[name] for name in wanted})
    _check_label_files(images)
    if not any(_label_file(image).is_file() for image in images):
        raise InputError(f"{root}: its images have no labels, such as {_label_file(images[0])}")
    if kind == "yolo":
        bare = [relative_name(root, one) for one in images if one.is_file() and not _label_file(one).is_file()]
        warn_of_unlabelled(root, bare, len(images), "; an empty label file confirms it")

    def read(image: Path) -> Sample:
        width, height, content = check_complete(image)
        label = _label_file(image)
        if label.is_file():
            text = label.read_text(encoding="utf-8-sig", errors="replace")
        elif label.is_symlink() or label.exists():
            what = "a folder" if label.exists() else "a link to nothing"
            raise InputError(f"{label}: must be a file (got {what})")
        elif kind == "mitsplat":
            raise InputError(f"{label}: is missing, but its image exists")
        else:
            text = ""
        instances = tuple(_yolo_instances(text, label, len(classes), (width, height)))
        content.add(text)
        return Sample(image, relative_name(root, image), width, height, instances, content.hexdigest())

    return LabelledSet(root, kind, split, classes, read_samples(read, images, root, progress))


def _check_entries(root: Path, listed: dict[str, list[str]]) -> None:
    """Log a warning for each split of which no folder or list exists; other splits have images.

    Raises:
        InputError: If only some folders or lists of a split exist.
    """
    for name, entries in listed.items():
        missing = [str(root / entry) for entry in entries if not (root / entry).exists()]
        if missing and len(missing) < len(entries):
            raise InputError(f"{root / 'data.yaml'}: {name} must name folders or lists that exist (got {missing[0]})")
        if missing:
            _logger.warning("%s: there are no images for %s in %s", root, name, ", ".join(missing))


def _check_label_files(images: list[Path]) -> None:
    """Log a warning if label files have no image.

    Raises:
        InputError: If the name of such a file is another spelling of the name of an image without labels.
    """
    for labels, pictures in dict.fromkeys((_label_file(image).parent, image.parent) for image in images):
        if labels == pictures or not labels.is_dir():
            continue
        stems = {path.stem for path in pictures.iterdir() if path.suffix.lower() in SUFFIXES}
        bare = {_plain(stem): stem for stem in stems if not (labels / f"{stem}.txt").is_file()}
        texts = sorted(path for path in labels.iterdir() if path.suffix.lower() == ".txt" and path.name != CLASSES_FILE)
        alone = [path for path in texts if path.stem not in stems or path.suffix != ".txt"]
        for path in alone:
            if stem := bare.get(_plain(path.stem)):
                raise InputError(
                    f"{path}: must be named as its image {stem} with .txt (got another letter case, or another Unicode "
                    "form of its letters)"
                )
        if alone:
            names = list_first([path.name for path in alone], 1)
            _logger.warning("%s: %s are not used, because %s has no image of these names", labels, names, pictures)


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _split_entry(root: Path, base: str, entry: str) -> str:
    """Return the image folder or list of a split, relative to ``root``.

    Some exports write ``../`` paths that are correct only from a folder below ``data.yaml``. If the path does not
    exist, the ``../`` is removed.
    """
    place, inner = str(Path(base, entry)), entry.removeprefix("../")
    return str(Path(base, inner)) if inner != entry and not (root / place).exists() else place


def _split_counts(root: Path, listed: dict[str, list[str]]) -> str:
    """Return the numbers of images of the splits in words; empty if there are none."""
    counts = {name: sum(len(_listed_images(root, entry)) for entry in entries) for name, entries in listed.items()}
    shown = ", ".join(f"{count} for {name}" for name, count in counts.items() if count)
    return f" (it has {shown})" if shown else ""


def _listed_images(root: Path, entry: str) -> list[Path]:
    """Return the images of a folder or of a list file, by name; none if it is missing."""
    place = root / entry
    if place.is_dir():
        return images_below(place)
    if not place.is_file():
        return []
    images = [place.parent / line for line in _read_lines(place)]
    # CVAT lists `data/images/...`, but its archives begin with `images`.
    shorter = [place.parent / line.removeprefix("data/") for line in _read_lines(place)]
    return [
        other if not image.exists() and other.exists() else image for image, other in zip(images, shorter, strict=True)
    ]


def _read_lines(path: Path) -> list[str]:
    """Return the lines of a text file without blank ones."""
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be lines of text in UTF-8 ({error.reason})") from error
    return [line.strip() for line in lines if line.strip()]


def _label_file(image: Path) -> Path:
    """Return the label file of an image; Ultralytics replaces the last ``images`` of the path with ``labels``."""
    before, found, after = f"/{image}".rpartition("/images/")
    return Path(f"{before}/labels/{after}"[1:] if found else image).with_suffix(".txt")


def _yolo_instances(text: str, path: Path, num_classes: int, size: tuple[int, int]) -> Iterator[LabelledObject]:
    """Return the labelled objects of a label file for an image of this width and height [px]."""
    seen: set[bytes] = set()
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        place = f"{path}:{number}"
        try:
            values = np.array(words, dtype=np.float64)
        except ValueError as error:
            raise InputError(f"{place}: must be numbers (got {line[:60]!r})") from error
        if len(values) != 5 and (len(values) < 7 or len(values) % 2 == 0):
            hint = ": is the last one a confidence or a track?" if len(values) == 6 else ""
            raise InputError(
                f"{place}: must be a class and a box (5 numbers) or a polygon of 3 points or more (got {len(values)} "
                f"numbers){hint}"
            )
        if values[0] not in range(num_classes):
            raise InputError(f"{place}: the class must be 0 to {num_classes - 1} (got {words[0]})")
        if (key := values.astype(np.float32).tobytes()) in seen:  # Ultralytics compares numbers of this precision
            continue
        seen.add(key)
        points = values[1:].reshape(-1, 2)
        if len(values) == 5:
            (x, y), (w, h) = points
            if w < 0 or h < 0:
                raise InputError(f"{place}: must have a width and a height of at least 0 (got {line[:60]!r})")
            points = np.array([[x - w / 2, y - h / 2], [x + w / 2, y + h / 2]])
        polygon = clip_points(points * size, size, place)
        (x0, y0), (x1, y1) = polygon.min(axis=0), polygon.max(axis=0)
        if not (x1 > x0 and y1 > y0):
            raise InputError(f"{place}: must have a width and a height (got {line[:60]!r})")
        box = float(x0), float(y0), float(x1), float(y1)
        yield LabelledObject(int(values[0]), box, None if len(values) == 5 else polygon)
