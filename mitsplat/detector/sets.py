"""Labelled images for training and evaluation, read from a folder.

======== ===============================================================================================================
kind     content of the folder
======== ===============================================================================================================
mitsplat ``dataset.json``, and files of the format ``yolo``
yolo     ``data.yaml`` with folders or lists of images, or ``classes.txt`` beside the folders ``images`` and ``labels``;
         labels lie at the paths that Ultralytics expects
coco     JSON files of ``images``, ``annotations`` and ``categories``, in the folder, in ``annotations`` or in folders
         of splits; images beside them or anywhere in the folder
======== ===============================================================================================================

Exact duplicates of a label count once, as in Ultralytics. A COCO category without labels that is only the supercategory
of others is no class; Roboflow writes one.

All images and labels are read and checked first. A truncated image or label is therefore an error, and later readers
cannot skip it silently.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pycocotools import mask as coco_mask
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from mitsplat.arrays import Float64Array
from mitsplat.detector.pictures import check_image, images_below
from mitsplat.errors import InputError
from mitsplat.images.masks import decode_rle, encode_mask
from mitsplat.labels.polygons import fill_polygon, outline
from mitsplat.progress import Progress
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.files import SPLITS, is_inside, read_json

Split = Literal["train", "val", "test", "all"]

STRIDE = 32
"""Divisor of the image sides in Ultralytics' networks [px]."""

CLASSES_FILE = "classes.txt"
"""Class names in YOLO exports of Label Studio, one a line; all their images belong to every split."""

_MAX_COCO_BYTES = 1 << 32
"""Largest COCO file that is read [bytes]; the file of COCO's 118,287 training images has 0.45e9 bytes."""
_SPLIT_FOLDERS = {"train": "train", "val": "val", "valid": "val", "validation": "val", "test": "test"}
"""Folders of splits in COCO exports, and the split of each."""

_BACKGROUND = {"background", "_background_", "__background__"}
"""Categories that are no classes if they have no labels."""

_OUTSIDE_TOLERANCE = 0.01
"""Largest distance of a position from the image, as a share of its sides; such positions are clipped."""

_BOX_TOLERANCE = 2.0
"""Largest difference of a box from the bounds of its segmentation at which both are the same [px]."""


@dataclass(frozen=True, eq=False)
class LabelledObject:
    """One labelled object.

    Attributes:
        class_index: Index of the class in the class list of the set.
        box: x0, y0, x1, y1 [px].
        polygon: Closed outline [px], shape (M, 2), or None.
        rle: COCO's compressed run-length code of the mask, or None.
        crowd: True for a COCO crowd, which a detector does not have to find.
    """

    class_index: int
    box: tuple[float, float, float, float]
    polygon: Float64Array | None = None
    rle: dict[str, Any] | None = None
    crowd: bool = False

    @property
    def has_mask(self) -> bool:
        """True if the label has an outline or a mask, not only a box."""
        return self.polygon is not None or self.rle is not None

    def encode_mask(self, width: int, height: int) -> dict[str, Any]:
        """Return the mask in an image of this size [px] as COCO's compressed run-length code.

        For a label without a mask, the mask is the filled box.
        """
        if self.rle is not None:
            return self.rle
        if self.polygon is not None:
            mask = fill_polygon(self.polygon, width, height)
            return {"size": [height, width], "counts": encode_mask(mask, (0, 0, width, height), (width, height))}
        x0, y0, x1, y1 = self.box
        corners = [[x0, y0, x1, y0, x1, y1, x0, y1]]
        return _rle_text(coco_mask.merge(coco_mask.frPyObjects(corners, height, width)))

    def outline_points(self) -> Float64Array:
        """Return the outline [px], shape (M, 2)."""
        if self.polygon is not None:
            return self.polygon
        if self.rle is None:
            raise ValueError("a label without a mask has no outline")
        return outline(decode_rle(self.rle).astype(bool))


@dataclass(frozen=True, eq=False)
class Sample:
    """An image and its labels.

    Attributes:
        path: Path of the image.
        name: Path of the image relative to its set.
        width: Width after EXIF orientation [px].
        height: Height after EXIF orientation [px].
        instances: Labelled objects.
        digest: SHA-256 of the image and its label.
    """

    path: Path
    name: str
    width: int
    height: int
    instances: tuple[LabelledObject, ...]
    digest: str


@dataclass(frozen=True, eq=False)
class LabelledSet:
    """Labelled images, at least one.

    Attributes:
        root: The folder that was read.
        kind: Kind of the labels.
        split: Split that was read.
        class_names: Names of the classes.
        samples: The images.
    """

    root: Path
    kind: Literal["mitsplat", "yolo", "coco"]
    split: Split
    class_names: tuple[str, ...]
    samples: tuple[Sample, ...]

    def to_record(self) -> dict[str, Any]:
        """Return the record of the set; its digest covers images, labels and classes."""
        sha = ContentHash()
        sha.add_json([self.class_names, [(sample.name, sample.digest) for sample in self.samples]])
        counts = Counter(i.class_index for sample in self.samples for i in sample.instances if not i.crowd)
        return {
            "path": str(self.root),
            "kind": self.kind,
            "split": self.split,
            "images": len(self.samples),
            "instances": {name: counts[i] for i, name in enumerate(self.class_names)},
            "digest": sha.hexdigest(),
        }


def read_set(path: str | Path, split: Split, progress: Progress | None = None) -> LabelledSet:
    """Read labelled images.

    Args:
        path: A mitsplat dataset, a YOLO folder, or a COCO folder.
        split: Split to read. For COCO, this is the file with the split in its name; a single file is always read
            completely.
        progress: Called after each image.

    Raises:
        InputError: If the folder is of none of these kinds or has no image in the split. Also if an image or a label is
            missing, truncated or out of range.
    """
    root = Path(path)
    if not root.is_dir():
        raise InputError(f"{root}: must be the folder of a dataset (got {'a file' if root.exists() else 'nothing'})")
    if (root / "dataset.json").is_file():
        if not (root / "labels").is_dir():
            raise InputError(f"{root}: training needs YOLO labels: add yolo to output.formats of the scene")
        classes = _class_names(_read_yaml(root / "data.yaml"), root / "data.yaml")
        return _read_yolo(root, "mitsplat", split, classes, {name: [f"images/{name}"] for name in SPLITS}, progress)
    if (root / "data.yaml").is_file():
        content = _read_yaml(root / "data.yaml")
        if "kpt_shape" in content:
            raise InputError(f"{root / 'data.yaml'}: labels must be boxes or masks (got keypoints, kpt_shape)")
        base = str(content.get("path") or ".")
        entries = {name: content[name] for name in SPLITS if content.get(name)}
        listed = {
            name: [_split_entry(root, base, str(entry)) for entry in (given if isinstance(given, list) else [given])]
            for name, given in entries.items()
        }
        return _read_yolo(root, "yolo", split, _class_names(content, root / "data.yaml"), listed, progress)
    if (root / CLASSES_FILE).is_file() and (root / "images").is_dir():
        names = _class_names({"names": _read_lines(root / CLASSES_FILE)}, root / CLASSES_FILE)
        return _read_yolo(root, "yolo", split, names, {name: ["images"] for name in SPLITS}, progress)
    return _read_coco(root, split, progress)


def reorder_classes(found: LabelledSet, class_names: Sequence[str], owner: str) -> LabelledSet:
    """Return the set with its classes in the order of ``class_names``, the classes of ``owner``.

    Raises:
        InputError: If the set has other classes.
    """
    own, wanted = set(found.class_names), set(class_names)
    if own != wanted:
        more, less = sorted(own - wanted), sorted(wanted - own)
        counts = found.to_record()["instances"]
        differences = [f"it also has {', '.join(f'{name} ({counts[name]} labels)' for name in more)}"] * bool(more)
        differences += [f"it lacks {', '.join(less)}"] * bool(less)
        raise InputError(
            f"{found.root}: its classes must be those of {owner}: {' and '.join(differences)}; rename its classes, or "
            "remove those without labels"
        )
    if tuple(class_names) == found.class_names:
        return found
    place = [list(class_names).index(name) for name in found.class_names]
    samples = tuple(
        replace(sample, instances=tuple(replace(i, class_index=place[i.class_index]) for i in sample.instances))
        for sample in found.samples
    )
    return replace(found, class_names=tuple(class_names), samples=samples)


def check_masks(found: LabelledSet) -> None:
    """Check that all labels of a set have masks.

    Raises:
        InputError: If a label is only a box; the error names the first such image.
    """
    for sample in found.samples:
        if not all(instance.has_mask for instance in sample.instances):
            raise InputError(
                f"{found.root}: a mask model needs mask labels, but {sample.name} has only boxes: "
                "choose a box model, such as yolo11n"
            )


def _rle_text(rle: dict[str, Any]) -> dict[str, Any]:
    return {"size": [int(side) for side in rle["size"]], "counts": rle["counts"].decode("ascii")}


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = YAML(typ="safe", pure=True).load(path)
    except (OSError, ValueError, RecursionError, YAMLError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({str(error).splitlines()[0]})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: must name the images and classes of a YOLO dataset")
    return content


def _class_names(content: dict[str, Any], path: Path) -> tuple[str, ...]:
    names = content.get("names")
    if isinstance(names, dict) and names.keys() == set(range(len(names))):
        names = [names[i] for i in range(len(names))]
    if not isinstance(names, list) or not names or len(set(map(str, names))) < len(names):
        raise InputError(f"{path}: names must be distinct classes, numbered from 0 (got {str(names)[:80]})")
    if content.get("nc", len(names)) != len(names):
        raise InputError(f"{path}: nc must be the number of names, {len(names)} (got {content['nc']})")
    return tuple(map(str, names))


def _read_yolo(
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
        raise InputError(
            f"{root}: there are no images for {split}"
            + (_split_counts_text(_split_counts(root, listed)) or f" in {sought}")
        )
    if not any(_label_file(image).is_file() for image in images):
        raise InputError(f"{root}: its images have no labels, such as {_label_file(images[0])}")

    def read(image: Path) -> Sample:
        width, height, content = check_image(image)
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
        return Sample(image, _relative_name(root, image), width, height, instances, content.hexdigest())

    return LabelledSet(root, kind, split, classes, _read_samples(read, images, root, progress))


def _split_entry(root: Path, base: str, entry: str) -> str:
    """Return the image folder or list of a split, relative to ``root``.

    Some exports write ``../`` paths that are correct only from a folder below ``data.yaml``. If the path does not
    exist, the ``../`` is removed.
    """
    place, inner = str(Path(base, entry)), entry.removeprefix("../")
    return str(Path(base, inner)) if inner != entry and not (root / place).exists() else place


def _split_counts(root: Path, listed: dict[str, list[str]]) -> dict[str, int]:
    return {name: sum(len(_listed_images(root, entry)) for entry in entries) for name, entries in listed.items()}


def _split_counts_text(counts: dict[str, int]) -> str:
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
            raise InputError(
                f"{place}: must be a class and a box (5 numbers) or a polygon of 3 points or more (got {len(values)})"
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
        polygon = _clip_points(points * size, size, place)
        (x0, y0), (x1, y1) = polygon.min(axis=0), polygon.max(axis=0)
        if not (x1 > x0 and y1 > y0):
            raise InputError(f"{place}: must have a width and a height (got {line[:60]!r})")
        box = float(x0), float(y0), float(x1), float(y1)
        yield LabelledObject(int(values[0]), box, None if len(values) == 5 else polygon)


def _clip_points(points: Float64Array, size: tuple[int, int], place: str) -> Float64Array:
    """Return points [px] clipped to the image.

    Raises:
        InputError: If a point lies farther than ``_OUTSIDE_TOLERANCE`` outside the image.
    """
    shares = points / size
    if not (
        np.isfinite(shares).all() and shares.min() >= -_OUTSIDE_TOLERANCE and shares.max() <= 1 + _OUTSIDE_TOLERANCE
    ):
        worst = shares.ravel()[np.abs(np.nan_to_num(shares.ravel(), nan=np.inf) - 0.5).argmax()]
        raise InputError(
            f"{place}: positions must lie in the image, at 0 to 1 of its width and height (got {worst:.4g})"
        )
    return np.clip(points, 0, size)


def _read_coco(root: Path, split: Split, progress: Progress | None) -> LabelledSet:
    parts = [_coco_part(root, split, *file, progress) for file in _coco_files(root, split).items()]
    parts = [reorder_classes(part, parts[0].class_names, str(root)) for part in parts]
    samples = tuple(sample for part in parts for sample in part.samples)
    twice = [name for name, count in Counter(sample.name for sample in samples).items() if count > 1]
    if twice:
        raise InputError(f"{root}: each image must be in one of its COCO files (got {twice[0]} in several)")
    return replace(parts[0], samples=samples)


def _coco_part(root: Path, split: Split, path: Path, content: dict[str, Any], progress: Progress | None) -> LabelledSet:
    """Return the labelled images of one COCO file."""
    try:
        used = {annotation["category_id"] for annotation in content["annotations"]}
        above = {c["name"]: c.get("supercategory") for c in content["categories"]}
        parents = {parent for name, parent in above.items() if parent != name and above.get(parent) != parent}
        unlabelled = parents | _BACKGROUND
        categories = [c for c in content["categories"] if c["id"] in used or c["name"] not in unlabelled]
        categories.sort(key=lambda category: category["id"])
        names = tuple(str(category["name"]) for category in categories)
        index = {category["id"]: i for i, category in enumerate(categories)}
        by_image: dict[Any, list[dict[str, Any]]] = {image["id"]: [] for image in content["images"]}
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
    if len(set(names)) < len(names) or len(index) < len(names) or len(by_image) < len(content["images"]):
        raise InputError(f"{path}: ids of images, and ids and names of categories, must differ")
    if not by_image:
        raise InputError(f"{root}: there are no images for {split}")
    boxes = [annotation.get("bbox") for annotation in content["annotations"]]
    if boxes and all(map(_is_fraction, boxes)):
        raise InputError(f"{path}: bbox must be in pixels (got at most 1 in every annotation: are they fractions?)")
    find = _image_finder(root, path)

    def read(image: dict[str, Any]) -> Sample:
        file = find(str(image.get("file_name")))
        width, height, shown = check_image(file)
        if (image.get("width", width), image.get("height", height)) != (width, height):
            raise InputError(
                f"{file}: must have the size in {path.name}, {image.get('width')} x {image.get('height')} px, "
                f"after EXIF orientation (got {width} x {height})"
            )
        found = by_image[image["id"]]
        instances = {
            (one.class_index, one.box, one.rle and one.rle["counts"], one.crowd): one
            for one in (_coco_instance(a, index[a["category_id"]], (width, height), path) for a in found)
        }
        shown.add_json([names, found])
        return Sample(file, _relative_name(root, file), width, height, tuple(instances.values()), shown.hexdigest())

    images = sorted(content["images"], key=lambda image: str(image.get("file_name")))
    return LabelledSet(root, "coco", split, names, _read_samples(read, images, root, progress))


def _coco_files(root: Path, split: Split) -> dict[Path, dict[str, Any]]:
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
        raise InputError(f"{root}: one of its COCO files must have {split} in its name (got {_file_names(files)})")
    raise InputError(
        f"{root}: must be a dataset of mitsplat (dataset.json), a YOLO folder (data.yaml) or a COCO folder (a JSON "
        "file with images, annotations and categories)"
    )


def _split_words(path: Path) -> list[str]:
    """Return the words of a path, those of other tools' splits translated."""
    return [_SPLIT_FOLDERS.get(word, word) for word in re.findall("[a-z]+", str(path.with_suffix("")).lower())]


def _file_names(files: Iterable[Path]) -> str:
    return ", ".join(path.name for path in files)


def _read_json(path: Path) -> Any:
    try:
        return read_json(path, _MAX_COCO_BYTES)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from error


def _image_finder(root: Path, listing: Path) -> Callable[[str], Path]:
    """Return a function that finds the images named in an annotation file."""
    below: dict[str, list[Path]] = {}
    for path in images_below(root):
        below.setdefault(path.name, []).append(path)

    def find(name: str) -> Path:
        name = name.replace("\\", "/")  # as Label Studio writes it on Windows
        if not is_inside(root, name):
            raise InputError(f"{listing}: file_name must be of an image in {root} (got {name})")
        for folder in (listing.parent, root):
            if (folder / name).is_file():
                return folder / name
        found = [path for path in below.get(Path(name).name, ()) if f"/{path}".endswith(f"/{name}")]
        if len(found) != 1:
            raise InputError(f"{listing}: {name} must be one image in {root} (got {len(found)})")
        return found[0]

    return find


def _coco_instance(annotation: dict[str, Any], class_index: int, size: tuple[int, int], path: Path) -> LabelledObject:
    place = f"{path}: annotation {annotation.get('id')}"
    width, height = size
    try:
        x, y, w, h = (float(value) for value in annotation["bbox"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{place}: bbox must be x, y, width, height (got {annotation.get('bbox')})") from error
    corners = _clip_points(np.array([[x, y], [x + w, y + h]]), size, f"{place}: bbox")
    (x0, y0), (x1, y1) = corners.tolist()
    if not (x1 > x0 and y1 > y0):
        raise InputError(f"{place}: bbox must have a width and a height (got {annotation['bbox']})")
    rle, given = None, annotation.get("segmentation")
    if given:
        try:
            if isinstance(given, list):
                for part in given:
                    if len(part) < 6 or len(part) % 2:
                        raise InputError(
                            f"{place}: segmentation must be polygons of 3 points or more (got {len(part)} numbers)"
                        )
                    _clip_points(np.array(part, dtype=np.float64).reshape(-1, 2), size, f"{place}: segmentation")
                rle = coco_mask.merge(coco_mask.frPyObjects(given, height, width))
            elif list(given["size"]) != [height, width]:
                raise InputError(f"{place}: segmentation must be of {height} x {width} px (got {given['size']})")
            else:
                lengths = given["counts"] if isinstance(given["counts"], list) else _run_lengths(str(given["counts"]))
                if sum(lengths) != height * width or min(lengths) < 0:  # decoding would invent the missing pixels
                    raise InputError(
                        f"{place}: run lengths must be of {height} x {width} px, {height * width} (got {sum(lengths)})"
                    )
                rle = coco_mask.frPyObjects({"size": [height, width], "counts": lengths}, height, width)
            if not decode_rle(rle).any():
                raise InputError(f"{place}: segmentation must cover a pixel")
            stated = np.array([x, y, w, h])
            x, y, w, h = coco_mask.toBbox(rle).tolist()
            if (other := _other_box(stated, x, y, w, h)) is not None:
                raise InputError(
                    f"{place}: bbox must be x, y, width, height, not {other} (got {annotation['bbox']} for a "
                    f"segmentation that spans [{x:g}, {y:g}, {w:g}, {h:g}])"
                )
            if min(x1, x + w) < max(x0, x) - 1 or min(y1, y + h) < max(y0, y) - 1:  # masks have whole pixels
                raise InputError(
                    f"{place}: bbox must enclose its segmentation, which spans [{x:g}, {y:g}, {w:g}, {h:g}] (got "
                    f"{annotation['bbox']})"
                )
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
            raise InputError(f"{place}: segmentation must be polygons or run lengths ({error})") from error
    else:
        _check_box_alone(annotation, np.array([x, y, w, h]), place)
    crowd = annotation.get("iscrowd") or 0
    if crowd not in (0, 1):
        raise InputError(f"{place}: iscrowd must be 0 or 1 (got {crowd!r})")
    return LabelledObject(class_index, (x0, y0, x1, y1), None, None if rle is None else _rle_text(rle), bool(crowd))


def _check_box_alone(annotation: dict[str, Any], box: Float64Array, place: str) -> None:
    """Check the rotation and the area that an annotation without segmentation states for its box.

    Raises:
        InputError: If the box is rotated, or if its area is that of its two corners.
    """
    attributes, area, (x, y, w, h) = annotation.get("attributes"), annotation.get("area"), box.tolist()
    if isinstance(attributes, dict) and (turn := attributes.get("rotation")):
        raise InputError(f"{place}: bbox must not be rotated (got rotation {turn}): export masks or polygons")
    own, corners = (isinstance(area, int | float) and abs(a - area) <= 0.02 * area for a in (w * h, (w - x) * (h - y)))
    if corners and not own:
        raise InputError(
            f"{place}: bbox must be x, y, width, height, not its two corners (got {annotation['bbox']}, area {area})"
        )


def _other_box(stated: Float64Array, x: float, y: float, w: float, h: float) -> str | None:
    """Return how a box is stated if it fits a segmentation within 2 pixels in another form than COCO's, or None."""
    forms = {
        "its two corners": (x, y, x + w, y + h),
        "its centre and size": (x + w / 2, y + h / 2, w, h),
    }
    if np.abs(stated - (x, y, w, h)).max() <= _BOX_TOLERANCE:
        return None
    return next((name for name, box in forms.items() if np.abs(stated - box).max() <= _BOX_TOLERANCE), None)


def _is_fraction(box: object) -> bool:
    """Return True if a box has no value above 1."""
    return isinstance(box, list) and all(isinstance(value, int | float) and value <= 1 for value in box)


def _run_lengths(code: str) -> list[int]:
    """Return the run lengths of COCO's compressed mask code.

    Each character has five value bits. From the third run on, the code stores the difference to the run two before.
    """
    lengths: list[int] = []
    value = shift = 0
    for letter in code:
        bits = ord(letter) - 48
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            value -= (bits & 16) << (shift - 4)
            lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
            value = shift = 0
    return lengths


def _relative_name(root: Path, path: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.as_posix()


def _read_samples(
    read: Callable[[Any], Sample], images: Sequence[Any], root: Path, progress: Progress | None
) -> tuple[Sample, ...]:
    samples = []
    for number, image in enumerate(images, start=1):
        samples.append(read(image))
        if progress is not None:
            progress(number, len(images), f"reading {root.name}")
    if not any(sample.instances for sample in samples):
        raise InputError(f"{root}: its {len(samples)} images have no labels")
    return tuple(samples)
