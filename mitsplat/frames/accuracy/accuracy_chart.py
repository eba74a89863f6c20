"""Table and chart of the measured speed and accuracy."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsplat.frames.accuracy.speed_accuracy import (
    BUDGET_PREFIX,
    CAPTURED,
    MESH_PREFIX,
    TOLERANCE_PREFIX,
    Row,
    fastest_preset,
)
from mitsplat.quality import PRESETS
from mitsplat.storage.files import storage_errors, write_file, write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_csv(rows: Sequence[Row], file: Path) -> None:
    """Write a CSV file with a header and one line per row."""
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, list(asdict(rows[0])))
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    with storage_errors(file):
        write_text(file, stream.getvalue())


def draw_chart(rows: Sequence[Row], file: Path, *, title: str, tolerance: float) -> None:
    """Plot the time of an image against the error of whole pictures, and beside it against the PSNR of objects."""
    from matplotlib.figure import Figure  # takes half a second, which only a chart needs

    shows_objects = any(math.isfinite(row.objects) for row in rows)
    figure = Figure(figsize=(16 if shows_objects else 8, 5), layout="constrained")
    panels = figure.subplots(1, 2 if shows_objects else 1, squeeze=False)[0]
    _draw_errors(panels[0], [row for row in rows if not row.name.startswith(MESH_PREFIX)], tolerance)
    panels[0].set_title(title)
    if shows_objects:
        _draw_objects(panels[1], [row for row in rows if math.isfinite(row.objects)])
    with storage_errors(file):
        write_file(file, lambda part: figure.savefig(part, dpi=110, format=file.suffix[1:]))


def _draw_errors(axes: Axes, rows: Sequence[Row], tolerance: float) -> None:
    """Plot the time against the RMSE, both logarithmic.

    Steps connect the Pareto-optimal configurations; a curve connects those of ``balanced`` over its tolerance.
    """
    least = min((row.rmse for row in rows if row.rmse > 0), default=1e-3) / 4
    errors = [max(row.rmse, least) for row in rows]
    points = [(row.seconds, error) for row, error in zip(rows, errors, strict=True)]
    front = sorted(p for p in points if not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points))
    axes.step(*zip(*front, strict=True), where="post", color="0.7", zorder=1)
    axes.plot(*zip(*curve_of(rows, least), strict=True), color="C0", linewidth=1, zorder=1)
    chosen = fastest_preset(rows, tolerance)
    for row, error in zip(rows, errors, strict=True):
        axes.scatter(row.seconds, error, s=50, color="C3" if row == chosen else "C0", zorder=2)
        label = f"{row.name} (no error)" if row.rmse == 0 else row.name
        placed: dict[str, Any] = {"xytext": (6, 4)}
        if row.name.startswith(TOLERANCE_PREFIX):  # below the points, which are dense at the curve's end
            label, placed = row.name.removeprefix(TOLERANCE_PREFIX), {"xytext": (0, -6), "rotation": -45, "va": "top"}
        axes.annotate(label, (row.seconds, error), textcoords="offset points", fontsize=8, **placed)
    axes.axhline(tolerance, color="C3", linewidth=0.8, linestyle="--")
    axes.set(xscale="log", yscale="log", xlabel="seconds per image", ylabel="RMSE against exact")
    axes.margins(x=0.2, y=0.1)


def _draw_objects(axes: Axes, rows: Sequence[Row]) -> None:
    """Plot the time against the PSNR of objects, without models of light that are cheaper than reflections.

    Lines connect ray budgets of splats and of path-traced meshes.
    """
    meshes = [row for row in rows if row.name.startswith(MESH_PREFIX)]
    budgets = [row for row in rows if row.name == "fast" or row.name.startswith(BUDGET_PREFIX)]
    others = [row for row in rows if row.name in (*PRESETS, CAPTURED) and row not in budgets]
    for series, colour, line in ((budgets, "C0", "-"), (meshes, "C1", "-"), (others, "C2", "")):
        points = sorted((row.objects, row.seconds) for row in series)
        axes.plot([p[1] for p in points], [p[0] for p in points], f"o{line}", color=colour)
        for row in series:
            axes.annotate(row.name, (row.seconds, row.objects), xytext=(6, 4), textcoords="offset points", fontsize=8)
    reference = "path-traced meshes" if meshes else "exact"
    axes.set(xscale="log", xlabel="seconds per image", ylabel=f"PSNR of objects against {reference} [dB]")
    axes.margins(x=0.2, y=0.1)


def curve_of(rows: Sequence[Row], least: float = 0.0) -> list[tuple[float, float]]:
    """Return (seconds, error >= ``least``) of ``balanced`` at all its tolerances, in descending order."""
    preset = f"{TOLERANCE_PREFIX}{PRESETS['balanced'].tolerance:g}"
    named = {preset if row.name == "balanced" else row.name: row for row in rows}
    curve = {name.removeprefix(TOLERANCE_PREFIX): named[name] for name in named if name.startswith(TOLERANCE_PREFIX)}
    return [(curve[key].seconds, max(curve[key].rmse, least)) for key in sorted(curve, key=float, reverse=True)]
