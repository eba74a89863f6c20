"""A page to look at a dataset by: samples with their labels, draws and what is missing, statistics, audit, origin.

In: a dataset's folder. Out: one HTML file that needs no network, and warnings of what a detector cannot learn.
"""

from __future__ import annotations

from mitsplat.report.dataset_report import write_report

__all__ = ["write_report"]
