"""Checks of a machine, an asset or a scene, with a remedy for every problem.

In: a path, or nothing. Out: an iterator of :class:`~mitsplat.findings.Finding`.
"""

from __future__ import annotations

from mitsplat.checks.doctor import examine
from mitsplat.checks.path_checks import check_path

__all__ = ["check_path", "examine"]
