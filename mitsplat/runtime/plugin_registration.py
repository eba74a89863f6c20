"""Registration of Mitsuba plugins under a variant, set by the package that has the plugins.

The packages below the plugins choose variants, and must not import the plugins. Mitsuba creates plugin classes once per
variant.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

_lock = threading.RLock()
_registration: Callable[[str | None], None] | None = None


def set_registration(function: Callable[[str | None], None]) -> None:
    """Set the function that registers the plugins under a variant; calling it twice for one variant must do no harm."""
    global _registration
    _registration = function


def register_plugins(variant: str | None) -> None:
    """Register the plugins under a variant; one thread at a time, and complete when this returns."""
    with _lock:
        if _registration is not None:
            _registration(variant)
