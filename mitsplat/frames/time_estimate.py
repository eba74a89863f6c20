"""Time that a dataset takes, from the times of its first layouts and images."""

from __future__ import annotations

from collections.abc import Mapping

TIMED_FRAMES = 3
"""Number of images after which a run first states its time; the first image of a process also compiles kernels."""
CORRECTED = 0.5
"""Later estimates are reported if they are lower than this share of the last one: with several processes, the first
images of each compile kernels."""


class RunTime:
    """Estimate of the time of a run from its first images.

    Args:
        layouts: Number of layouts that are not settled yet.
        images: Number of images of the run.
        settles_first: True if the first image needs one of these layouts.
    """

    def __init__(self, layouts: int, images: int, *, settles_first: bool) -> None:
        self._layouts, self._images, self._settles_first = layouts, images, settles_first
        self._settle = self._image = 0.0
        self._timed = 0
        self._reported = 0.0

    def add(self, seconds: Mapping[str, float]) -> str:
        """Add the seconds of the stages of an image.

        Returns:
            The estimate after ``TIMED_FRAMES`` images, and after any later image that shows that the run takes much
            less time; otherwise an empty string.
        """
        settle = seconds.get("settle", 0.0)
        image = sum(seconds.values()) - settle
        self._settle = max(self._settle, settle)
        self._image = min(self._image, image) if self._timed else image
        self._timed += 1
        total = self._layouts * self._settle + self._images * self._image
        much_less = self._timed > TIMED_FRAMES and total < CORRECTED * self._reported
        if self._timed != TIMED_FRAMES and not much_less:
            return ""
        self._reported = total
        return describe_time(self._layouts, self._settle if self._settles_first else None, self._images, self._image)


def describe_time(layouts: int, settle: float | None, images: int, image: float) -> str:
    """Return a sentence on the time of layouts and images that take ``settle`` and ``image`` [s] each.

    ``settle`` is None if no layout was timed, because the first one was in the cache.
    """
    total = format_time(layouts * (settle or 0.0) + images * image)
    text = f"about {total} in one process: {images} image{'s' * (images != 1)} of {image:.2g} s"
    drops = f"{layouts} layout{'s' * (layouts != 1)}"
    if not layouts:
        return f"{text}; no layout to settle"
    if settle is None:
        return f"{text}, without settling {drops}"
    return f"{text}, and {drops} that settle{'s' * (layouts == 1)} in {settle:.2g} s"


def format_time(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
