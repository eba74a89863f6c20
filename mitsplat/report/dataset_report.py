"""Dataset report: a single HTML file that needs no network, no server and no other file."""

from __future__ import annotations

import html
import json
import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mitsplat.arguments import path_of
from mitsplat.audit.audit import POLYGON_AREA, POLYGON_IOU, Audit, audit_dataset
from mitsplat.dataset.records.manifest import read_lines
from mitsplat.dataset.records.record_schema import Records, read_content
from mitsplat.formats.coco import image_file
from mitsplat.images.masks import Silhouette
from mitsplat.images.picture_files import read_picture_inside
from mitsplat.labels.labels import Labels
from mitsplat.labels.overlay import class_colour
from mitsplat.pages.html import make_charts, make_page, make_section, make_table, mask_path, shrunk_image
from mitsplat.pages.svg_charts import HeatMap, Histogram, bars, columns
from mitsplat.report.variety import Variety
from mitsplat.storage.files import JsonObject, Record, open_regular, parse_json, write_text

SAMPLES = 12
"""Number of sample images, evenly spread over the dataset."""
BRIGHTNESS_IMAGES = 200
"""Number of images for the brightness statistics, evenly spread over the dataset."""

_THUMBNAIL_WIDTH = 640
_OVERLAYS = {"mask": "Masks", "box": "Boxes", "name": "Names", "alone": "Silhouettes, hidden parts included"}
_SHOWN_FIRST = ("mask", "name")
_FRACTIONS = ("visible_fraction", "truncation", "agreement", "boundary_f1")


class _Statistics:
    """Statistics of the manifest, computed in one pass, for images of ``size`` (width, height) [px]."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.images, self.classes, self.per_image = Counter[str](), Counter[str](), Counter[int]()
        self.fractions = {key: Histogram((0, 1)) for key in _FRACTIONS}
        self.order_errors: list[tuple[float, float]] = []
        self.left_out: dict[int, list[str]] = {}
        cells = 24, max(2, round(24 * size[1] / size[0]))
        self.places, self.sizes = HeatMap(size, cells), HeatMap(size, cells)

    def add(self, record: Record) -> None:
        labels = record["labels"]
        self.images[record["split"]] += 1
        self.per_image[len(labels["instances"])] += 1
        self.classes.update(label["class"] for label in labels["instances"])
        if error := record.get("order_error"):
            self.order_errors.append((error["largest"], error["mean"]))
        if record.get("left_out"):
            self.left_out[record["layout"]] = [f"{one['name']} ({one['reason']})" for one in record["left_out"]]
        boxes = np.array([label["box"] for label in labels["instances"]], dtype=np.float64).reshape(-1, 4)
        self.places.add((boxes[:, 0] + boxes[:, 2]) / 2, (boxes[:, 1] + boxes[:, 3]) / 2)
        self.sizes.add(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1])
        for key, histogram in self.fractions.items():
            histogram.add([label[key] for label in labels["instances"]])


class DatasetReport(NamedTuple):
    """Result of :func:`write_report`.

    Attributes:
        path: The HTML page.
        audit: The audit that the page shows.
        warnings: Warnings about gaps in the variety of the dataset, a sentence each.
    """

    path: Path
    audit: Audit
    warnings: list[str]


def write_report(root: str | Path, out: str | Path | None = None) -> DatasetReport:
    """Write the report of a dataset, by default to ``report.html`` in its folder.

    Raises:
        InputError: If the folder is no dataset of mitsplat.
        OSError: If the page cannot be written.
    """
    root = path_of(root, "root")
    out = root / "report.html" if out is None else path_of(out, "out")
    content = read_content(root)
    records = Records(root, content)
    output = content["scene"]["output"]
    statistics = _Statistics((output["width"], output["height"]))
    variety = Variety(content)

    def visit(record: Record) -> None:
        statistics.add(record)
        variety.add(record)

    audit = audit_dataset(root, visit)
    name = str(content["scene"]["name"])
    parts = [
        f"<h1>{html.escape(name)}</h1>",
        _summary(content, statistics, audit, root),
        _audit(audit),
        _samples(root, records.sample(SAMPLES)),
        variety.sections(),
        _charts(statistics, _brightness(root, records.sample(BRIGHTNESS_IMAGES)), _seconds(root)),
        _details(content),
    ]
    write_text(out, make_page(f"{name}: dataset report", "\n".join(parts), script=_SCRIPT))
    return DatasetReport(out, audit, variety.warnings())


def _summary(content: JsonObject, statistics: _Statistics, audit: Audit, root: Path) -> str:
    runs = _lines(root / "runs.jsonl")
    rows = {
        "Images": ", ".join(f"{count} {split}" for split, count in sorted(statistics.images.items())),
        "Size": f"{statistics.size[0]} x {statistics.size[1]} px",
        "Instances": str(sum(statistics.classes.values())),
        "Not labelled": _format_counts(audit.dropped),
        "Marked": _format_counts(audit.marked),
        **({"Left out": _left_out(statistics)} if statistics.left_out else {}),
        "Estimated blending-order error": _order_error(statistics),
        "Labels from": content["scene"]["labels"]["source"],
        "Formats": ", ".join(content["scene"]["output"]["formats"]),
        "Seed": str(content["scene"]["seed"]),
        "Command": " ; ".join(str(run.get("command", "unknown")) for run in runs) or "unknown",
        "Device": content.get("device", "cpu"),
        "mitsplat": content["mitsplat"],
    }
    return make_section("summary", "Summary", make_table(rows.items()))


def _left_out(statistics: _Statistics) -> str:
    """List the objects that did not come to rest, most frequent first."""
    reasons = Counter(text for objects in statistics.left_out.values() for text in objects).most_common(5)
    often = ", ".join(f"{count} {text}" for text, count in reasons)
    return f"{len(statistics.left_out)} layouts lack objects that did not come to rest: {often}"


def _order_error(statistics: _Statistics) -> str:
    """Format the estimated order error of display-encoded colours, over the images that have an estimate."""
    found, images = statistics.order_errors, sum(statistics.images.values())
    if not found:
        return "not estimated by this preset"
    largest, mean = max(e for e, _ in found), sum(e for _, e in found) / len(found)
    some = "" if len(found) == images else f", in {len(found)} of {images} images"
    return f"{mean:.1e} of the range on average, {largest:.4f} at most{some}"


def _audit(audit: Audit) -> str:
    verdict = "No violations" if not audit.violations else f"{len(audit.violations)} violations"
    found = "".join(
        f"<li><code>{html.escape(file)}</code>: {html.escape(text)}</li>" for file, text in audit.violations[:100]
    )
    more = f"<p>and {len(audit.violations) - 100} more</p>" if len(audit.violations) > 100 else ""
    return make_section(
        "audit",
        "Audit",
        f'<p class="{"good" if not audit.violations else "bad"}">{verdict} in {audit.files} files, '
        f"{audit.instances} instances.</p>"
        f"<p>Masks of more than {POLYGON_AREA} px in several parts whose YOLO polygon has an IoU below {POLYGON_IOU}, "
        f"because bridges join the parts: {audit.low_polygons}.</p>"
        f"{f'<ul>{found}</ul>' if found else ''}{more}",
    )


def _samples(root: Path, records: Iterable[Record]) -> str:
    boxes = "".join(
        f'<label><input type="checkbox" data-overlay="{key}"{" checked" if key in _SHOWN_FIRST else ""}> {text}</label>'
        for key, text in _OVERLAYS.items()
    )
    figures = "".join(_sample(root, record) for record in records)
    return make_section(
        "samples",
        "Samples",
        f"<fieldset><legend>Show</legend>{boxes}</fieldset>"
        f'<div class="samples {" ".join(f"show-{key}" for key in _SHOWN_FIRST)}" id="sheet">{figures}</div>',
    )


def _sample(root: Path, record: Record) -> str:
    image = read_picture_inside(root, image_file(record))
    if image is None:
        return f"<figure><figcaption>Frame {record['index']}: its image cannot be read</figcaption></figure>"
    labels = Labels.from_json(record["labels"])
    height, width = image.shape[:2]
    rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    unit = width / 640
    marks, names = [], []
    for label in labels.instances:
        colour = "rgb({},{},{})".format(*class_colour(label.class_index))
        x0, y0, x1, y1 = label.box
        title = (
            f"{label.class_name} {label.id}: {label.visible_fraction:.0%} visible, {label.truncation:.0%} cut off"
            f"{''.join(f', {mark}' for mark in label.marks)}"
        )
        marks.append(
            f"<g><title>{html.escape(title)}</title>"
            f'<path class="alone" d="{mask_path(label.amodal)}" stroke="{colour}"/>'
            f'<path class="mask" d="{mask_path(Silhouette(label.box, label.mask))}" fill="{colour}" stroke="{colour}"/>'
            f'<rect class="box" x="{x0}" y="{y0}" width="{x1 - x0}" height="{y1 - y0}" stroke="{colour}"/></g>'
        )
        names.append(
            f'<text class="name" x="{x0}" y="{max(y0 - 3 * unit, 11 * unit):.0f}" font-size="{12 * unit:.1f}">'
            f"{html.escape(label.class_name)}</text>"
        )
    classes = _format_counts(Counter(label.class_name for label in labels.instances))
    text = html.escape(f"Frame {record['index']}, {record['split']}: {classes}", quote=True)
    return (
        f'<figure><div class="picture"><img alt="{text}" src="{shrunk_image(rgb, _THUMBNAIL_WIDTH)}">'
        f'<svg aria-hidden="true" viewBox="0 0 {width} {height}">{"".join(marks + names)}</svg></div>'
        f"<figcaption>{text}</figcaption></figure>"
    )


def _brightness(root: Path, records: Iterable[Record]) -> tuple[np.ndarray, Histogram]:
    """Count pixels by luma in 32 bins, and images by their mean luma."""
    counts, means = np.zeros(32, dtype=np.int64), Histogram((0, 255))
    for record in records:
        grey = read_picture_inside(root, image_file(record), cv2.IMREAD_GRAYSCALE)
        if grey is not None:
            counts += np.histogram(grey, bins=32, range=(0, 256))[0]
            means.add(grey.mean())
    return counts, means


def _seconds(root: Path) -> dict[str, float]:
    """Return the median seconds of every stage over the frames."""
    stages: defaultdict[str, array[float]] = defaultdict(lambda: array("f"))
    for line in _lines(root / "timings.jsonl"):
        for stage, seconds in line.items():
            if stage != "index" and isinstance(seconds, int | float) and math.isfinite(seconds):
                stages[stage].append(seconds)
    return {stage: round(float(np.median(values)), 4) for stage, values in stages.items()}


def _charts(statistics: _Statistics, brightness: tuple[np.ndarray, Histogram], seconds: dict[str, float]) -> str:
    fractions = statistics.fractions
    numbers = range(max([1, *statistics.per_image]) + 1)
    luma = [f"{8 * i} to {8 * i + 7}" for i in range(len(brightness[0]))]
    charts = [
        bars("Instances by class", dict(sorted(statistics.classes.items()))),
        columns(
            "Instances per image", [statistics.per_image[i] for i in numbers], list(map(str, numbers)), "instances"
        ),
        statistics.places.draw("Positions of boxes", "centre of the box [px]"),
        statistics.sizes.draw("Sizes of boxes", "width to the right, height down [px]"),
        fractions["visible_fraction"].draw("Visible fraction of instances", "visible fraction"),
        fractions["truncation"].draw("Truncation of instances", "fraction beyond the border"),
        fractions["agreement"].draw("Agreement of splats and proxies", "IoU"),
        fractions["boundary_f1"].draw("Agreement of their boundaries", "boundary F1"),
        columns("Brightness of pixels", brightness[0], luma, "luma"),
        brightness[1].draw("Brightness of images", "mean luma"),
        bars("Seconds per frame by stage, median", seconds, unit=" s"),
    ]
    return make_section("charts", "Statistics", make_charts(charts))


def _details(content: JsonObject) -> str:
    scene = html.escape(json.dumps(content["scene"], indent=1))
    return make_section(
        "origin",
        "Origin",
        f"<details><summary>Libraries</summary>{make_table(content['libraries'].items())}</details>"
        f'<details><summary>Effective scene</summary><pre tabindex="0">{scene}</pre></details>',
    )


def _lines(path: Path) -> Iterator[JsonObject]:
    """Yield the JSON objects in the lines of a file; the file may be missing or damaged."""
    with suppress(FileNotFoundError), open_regular(path) as file:
        for line in read_lines(file):
            with suppress(ValueError):
                if isinstance(found := parse_json(line), dict):
                    yield found


def _format_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()) if count) or "none"


_SCRIPT = """
"use strict";
const sheet = document.getElementById("sheet");
for (const box of document.querySelectorAll("input[data-overlay]")) {
  const show = () => sheet.classList.toggle("show-" + box.dataset.overlay, box.checked);
  box.addEventListener("change", show);
  show();
}
"""
