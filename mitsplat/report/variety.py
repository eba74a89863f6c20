"""Variety of a dataset: drawn values, viewpoints of its objects, and warnings about gaps."""

from __future__ import annotations

import html
import math
from array import array
from collections import Counter
from collections.abc import Iterator

import numpy as np
from pycocotools import mask as coco_mask

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.pages.html import make_charts, make_section, make_table
from mitsplat.pages.svg_charts import Histogram, bars, discs
from mitsplat.storage.files import JsonObject, Record

OCCLUDED = 0.05
"""Fraction of hidden pixels above which an instance counts as occluded."""
MIN_COUNT, MIN_VIEWS = 20, 100
"""Minimum number of images or instances for a warning, and of instances of an object for a warning about viewpoints."""
MAX_CLASS_RATIO = 3.0
"""Ratio of the instances of two classes above which a warning is given."""
MIN_OCCLUDED, MIN_DIRECTIONS, MAX_ONE_SIDED = 0.1, 0.8, 0.95
"""Minimum fractions of occluded instances and of covered view directions, maximum fraction of images lit from one side.
"""
RINGS, SECTORS = 3, 8
"""Cells of a hemisphere: rings of equal height, hence of equal area (Archimedes), divided into sectors; 30 degrees
wide.
"""

_NOT_DRAWN_KEYS = frozenset(
    (
        *("index", "layout", "view", "split", "seed", "files", "camera", "labels", "environment", "rest"),
        *("depth_scale", "depth_sensor_scale", "order_error"),
    )
)
"""Keys of a frame's record that contain no drawn values, or that are evaluated separately."""
_IGNORED_KEYS = frozenset({"id", "entry", "asset", "seed"})
_MAX_NUMBERS, _MAX_TEXTS, _MAX_PAIRS = 1 << 16, 1000, 20


class Variety:
    """Variety of a dataset, counted in one pass over the manifest.

    Args:
        content: Content of ``dataset.json``.
    """

    def __init__(self, content: JsonObject) -> None:
        self._classes: list[str] = content["classes"]
        self._assets: list[str] = content["assets"]
        self._numbers, self._texts = dict[str, _Sample](), dict[str, Counter[str]]()
        self._images, self._truncated = Counter[str](), 0
        self._instances, self._of_split = Counter[str](), Counter[tuple[str, str]]()
        self._occluded, self._pairs = Counter[str](), Counter[str]()
        self._directions: dict[str, Int64Array] = {}
        self._sides, self._lit = Counter[str](), Histogram((-180, 180), bins=24)

    def add(self, record: Record) -> None:
        """Count a frame."""
        drawn = {key: value for key, value in record.items() if key not in _NOT_DRAWN_KEYS}
        for name, value in (*_values(drawn, ""), *_camera_values(record)):
            if isinstance(value, str):
                texts = self._texts.setdefault(name, Counter())
                texts[value if value in texts or len(texts) < _MAX_TEXTS else "others"] += 1
            elif math.isfinite(value):
                self._numbers.setdefault(name, _Sample()).add(value)
        labels = record["labels"]["instances"]
        self._images[record["split"]] += 1
        self._instances.update(label["class"] for label in labels)
        self._of_split.update((label["class"], record["split"]) for label in labels)
        self._truncated += sum(label["truncation"] > 0 for label in labels)
        self._add_occlusion(labels, record["labels"]["size"])
        self._add_directions(record)

    def _add_occlusion(self, labels: list[JsonObject], size: list[int]) -> None:
        """Count the pairs of classes where the visible part of one overlaps the silhouette of the other."""
        hidden = [label for label in labels if label["visible_fraction"] < 1 - OCCLUDED]
        self._occluded.update(label["class"] for label in hidden)
        if not hidden:
            return
        silhouettes = [{"size": size[::-1], "counts": label["amodal_rle"]} for label in hidden]
        visible = [{"size": size[::-1], "counts": label["rle"]} for label in labels]
        # For crowd annotations, pycocotools divides the intersection by the area of the first mask alone.
        shares = np.asarray(coco_mask.iou(silhouettes, visible, [1] * len(visible))).reshape(len(hidden), len(labels))
        for label, row in zip(hidden, shares, strict=True):
            near = {
                other["class"]
                for other, share in zip(labels, row, strict=True)
                if share > OCCLUDED and other is not label
            }
            self._pairs.update(f"{other} hides {label['class']}" for other in near)

    def _add_directions(self, record: Record) -> None:
        """Count view directions of objects in their own coordinates, and the side that light comes from."""
        labels, camera = record["labels"]["instances"], np.array(record["camera"]["world_from_camera"])
        places = []
        for label in labels:
            pose = np.array(label["world_from_object"])
            places.append(pose[:3, 3])
            asset = self._assets[label["asset"]]
            counts = self._directions.setdefault(asset, np.zeros((2 * RINGS, SECTORS), dtype=np.int64))
            counts[cell_of(pose[:3, :3].T @ (camera[:3, 3] - pose[:3, 3]))] += 1
        if places and (light := _key_light(record.get("lights", []), np.mean(places, axis=0))) is not None:
            x, y, _ = camera[:3, :3].T @ light
            self._lit.add(math.degrees(math.atan2(-y, x)))
            self._sides["right" if x > 0 else "left"] += 1

    def warnings(self) -> list[str]:
        """Return warnings about gaps, such as classes with few examples or unseen view directions, a sentence each."""
        found = [*self._class_warnings(), *self._instance_warnings()]
        for name, counts in sorted(self._directions.items()):
            cells = np.count_nonzero(counts[:RINGS])
            if counts.sum() >= MIN_VIEWS and cells < MIN_DIRECTIONS * RINGS * SECTORS:
                found.append(f"{name} is seen from {cells} of the {RINGS * SECTORS} directions above it")
        side, images = max(self._sides.items(), key=lambda item: item[1], default=("", 0))
        if self._sides.total() >= MIN_COUNT and images > MAX_ONE_SIDED * self._sides.total():
            found.append(f"light comes from the {side} in {images} of {self._sides.total()} images")
        return found

    def _class_warnings(self) -> Iterator[str]:
        most, most_of = max(((self._instances[name], name) for name in self._classes), default=(0, ""))
        for name in self._classes if most else ():
            count = self._instances[name]
            if count == 0:
                yield f"class {name} has no instance"
                continue
            if most >= MIN_COUNT and most > MAX_CLASS_RATIO * count:
                yield f"class {name} has {most / count:.1f} times fewer instances than {most_of}"
            if missing := [split for split in sorted(self._images) if not self._of_split[name, split]]:
                yield f"class {name} has no instance in {' and '.join(missing)}"
            if count >= MIN_COUNT and not self._occluded[name]:
                yield f"class {name} is never occluded"

    def _instance_warnings(self) -> Iterator[str]:
        total = self._instances.total()
        if total < MIN_COUNT:
            yield f"there are {total} instances, too few to learn from"
            return
        if self._occluded.total() < MIN_OCCLUDED * total:
            yield f"only {self._occluded.total()} of {total} instances are hidden by more than {OCCLUDED:.0%}"
        if not self._truncated:
            yield "no instance is cut off by the image's border"

    def sections(self) -> str:
        """Return parts of the page: warnings, view directions, and the histogram of every drawn value."""
        warned = "".join(f"<li>{html.escape(text)}</li>" for text in self.warnings())
        warned = f"<ul>{warned}</ul>" if warned else '<p class="good">No warnings</p>'
        directions = dict(sorted(self._directions.items()))
        upper, lower = (
            {name: 100 * np.count_nonzero(counts[half]) / (RINGS * SECTORS) for name, counts in directions.items()}
            for half in (slice(RINGS), slice(RINGS, None))
        )
        occluded = {name: 100 * self._occluded[name] / count for name, count in sorted(self._instances.items())}
        pairs = dict(self._pairs.most_common(_MAX_PAIRS))
        charts = [
            discs("View directions above objects", {name: counts[:RINGS] for name, counts in directions.items()}),
            bars("Covered view directions above objects", upper, unit=" %"),
            bars("Covered view directions below objects", lower, unit=" %"),
            bars("Occluded instances of each class", occluded, unit=" %"),
            bars("Most frequent pairs of occluder and occluded class", pairs, name_width=240),
            self._lit.draw("Direction of light in the image", "from the right 0, from above 90 [degrees]"),
        ]
        drawn, fixed = [], []
        for name, sample in sorted(self._numbers.items()):
            low, high = min(sample.values), max(sample.values)
            if low == high:
                fixed.append((name, f"{low:.6g}"))
                continue
            histogram = Histogram((low, high))
            histogram.add(sample.values)
            drawn.append(histogram.draw(name))
        for name, texts in sorted(self._texts.items()):
            if len(texts) == 1:
                fixed.append((name, next(iter(texts))))
            else:
                drawn.append(bars(name, dict(texts.most_common(_MAX_PAIRS))))
        constant = f"<details><summary>Constant in all images</summary>{make_table(fixed)}</details>"
        return make_section("variety", "Variety", warned + make_charts(charts)) + make_section(
            "draws", "Draws", make_charts(drawn) + constant
        )


class _Sample:
    """Bounded list of numbers; every second one is removed when the list is full."""

    def __init__(self) -> None:
        self.values = array("d")
        self._step, self._count = 1, 0

    def add(self, value: float) -> None:
        if self._count % self._step == 0:
            self.values.append(value)
            if len(self.values) > _MAX_NUMBERS:
                del self.values[1::2]
                self._step *= 2
        self._count += 1


def cell_of(direction: Float64Array) -> tuple[int, int]:
    """Return ring, from the top down, and sector of a direction (3,); both hemispheres have :data:`RINGS` rings."""
    x, y, z = direction / max(float(np.linalg.norm(direction)), 1e-12)
    ring = int((1 - z) / 2 * 2 * RINGS)
    sector = int((math.atan2(y, x) / math.tau % 1) * SECTORS)
    return min(ring, 2 * RINGS - 1), min(sector, SECTORS - 1)


def _values(value: object, name: str) -> Iterator[tuple[str, float | str]]:
    """Yield numbers and texts in a part of a record by key path; values of an entry are grouped by its number."""
    if isinstance(value, bool | str):
        yield name, str(value)
    elif isinstance(value, int | float):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, inner in value.items():
            if key not in _IGNORED_KEYS:
                yield from _values(inner, key if name in ("", "draws") else f"{name}.{key}")
    elif isinstance(value, list):
        for position, inner in enumerate(value):
            number = inner.get("entry", position) if isinstance(inner, dict) else position
            yield from _values(inner, f"{name}[{number}]")


def _camera_values(record: Record) -> Iterator[tuple[str, float]]:
    """Yield values of a camera's pose and lens; azimuth and elevation are its direction seen from its target."""
    camera = record["camera"]
    pose = np.array(camera["world_from_camera"])
    right, forward = pose[:3, 0], pose[:3, 2]
    yield from ((f"camera position {axis} [m]", float(value)) for axis, value in zip("xyz", pose[:3, 3], strict=True))
    yield "camera elevation [degrees]", math.degrees(math.asin(np.clip(-forward[2], -1, 1)))
    yield "camera azimuth [degrees]", math.degrees(math.atan2(-forward[1], -forward[0])) % 360
    level = np.cross(forward, (0, 0, 1))
    if np.linalg.norm(level) > 1e-6:
        sine, cosine = np.cross(level, right) @ forward, level @ right
        yield "camera roll [degrees]", math.degrees(math.atan2(sine, cosine))
    yield "camera focal length [px]", camera["intrinsics"][0][0]
    yield "camera focus distance [m]", camera["focus_distance"]
    yield "camera aperture radius [m]", camera["aperture_radius"]


def _key_light(lights: list[JsonObject], point: Float64Array) -> Float64Array | None:
    """Return the sum of the directions to local lights, weighted by their irradiance at a point without cosine terms.

    The result is None if there is no local light.
    """
    total = np.zeros(3)
    for light in lights:
        if light.get("position") is not None:
            away = np.subtract(light["position"], point)
            width, height = light.get("size") or (1.0, 1.0)
            strength = light.get("intensity") or width * height * (light.get("radiance") or 0.0)
            total += strength * away / max(float(np.linalg.norm(away)), 1e-9) ** 3
    return total if total.any() else None
