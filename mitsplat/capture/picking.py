"""What is pointed at in a capture: from a pixel to the object, and from a ray to a pixel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsplat.capture.capture import Capture
from mitsplat.capture.isolation import ChosenObject, PhotoView, Pick, choose_object
from mitsplat.errors import InputError

_CONE = np.radians(1.0)
"""Half of the angle around a ray within which the nearest point is what it meets."""
_WIDE = np.radians(5.0)
"""The same where nothing lies so near to it."""


def chosen_object(
    capture: Capture,
    picks: Sequence[str] = (),
    picks_not: Sequence[str] = (),
    box: tuple[float, ...] | None = None,
) -> ChosenObject:
    """The points of the object, by the hints that there are.

    Args:
        capture: With z up.
        picks: PHOTO:X,Y on it.
        picks_not: The same on things that it is not.
        box: Least and largest x, y and z of a box that holds it.

    Raises:
        InputError: If a pick means nothing, or nothing stands out there.
    """
    views = {photo.name: PhotoView(photo.camera, photo.seen) for photo in capture.photos}

    def pick(spot: str) -> Pick:
        photo, pixel = capture.picked(spot)
        return Pick(spot, views[photo.name], pixel)

    on, off = ([pick(spot) for spot in spots] for spots in (picks, picks_not))
    return choose_object(capture.points, list(views.values()), picks=on, picks_not=off, box=box)


def pick_along(capture: Capture, origin: npt.ArrayLike, direction: npt.ArrayLike) -> str:
    """PHOTO:X,Y of the point that a ray meets, in the photo that shows it most as the ray does.

    Args:
        capture: Where.
        origin: Of the ray, shape (3,), in the capture's frame.
        direction: Of the ray, shape (3,).

    Raises:
        InputError: If no point lies near the ray.
    """
    ahead = np.asarray(direction, dtype=np.float64)
    ahead = ahead / np.linalg.norm(ahead)
    away = capture.points - np.asarray(origin, dtype=np.float64)
    along = away @ ahead
    aside = np.arctan2(np.linalg.norm(away - along[:, None] * ahead, axis=1), along)
    near = np.flatnonzero(aside < _CONE)
    if len(near):
        point = int(near[along[near].argmin()])
    elif len(aside) and aside.min() < _WIDE:
        point = int(aside.argmin())
    else:
        raise InputError("no point of the capture lies there: click on one")
    shown = [photo for photo in capture.photos if (photo.seen == point).any()]
    if not shown:
        raise InputError("no photo that was kept shows the point that lies there: click on another one")

    def likeness(world_place: npt.NDArray[np.float64]) -> float:
        towards = capture.points[point] - world_place
        return float(towards @ ahead / np.linalg.norm(towards))

    photo = max(shown, key=lambda photo: likeness(photo.camera.centre))
    (x, y), *_ = photo.camera.project(capture.points[point][None])[0]
    return f"{photo.name}:{x:.0f},{y:.0f}"
