"""HTML report of an evaluation: average precision, cost of the kinds of errors, and the worst images."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

import numpy as np

from mitsplat.detector.labelled_sets.labelled_set import LabelledSet, Sample
from mitsplat.detector.labelled_sets.pictures import read_upright
from mitsplat.detector.losses import ERROR_KINDS
from mitsplat.detector.scores import CONFIDENCE, IOU, MAX_DETECTIONS, AveragePrecision, Confusion, Detection
from mitsplat.images.masks import Silhouette, decode_rle
from mitsplat.labels.overlay import class_colour
from mitsplat.pages.html import make_charts, make_page, make_section, make_table, mask_path, shrunk_image
from mitsplat.pages.svg_charts import bars, curves
from mitsplat.storage.files import JsonObject

NUM_WORST_IMAGES = 8
"""Number of images in the report; those with the lowest share of correct detections."""
_THUMBNAIL = 560
_PLURALS = {"box": "boxes", "mask": "masks"}


def make_report(
    found: LabelledSet,
    truth: JsonObject,
    detections: Sequence[Detection],
    scores: Mapping[str, AveragePrecision],
    confusion: Confusion,
    results: JsonObject,
) -> str:
    """Return the report as one self-contained HTML page."""
    title = f"{found.root.resolve().name}, {found.split}: evaluation of a detector"
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        _summary(found, scores, confusion, results),
        _classes(scores, results),
        _charts(scores),
        _gains(results["gains"]),
        _confusion(confusion, found.class_names),
        _worst(found, truth, detections, confusion),
    ]
    return make_page(title, "\n".join(parts))


def _summary(
    found: LabelledSet, scores: Mapping[str, AveragePrecision], confusion: Confusion, results: JsonObject
) -> str:
    right, missed, confused, extra = (sum(values) for values in zip(*confusion.errors.values(), strict=True))
    rows = {f"mAP50-95 of {_PLURALS[kind]}": f"{score.map50_95:.3f}" for kind, score in scores.items()}
    rows |= {f"mAP50 of {_PLURALS[kind]}": f"{score.map50:.3f}" for kind, score in scores.items()}
    rows |= {
        f"At a score of {CONFIDENCE} and an IoU of {IOU}": f"{right} correct, {confused} with the wrong "
        f"class, {missed} missed; {extra} false detections",
        "Images": f"{len(found.samples)} of {found.root} ({found.split})",
        "Labels of other classes, not used": ", ".join(f"{count} {name}" for name, count in found.other_labels.items())
        or "none",
        "Run": str(results.get("run", "unknown")),
        "Images scaled to": f"{results['size']} px" if "size" in results else "unknown",
        "Device": str(results.get("device", "unknown")),
        "Versions": ", ".join(f"{name} {version}" for name, version in results.get("versions", {}).items())
        or "unknown",
    }
    rules = results["rules"]
    note = (
        "Average precision by COCO's rules: mean over 101 recalls and IoU thresholds 0.5 to 0.95, at most "
        f"{MAX_DETECTIONS} detections per image with scores of at least {rules['least_score']}, "
        f"non-maximum suppression at an IoU of {rules['nms_iou']}."
    )
    return make_section("summary", "Summary", f"{make_table(rows.items())}<p>{note}</p>")


def _classes(scores: Mapping[str, AveragePrecision], results: JsonObject) -> str:
    heads = [f"{name} of {_PLURALS[kind]}" for kind in scores for name in ("AP50-95", "AP50")]
    rows = []
    for name, count in results["data"]["instances"].items():
        values = [value for score in scores.values() for value in score.classes.get(name, (None, None))]
        cells = "".join(f"<td>{'no labels' if value is None else f'{value:.3f}'}</td>" for value in values)
        rows.append(f'<tr><th scope="row">{html.escape(name)}</th><td>{count}</td>{cells}</tr>')
    return make_section("classes", "Classes", _headed_table(("Class", "Labelled", *heads), rows))


def _headed_table(heads: Sequence[str], rows: Sequence[str]) -> str:
    """Build a table of rows below column headings; all are HTML."""
    head = "".join(f'<th scope="col">{text}</th>' for text in heads)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _charts(scores: Mapping[str, AveragePrecision]) -> str:
    recalls = np.linspace(0, 1, 101)
    charts, means = [], []
    for kind, score in scores.items():
        lines = {"mean of the classes": np.mean(list(score.curves.values()), axis=0)} if score.curves else {}
        lines |= score.curves
        charts.append(
            curves(
                f"Precision over recall of {_PLURALS[kind]}, IoU 0.5",
                {name: np.stack([recalls, precision], axis=1) for name, precision in lines.items()},
                ("recall", "precision"),
                {f"{name}, at recall 0.5 and 0.9": f"{line[50]:.3f}, {line[90]:.3f}" for name, line in lines.items()},
            )
        )
        means.append(
            bars(f"AP50-95 of {_PLURALS[kind]} by class", {name: ap for name, (ap, _) in score.classes.items()})
        )
    return make_section("charts", "Charts", make_charts(charts + means))


def _gains(found: Mapping[str, float]) -> str:
    text = "Gain in mAP50-95 of boxes if one kind of error is corrected; gains do not add up."
    chart = bars(text, {ERROR_KINDS[kind]: max(gain, 0.0) for kind, gain in found.items()}, name_width=170)
    return make_section("gains", "Cost of errors", make_charts([chart]))


def _confusion(confusion: Confusion, class_names: Sequence[str]) -> str:
    names = [html.escape(name) for name in (*class_names, "nothing")]
    rows = []
    for i, (name, row) in enumerate(zip(names, confusion.matrix, strict=True)):
        total = max(int(row.sum()), 1)
        cells = []
        for j, count in enumerate(row.tolist()):
            colour = "var(--bar)" if i == j else "var(--bad)"
            shade = f' style="background: color-mix(in srgb, {colour} {60 * count / total:.0f}%, transparent)"'
            cells.append(f"<td{shade if count else ''}>{count or ''}</td>")
        rows.append(f'<tr><th scope="row">{name}</th>{"".join(cells)}</tr>')
    text = f"Labelled and detected classes, for scores of at least {CONFIDENCE} and a box IoU of at least {IOU}."
    table = _headed_table(("labelled \\ found", *names), rows)
    return make_section("confusion", "Confusion", f'<p>{text}</p><div class="matrix">{table}</div>')


def _worst(found: LabelledSet, truth: JsonObject, detections: Sequence[Detection], confusion: Confusion) -> str:
    order = worst_images(confusion)[:NUM_WORST_IMAGES]
    labelled: dict[int, list[JsonObject]] = {image: [] for image in order}
    predicted: dict[int, list[JsonObject]] = {image: [] for image in order}
    for annotation in truth["annotations"]:
        if annotation["image_id"] in labelled:
            labelled[annotation["image_id"]].append(annotation)
    for detection in detections:
        if detection["image_id"] in predicted and detection["score"] >= CONFIDENCE:
            predicted[detection["image_id"]].append(detection)
    figures = []
    for image in order:
        sample = found.samples[image - 1]
        right, missed, confused, extra = confusion.errors[image]
        summary = f"{right} right, {missed} missed, {confused} with the wrong class, {extra} false detections"
        figures.append(
            f'<figure><div class="pair">{_picture(sample, labelled[image], found.class_names, "labelled")}'
            f"{_picture(sample, predicted[image], found.class_names, 'found')}</div>"
            f"<figcaption>{html.escape(sample.name)}: {summary}</figcaption></figure>"
        )
    text = f"Left: labels. Right: detections with a score of at least {CONFIDENCE}."
    body = "".join(figures) if figures else "<p>All detections are correct.</p>"
    return make_section("worst", "Worst images", f'<p>{text}</p><div class="show-mask show-box show-name">{body}</div>')


def worst_images(confusion: Confusion) -> list[int]:
    """Return the ids of images with errors, in ascending order of their share of correct detections."""
    shares = {
        image: (right / (right + sum(wrong)), -sum(wrong), image)
        for image, (right, *wrong) in confusion.errors.items()
        if sum(wrong)
    }
    return sorted(shares, key=lambda image: shares[image])


def _picture(sample: Sample, shown: Sequence[JsonObject], class_names: Sequence[str], what: str) -> str:
    unit, marks, names = sample.width / _THUMBNAIL, [], []
    for entry in shown:
        index = entry["category_id"] - 1
        colour = "rgb({},{},{})".format(*class_colour(index))
        x, y, width, height = entry["bbox"]
        name = class_names[index] + (f" {entry['score']:.2f}" if "score" in entry else "")
        if "segmentation" in entry and (mask := decode_rle(entry["segmentation"])).any():
            path = mask_path(Silhouette.cropped(mask.astype(bool), 0, 0))
            marks.append(f'<path class="mask" d="{path}" fill="{colour}" stroke="{colour}"/>')
        marks.append(f'<rect class="box" x="{x}" y="{y}" width="{width}" height="{height}" stroke="{colour}"/>')
        names.append(
            f'<text class="name" x="{x}" y="{max(y - 3 * unit, 11 * unit):.0f}" font-size="{11 * unit:.1f}">'
            f"{html.escape(name)}</text>"
        )
    text = html.escape(f"{sample.name}, {what}: {len(shown)}", quote=True)
    source = shrunk_image(np.ascontiguousarray(read_upright(sample.path)[..., ::-1]), _THUMBNAIL)
    return (
        f'<div class="picture"><img alt="{text}" src="{source}"><svg aria-hidden="true" '
        f'viewBox="0 0 {sample.width} {sample.height}">{"".join(marks + names)}</svg></div>'
    )
