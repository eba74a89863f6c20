"""How far labelled photographs lie outside of rendered images: brightness, colours and size of objects, noise.

A detector fails where photographs show what it was never shown. Means of whole pictures hide that: objects are small,
and a camera that meters the picture makes them dark where what lies around is bright. So objects are measured within
their labels, image by image at the size that a detector is given, and photographs are told by the share of them that
lies beyond the middle nine tenths of the rendered ones: a tenth would where both are drawn from the same.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from mitsplat.arrays import BoolArray, ByteImage, Float64Array
from mitsplat.detector.pictures import read_picture
from mitsplat.detector.sets import STRIDE, LabelledObject, Sample, Split, in_classes, read_set
from mitsplat.errors import InputError
from mitsplat.labels.polygons import fill_polygon
from mitsplat.progress import Progress

FEWEST, FEWEST_RENDERED = 5, 20
"""Objects of a class, on photographs and rendered, from which it is judged."""
CHANCE = 0.01
"""Of so many outside of the rendered range by chance; what is less likely is advised on."""
_DRAWS = 299
"""Times that images are dealt anew to both sides, which tells what chance does."""
_TAIL = 0.05
_SMALLEST = 64
"""Area within a label from which its colour is measured [px]."""
_FLAT_QUANTILE = 0.4
"""Share of an image whose smoothed gradient is least: there the Laplacian is noise."""
_DARK = 40
"""Bytes below which a sensor clips its noise."""

BRIGHTNESS, SIZE = "brightness of objects", "size of objects"
_WHOLE = "size of objects that no border cuts"
_HUES = 120
"""Bins of a turn of hues."""
_FARTHEST = 15
"""Bins by which hues are looked for on either side."""
_COLOURED = 25
"""Bytes by which channels differ in what has a hue."""
_TURNED = 8.0
"""Degrees by which hues differ in half of the classes where a camera shows colours in its own way."""
_TRAITS: dict[str, tuple[str, str, str]] = {
    BRIGHTNESS: (
        "of 255",
        "lower randomise.exposure, or light less",
        "raise randomise.exposure, light objects more, or darken what lies around them",
    ),
    "saturation of objects": ("%", "lower randomise.saturation", "raise randomise.saturation, or give less gloss"),
    SIZE: ("px", "take cameras farther away", "take cameras nearer"),
    "objects of an image": ("", "lower objects[].count", "raise objects[].count, or show more of them at once"),
    "objects cut by the border": ("% of an image's", "look at all of them, from farther", "let views cut more off"),
    "brightness of images": ("of 255", "darken the backdrop", "brighten the backdrop"),
    "noise of images": ("of 255", "lower randomise.iso, or expose more", "raise randomise.iso"),
}
"""Unit, and what to change if photographs have less, or more."""

_Values: TypeAlias = dict[tuple[str, int | None], list[tuple[int, float]]]
"""Values of a trait, each with its image's number: of all objects or images, and of those of a class by its index."""

_Hues: TypeAlias = dict[int, Float64Array]
"""Sums over the objects of a class, by its index, of what :func:`_hues_of` tells of each."""


@dataclass(frozen=True)
class Trait:
    """One trait of rendered images and of photographs.

    Attributes:
        name: What is measured.
        unit: In which unit.
        rendered: Quantiles 0.05, 0.5 and 0.95 of rendered images, or of objects in them.
        real: Those of photographs.
        below: Share of photographs, or of objects in them, that have less than 95 % of the rendered ones.
        above: That have more than 95 % of them.
        advice: What to change, if more lie outside on a side than would by chance; empty otherwise.
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
    """How rendered images and photographs differ.

    Attributes:
        images: How many rendered images were measured.
        photographs: How many photographs.
        same_size: Longer side of photographs, a multiple of 32, at which their objects are about as large as those of
            rendered images [px]: by the median over classes of the ratio of upper quartiles, as what is hidden looks
            smaller, of objects that no border cuts. None if no class is shown often enough by both.
        traits: Of all of them.
        classes: Brightness and saturation of each class that both show often enough.
        hues: By how much photographs show its colours turned, towards green from red, of each such class of which that
            can be told [degrees].
    """

    images: int
    photographs: int
    same_size: int | None
    traits: tuple[Trait, ...]
    classes: dict[str, tuple[Trait, ...]]
    hues: dict[str, float]

    @property
    def hue_advice(self) -> str:
        """What to change, if photographs show the colours of classes turned; empty otherwise."""
        turned = list(self.hues.values())
        if not turned or np.median(np.abs(turned)) < _TURNED:
            return ""
        return "have the camera turn colours as far, by randomise.hue, and more by randomise.chroma_stretch"


def compare_with_photographs(
    rendered: Sequence[str | Path],
    photographs: str | Path,
    *,
    split: Split = "train",
    size: int = 640,
    most: int = 400,
    progress: Progress | None = None,
) -> Likeness:
    """Measure rendered images beside labelled photographs.

    Colours are those of pixels within masks, and within the middle half of boxes where there is no mask.

    Args:
        rendered: Datasets, or YOLO or COCO folders, with the same classes.
        photographs: Likewise, of which all count; classes may come in another order.
        split: Which rendered images.
        size: Longer side that images are scaled to before they are measured [px].
        most: Images of each side, evenly drawn from what there is.
        progress: Told of each image.

    Raises:
        InputError: If there is nothing to compare, or something cannot be read.
    """
    if size < 32:
        raise InputError(f"size must be 32 px or more (got {size})")
    if most < 1:
        raise InputError(f"images of each side must be at least 1 (got {most})")
    real = read_set(photographs, "all")
    sets = [in_classes(read_set(one, split), real.class_names, str(photographs)) for one in rendered]
    if not sets:
        raise InputError("there are no rendered images to compare")
    ours = _evenly([sample for one in sets for sample in one.samples], most)
    theirs = _evenly(list(real.samples), most)
    sides: tuple[_Values, _Values] = defaultdict(list), defaultdict(list)
    hues: tuple[_Hues, _Hues] = defaultdict(_no_hues), defaultdict(_no_hues)
    for number, sample in enumerate(ours + theirs):
        if progress is not None:
            progress(number, len(ours) + len(theirs), "measuring images")
        _measure(sample, number, size, sides[number >= len(ours)], hues[number >= len(ours)])

    def traits_of(index: int | None) -> tuple[Trait, ...]:
        shown = [key for key in _TRAITS if all(side.get((key, index)) for side in sides)]
        return tuple(_trait(key, sides[0][key, index], sides[1][key, index]) for key in shown)

    least = FEWEST_RENDERED, FEWEST
    classes = {
        name: traits_of(index)
        for index, name in enumerate(real.class_names)
        if all(len(side.get((BRIGHTNESS, index), [])) >= few for side, few in zip(sides, least, strict=True))
    }
    turned = {
        name: turn
        for index, name in enumerate(real.class_names)
        if name in classes and (turn := _turn(hues[0][index], hues[1][index])) is not None
    }
    larger = _larger(sides, len(real.class_names))
    same_size = None if larger is None else max(round(size * larger / STRIDE), 1) * STRIDE
    return Likeness(len(ours), len(theirs), same_size, traits_of(None), classes, turned)


def _no_hues() -> Float64Array:
    return np.zeros(_HUES)


def _hues_of(pixels: ByteImage) -> Float64Array:
    """How far from grey pixels (N, 3), BGR, are by their hues, of all of them [bytes], shape (_HUES,)."""
    hue = cv2.cvtColor(pixels[None].astype(np.float32) / 255, cv2.COLOR_BGR2HSV)[0, :, 0]
    chroma = np.ptp(pixels.astype(float), axis=1)
    places = (hue * (_HUES / 360)).astype(np.intp) % _HUES
    found = np.bincount(places, chroma * (chroma >= _COLOURED), _HUES)
    return np.asarray(found / len(pixels))


def _turn(ours: Float64Array, theirs: Float64Array) -> float | None:
    """Degrees by which hues must be turned so that they overlap most with others; None if none are there or near."""
    if not (ours.any() and theirs.any()):
        return None
    smooth, wanted = (gaussian_filter1d(side / side.sum(), 2.0, mode="wrap") for side in (ours, theirs))
    turns = sorted(range(-_FARTHEST, _FARTHEST + 1), key=abs)
    overlaps = [float(np.minimum(np.roll(smooth, turn), wanted).sum()) for turn in turns]
    best = turns[int(np.argmax(overlaps))]
    return None if abs(best) == _FARTHEST else 360 / _HUES * best


def _larger(sides: tuple[_Values, _Values], classes: int) -> float | None:
    """How much larger rendered objects are than photographed ones, None if no class is shown often enough by both."""
    ratios = []
    for index in range(classes):
        ours, theirs = (side.get((_WHOLE, index), []) for side in sides)
        if len(ours) >= FEWEST_RENDERED and len(theirs) >= FEWEST:
            upper = [np.quantile([value for _, value in values], 0.75) for values in (ours, theirs)]
            ratios.append(upper[0] / upper[1])
    return float(np.median(ratios)) if ratios else None


def _evenly(samples: list[Sample], most: int) -> list[Sample]:
    places = np.unique(np.linspace(0, len(samples) - 1, min(most, len(samples))).round().astype(int))
    return [samples[place] for place in places]


def _measure(sample: Sample, number: int, size: int, values: _Values, hues: _Hues) -> None:
    """Add what an image of a number shows at a longer side of ``size`` pixels."""
    stored = read_picture(sample.path)
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
            values[_WHOLE, instance.class_index].append((number, side))
        inside = _inside(instance, sample, width, height)
        if inside.sum() >= _SMALLEST:
            hues[instance.class_index] += _hues_of(picture[inside])
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
    noise = _noise(picture[..., 1], picture.max(axis=2))
    if noise is not None:
        values["noise of images", None].append((number, noise))


def _inside(instance: LabelledObject, sample: Sample, width: int, height: int) -> BoolArray:
    """Pixels (height, width) of an object in the scaled image."""
    factor = np.array([width / sample.width, height / sample.height])
    if instance.has_mask:
        return fill_polygon(instance.outlined() * factor, width, height)
    inside = np.zeros((height, width), dtype=bool)
    (x0, y0), (x1, y1) = (np.array(corner) * factor for corner in (instance.box[:2], instance.box[2:]))
    rows, columns = (
        slice(max(round(low + (high - low) / 4), 0), max(round(high - (high - low) / 4), 0))
        for low, high in ((y0, y1), (x0, x1))
    )
    inside[rows, columns] = True
    return inside


def _noise(green: ByteImage, bright: ByteImage) -> float | None:
    """Median of the Laplacian's size where an image is flat, in bytes; None where hardly anything is to be seen."""
    values = green.astype(np.float32)
    smooth = cv2.GaussianBlur(values, (0, 0), 2)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    lit = (bright > _DARK) & (bright < 250)
    if lit.sum() < _SMALLEST:
        return None
    flat = lit & (slope <= np.quantile(slope[lit], _FLAT_QUANTILE))
    return float(np.median(np.abs(cv2.Laplacian(values, cv2.CV_32F))[flat]))


def _trait(name: str, rendered: Sequence[tuple[int, float]], real: Sequence[tuple[int, float]]) -> Trait:
    unit, less, more = _TRAITS[name]
    images, values = np.array([*rendered, *real], dtype=float).T
    photographed = np.arange(len(values)) >= len(rendered)
    ours, theirs = (np.quantile(values[side], [_TAIL, 0.5, 1 - _TAIL]) for side in (~photographed, photographed))
    outside = _outside(values, photographed)
    too_low, too_high = _unlikely(outside, images, values, photographed)
    advice = {
        (True, False): less,
        (False, True): more,
        (True, True): "photographs differ more among themselves: widen both ends of the range",
    }
    quantiles = [(float(values[0]), float(values[1]), float(values[2])) for values in (ours, theirs)]
    below, above = outside.tolist()
    return Trait(name, unit, quantiles[0], quantiles[1], below, above, advice.get((too_low, too_high), ""))


def _outside(values: Float64Array, photographed: BoolArray) -> Float64Array:
    """Shares of photographs' values below and above the middle nine tenths of the others, shape (2,)."""
    low, high = np.quantile(values[~photographed], [_TAIL, 1 - _TAIL])
    real = values[photographed]
    return np.array([np.mean(real < low), np.mean(real > high)])


def _unlikely(
    outside: Float64Array, images: Float64Array, values: Float64Array, photographed: BoolArray
) -> tuple[bool, bool]:
    """Whether as much lies outside on a side in less than :data:`CHANCE` of deals of all images to the two sides.

    What one image shows stays together: its objects share its light. Of too few objects nothing is said.
    """
    if (~photographed).sum() < FEWEST_RENDERED or photographed.sum() < FEWEST:
        return False, False
    names, places = np.unique(images, return_inverse=True)
    count = len(np.unique(images[photographed]))
    rng = np.random.default_rng(0)
    as_much = np.ones(2)
    for _ in range(_DRAWS):
        dealt = np.zeros(len(names), dtype=bool)
        dealt[rng.choice(len(names), count, replace=False)] = True
        as_much += _outside(values, dealt[places]) >= outside
    low, high = (as_much / (_DRAWS + 1) < CHANCE).tolist()
    return low, high
