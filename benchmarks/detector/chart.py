"""Cost of an image against the precision of a detector trained on as many images, as a chart of the documentation.

    python -m benchmarks.detector.chart [--picture docs/chart_detectors.png]

Seconds are those of ``benchmarks.detector.cost``; bars are 95 % intervals over the scenes of photographs and over
seeds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.detector.table import mean_precision, precision_draws
from benchmarks.figures import read_results, value_of
from benchmarks.record import ROOT

NAMES = {
    "traced_shadow": "fast",
    "balanced": "balanced",
    "exact": "exact",
    "aliased": "fast, one ray a pixel",
    "no_camera": "fast, ideal camera",
    "image_shadow": "fast, image shadow",
    "no_shadow": "fast, no shadow",
    "meshes": "path-traced meshes",
}
"""Names of arms in the chart."""


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path, default=ROOT / "docs" / "chart_detectors.png")
    options = parser.parse_args()
    from matplotlib.figure import Figure

    results = read_results()
    draws = precision_draws(results)
    chart = Figure(figsize=(8, 4.5), layout="constrained")
    axes = chart.add_subplot()
    for arm, name in NAMES.items():
        seconds, mean = value_of(results, "detector.cost", arm), mean_precision(results, "arms", arm)
        # Scenes differ far more than arms, and equally in all arms: the chart shows the interval of the difference.
        less = np.percentile(draws[arm] - draws["traced_shadow"], [2.5, 97.5]) if arm != "traced_shadow" else [0.0, 0.0]
        low, high = mean_precision(results, "arms", "traced_shadow") + np.array(less)
        axes.errorbar(seconds, mean, [[max(mean - low, 0)], [max(high - mean, 0)]], fmt="o", capsize=3, label=name)
    axes.set(xscale="log", xlabel="processor seconds per image", ylabel="mAP50-95 on photographs")
    ticks = [1, 2, 5, 10, 20]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.legend(loc="lower right", fontsize=8)
    axes.set_title("640 images; bars: 95 % of the difference from fast, over scenes and seeds", fontsize=9)
    axes.margins(x=0.15)
    chart.savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()
