"""Result type of checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One line of a check report; ``remedy`` is the recommended action if ``ok`` is false."""

    name: str
    ok: bool
    text: str
    remedy: str = ""
