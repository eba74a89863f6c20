"""What a check found, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One line of a report; ``remedy`` says what to do where ``ok`` is false."""

    name: str
    ok: bool
    text: str
    remedy: str = ""
