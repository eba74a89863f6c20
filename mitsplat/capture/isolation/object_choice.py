"""Selection of the object among the points of a photographed place.

Points above the support surface (:mod:`.support`) are clustered into separate objects. A pick or a box decides if
given. Otherwise the score of an object increases with its closeness to the centres of the photos, and with its
closeness to the point at which the cameras are directed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mitsplat.arrays import Float64Array, Int32Array, Int64Array
from mitsplat.capture.isolation.support import SupportSurface, find_support
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.clusters import cluster_points, gap_between
from mitsplat.geometry.triangulation import count_observers, nearest_point_to_lines, optical_axes

_MAX_DISTANCE = 0.7
"""Maximum distance of considered points from the focus, as a fraction of the cameras' distance."""
_FOCUS_SIGMA = 0.25
"""Standard deviation of the object's distance from the focus, as a fraction of the cameras' distance."""
_IMAGE_SIGMA = 0.2
"""Standard deviation of the window around the centre of a photo, as a fraction of its longer edge."""
_MIN_HEIGHT = 3.0
"""Minimum height of points above the support, in roughnesses of the support."""
_MIN_ROUGHNESS = 0.003
"""Minimum roughness, as a fraction of the cameras' distance."""
_GAP_BOUNDS = (0.02, 0.08)
"""Bounds of the gap between objects, as fractions of the cameras' distance; the gap is four times the point spacing."""
_MIN_POINTS = 20
_PICK_RADIUS = 0.1
"""Maximum distance of a point from a picked pixel, as a fraction of the photo's longer edge."""
_FOOT_HEIGHT = 0.15
"""Height below which points are projected onto the support, as a fraction of the object's height."""


@dataclass(frozen=True, eq=False)
class PhotoView:
    """Camera with the points that it observes.

    Attributes:
        camera: Camera of the photo.
        seen: Indices of points, shape (K,).
    """

    camera: Camera
    seen: Int32Array


@dataclass(frozen=True, eq=False)
class Pick:
    """Pixel that is on the object, or is not.

    Attributes:
        name: Pick as given by the user, for messages.
        view: View of the photo.
        pixel: x and y [px].
    """

    name: str
    view: PhotoView
    pixel: tuple[float, float]


@dataclass(frozen=True, eq=False)
class ChosenObject:
    """Selected object among points.

    Attributes:
        points: Points on the object, and the projections of the lowest onto the support, shape (N, 3).
        above: Points on the object only, shape (M, 3).
        others: Points on each other object on the support, shape (K, 3) each.
    """

    points: Float64Array
    above: Float64Array
    others: tuple[Float64Array, ...]


def choose_object(
    points: Float64Array,
    views: Sequence[PhotoView],
    *,
    picks: Sequence[Pick] = (),
    picks_not: Sequence[Pick] = (),
    box: tuple[float, ...] | None = None,
) -> ChosenObject:
    """Select the points of the object; z is up.

    Args:
        points: Points that the photos share, shape (N, 3).
        views: Views of the photos.
        picks: Pixels on the object; several picks can mark separate parts.
        picks_not: Pixels on other objects.
        box: Minimum and maximum x, y and z of a box that contains the object.

    Raises:
        InputError: If there is no object above the support, if a pick is near no point of an object, or if the picks
            of other objects exclude it.
    """
    focus, distance = focus_of([view.camera for view in views])
    if box is not None:
        focus = np.array(box, dtype=np.float64).reshape(2, 3).mean(axis=0)
    counts = count_observers([view.seen for view in views], len(points))
    near = (counts >= 3) & (np.linalg.norm(points - focus, axis=1) < _MAX_DISTANCE * distance)
    support = find_support(points[near], focus, _MAX_DISTANCE * distance)
    height = points[:, 2] - support.under(points)
    stands = near & (height > _MIN_HEIGHT * max(support.roughness, _MIN_ROUGHNESS * distance))
    if box is not None:
        stands &= ((points >= box[:3]) & (points <= box[3:])).all(axis=1)
    if np.count_nonzero(stands) < _MIN_POINTS:
        raise InputError(
            f"no object was found above its support in the photos ({np.count_nonzero(stands)} points above it): give "
            "masks, or take photos of one object with texture on and below it"
        )
    gap = gap_between(points[stands], *(bound * distance for bound in _GAP_BOUNDS))
    cluster = np.full(len(points), -1, dtype=np.int64)
    cluster[stands] = cluster_points(points[stands], gap)
    refused = {_picked_cluster(pick, points, cluster): pick.name for pick in picks_not}
    if picks:
        chosen = {_picked_cluster(pick, points, cluster) for pick in picks}
    else:
        away = np.linalg.norm(points[stands] - focus, axis=1) / (_FOCUS_SIGMA * distance)
        scores = np.bincount(cluster[stands], _centrality(points, views)[stands] * np.exp(-0.5 * away**2))
        scores[list(refused)] = -1
        chosen = {int(scores.argmax())}
    if chosen <= refused.keys():
        names = ", ".join(refused[number] for number in sorted(chosen if picks else refused))
        if picks:
            raise InputError(f"an object is selected by both --pick and --pick-not ({names}): the picked objects touch")
        raise InputError(f"no object remains: --pick-not ({names}) excludes all of them")
    own = np.isin(cluster, sorted(chosen - refused.keys()))
    feet = _project_feet(points[own], height[own], support)
    large = np.flatnonzero(np.bincount(cluster[stands]) >= _MIN_POINTS)
    others = tuple(points[cluster == number] for number in large if not own[cluster == number].any())
    return ChosenObject(np.concatenate([points[own], feet]), points[own], others)


def _centrality(points: Float64Array, views: Sequence[PhotoView]) -> Float64Array:
    """Sum a Gaussian of the distance from the image centre over the photos that observe each point, shape (N,)."""
    central = np.zeros(len(points))
    for view in views:
        camera, shown = view.camera, view.seen
        pixels, _ = camera.project(points[shown])
        away = np.linalg.norm(pixels - np.array(camera.size) / 2, axis=1)
        away[np.isnan(away)] = np.inf  # the model may state observations of points behind a camera
        central[shown] += np.exp(-0.5 * (away / (_IMAGE_SIGMA * max(camera.size))) ** 2)
    return central


def focus_of(cameras: Sequence[Camera]) -> tuple[Float64Array, float]:
    """Return the point (3,) at which most cameras are directed, and the median distance of the cameras from it.

    The point is found by iteratively reweighted least squares. Axes far from the point have low weights (Cauchy).
    """
    centres, axes = optical_axes(cameras)
    weights, focus = np.ones(len(centres)), centres.mean(axis=0)
    for _ in range(20):
        focus = nearest_point_to_lines(centres, axes, weights=weights, pull=1e-6 * float(weights.sum()))
        gaps = np.linalg.norm(np.cross(axes, focus - centres), axis=1)
        weights = 1 / (1 + (gaps / max(1.5 * float(np.median(gaps)), 1e-9)) ** 2)
    return focus, float(np.median(np.linalg.norm(centres - focus, axis=1)))


def _picked_cluster(pick: Pick, points: Float64Array, cluster: Int64Array) -> int:
    """Return the index of the object nearest to a pixel of a photo."""
    camera = pick.view.camera
    shown = pick.view.seen[cluster[pick.view.seen] >= 0]
    gaps = np.linalg.norm(camera.project(points[shown])[0] - pick.pixel, axis=1)
    limit = _PICK_RADIUS * max(camera.size)
    if not len(gaps) or not gaps.min() < limit:
        raise InputError(f"{pick.name}: the photo observes no point of an object within {limit:.0f} px of this pixel")
    return int(cluster[shown[int(gaps.argmin())]])


def _project_feet(own: Float64Array, height: Float64Array, support: SupportSurface) -> Float64Array:
    """Project the lowest points onto the support; all points if few are low.

    Points at the height of the support cannot be separated from it, so the object has no points there.
    """
    low = own[height < _FOOT_HEIGHT * height.max()]
    feet = (low if len(low) >= 5 else own).copy()
    feet[:, 2] = support.under(feet)
    return feet
