"""Extraction of lamps from a panorama, as rectangles that send the same light.

A pixel belongs to a lamp if its luminance exceeds ``CONTRAST`` times the mean of all other pixels, weighted by solid
angle. The rule is repeated until nothing changes. So a cloudy sky or a bright wall has no lamps. A lamp and a window
beside it, with very different radiances, are both found; a single threshold between two classes (Otsu 1979) finds only
the brighter one. Median cut (Debevec 2005) and variance cut (Viriyothai and Debevec 2009) place points by energy and
give no sizes.

Pixels are grouped by their distance on the sphere, so that the seam and the poles of the panorama have no effect.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mitsplat.arrays import BoolArray, Float32Array, Float64Array
from mitsplat.capture.lighting.panorama import (
    angles,
    directions,
    level_irradiance,
    level_weights,
    resized,
    solid_angles,
)
from mitsplat.geometry.clusters import cluster_points
from mitsplat.images.colour import LUMINANCE

CONTRAST = 4.0
"""Minimum luminance of a lamp relative to the mean of the rest; walls and ceilings of a room with one lamp reach 3."""
LEAST_SHARE = 0.02
"""Minimum fraction of the irradiance that a lamp must contribute."""
_SEARCH_WIDTH = 360
"""Width of the panorama in which lamps are searched [px]."""
_GAP = 3.0
"""Maximum distance between bright pixels of one lamp [degrees]."""
_RING = 4.0
"""Width of the ring around a lamp whose mean radiance replaces the lamp [degrees]."""
_MAX_HALF_ANGLE = 60.0
"""Maximum angle between the centre and any point of a lamp [degrees]; larger bright regions are sky."""
_GRID = 64
"""Points along an edge of a rectangle for the integration of its light."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """Rectangular lamp that faces the origin of the panorama, with its width horizontal.

    Attributes:
        direction: Unit vector to its centre, shape (3,).
        extents: Width and height divided by its distance.
        radiance: Linear RGB in excess of the surroundings, which remain in the panorama [W/(m^2 sr)].
        irradiance: Irradiance of a horizontal plane by the lamp, linear RGB [W/m^2], shape (3,).
        pixels: Pixels of the lamp in the panorama, (H, W).
    """

    direction: Float64Array
    extents: tuple[float, float]
    radiance: Float64Array
    irradiance: Float64Array
    pixels: BoolArray

    @property
    def angles(self) -> tuple[float, float]:
        """Azimuth and elevation of the centre [degrees]."""
        return angles(self.direction)

    @property
    def luminance(self) -> float:
        """Luminance of the radiance [W/(m^2 sr)]."""
        return float(self.radiance @ LUMINANCE)

    @property
    def colour(self) -> Float64Array:
        """Linear RGB, scaled to luminance 1, shape (3,)."""
        return self.radiance / self.luminance

    @property
    def angular_size(self) -> tuple[float, float]:
        """Width and height [degrees]."""
        width, height = np.degrees(2 * np.arctan(np.array(self.extents) / 2)).tolist()
        return width, height


def take_lamps(panorama: Float32Array, *, rotate_z: float, most: int) -> tuple[list[Lamp], Float32Array]:
    """Extract the lamps of a panorama and replace them by the radiance of their surroundings.

    Lamps and the remaining panorama together give a horizontal plane the same irradiance as the panorama.

    Args:
        panorama: Radiance, (H, W, 3).
        rotate_z: Rotation of the panorama about the vertical [degrees].
        most: Maximum number of lamps.

    Returns:
        Lamps by decreasing irradiance, and the remaining panorama.
    """
    height, width = panorama.shape[:2]
    shape = (min(height, _SEARCH_WIDTH // 2), min(width, _SEARCH_WIDTH))
    coarse = resized(panorama, *shape)
    sight = directions(*shape)  # only distances between pixels count
    bright = _lamp_pixels(coarse)
    groups = cluster_points(sight[bright], 2 * np.sin(np.radians(_GAP) / 2))
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
        # Limited to the mean of the lamp in each channel, so that its radiance does not become negative.
        around = np.minimum(_ring_radiance(coarse, sight, own, bright), arrives / weight.sum())
        lamp = _fit_rectangle(panorama[pixels], everywhere[pixels], pixels, arrives - weight.sum() * around)
        if lamp is not None:
            found.append((lamp, around))
    found.sort(key=lambda lamp: -float(lamp[0].irradiance @ LUMINANCE))
    rest = panorama.copy()
    for lamp, around in found[:most]:
        rest[lamp.pixels] = around
    return [lamp for lamp, _ in found[:most]], rest


def _lamp_pixels(panorama: Float32Array) -> BoolArray:
    """Return the pixels that belong to lamps, (H, W)."""
    luminance = panorama @ LUMINANCE
    weights = np.broadcast_to(solid_angles(*luminance.shape), luminance.shape)
    bright = np.zeros(luminance.shape, bool)
    while True:  # terminates, because the mean of the rest never increases
        brighter = luminance > CONTRAST * np.average(luminance[~bright], weights=weights[~bright])
        if (brighter == bright).all():
            return bright
        bright = brighter


def _ring_radiance(panorama: Float32Array, sight: Float32Array, own: BoolArray, bright: BoolArray) -> Float64Array:
    """Return the mean radiance (3,) of a ring around a lamp, without other lamps.

    If the ring has no such pixels, the mean of all pixels without lamps is returned.
    """
    reach = 2 * np.sin(np.radians(_RING) / 2)
    near = np.isfinite(cKDTree(sight[own]).query(sight[~bright], distance_upper_bound=reach)[0])
    weights = np.broadcast_to(solid_angles(*own.shape), own.shape)[~bright]
    chosen = near if near.any() else np.ones_like(near)
    return np.asarray(np.average(panorama[~bright][chosen], axis=0, weights=weights[chosen]))


def _fit_rectangle(
    radiance: Float32Array, sight: Float32Array, pixels: BoolArray, irradiance: Float64Array
) -> Lamp | None:
    """Fit a lamp to pixels; None if they extend too far or their centre is below the horizon.

    The centre of the lamp is the centroid of its light. The area and the aspect ratio are those of its core, projected
    to the plane perpendicular to the centre; the aspect ratio is from second moments. The core has at least half of the
    mean radiance, weighted by light, because images are blurred.
    """
    luminance = radiance @ LUMINANCE
    solid = np.broadcast_to(solid_angles(*pixels.shape), pixels.shape)[pixels]
    light = luminance * solid
    middle = light @ sight
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    core = luminance >= 0.5 * (light @ luminance) / light.sum()
    depth = (sight @ middle)[core]
    if depth.min() < np.cos(np.radians(_MAX_HALF_ANGLE)) or middle[2] <= 0:
        return None
    axes = rectangle_axes(middle)
    area = solid[core] / depth**3
    plane = (sight[core] @ axes.T) / depth[:, None]
    spread = plane - np.average(plane, axis=0, weights=area)
    moments = np.average(spread**2, axis=0, weights=area) + np.average(area, weights=area) / 12  # of one pixel
    ratio, whole = np.sqrt(moments[0] / moments[1]), float(area.sum())
    extents = float(np.sqrt(whole * ratio)), float(np.sqrt(whole / ratio))
    return Lamp(middle, extents, irradiance / rectangle_irradiance(middle, extents), irradiance, pixels)


def rectangle_axes(direction: Float64Array) -> Float64Array:
    """Return the unit vectors (2, 3) along width and height of an area light in this direction from its target.

    They equal those of :func:`mitsplat.renderer.scene_emitters.emitter_dict` up to signs.
    """
    level = np.hypot(direction[0], direction[1]) <= 1e-6
    across = np.cross((0.0, 1.0, 0.0) if level else (0.0, 0.0, 1.0), direction)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(direction, across)])


def rectangle_irradiance(direction: Float64Array, extents: tuple[float, float]) -> float:
    """Compute the irradiance of a horizontal plane by a rectangle of radiance 1 that faces the origin.

    Only the part of the rectangle above the horizon counts. It integrates ``cos(lamp) cos(plane) / r^2`` over the area
    at distance 1 by the midpoint rule.

    Args:
        direction: Unit vector to the centre of the rectangle, shape (3,).
        extents: Width and height divided by the distance.
    """
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    across, up = rectangle_axes(direction)
    points = direction + extents[0] * steps[:, None, None] * across + extents[1] * steps[None, :, None] * up
    squared = (points**2).sum(axis=-1)
    return float((np.maximum(points[..., 2], 0.0) / squared**2).mean() * extents[0] * extents[1])
