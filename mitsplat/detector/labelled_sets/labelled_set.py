"""Labelled images as values, and checks that both label formats share."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from pycocotools import mask as coco_mask

from mitsplat.arguments import list_first
from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.images.masks import decode_rle, encode_mask
from mitsplat.labels.polygons import fill_polygon, outline
from mitsplat.progress import Progress
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.files import JsonObject

_logger = logging.getLogger(__name__)

Split = Literal["train", "val", "test", "all"]

_OUTSIDE_TOLERANCE = 0.01
"""Largest distance of a position from the image, as a share of its sides; such positions are clipped."""
_MAX_LISTED = 3
"""Maximum number of images that a warning lists."""
_PIXELS = 3.0
"""Positions above this share of the sides of an image are probably pixels."""


Item = TypeVar("Item")


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
    rle: JsonObject | None = None
    crowd: bool = False

    @property
    def has_mask(self) -> bool:
        """True if the label has an outline or a mask, not only a box."""
        return self.polygon is not None or self.rle is not None

    def encode_mask(self, width: int, height: int) -> JsonObject:
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
        return ascii_rle(coco_mask.merge(coco_mask.frPyObjects(corners, height, width)))

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
        other_labels: Number of labels of other classes, which were left out, by class.
    """

    root: Path
    kind: Literal["mitsplat", "yolo", "coco"]
    split: Split
    class_names: tuple[str, ...]
    samples: tuple[Sample, ...]
    other_labels: Mapping[str, int] = field(default_factory=dict)

    def to_record(self) -> JsonObject:
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
            **({"other_labels": dict(self.other_labels)} if self.other_labels else {}),
        }


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
    return select_classes(found, class_names)


def match_classes(found: LabelledSet, class_names: Sequence[str], owner: str) -> LabelledSet:
    """Return the set with the classes of a detector alone, which are those of ``owner``.

    A detector must not find objects of other classes, so their labels are left out. A warning names these classes.

    Raises:
        InputError: If the set lacks a class, because it does not state whether unlabelled objects of this class are
            absent. Also if no label is left.
    """
    if less := sorted(set(class_names) - set(found.class_names)):
        others = ", ".join(sorted(set(found.class_names) - set(class_names)))
        raise InputError(
            f"{found.root}: its classes must contain those of {owner}: it lacks {', '.join(less)}"
            + (f" (its other classes are {others})" if others else "")
            + "; rename its classes, or add those that no image shows"
        )
    chosen = select_classes(found, class_names)
    if chosen.other_labels:
        others = ", ".join(f"{name} ({count} labels)" for name, count in chosen.other_labels.items())
        if not any(sample.instances for sample in chosen.samples):
            raise InputError(f"{found.root}: its images must have labels of the classes of {owner} (got {others})")
        _logger.warning("%s: not used, because %s does not have these classes: %s", found.root, owner, others)
    return chosen


def select_classes(found: LabelledSet, class_names: Sequence[str]) -> LabelledSet:
    """Return the set with these classes alone, in this order; labels of its other classes are left out and counted."""
    if tuple(class_names) == found.class_names:
        return found
    place = {name: index for index, name in enumerate(class_names)}
    new = [place.get(name) for name in found.class_names]
    samples, others = [], Counter[str]()
    for sample in found.samples:
        kept = []
        for instance in sample.instances:
            index = new[instance.class_index]
            if index is None:
                others[found.class_names[instance.class_index]] += 1
            else:
                kept.append(replace(instance, class_index=index))
        samples.append(replace(sample, instances=tuple(kept)))
    return replace(
        found, class_names=tuple(class_names), samples=tuple(samples), other_labels=dict(sorted(others.items()))
    )


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


def ascii_rle(rle: JsonObject) -> JsonObject:
    """Return a run-length code of pycocotools with its counts as text."""
    return {"size": [int(side) for side in rle["size"]], "counts": rle["counts"].decode("ascii")}


def clip_points(points: Float64Array, size: tuple[int, int], place: str) -> Float64Array:
    """Return points (N, 2) [px] clipped to the image.

    Raises:
        InputError: If a point lies farther than ``_OUTSIDE_TOLERANCE`` outside the image.
    """
    shares = points / size
    if not (
        np.isfinite(shares).all() and shares.min() >= -_OUTSIDE_TOLERANCE and shares.max() <= 1 + _OUTSIDE_TOLERANCE
    ):
        worst = shares.ravel()[np.abs(np.nan_to_num(shares.ravel(), nan=np.inf) - 0.5).argmax()]
        hint = ": are they pixels?" if worst > _PIXELS and max(size) > 1 else ""
        raise InputError(
            f"{place}: positions must lie in the image, at 0 to 1 of its width and height (got {worst:.4g}){hint}"
        )
    return np.clip(points, 0, size)


def read_samples(
    read: Callable[[Item], Sample], images: Sequence[Item], root: Path, progress: Progress | None
) -> tuple[Sample, ...]:
    """Return the samples that ``read`` makes of the images.

    Raises:
        InputError: If no image has a label.
    """
    samples = []
    for number, image in enumerate(images, start=1):
        samples.append(read(image))
        if progress is not None:
            progress(number, len(images), f"reading {root.name}")
    if not any(sample.instances for sample in samples):
        raise InputError(f"{root}: its {len(samples)} images have no labels")
    return tuple(samples)


def warn_of_unlabelled(root: Path, names: Sequence[str], total: int, remedy: str = "") -> None:
    """Log a warning if some of ``total`` images have no labels; ``names`` are those of these images."""
    if names:
        _logger.warning(
            "%s: %d of %d images have no labels and count as images without objects%s: %s",
            *(root, len(names), total, remedy, list_first(names, _MAX_LISTED)),
        )


def relative_name(root: Path, path: Path) -> str:
    """Return the path of an image relative to its set, or the whole path of an image outside."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.as_posix()
