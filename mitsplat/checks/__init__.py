"""What is questionable about a machine, an asset or a scene, and what to do about it.

In: a path, or nothing. Out: :class:`~mitsplat.findings.Finding` after finding.
"""

from __future__ import annotations

from mitsplat.checks.doctor import examine
from mitsplat.checks.path_checks import check_path

__all__ = ["check_path", "examine"]
