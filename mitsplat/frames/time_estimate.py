"""Time that a dataset takes, from the times of its first layouts and images."""

from __future__ import annotations

TIMED_FRAMES = 3
"""Number of frames of a run after which its time is estimated; the first ones also compile kernels."""


def describe_time(layouts: int, settle: float | None, images: int, image: float) -> str:
    """Return a sentence on the time of layouts and images that take ``settle`` and ``image`` [s] each.

    ``settle`` is None if no layout was timed, because the first one was in the cache.
    """
    total = format_time(layouts * (settle or 0.0) + images * image)
    text = f"about {total} in one process: {images} images of {image:.2g} s"
    if not layouts:
        return f"{text}; no layout to settle"
    if settle is None:
        return f"{text}, without settling {layouts} layouts"
    return f"{text}, and {layouts} layouts that settle in {settle:.2g} s"


def format_time(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
