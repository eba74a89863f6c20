"""HTML report of a dataset: labelled samples, draws, missing variety, statistics, audit and provenance.

In: a dataset folder. Out: one HTML file that needs no network, and warnings about gaps in its variety.
"""

from __future__ import annotations

from mitsplat.report.dataset_report import DatasetReport, write_report

__all__ = ["DatasetReport", "write_report"]
