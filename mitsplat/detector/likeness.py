"""Comparison of rendered images with labelled photographs: brightness, colour and size of objects, and noise.

A detector fails where photographs differ from its training images. Image means do not show these differences: objects
are small, and auto-exposure makes them dark in front of a bright background. Objects are therefore measured inside
their labels, image by image, at the input size of the detector.

The result is the share of photographs outside the middle 90 % of the rendered values. For two samples of one
distribution this share is 10 %.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from mitsplat.arrays import BoolArray, ByteImage, Float64Array, evenly_spaced
from mitsplat.detector.labelled_sets.labelled_set import LabelledObject, LabelledSet, Sample, Split, select_classes
from mitsplat.detector.labelled_sets.pictures import read_upright
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.libraries import STRIDE
from mitsplat.errors import InputError
from mitsplat.labels.polygons import fill_polygon
from mitsplat.progress import Progress

MIN_REAL_OBJECTS, MIN_RENDERED_OBJECTS = 5, 20
"""Least numbers of photographed and of rendered objects of a class that are compared."""
SIGNIFICANCE = 0.01
"""Significance level: advice is given if chance explains the share outside the range with a lower probability."""
_PERMUTATIONS = 299
"""Number of random permutations of the images between the two sides."""
_TAIL = 0.05
_MIN_AREA = 64
"""Least area inside a label for a colour measurement [px]."""
_FLAT_QUANTILE = 0.4
"""Share of the pixels with the smallest smoothed gradient; there the Laplacian measures noise."""
_MIN_BYTE = 40
"""Byte value below which a sensor clips its noise."""

BRIGHTNESS, SIZE = "brightness of objects", "size of objects"
_UNCUT_SIZE = "size of objects that no border cuts"
_HUE_BINS = 120
"""Number of hue bins over 360 degrees."""
_MAX_HUE_SHIFT = 15
"""Largest hue shift in the search, in bins to either side."""
_MIN_CHROMA = 25
"""Least difference between the channels of a pixel with a hue, in bytes."""
_SHIFT_LIMIT = 8.0
"""Median hue shift over the classes from which a colour shift of the camera is reported [degrees]."""
_TRAITS: dict[str, tuple[str, str, str]] = {
    BRIGHTNESS: (
        "of 255",
        "lower randomise.exposure, or brighten the surroundings of objects",
        "raise randomise.exposure, or darken the surroundings of objects",
    ),
    "saturation of objects": ("%", "lower randomise.saturation", "raise randomise.saturation, or reduce gloss"),
    SIZE: ("px", "move cameras farther away", "move cameras nearer"),
    "objects of an image": ("", "lower objects[].count", "raise objects[].count, or use wider views"),
    "objects cut by the border": (
        "% of an image's",
        "aim views at all objects, from farther away",
        "aim views less at the centre",
    ),
    "brightness of images": ("of 255", "darken the backdrop", "brighten the backdrop"),
    "noise of images": ("of 255", "lower randomise.iso, or increase the exposure", "raise randomise.iso"),
}
"""Unit of each trait, and the advice if photographs have lower or higher values."""

_Values: TypeAlias = dict[tuple[str, int | None], list[tuple[int, float]]]
"""Pairs of image number and value, by trait and class index; the class index None stands for all classes."""

_HueSums: TypeAlias = dict[int, Float64Array]
"""Sums of :func:`_hue_histogram` over the objects of a class, by class index."""


@dataclass(frozen=True)
class Trait:
    """Distribution of one trait in rendered images and in photographs.

    Attributes:
        name: Name of the trait.
        unit: Unit of the values.
        rendered: Quantiles 0.05, 0.5 and 0.95 of the rendered images, or of the objects in them.
        real: The same quantiles of the photographs.
        below: Share of photographs, or of objects in them, below the rendered quantile 0.05.
        above: Share of photographs, or of objects in them, above the rendered quantile 0.95.
        advice: Suggested change, if significantly more values than expected lie outside on one side; empty otherwise.
    """

    name: str
    unit: str
    rendered: tuple[float, float, float]
    real: tuple[float, float, float]
    below: float
    above: float
    advice: str


@dataclass(frozen=True)
class Likeness:
    """Differences between rendered images and photographs.

    Attributes:
        images: Number of rendered images that were measured.
        photographs: Number of photographs that were measured.
        same_size: Longer side of photographs [px], a multiple of 32, at which their objects have the size of rendered
            ones. This is the median over classes of the ratio of upper quartiles, of objects that no border cuts; upper
            quartiles, because partly hidden objects look smaller. None if no class is frequent enough on both sides.
        same_sizes: Smallest and largest of these sizes over classes [px], which show how uncertain ``same_size`` is.
        traits: Traits over all classes.
        classes: Brightness and saturation of each class that is frequent enough on both sides.
        hues: Hue shift of the photographs from red towards green [degrees], for each of these classes where it can be
            measured.
        only_rendered: Number of rendered labels of classes that the photographs do not have, by class. These labels are
            not compared.
        only_photographed: Number of labels of classes that the rendered images do not have, by class. These labels are
            not compared.
        skipped: Numbers of rendered images and of photographs whose labels are all of such classes. These images are
            not compared.
    """

    images: int
    photographs: int
    same_size: int | None
    same_sizes: tuple[int, int] | None
    traits: tuple[Trait, ...]
    classes: dict[str, tuple[Trait, ...]]
    hues: dict[str, float]
    only_rendered: dict[str, int] = field(default_factory=dict)
    only_photographed: dict[str, int] = field(default_factory=dict)
    skipped: tuple[int, int] = (0, 0)

    @property
    def hue_advice(self) -> str:
        """Suggested change if photographs show shifted hues; empty otherwise."""
        turned = list(self.hues.values())
        if not turned or np.median(np.abs(turned)) < _SHIFT_LIMIT:
            return ""
        return "shift the camera's hues as far with randomise.hue, and add randomise.chroma_stretch"


def compare_with_photographs(
    rendered: Sequence[str | Path],
    photographs: str | Path,
    *,
    split: Split = "train",
    size: int = 640,
    max_images: int = 400,
    progress: Progress | None = None,
) -> Likeness:
    """Compare rendered images with labelled photographs.

    Colours are measured at pixels inside masks. If any label of a class is a box without a mask, on either side, they
    are measured in the middle half of the boxes of all labels of this class.

    Args:
        rendered: mitsplat datasets, YOLO folders or COCO folders.
        photographs: A folder of the same kinds; all splits are used. Classes are matched by name. Classes that only one
            side has are not compared, but counted in the result.
        split: Split of the rendered images.
        size: Longer side to which images are scaled before measurement [px].
        max_images: Maximum number of images of each side, drawn at equal intervals.
        progress: Called after each image.

    Raises:
        InputError: If there is nothing to compare, or a file cannot be read.
    """
    if size < STRIDE:
        raise InputError(f"size must be {STRIDE} px or more (got {size})")
    if max_images < 1:
        raise InputError(f"the number of images per side must be at least 1 (got {max_images})")
    real = read_set(photographs, "all")
    sets = [read_set(one, split) for one in rendered]
    if not sets:
        raise InputError("there are no rendered images to compare")
    rendered_names = {name for one in sets for name in one.class_names}
    names = [name for name in real.class_names if name in rendered_names]
    if not names:
        raise InputError(
            f"{photographs}: must have a class of the rendered images, which are {', '.join(sorted(rendered_names))} "
            f"(got {', '.join(real.class_names)})"
        )
    rendered_side, real_side = _common_part(sets, names), _common_part([real], names)
    ours, theirs = (
        [side.samples[i] for i in evenly_spaced(len(side.samples), max_images)] for side in (rendered_side, real_side)
    )
    only_boxes = frozenset(i.class_index for one in ours + theirs for i in one.instances if not (i.has_mask or i.crowd))
    sides: tuple[_Values, _Values] = defaultdict(list), defaultdict(list)
    no_hues = partial(np.zeros, _HUE_BINS)
    hues: tuple[_HueSums, _HueSums] = defaultdict(no_hues), defaultdict(no_hues)
    for number, sample in enumerate(ours + theirs):
        _measure(sample, number, size, only_boxes, sides[number >= len(ours)], hues[number >= len(ours)])
        if progress is not None:
            progress(number + 1, len(ours) + len(theirs), "measuring images")
    least = MIN_RENDERED_OBJECTS, MIN_REAL_OBJECTS
    classes = {
        name: _traits(sides, index)
        for index, name in enumerate(names)
        if all(len(side.get((BRIGHTNESS, index), [])) >= few for side, few in zip(sides, least, strict=True))
    }
    turned = {
        name: turn
        for index, name in enumerate(names)
        if name in classes and (turn := _hue_shift(hues[0][index], hues[1][index])) is not None
    }
    same_size, same_sizes = _equal_sizes(_size_ratios(sides, len(names)), size)
    return Likeness(
        len(ours),
        len(theirs),
        same_size,
        same_sizes,
        _traits(sides, None),
        classes,
        turned,
        rendered_side.other_labels,
        real_side.other_labels,
        (rendered_side.skipped, real_side.skipped),
    )


@dataclass(frozen=True)
class _Side:
    """Images of one side with the labels of the common classes; other attributes as of :class:`Likeness`."""

    samples: list[Sample]
    other_labels: dict[str, int]
    skipped: int


def _common_part(sets: Sequence[LabelledSet], names: Sequence[str]) -> _Side:
    """Return the labels of the common classes ``names``, without images whose labels are all of other classes.

    Raises:
        InputError: If no label is left.
    """
    samples: list[Sample] = []
    others, skipped = Counter[str](), 0
    for one in sets:
        chosen = select_classes(one, names)
        others.update(chosen.other_labels)
        kept = [
            after
            for before, after in zip(one.samples, chosen.samples, strict=True)
            if after.instances or not before.instances
        ]
        samples += kept
        skipped += len(one.samples) - len(kept)
    if not any(sample.instances for sample in samples):
        raise InputError(
            f"{sets[0].root}: must have labels of a class that both sides have, {', '.join(names)} "
            f"(got {', '.join(sorted(others))})"
        )
    return _Side(samples, dict(sorted(others.items())), skipped)


def _traits(sides: tuple[_Values, _Values], index: int | None) -> tuple[Trait, ...]:
    """Return the traits that both sides have, of a class by its index, or of all classes."""
    shown = [key for key in _TRAITS if all(side.get((key, index)) for side in sides)]
    return tuple(_trait(key, sides[0][key, index], sides[1][key, index]) for key in shown)


def _equal_sizes(ratios: Sequence[float], size: int) -> tuple[int | None, tuple[int, int] | None]:
    """Return the image size [px] at which photographed objects are as large as rendered ones at ``size``.

    The size is that of the median class, followed by the sizes of the extreme classes; None without classes.
    """
    if not ratios:
        return None, None
    least, middle, most = (max(round(size * ratio / STRIDE), 1) * STRIDE for ratio in np.quantile(ratios, [0, 0.5, 1]))
    return middle, (least, most)


def _hue_histogram(pixels: ByteImage) -> Float64Array:
    """Return the sum of the chroma [bytes] by hue, divided by the number of pixels, shape (_HUE_BINS,).

    ``pixels`` has shape (N, 3), BGR. Pixels without a hue count as zero.
    """
    hue = cv2.cvtColor(pixels[None].astype(np.float32) / 255, cv2.COLOR_BGR2HSV)[0, :, 0]
    chroma = np.ptp(pixels.astype(float), axis=1)
    places = (hue * (_HUE_BINS / 360)).astype(np.intp) % _HUE_BINS
    found = np.bincount(places, chroma * (chroma >= _MIN_CHROMA), _HUE_BINS)
    return np.asarray(found / len(pixels))


def _hue_shift(ours: Float64Array, theirs: Float64Array) -> float | None:
    """Return the hue shift with the largest overlap of two hue histograms [degrees].

    None if a histogram is empty, or if the best shift lies at the end of the search range.
    """
    if not (ours.any() and theirs.any()):
        return None
    smooth, wanted = (gaussian_filter1d(side / side.sum(), 2.0, mode="wrap") for side in (ours, theirs))
    turns = sorted(range(-_MAX_HUE_SHIFT, _MAX_HUE_SHIFT + 1), key=abs)
    overlaps = [float(np.minimum(np.roll(smooth, turn), wanted).sum()) for turn in turns]
    best = turns[int(np.argmax(overlaps))]
    return None if abs(best) == _MAX_HUE_SHIFT else 360 / _HUE_BINS * best


def _size_ratios(sides: tuple[_Values, _Values], classes: int) -> list[float]:
    """Return the size ratio of rendered to photographed objects, for each class that is frequent enough in both."""
    ratios = []
    for index in range(classes):
        ours, theirs = (side.get((_UNCUT_SIZE, index), []) for side in sides)
        if len(ours) >= MIN_RENDERED_OBJECTS and len(theirs) >= MIN_REAL_OBJECTS:
            upper = [np.quantile([value for _, value in values], 0.75) for values in (ours, theirs)]
            ratios.append(float(upper[0] / upper[1]))
    return ratios


def _measure(
    sample: Sample, number: int, size: int, only_boxes: Collection[int], values: _Values, hues: _HueSums
) -> None:
    """Add the measurements of an image to ``values`` and ``hues``.

    Args:
        sample: The image and its labels.
        number: Number of the image.
        size: Longer side to which the image is scaled [px].
        only_boxes: Indices of the classes whose colours are measured within boxes.
        values: Measurements of one side.
        hues: Sums of hue histograms of one side.
    """
    stored = read_upright(sample.path)
    scale = size / max(sample.width, sample.height)
    width, height = (max(round(scale * side), 1) for side in (sample.width, sample.height))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    picture: ByteImage = cv2.resize(stored, (width, height), interpolation=way).astype(np.uint8)
    objects, cut = [instance for instance in sample.instances if not instance.crowd], 0
    for instance in objects:
        x0, y0, x1, y1 = instance.box
        side = scale * float(np.sqrt(max(x1 - x0, 0) * max(y1 - y0, 0)))
        values[SIZE, None].append((number, side))
        if min(x0, y0) < 1 or x1 > sample.width - 1 or y1 > sample.height - 1:
            cut += 1
        else:
            values[_UNCUT_SIZE, instance.class_index].append((number, side))
        inside = _object_pixels(instance, sample, width, height, as_box=instance.class_index in only_boxes)
        if inside.sum() >= _MIN_AREA:
            hues[instance.class_index] += _hue_histogram(picture[inside])
            pixels = picture[inside].astype(float)
            most = pixels.max(axis=1)
            saturation = (most - pixels.min(axis=1)) / np.maximum(most, 1)
            for index in (None, instance.class_index):
                values[BRIGHTNESS, index].append((number, float(np.median(most))))
                values["saturation of objects", index].append((number, 100 * float(np.median(saturation))))
    values["objects of an image", None].append((number, float(len(objects))))
    if objects:
        values["objects cut by the border", None].append((number, 100 * cut / len(objects)))
    values["brightness of images", None].append((number, float(picture.mean())))
    noise = _noise_level(picture[..., 1], picture.max(axis=2))
    if noise is not None:
        values["noise of images", None].append((number, noise))


def _object_pixels(instance: LabelledObject, sample: Sample, width: int, height: int, *, as_box: bool) -> BoolArray:
    """Return the pixels of an object in the scaled image, or of the middle half of its box, shape (height, width)."""
    factor = np.array([width / sample.width, height / sample.height])
    if not as_box:
        return fill_polygon(instance.outline_points() * factor, width, height)
    inside = np.zeros((height, width), dtype=bool)
    (x0, y0), (x1, y1) = (np.array(corner) * factor for corner in (instance.box[:2], instance.box[2:]))
    rows, columns = (
        slice(max(round(low + (high - low) / 4), 0), max(round(high - (high - low) / 4), 0))
        for low, high in ((y0, y1), (x0, x1))
    )
    inside[rows, columns] = True
    return inside


def _noise_level(green: ByteImage, bright: ByteImage) -> float | None:
    """Return the median absolute Laplacian in flat areas [bytes], or None if the image is almost black or clipped."""
    values = green.astype(np.float32)
    smooth = cv2.GaussianBlur(values, (0, 0), 2)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    lit = (bright > _MIN_BYTE) & (bright < 250)
    if lit.sum() < _MIN_AREA:
        return None
    flat = lit & (slope <= np.quantile(slope[lit], _FLAT_QUANTILE))
    return float(np.median(np.abs(cv2.Laplacian(values, cv2.CV_32F))[flat]))


def _trait(name: str, rendered: Sequence[tuple[int, float]], real: Sequence[tuple[int, float]]) -> Trait:
    unit, less, more = _TRAITS[name]
    images, values = np.array([*rendered, *real], dtype=float).T
    photographed = np.arange(len(values)) >= len(rendered)
    ours, theirs = (np.quantile(values[side], [_TAIL, 0.5, 1 - _TAIL]) for side in (~photographed, photographed))
    outside = _outside_shares(values, photographed)
    too_low, too_high = _significant(outside, images, values, photographed)
    advice = {
        (True, False): less,
        (False, True): more,
        (True, True): "photographs vary more: widen the range at both ends",
    }
    quantiles = [(float(values[0]), float(values[1]), float(values[2])) for values in (ours, theirs)]
    below, above = outside.tolist()
    return Trait(name, unit, quantiles[0], quantiles[1], below, above, advice.get((too_low, too_high), ""))


def _outside_shares(values: Float64Array, photographed: BoolArray) -> Float64Array:
    """Return the shares of photograph values below and above the middle 90 % of the rendered values, shape (2,)."""
    low, high = np.quantile(values[~photographed], [_TAIL, 1 - _TAIL])
    real = values[photographed]
    return np.array([np.mean(real < low), np.mean(real > high)])


def _significant(
    outside: Float64Array, images: Float64Array, values: Float64Array, photographed: BoolArray
) -> tuple[bool, bool]:
    """Return for each side True if the share outside is significant in a permutation test.

    The test assigns all images to the two sides at random. A share is significant if fewer than :data:`SIGNIFICANCE` of
    the permutations reach it. The objects of an image stay together because they share its light. The result is False
    for too few objects.
    """
    if (~photographed).sum() < MIN_RENDERED_OBJECTS or photographed.sum() < MIN_REAL_OBJECTS:
        return False, False
    names, places = np.unique(images, return_inverse=True)
    count = len(np.unique(images[photographed]))
    rng = np.random.default_rng(0)
    reached = np.ones(2)
    for _ in range(_PERMUTATIONS):
        dealt = np.zeros(len(names), dtype=bool)
        dealt[rng.choice(len(names), count, replace=False)] = True
        reached += _outside_shares(values, dealt[places]) >= outside
    low, high = (reached / (_PERMUTATIONS + 1) < SIGNIFICANCE).tolist()
    return low, high
