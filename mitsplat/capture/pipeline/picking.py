"""Object selection from pixels, and conversion of viewer rays to pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsplat.capture.capture import Capture
from mitsplat.capture.isolation import ChosenObject, PhotoView, Pick, choose_object
from mitsplat.errors import InputError

_CONE = np.radians(1.0)
"""Half angle of the cone around a ray in which the nearest point is picked [rad]."""
_WIDE = np.radians(5.0)
"""Half angle of the wider cone that is used if the first cone has no point [rad]."""


def chosen_object(
    capture: Capture, picks: Sequence[str] = (), picks_not: Sequence[str] = (), box: tuple[float, ...] | None = None
) -> ChosenObject:
    """Return the points of the object that the hints select.

    Args:
        capture: Capture with z up.
        picks: Pixels on the object, PHOTO:X,Y.
        picks_not: Pixels on other objects.
        box: Minimum and maximum x, y and z of a box that contains the object.

    Raises:
        InputError: If a pick is invalid or no object is found there.
    """
    views = {photo.name: PhotoView(photo.camera, photo.seen) for photo in capture.photos}

    def pick(spot: str) -> Pick:
        photo, pixel = capture.picked(spot)
        return Pick(spot, views[photo.name], pixel)

    on, off = ([pick(spot) for spot in spots] for spots in (picks, picks_not))
    return choose_object(capture.points, list(views.values()), picks=on, picks_not=off, box=box)


def pick_along(capture: Capture, origin: npt.ArrayLike, direction: npt.ArrayLike) -> str:
    """Return PHOTO:X,Y of the point that a ray hits, in the photo with the most similar viewing direction.

    Args:
        capture: Capture that contains the points.
        origin: Origin of the ray in the frame of the capture, shape (3,).
        direction: Direction of the ray, shape (3,).

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
        raise InputError("there is no point of the capture at this position: click on a point")
    shown = [photo for photo in capture.photos if (photo.seen == point).any()]
    if not shown:
        raise InputError("no photo of the capture observes the point at this position: click on another point")

    towards = capture.points[point] - np.array([photo.camera.centre for photo in shown])
    photo = shown[int((towards @ ahead / np.linalg.norm(towards, axis=1)).argmax())]
    (x, y), *_ = photo.camera.project(capture.points[point][None])[0]
    return f"{photo.name}:{x:.0f},{y:.0f}"
