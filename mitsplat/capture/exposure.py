"""Relative exposure and white balance of photos, estimated from points that several photos observe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.capture.capture import Capture, Photo
from mitsplat.images.colour import decode_srgb

STEADY = 0.02
"""Largest standard deviation of the logarithmic gains at which exposure counts as fixed and is not corrected."""
_LOOKUP_EDGE = 320
"""Longest edge of the reduced pictures for colour look-up [px]; their pixels average out noise."""
_RELIABLE_RANGE = (0.04, 0.96)
"""Range of display-encoded values that are neither dominated by noise nor clipped."""
_MIN_OBSERVATIONS = 20
"""Minimum number of points for the correction of a photo."""
_MIN_SCALE = 0.02
"""Lower limit of the scale of the robust weights, in differences of logarithms."""


def even_exposure(capture: Capture) -> Capture:
    """Return the capture with gains that equalise the colours of shared points, unless exposure was fixed."""
    gains = relative_gains(capture.photos, capture.points)
    if np.log(gains).std(axis=0).max(initial=0.0) <= STEADY:
        return capture
    photos = (
        replace(p, gain=(float(r), float(g), float(b))) for p, (r, g, b) in zip(capture.photos, gains, strict=True)
    )
    return replace(capture, photos=tuple(photos))


def relative_gains(photos: Sequence[Photo], points: Float64Array) -> Float64Array:
    """Estimate the factors of linear red, green and blue for each photo, (N, 3); their logarithms have mean 0.

    The model is: log colour of a point in a photo = log colour of the point - log gain of the photo. It is solved by
    linear least squares with the points eliminated. Residuals have Cauchy weights, because glossy and occluded points
    carry no information about exposure.

    Args:
        photos: Photos of a capture.
        points: Points of the same capture, shape (M, 3).
    """
    photo, point, seen = _observations(photos, points)
    if not len(photo):
        return np.ones((len(photos), 3))
    corrections, weight = np.zeros((len(photos), 3)), np.ones(len(photo))
    for _ in range(12):
        shape = len(photos), int(point.max()) + 1
        links = coo_array((weight, (photo, point)), shape=shape).tocsr()
        share = 1 / np.maximum(np.asarray(links.sum(axis=0)).ravel(), 1e-12)

        def means(values: Float64Array, weight: Float64Array = weight, share: Float64Array = share) -> Float64Array:
            return np.column_stack([np.bincount(point, weight * v, len(share)) * share for v in values.T])

        spread = links @ (links * share).T
        system = np.diag(np.asarray(links.sum(axis=1)).ravel()) - spread.toarray()
        residual = weight[:, None] * (means(seen)[point] - seen)
        right = np.column_stack([np.bincount(photo, r, len(photos)) for r in residual.T])
        # Minimum-norm solution: groups of photos without shared points keep their means.
        corrections = np.linalg.lstsq(system, right, rcond=1e-9)[0]
        corrected = seen + corrections[photo]
        off = np.linalg.norm(corrected - means(corrected)[point], axis=1)
        weight = 1 / (1 + (off / max(float(np.median(off)), _MIN_SCALE)) ** 2)
    corrections[np.bincount(photo, minlength=len(photos)) < _MIN_OBSERVATIONS] = 0
    return np.asarray(np.exp(corrections - corrections.mean(axis=0)))


def _observations(photos: Sequence[Photo], points: Float64Array) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Return photo index and point index of each observation, (K,), and its log linear colour, (K, 3)."""
    found = []
    for number, photo in enumerate(photos):
        camera, rgb, *_ = photo.fitted(_LOOKUP_EDGE)
        inside, x, y = camera.visible_pixels(points[photo.seen])
        values = rgb[y, x]
        reliable = ((values > _RELIABLE_RANGE[0]) & (values < _RELIABLE_RANGE[1])).all(axis=1)
        own = photo.seen[inside][reliable].astype(np.int64)
        found.append((np.full(len(own), number, dtype=np.int64), own, np.log(decode_srgb(values[reliable]))))
    photo_of, point_of, shown = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return photo_of, point_of, shown
