"""The lamps of a panorama, as rectangles that send the same light, and the panorama without them.

What is a lamp is decided against the rest, as outliers are by clipping at a multiple of the mean: a pixel belongs to
one if its luminance is more than ``CONTRAST`` times the mean over the solid angle of all that belong to none, which is
repeated until nothing changes. A cloudy sky or a bright wall has no lamps; a lamp and a window beside it, which differ
by far in radiance, are both found, where one threshold between two classes (Otsu 1979) finds the brighter one. Median
cut (Debevec 2005) and variance cut (Viriyothai and Debevec 2009) place points by energy and know nothing of sizes.

Pixels are grouped by their distance on the sphere, to which the panorama's seam and poles are nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from mitsplat.capture.lighting.panorama import (
    angles,
    directions,
    level_irradiance,
    level_weights,
    resized,
    solid_angles,
)
from mitsplat.images.colour import LUMINANCE

CONTRAST = 4.0
"""Luminance of a lamp over the mean of the rest. In a room of one lamp, walls and ceilings come up to 3."""
LEAST_SHARE = 0.02
"""Share of the irradiance below which a bright place is none of the lamps."""
_WIDTH = 360
"""Of the panorama that lamps are looked for in [px]."""
_GAP = 3.0
"""Bright pixels that are nearer to each other are one lamp [degrees]."""
_RING = 4.0
"""Width of the surroundings that take a lamp's place [degrees]."""
_WIDEST = 60.0
"""Angle from its middle up to which a bright place is a lamp, and not half of the sky [degrees]."""
_GRID = 64
"""Points along an edge of a rectangle by which its light is integrated."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """A rectangle that faces the panorama's origin, its width level.

    Attributes:
        direction: Unit vector to its middle.
        extents: Width and height over its distance.
        radiance: Linear RGB, beyond that of its surroundings, which stay behind it [W/(m^2 sr)].
        irradiance: Linear RGB, of a horizontal plane by it [W/m^2].
        pixels: Where it is in the panorama, (H, W).
    """

    direction: Float64Array
    extents: tuple[float, float]
    radiance: Float64Array
    irradiance: Float64Array
    pixels: BoolArray

    @property
    def angles(self) -> tuple[float, float]:
        """Azimuth and elevation of its middle [degrees]."""
        return angles(self.direction)

    @property
    def luminance(self) -> float:
        """Of its radiance [W/(m^2 sr)]."""
        return float(self.radiance @ LUMINANCE)

    @property
    def colour(self) -> Float64Array:
        """Linear RGB of luminance 1."""
        return self.radiance / self.luminance

    @property
    def angular_size(self) -> tuple[float, float]:
        """Width and height [degrees]."""
        width, height = np.degrees(2 * np.arctan(np.array(self.extents) / 2)).tolist()
        return width, height


def take_lamps(panorama: Float32Array, *, rotate_z: float = 0.0, most: int = 6) -> tuple[list[Lamp], Float32Array]:
    """Lamps by falling share of the irradiance, and the panorama with their surroundings in their place.

    The horizontal irradiance of both together is that of the panorama.

    Args:
        panorama: Radiance, (H, W, 3).
        rotate_z: Its turn about the vertical [degrees].
        most: Most lamps that are taken out.
    """
    height, width = panorama.shape[:2]
    shape = (min(height, _WIDTH // 2), min(width, _WIDTH))
    coarse = resized(panorama, *shape)
    sight = directions(*shape, rotate_z)
    bright = _bright(coarse)
    groups = _grouped(sight[bright])
    everywhere, weights = directions(height, width, rotate_z), level_weights(height, width)
    total = level_irradiance(panorama) @ LUMINANCE
    found: list[tuple[Lamp, Float64Array]] = []
    for group in range(groups.max(initial=-1) + 1):
        own = np.zeros(shape, bool)
        own[bright] = groups == group
        pixels = np.asarray(cv2.resize(own.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)
        weight = np.broadcast_to(weights, pixels.shape)[pixels][:, None]
        arrives = (weight * panorama[pixels]).sum(axis=0)
        if arrives @ LUMINANCE < LEAST_SHARE * total:
            continue
        # In no channel more than the lamp itself has, so that nothing negative is left of it.
        around = np.minimum(_surroundings(coarse, sight, own, bright), arrives / weight.sum())
        lamp = _rectangle(panorama[pixels], everywhere[pixels], pixels, arrives - weight.sum() * around)
        if lamp is not None:
            found.append((lamp, around))
    found.sort(key=lambda lamp: -float(lamp[0].irradiance @ LUMINANCE))
    rest = panorama.copy()
    for lamp, around in found[:most]:
        rest[lamp.pixels] = around
    return [lamp for lamp, _ in found[:most]], rest


def _bright(panorama: Float32Array) -> BoolArray:
    """Pixels that belong to lamps, (H, W)."""
    luminance = panorama @ LUMINANCE
    weights = np.broadcast_to(solid_angles(*luminance.shape), luminance.shape)
    bright = np.zeros(luminance.shape, bool)
    while True:  # lamps only grow: each round's mean of the rest is below the last one's
        brighter = luminance > CONTRAST * np.average(luminance[~bright], weights=weights[~bright])
        if (brighter == bright).all():
            return bright
        bright = brighter


def _grouped(points: Float32Array) -> Int32Array:
    """Number of the group of each unit vector (N,): what is linked by steps of less than ``_GAP``."""
    pairs = cKDTree(points).query_pairs(2 * np.sin(np.radians(_GAP) / 2), output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(points), len(points)))
    return np.asarray(connected_components(graph, directed=False)[1])


def _surroundings(panorama: Float32Array, sight: Float32Array, own: BoolArray, bright: BoolArray) -> Float64Array:
    """Mean radiance (3,) of a ring around a lamp, without other lamps; of all that is none where there is no ring."""
    reach = 2 * np.sin(np.radians(_RING) / 2)
    near = np.isfinite(cKDTree(sight[own]).query(sight[~bright], distance_upper_bound=reach)[0])
    weights = np.broadcast_to(solid_angles(*own.shape), own.shape)[~bright]
    chosen = near if near.any() else np.ones_like(near)
    return np.asarray(np.average(panorama[~bright][chosen], axis=0, weights=weights[chosen]))


def _rectangle(radiance: Float32Array, sight: Float32Array, pixels: BoolArray, irradiance: Float64Array) -> Lamp | None:
    """The lamp of some pixels, or None if they reach too far around, or are below the horizon by their middle.

    Its middle is that of the light. Its area, in the plane that is perpendicular to that, and the ratio of its sides,
    which is that of second moments, are those of its core: what has half of the mean radiance that its light leaves
    with, as images blur.
    """
    luminance = radiance @ LUMINANCE
    solid = np.broadcast_to(solid_angles(*pixels.shape), pixels.shape)[pixels]
    light = luminance * solid
    middle = light @ sight
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    core = luminance >= 0.5 * (light @ luminance) / light.sum()
    depth = (sight @ middle)[core]
    if depth.min() < np.cos(np.radians(_WIDEST)) or middle[2] <= 0:
        return None
    axes = rectangle_axes(middle)
    area = solid[core] / depth**3
    plane = (sight[core] @ axes.T) / depth[:, None]
    spread = plane - np.average(plane, axis=0, weights=area)
    moments = np.average(spread**2, axis=0, weights=area) + np.average(area, weights=area) / 12  # of pixels themselves
    ratio, whole = np.sqrt(moments[0] / moments[1]), float(area.sum())
    extents = float(np.sqrt(whole * ratio)), float(np.sqrt(whole / ratio))
    return Lamp(middle, extents, irradiance / rectangle_irradiance(middle, extents), irradiance, pixels)


def rectangle_axes(direction: Float64Array) -> Float64Array:
    """Unit vectors (2, 3) along width and height of an area light in this direction from its target.

    Those of :func:`mitsplat.renderer.scene_emitters.emitter_dict`, but for signs.
    """
    level = np.hypot(direction[0], direction[1]) <= 1e-6
    across = np.cross((0.0, 1.0, 0.0) if level else (0.0, 0.0, 1.0), direction)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(direction, across)])


def rectangle_irradiance(direction: Float64Array, extents: tuple[float, float]) -> float:
    """Irradiance of a horizontal plane by a rectangle of radiance 1 that faces it, as far as it is above the horizon.

    The integral of ``cos(lamp) cos(plane) / r^2`` over the area at distance 1, by the midpoint rule.

    Args:
        direction: To its middle.
        extents: Width and height over the distance.
    """
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    across, up = rectangle_axes(direction)
    points = direction + extents[0] * steps[:, None, None] * across + extents[1] * steps[None, :, None] * up
    squared = (points**2).sum(axis=-1)
    return float((np.maximum(points[..., 2], 0.0) / squared**2).mean() * extents[0] * extents[1])
