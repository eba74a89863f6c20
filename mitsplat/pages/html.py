"""Self-contained HTML pages: page template and embedded pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import ByteImage
from mitsplat.images.masks import Silhouette
from mitsplat.storage.files import write_text

REPORT_FILE = "report.html"


def make_page(title: str, body: str, *, script: str = "") -> str:
    """Build an HTML page from an HTML body; bytes of file names that are not UTF-8 are written as escapes."""
    body = body.encode(errors="backslashreplace").decode()
    page = _PAGE.replace("{{title}}", html.escape(title)).replace("{{body}}", body)
    return page.replace("{{script}}", f"<script>{script}</script>\n" if script else "")


def write_report_page(folder: Path, name: str, kind: str, sections: Iterable[str]) -> Path:
    """Write the page ``report.html`` of an asset into its folder, and return its path.

    Raises:
        OSError: If the page cannot be written.
    """
    path = folder / REPORT_FILE
    body = "\n".join([f"<h1>{html.escape(name)}</h1>", *sections])
    write_text(path, make_page(f"{name}: {kind} report", body))
    return path


def make_section(key: str, title: str, body: str) -> str:
    """Build a section with a heading."""
    return f'<section aria-labelledby="{key}"><h2 id="{key}">{title}</h2>{body}</section>'


def make_table(rows: Iterable[tuple[str, str]]) -> str:
    """Build a table with a name and a value in each row."""
    cells = (f'<th scope="row">{html.escape(name)}</th><td>{html.escape(value)}</td>' for name, value in rows)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def make_charts(charts: Iterable[str]) -> str:
    """Build a grid of the charts of :mod:`mitsplat.pages.svg_charts`."""
    return f'<div class="charts">{"".join(charts)}</div>'


def make_figure(alt: str, caption: str, source: str) -> str:
    """Build a picture with a caption; ``source`` is a data URL."""
    return f'<figure><img alt="{alt}" src="{source}"><figcaption>{caption}</figcaption></figure>'


def shrunk_image(picture: ByteImage, width: int) -> str:
    """Encode an RGB picture (H, W, 3) as a data URL, at most ``width`` px wide."""
    scale = min(1.0, width / picture.shape[1])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    pixels = cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return f"data:image/jpeg;base64,{base64.b64encode(bytes(data)).decode('ascii')}"


def rgb_image(values: npt.NDArray[np.floating], width: int) -> str:
    """Encode colours from 0 to 1, (H, W, 3), as a data URL of a picture at most ``width`` px wide."""
    return shrunk_image(colour_bytes(values), width)


def colour_bytes(values: npt.NDArray[np.floating]) -> ByteImage:
    """Convert colours from 0 to 1 to bytes, in any shape."""
    return np.asarray(255 * np.clip(values, 0, 1) + 0.5).astype(np.uint8)


def mask_path(shape: Silhouette) -> str:
    """Convert a mask to an SVG path along the centres of its outline pixels; holes follow the even-odd rule."""
    x, y = shape.box[:2]
    rings, _ = cv2.findContours(shape.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
    return "".join(
        "M" + "L".join(f"{px + x + 0.5:g} {py + y + 0.5:g}" for px, py in ring.reshape(-1, 2)) + "Z" for ring in rings
    )


def figure_of(value: float | None, form: str) -> str | None:
    """Format a value, or return None if it is unknown."""
    return None if value is None else form.format(value)


def verdict_of(wrong: Sequence[str], good: str, rows: Mapping[str, str | None]) -> str:
    """Build HTML with one paragraph per defect, or the sentence ``good``, and a table of the known values."""
    lines = "".join(f'<p class="bad">{html.escape(line)}</p>' for line in wrong) or f'<p class="good">{good}</p>'
    return lines + make_table((key, value) for key, value in rows.items() if value)


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{title}}</title>
<style>
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --line: #c8ced6; --bar: #2f6db5; --soft: #f3f5f8;
  --good: #1a7f37; --bad: #cf222e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8ebef; --paper: #15181c; --line: #454c55; --bar: #6ea8ea; --soft: #1f242a;
    --good: #56d364; --bad: #ff7b72; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1400px; padding: 1rem 1.5rem 4rem; color: var(--ink); background: var(--paper);
  font: 16px/1.5 system-ui, sans-serif; }
h1, h2 { line-height: 1.2; }
h2 { margin: 2.5rem 0 .75rem; border-bottom: 1px solid var(--line); padding-bottom: .3rem; }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; padding: .2rem .9rem .2rem 0; overflow-wrap: anywhere; }
th { font-weight: 600; white-space: nowrap; }
.good::before { content: "\\2713  "; color: var(--good); font-weight: 700; }
.bad::before { content: "\\2717  "; color: var(--bad); font-weight: 700; }
fieldset { border: 1px solid var(--line); border-radius: 6px; margin: 0 0 1rem; padding: .4rem 1rem .6rem; }
fieldset label { display: inline-block; margin-right: 1.5rem; padding: .2rem 0; cursor: pointer; }
figure { margin: 0; }
figcaption { font-size: .9rem; padding: .35rem 0; }
.samples, .charts { display: grid; gap: 1.2rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 400px), 1fr)); }
.picture { position: relative; line-height: 0; background: var(--soft); }
.picture img { width: 100%; height: auto; }
.picture svg { position: absolute; inset: 0; width: 100%; height: 100%; }
.picture svg * { vector-effect: non-scaling-stroke; }
.picture .mask { fill-rule: evenodd; fill-opacity: .45; stroke-width: 1; }
.picture .alone { fill: none; stroke-width: 2; stroke-dasharray: 4 3; }
.picture .box { fill: none; stroke-width: 1.5; }
.picture .name { fill: #fff; stroke: #000; stroke-width: 3px; paint-order: stroke; font-family: system-ui, sans-serif; }
.picture .mask, .picture .alone, .picture .box, .picture .name { display: none; }
.show-mask .mask, .show-alone .alone, .show-box .box, .show-name .name { display: inline; }
.charts figure { background: var(--soft); border-radius: 6px; padding: .5rem .9rem .7rem; }
.charts figcaption { font-weight: 600; }
.charts svg { width: 100%; height: auto; font-size: 12px; fill: var(--ink); }
.bar { fill: var(--bar); }
.axis { stroke: var(--line); }
.curve { fill: none; stroke: var(--bar); stroke-linejoin: round; }
.matrix { overflow-x: auto; }
.matrix td { text-align: right; padding: .2rem .6rem; }
.matrix thead th + th { writing-mode: vertical-rl; text-align: end; padding: .3rem .4rem; }
.pair { display: grid; gap: .6rem; grid-template-columns: 1fr 1fr; }
.frame { fill: none; stroke: var(--line); }
summary { cursor: pointer; }
pre { overflow: auto; max-height: 30rem; background: var(--soft); padding: .8rem; font-size: .85rem; }
.row { display: grid; gap: .6rem; grid-template-columns: repeat(4, 1fr); }
.thumbnails { display: grid; gap: .6rem; grid-template-columns: repeat(auto-fill, minmax(150px, 1fr)); }
.row img, .thumbnails img { width: 100%; height: auto; background: var(--soft); }
.camera { fill: none; stroke: var(--bar); stroke-width: 1; }
:focus-visible { outline: 3px solid var(--bar); outline-offset: 2px; }
</style>
</head>
<body>
<main>
{{body}}
</main>
{{script}}</body>
</html>
"""
