"""Charts as inline SVG without network or framework, each with a caption and a table of its numbers."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from mitsplat.pages.html import make_table

_WIDTH, _HEIGHT = 420, 190
_LEFT, _BOTTOM, _TOP = 46, 34, 10


def bars(caption: str, values: Mapping[str, float], *, unit: str = "", name_width: int = 150) -> str:
    """Draw horizontal bars with names (``name_width`` of the chart's 420 units) and values."""
    if not values:
        return _figure(caption, "<p>nothing</p>", [])
    most = max(values.values()) or 1.0
    row = 22
    marks = []
    for i, (name, value) in enumerate(values.items()):
        length = (_WIDTH - name_width - 70) * value / most
        y, shown = i * row, _short(name, name_width // 7 + 1)
        marks.append(
            f'<text x="{name_width - 6}" y="{y + 15}" text-anchor="end">{html.escape(shown)}</text>'
            f'<rect class="bar" x="{name_width}" y="{y + 3}" width="{length:.1f}" height="{row - 6}"/>'
            f'<text x="{name_width + length + 5:.1f}" y="{y + 15}">{_number(value)}</text>'
        )
    drawing = _svg(caption, len(values) * row + 4, marks)
    return _figure(caption, drawing, [(name, f"{_number(value)}{unit}") for name, value in values.items()])


class Histogram:
    """Counts of values in equal bins; values beyond ``bounds`` are counted in the outermost bins."""

    def __init__(self, bounds: tuple[float, float], bins: int = 20) -> None:
        self._bounds = bounds
        self._counts = np.zeros(bins, dtype=np.int64)

    def add(self, values: npt.ArrayLike) -> None:
        """Count values."""
        data = np.asarray(values, dtype=np.float64).ravel()
        self._counts += np.histogram(np.clip(data, *self._bounds), bins=len(self._counts), range=self._bounds)[0]

    def draw(self, caption: str, axis: str = "") -> str:
        """Draw the histogram as a chart."""
        if not self._counts.any():
            return _figure(caption, "<p>nothing</p>", [])
        low, high = self._bounds
        names = [f"{_number(a)} to {_number(b)}" for a, b in pairwise(np.linspace(low, high, len(self._counts) + 1))]
        ends = {share: _number(low + share * (high - low)) for share in (0.0, 0.5, 1.0)}
        return _columns(caption, self._counts, names, ends, axis)


def columns(caption: str, counts: Sequence[int] | npt.NDArray[np.integer], names: Sequence[str], axis: str = "") -> str:
    """Draw a histogram from given counts, with a name for every bin."""
    ends = {0.0: names[0]} | ({0.5: names[len(names) // 2], 1.0: names[-1]} if len(names) > 2 else {})
    return _columns(caption, np.asarray(counts), names, ends, axis)


def curves(
    caption: str, lines: Mapping[str, npt.NDArray[np.float64]], axes: tuple[str, str], numbers: Mapping[str, str]
) -> str:
    """Draw curves of points (x, y) in [0, 1], shape (N, 2) each, the first one thick; ``numbers`` is the table."""
    width, height = _WIDTH - _LEFT - 10, 0.6 * (_WIDTH - _LEFT - 10)
    base = _TOP + height
    marks = [f'<rect class="frame" x="{_LEFT}" y="{_TOP}" width="{width}" height="{height:.1f}"/>']
    for name, points in reversed(list(lines.items())):
        path = " ".join(f"{_LEFT + width * x:.1f},{base - height * y:.1f}" for x, y in points.tolist())
        style = 'stroke-width="3"' if name == next(iter(lines)) else 'stroke-width="1" stroke-opacity="0.6"'
        marks.append(f'<polyline class="curve" points="{path}" {style}><title>{html.escape(name)}</title></polyline>')
    for text, left, top, anchor in (
        ("0", _LEFT, base + 14, "start"),
        ("1", _LEFT + width, base + 14, "end"),
        ("0", _LEFT - 5, base, "end"),
        ("1", _LEFT - 5, _TOP + 10, "end"),
        (axes[0], _LEFT + width / 2, base + 28, "middle"),
        (axes[1], _LEFT + 8, base - 8, "start"),
    ):
        marks.append(f'<text x="{left:.1f}" y="{top:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>')
    return _figure(caption, _svg(caption, base + 34, marks), list(numbers.items()))


def discs(caption: str, counts: Mapping[str, npt.NDArray[np.integer]]) -> str:
    """Draw hemispheres from above; their cells (rings from the top, sectors from +x to +y) darken with the counts.

    Equal areas of the sphere have equal areas on the disc (Lambert's azimuthal projection).
    """
    if not counts:
        return _figure(caption, "<p>nothing</p>", [])
    across, side = 4, _WIDTH / 4
    marks, numbers = [], []
    for number, (name, cells) in enumerate(counts.items()):
        cx, cy, radius = (number % across + 0.5) * side, (number // across) * (side + 16) + side / 2, side / 2 - 6
        edges = radius * np.sqrt(np.arange(len(cells) + 1) / len(cells))
        marks.append(f'<circle class="frame" cx="{cx:.1f}" cy="{cy:.1f}" r="{radius:.1f}"/>')
        marks.append(
            f'<text x="{cx:.1f}" y="{cy + side / 2 + 6:.1f}" text-anchor="middle">{html.escape(_short(name))}</text>'
        )
        numbers.append((name, f"{np.count_nonzero(cells)} of {cells.size} directions, {int(cells.sum())} views"))
        for ring, sector in zip(*np.nonzero(cells), strict=True):
            angles = 2 * np.pi * np.array([sector, sector + 1]) / cells.shape[1]
            corners = [
                (cx + r * np.cos(a), cy - r * np.sin(a))
                for r, a in zip(edges[[ring, ring, ring + 1, ring + 1]], angles[[0, 1, 1, 0]], strict=True)
            ]
            (ax, ay), (bx, by), (dx, dy), (ex, ey) = corners
            path = (
                f"M{ax:.1f} {ay:.1f}A{edges[ring]:.1f} {edges[ring]:.1f} 0 0 0 {bx:.1f} {by:.1f}L{dx:.1f} {dy:.1f}"
                f"A{edges[ring + 1]:.1f} {edges[ring + 1]:.1f} 0 0 1 {ex:.1f} {ey:.1f}Z"
            )
            share = np.sqrt(cells[ring, sector] / cells.max())
            marks.append(f'<path class="bar" d="{path}" fill-opacity="{0.12 + 0.88 * share:.2f}"/>')
    rows = -(-len(counts) // across)
    return _figure(caption, _svg(caption, rows * (side + 16) + 4, marks), numbers)


class HeatMap:
    """Counts of points (x, y) in a grid from (0, 0) to ``size``, y downwards."""

    def __init__(self, size: tuple[float, float], cells: tuple[int, int]) -> None:
        self._size = size
        self._counts = np.zeros((cells[1], cells[0]))

    def add(self, x: npt.ArrayLike, y: npt.ArrayLike) -> None:
        """Count points."""
        counts, _, _ = np.histogram2d(
            np.clip(np.asarray(y, dtype=np.float64), 0, self._size[1]),
            np.clip(np.asarray(x, dtype=np.float64), 0, self._size[0]),
            bins=self._counts.shape,
            range=((0, self._size[1]), (0, self._size[0])),
        )
        self._counts += counts

    def draw(self, caption: str, axes: str) -> str:
        """Draw the map as a chart."""
        counts, size = self._counts, self._size
        cells = counts.shape[::-1]
        most = counts.max() or 1.0
        width = _WIDTH - _LEFT - 10
        height = width * size[1] / size[0]
        dx, dy = width / cells[0], height / cells[1]
        marks = [f'<rect class="frame" x="{_LEFT}" y="{_TOP}" width="{width}" height="{height:.1f}"/>']
        for row, column in zip(*np.nonzero(counts), strict=True):
            share = np.sqrt(counts[row, column] / most)
            marks.append(
                f'<rect class="bar" x="{_LEFT + column * dx:.1f}" y="{_TOP + row * dy:.1f}" width="{dx:.1f}" '
                f'height="{dy:.1f}" fill-opacity="{0.12 + 0.88 * share:.2f}"/>'
            )
        base = _TOP + height
        marks.append(f'<text x="{_LEFT}" y="{base + 14:.1f}">0</text>')
        marks.append(f'<text x="{_LEFT + width}" y="{base + 14:.1f}" text-anchor="end">{_number(size[0])}</text>')
        marks.append(f'<text x="{_LEFT - 5}" y="{_TOP + 10}" text-anchor="end">0</text>')
        marks.append(f'<text x="{_LEFT - 5}" y="{base:.1f}" text-anchor="end">{_number(size[1])}</text>')
        marks.append(
            f'<text x="{_LEFT + width / 2}" y="{base + 28:.1f}" text-anchor="middle">{html.escape(axes)}</text>'
        )
        busiest = np.unravel_index(int(counts.argmax()), counts.shape)
        numbers = [
            ("points", _number(counts.sum())),
            ("cells with a point", f"{np.count_nonzero(counts)} of {counts.size}"),
            ("busiest cell (column, row)", f"{busiest[1] + 1}, {busiest[0] + 1}: {_number(most)}"),
        ]
        return _figure(caption, _svg(caption, base + 34, marks), numbers)


def _columns(
    caption: str, counts: npt.NDArray[np.integer], names: Sequence[str], ends: Mapping[float, str], axis: str
) -> str:
    most = int(counts.max()) or 1
    width, height = _WIDTH - _LEFT - 10, _HEIGHT - _BOTTOM - _TOP
    step = width / len(counts)
    base = _TOP + height
    marks = [
        f'<rect class="bar" x="{_LEFT + i * step + 0.5:.1f}" y="{base - height * count / most:.1f}" '
        f'width="{max(step - 1, 0.5):.1f}" height="{height * count / most:.1f}"/>'
        for i, count in enumerate(counts)
        if count
    ]
    marks.append(f'<line class="axis" x1="{_LEFT}" y1="{base}" x2="{_LEFT + width}" y2="{base}"/>')
    for share, text in ends.items():
        anchor = {0.0: "start", 0.5: "middle", 1.0: "end"}[share]
        x = _LEFT + share * width
        marks.append(f'<text x="{x:.1f}" y="{base + 14}" text-anchor="{anchor}">{html.escape(text)}</text>')
    marks.append(f'<text x="{_LEFT - 5}" y="{_TOP + 10}" text-anchor="end">{_number(most)}</text>')
    marks.append(f'<text x="{_LEFT - 5}" y="{base}" text-anchor="end">0</text>')
    marks.append(f'<text x="{_LEFT + width / 2}" y="{base + 28}" text-anchor="middle">{html.escape(axis)}</text>')
    numbers = [(name, f"{count}") for name, count in zip(names, counts, strict=True) if count]
    return _figure(caption, _svg(caption, _HEIGHT, marks), numbers)


def _svg(caption: str, height: float, marks: Sequence[str]) -> str:
    label = html.escape(f"Chart: {caption}. Its numbers follow in a table.", quote=True)
    return f'<svg role="img" aria-label="{label}" viewBox="0 0 {_WIDTH} {height:.0f}">{"".join(marks)}</svg>'


def _figure(caption: str, drawing: str, numbers: Sequence[tuple[str, str]]) -> str:
    table = f"<details><summary>Numbers</summary>{make_table(numbers)}</details>" if numbers else ""
    return f"<figure><figcaption>{html.escape(caption)}</figcaption>{drawing}{table}</figure>"


def _number(value: float) -> str:
    if abs(value) >= 1e5:
        return f"{value / 1e6:.3g} M"
    return f"{value:.0f}" if float(value).is_integer() or abs(value) >= 1e3 else f"{value:.3g}"


def _short(name: str, most: int = 22) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"
