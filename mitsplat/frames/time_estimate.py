"""Time that a dataset takes, from the times of its first layouts and images."""

from __future__ import annotations

TIMED_FRAMES = 3
"""Number of frames of a run after which its time is estimated; the first ones also compile kernels."""


def describe_time(layouts: int, settle: float, images: int, image: float) -> str:
    """Return a sentence on the time of layouts and images that take ``settle`` and ``image`` [s] each."""
    text = f"about {format_time(layouts * settle + images * image)} in one process: {images} images of {image:.2g} s"
    return f"{text}, and {layouts} layouts that settle in {settle:.2g} s" if layouts else f"{text}; no layout to settle"


def format_time(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
