"""Isolation of one object from the splats of a whole scene.

The projection of masks is that of the published method: a Gaussian belongs to the object if its visible part in the
photographs falls inside their masks. The visible part is its blending weight, ``sum over pixels of T a``, so hidden
Gaussians do not count in a view. Needles and floaters, which masks cannot separate from the object, are removed
afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from mitsplat.capture.capture import known_where
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.progress import Progress
from mitsplat.quality import Quality
from mitsplat.renderer.differentiation.backward import pack_cloud, render_differentiable
from mitsplat.renderer.layers import make_sensor, render_splats
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.runtime.variant import ensure_variant

MIN_INSIDE_SHARE = 0.5
"""Least share of a Gaussian's visible weight inside the masks."""
MIN_VISIBLE_WEIGHT = 0.05
"""Visible weight over all views [px] below which a Gaussian counts as unseen."""
NEEDLE_RATIO = 8.0
"""Least ratio of the longest to the second longest standard deviation of a needle."""
NEEDLE_LENGTH = 0.1
"""Least length of a visible needle, as a share of the asset's size."""
NEEDLE_TIP = 2.0
"""Distance of a needle's tips from its centre [standard deviations]; tips must not stick out of the masks."""
TIP_MARGIN = 1.5
"""Largest distance of a tip from a mask [px]."""
TOUCH_SIGMAS = 2.5
"""Largest distance of touching Gaussians, in standard deviations of the larger one."""
MIN_PART_SHARE = 0.02
"""Share of the object's visible weight below which an isolated part is a floater."""

_QUALITY = Quality(alpha_min=2e-3, transmittance_min=1e-3, sh_degree=0)
_NEIGHBOURS = 12
_MOST_NEIGHBOURS = 12 * 4**3
"""Largest number of neighbours per Gaussian in a candidate floater."""


@dataclass(frozen=True, eq=False)
class MaskedView:
    """A camera and the mask of the object in its picture.

    Attributes:
        camera: The camera.
        mask: Share of each pixel that the object covers, (H, W) in [0, 1].
        hidden: Share of each pixel where another object may hide the object, (H, W) in [0, 1]; None if nowhere.

    Raises:
        ValueError: If the mask does not have the camera's size.
    """

    camera: Camera
    mask: Float32Array
    hidden: Float32Array | None = None

    def __post_init__(self) -> None:
        """Check the shape of the mask."""
        if self.mask.shape != (self.camera.height, self.camera.width):
            raise ValueError(f"a mask must have its camera's size, {self.camera.height} x {self.camera.width} px")

    @property
    def possible(self) -> Float32Array:
        """Share of each pixel that the object may cover, (H, W)."""
        return self.mask if self.hidden is None else np.maximum(self.mask, (self.hidden > 0).astype(np.float32))

    @property
    def known(self) -> BoolArray:
        """True where the mask is certain, because nothing may hide the object, (H, W)."""
        return known_where(self.hidden, self.camera)


@dataclass(frozen=True, eq=False)
class Isolation:
    """An object's splats and the counts of removed Gaussians.

    Attributes:
        splats: Splats of the object.
        kept: True for Gaussians of the object, shape (N,).
        unseen: Number of Gaussians that no view shows.
        outside: Number of Gaussians seen mostly outside the masks.
        needles: Number of elongated Gaussians whose tips stick out of the masks.
        floaters: Number of Gaussians in isolated parts.
        lost: Share of the alpha inside the masks that was lost by the removal.
    """

    splats: Splats
    kept: BoolArray
    unseen: int
    outside: int
    needles: int
    floaters: int
    lost: float


def isolate_object(splats: Splats, views: Sequence[MaskedView], *, progress: Progress | None = None) -> Isolation:
    """Return the Gaussians of the masked object.

    Args:
        splats: Object and surroundings.
        views: Views from all sides of the object.
        progress: Called after each view.

    Raises:
        InputError: If there are no views, or no Gaussian is left.
    """
    if not views:
        raise InputError("isolation of an object needs views with masks (got none)")
    visible_weights = VisibleWeights(splats)
    weights = np.zeros((len(splats), 2))
    for done, view in enumerate(views, 1):
        weights += visible_weights(view)
        if progress is not None:
            progress(done, len(views), "isolating the object")
    total = weights.sum(axis=1)
    seen = total > MIN_VISIBLE_WEIGHT
    inside = seen & (weights[:, 0] >= MIN_INSIDE_SHARE * total)
    needles = inside & _needles(splats, views)
    body = np.flatnonzero(inside & ~needles)
    floating = body[find_floaters(splats.select(body), weights[body, 0])]
    kept = inside & ~needles
    kept[floating] = False
    if not kept.any():
        raise InputError("no Gaussian lies inside the masks: do the masks belong to this capture?")
    isolated = splats.select(kept)
    return Isolation(
        splats=isolated,
        kept=kept,
        unseen=int((~seen).sum()),
        outside=int((seen & ~inside).sum()),
        needles=int(needles.sum()),
        floaters=len(floating),
        lost=_lost_alpha_share(splats, isolated, views),
    )


class VisibleWeights:
    """Blending weights of a cloud's Gaussians in views; the cloud is uploaded once.

    The picture is linear in the colours. The derivative of ``sum of mask * red`` with respect to the red of a Gaussian
    is therefore its weight ``T a`` summed over the mask. Green gives the weight outside the mask.
    """

    def __init__(self, splats: Splats) -> None:
        ensure_variant()
        fields = (splats.means, splats.quats, splats.scales, splats.opacities)
        self._count = len(splats)
        self._inputs = [mi.Float(np.ravel(values)) for values in fields]

    def __call__(self, view: MaskedView) -> Float64Array:
        """Return the weights inside and outside the mask, where it is known, shape (N, 2) [px]."""
        colours = dr.zeros(mi.Float, 3 * self._count)
        dr.enable_grad(colours)
        means, quats, scales, opacities = self._inputs
        cloud = pack_cloud(means, quats, scales, opacities, colours, 1)
        rgb, _ = render_differentiable(cloud, view_of(make_sensor(view.camera)), _QUALITY)
        inside, outside = np.where(view.known, view.mask, 0), np.where(view.known, 1 - view.mask, 0)
        own, other = (mi.Float(np.ravel(part).astype(np.float32)) for part in (inside, outside))
        dr.backward(dr.sum(rgb[0] * own) + dr.sum(rgb[1] * other))
        return np.array(dr.grad(colours), dtype=np.float64).reshape(-1, 3)[:, :2] / SH_C0


def _needles(splats: Splats, views: Sequence[MaskedView]) -> BoolArray:
    """Return True for elongated Gaussians with a tip outside the mask in more than one view."""
    ordered = np.sort(splats.scales.astype(np.float64), axis=1)
    needle = np.flatnonzero(ordered[:, 2] > NEEDLE_RATIO * ordered[:, 1])
    result = np.zeros(len(splats), dtype=bool)
    if not len(needle):
        return result
    axis = np.argmax(splats.scales[needle], axis=1)
    frames = Rotation.from_quat(splats.quats[needle]).as_matrix()
    reach = frames[np.arange(len(needle)), :, axis] * (NEEDLE_TIP * ordered[needle, 2])[:, None]
    tips = np.concatenate([splats.means[needle] + reach, splats.means[needle] - reach])
    outside: Int64Array = np.zeros(len(tips), dtype=np.int64)
    for view in views:
        away = cv2.distanceTransform((view.possible < 0.5).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        outside += view.camera.sample(away, tips, missing=0.0) > TIP_MARGIN
    result[needle] = (outside.reshape(2, -1) > 1).any(axis=0)
    return result


def long_needles(splats: Splats, size: float) -> BoolArray:
    """Return True for elongated Gaussians (N,) that are long relative to the ``size`` of their asset [m]."""
    ordered = np.sort(splats.scales, axis=1)
    return np.asarray((ordered[:, 2] > NEEDLE_RATIO * ordered[:, 1]) & (ordered[:, 2] > NEEDLE_LENGTH * size))


def visible_area(splats: Splats) -> Float64Array:
    """Return the largest projected area of each Gaussian times its opacity, up to a constant factor, shape (N,)."""
    ordered = np.sort(splats.scales, axis=1).astype(np.float64)
    return np.asarray(splats.opacities * ordered[:, 1] * ordered[:, 2])


def find_floaters(splats: Splats, weight: Float64Array) -> Int64Array:
    """Return the indices of Gaussians in isolated groups with a small share of the visible weight (N,).

    The number of neighbours grows as necessary. A fit with MCMC puts many Gaussians at one place, so the nearest
    neighbours may all lie at that place.
    """
    count = len(splats)
    if count < 2:
        return np.zeros(0, dtype=np.int64)
    sigma = splats.scales.max(axis=1).astype(np.float64)
    tree = KDTree(splats.means)
    floating, neighbours = np.arange(count), _NEIGHBOURS
    graph = coo_array((count, count)).tocsr()
    while True:
        distance, other = tree.query(splats.means[floating], k=min(neighbours + 1, count))
        touching = distance <= TOUCH_SIGMAS * np.maximum(sigma[floating, None], sigma[other])
        row = np.broadcast_to(floating[:, None], other.shape)[touching]
        graph = graph + coo_array((np.ones(len(row)), (row, other[touching])), shape=(count, count)).tocsr()
        _, group = connected_components(graph, directed=False)
        share = np.bincount(group, weights=weight) / max(float(weight.sum()), 1e-30)
        floating = np.flatnonzero(share[group] < MIN_PART_SHARE)
        if not len(floating) or neighbours >= min(_MOST_NEIGHBOURS, count):
            return floating
        neighbours *= 4


def _lost_alpha_share(before: Splats, after: Splats, views: Sequence[MaskedView]) -> float:
    """Return the share of the alpha inside the masks that is missing after the removal."""
    shown = missing = 0.0
    alphas = [render_splats(before, view.camera, quality="fast").alpha for view in views]
    for view, alpha in zip(views, alphas, strict=True):
        left = render_splats(after, view.camera, quality="fast").alpha
        shown += float((view.mask * alpha).sum())
        missing += float((view.mask * np.maximum(alpha - left, 0)).sum())
    return missing / max(shown, 1e-30)
