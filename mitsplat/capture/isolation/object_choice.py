"""The object among the points of a photographed place: what most photos look at, or what a hint says.

What stands out of its support (:mod:`.support`) falls into things that lie apart. Each is weighed by how near to the
middle of its photos it is seen, and how near to the place that the cameras look at it lies; a pick or a box decides
before that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from mitsplat.capture.isolation.support import SupportSurface, find_support
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera

_REACH = 0.7
"""Of the cameras' distance: how far from what they look at things count."""
_CENTRED = 0.25
"""Of the cameras' distance: standard deviation of how far from there the object may be."""
_MIDDLE = 0.2
"""Standard deviation of the window around a photo's middle, as a share of its longer edge."""
_HEIGHT = 3.0
"""Roughnesses of the support above it from which a point stands on it."""
_FLATTEST = 0.003
"""Least roughness, of the cameras' distance."""
_APART = (0.02, 0.08)
"""Of the cameras' distance: bounds of the gap between things, which is four times that between points."""
_FEWEST = 20
_PICKED = 0.1
"""How far from a picked pixel a point may be seen, as a share of the photo's longer edge."""
_LOW = 0.15
"""Share of the object's height whose points have feet on the support."""


@dataclass(frozen=True, eq=False)
class PhotoView:
    """A camera, and which of the points it observes.

    Attributes:
        camera: From where.
        seen: Indices of points, shape (K,).
    """

    camera: Camera
    seen: Int32Array


@dataclass(frozen=True, eq=False)
class Pick:
    """A pixel that is of the object, or is not.

    Attributes:
        name: As the user gave it, for messages.
        view: Of the photo.
        pixel: x and y [px].
    """

    name: str
    view: PhotoView
    pixel: tuple[float, float]


@dataclass(frozen=True, eq=False)
class ChosenObject:
    """An object among points.

    Attributes:
        points: On it, and where the lowest stand on the support, shape (N, 3).
        above: Those on it alone, shape (M, 3).
        others: Those on each other thing that stands there, shape (K, 3).
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
    """The points of the object, z up.

    Args:
        points: That the photos share, shape (N, 3).
        views: Of the photos.
        picks: Pixels on the object; several may name its parts.
        picks_not: Pixels on things that it is not.
        box: Least and largest x, y and z of a box that holds the object.

    Raises:
        InputError: If nothing stands out there, or a pick shows no point of a thing.
    """
    focus, distance = focus_of([view.camera for view in views])
    if box is not None:
        focus = np.array(box, dtype=np.float64).reshape(2, 3).mean(axis=0)
    counts, central = np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for view in views:
        camera, shown = view.camera, view.seen
        pixels, _ = camera.project(points[shown])
        away = np.linalg.norm(pixels - (camera.width / 2, camera.height / 2), axis=1)
        counts[shown] += 1
        central[shown] += np.exp(-0.5 * (away / (_MIDDLE * max(camera.width, camera.height))) ** 2)
    near = (counts >= 3) & (np.linalg.norm(points - focus, axis=1) < _REACH * distance)
    support = find_support(points[near], focus, _REACH * distance)
    height = points[:, 2] - support.under(points)
    stands = near & (height > _HEIGHT * max(support.roughness, _FLATTEST * distance))
    if box is not None:
        stands &= ((points >= box[:3]) & (points <= box[3:])).all(axis=1)
    if np.count_nonzero(stands) < _FEWEST:
        raise InputError(
            f"no object stands out of its support in the photos ({np.count_nonzero(stands)} points above it): give "
            "masks, or take photos of one object with texture on and under it"
        )
    thing, count = _things(points, stands, distance)
    if picks:
        chosen = np.unique([_picked(pick, points, thing) for pick in picks])
    else:
        away = np.linalg.norm(points[stands] - focus, axis=1) / (_CENTRED * distance)
        scores = np.bincount(thing[stands], central[stands] * np.exp(-0.5 * away**2), count)
        for pick in picks_not:
            scores[_picked(pick, points, thing)] = -1
        chosen = np.array([int(scores.argmax())])
    refused = {_picked(pick, points, thing) for pick in picks_not}
    if refused >= set(chosen.tolist()):
        raise InputError(f"what was picked is also said not to be the object ({picks_not[0].name}): they touch")
    own = np.isin(thing, [number for number in chosen.tolist() if number not in refused])
    feet = _feet(points[own], height[own], support)
    large = np.flatnonzero(np.bincount(thing[stands]) >= _FEWEST)
    others = tuple(points[thing == number] for number in large if not own[thing == number].any())
    return ChosenObject(np.concatenate([points[own], feet]), points[own], others)


def focus_of(cameras: Sequence[Camera]) -> tuple[Float64Array, float]:
    """The point (3,) that most cameras look at, and their median distance from it.

    Axes that pass it by count less: iteratively reweighted least squares with Cauchy's weights.
    """
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.world_from_camera[:3, 2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weights, focus = np.ones(len(cameras)), centres.mean(axis=0)
    for _ in range(20):
        whole = np.einsum("n,nij->ij", weights, across) + 1e-6 * weights.sum() * np.eye(3)
        right = np.einsum("n,nij,nj->i", weights, across, centres) + 1e-6 * weights @ centres
        focus = np.linalg.solve(whole, right)
        gaps = np.linalg.norm(np.einsum("nij,nj->ni", across, focus - centres), axis=1)
        weights = 1 / (1 + (gaps / max(1.5 * float(np.median(gaps)), 1e-9)) ** 2)
    return focus, float(np.median(np.linalg.norm(centres - focus, axis=1)))


def _things(points: Float64Array, stands: BoolArray, distance: float) -> tuple[Int64Array, int]:
    """The thing that each point (N,) is of, -1 for none, and how many there are."""
    tree = KDTree(points[stands])
    gap = 4 * float(np.median(tree.query(points[stands], k=6)[0][:, -1]))
    gap = min(max(gap, _APART[0] * distance), _APART[1] * distance)
    pairs = tree.query_pairs(gap, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(tree.n, tree.n))
    count, label = connected_components(graph, directed=False)
    thing = np.full(len(points), -1, dtype=np.int64)
    thing[stands] = label
    return thing, int(count)


def _picked(pick: Pick, points: Float64Array, thing: Int64Array) -> int:
    """The thing that a photo shows nearest to a pixel."""
    camera = pick.view.camera
    shown = pick.view.seen[thing[pick.view.seen] >= 0]
    gaps = np.linalg.norm(camera.project(points[shown])[0] - pick.pixel, axis=1)
    limit = _PICKED * max(camera.width, camera.height)
    if not len(gaps) or not gaps.min() < limit:
        raise InputError(f"{pick.name}: the photo shows no point of a thing within {limit:.0f} px of this pixel")
    return int(thing[shown[int(gaps.argmin())]])


def _feet(own: Float64Array, height: Float64Array, support: SupportSurface) -> Float64Array:
    """Where the lowest points stand; all, if few are low. Points as low as the support cannot be told from it."""
    low = own[height < _LOW * height.max()]
    feet = (low if len(low) >= 5 else own).copy()
    feet[:, 2] = support.under(feet)
    return feet
