"""Result type of checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One line of a check report.

    Attributes:
        name: Name of the check.
        ok: True if there is no problem.
        text: Result.
        remedy: Recommended action if ``ok`` is false.
        place: File, line and key to change, as errors begin: ``scene.yaml:41: region``.
    """

    name: str
    ok: bool
    text: str
    remedy: str = ""
    place: str = ""
