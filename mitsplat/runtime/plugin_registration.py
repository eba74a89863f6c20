"""Registration of Mitsuba plugins under a variant, set by the package that defines the plugins.

Lower-level packages select variants, and must not import the plugins. Mitsuba creates plugin classes once per variant.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

_lock = threading.RLock()
_registration: Callable[[str | None], None] | None = None


def set_registration(function: Callable[[str | None], None]) -> None:
    """Set the function that registers the plugins under a variant; it must be idempotent for each variant."""
    global _registration
    _registration = function


def register_plugins(variant: str | None) -> None:
    """Register the plugins under a variant. Threads are serialised, and registration is complete on return."""
    with _lock:
        if _registration is not None:
            _registration(variant)
