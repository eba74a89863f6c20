"""Estimation of lamps from the shadows on a level surface in photographs.

The radiance of a matt surface is its reflectance times the irradiance. The reflectance is unknown, but prints and grain
do not depend on lamp positions, while shadows do. Candidate lamps in all directions, with the shadows of the things on
the surface, are compared with the observed brightness. The lamp that explains most is refined. Further lamps are added
while they explain enough. The rest is ambient light, reduced by ambient occlusion. Slow variations over the surface are
ignored, because reflectance can have them too. The colour of the total light is also unknown and is taken as white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.stats import qmc

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.capture.lighting.lamps import rectangle_axes
from mitsplat.images.colour import LUMINANCE

_DISTANCES = (1.0, 1.5, 2.2, 3.3)
"""Distances of candidate lamps from the centre [m]."""
_AZIMUTH_STEP, _ELEVATION_STEP = 10.0, 8.0
"""Azimuth and elevation steps between candidates [degrees]."""
_MIN_ELEVATION = 14.0
"""Elevation of the lowest candidates [degrees]."""
_MIN_DISTANCE, _MAX_DISTANCE = 0.8, 4.0
"""Range of the distances of lamps [m]."""
_MIN_SINE = np.sin(np.radians(10.0))
_SIZES = (0.1, 0.2, 0.4, 0.8)
"""Candidate edges of lamps [m]."""
_LAMP_SAMPLES = 8
"""Sample points of a lamp with soft shadows."""
_DIRECTION_STEPS = (6.0, 3.0, 1.5)
"""Step sizes of the refinement of a lamp's direction [degrees]."""
_FULL_WEIGHT_RESIDUAL = 0.1
"""Largest residual of the logarithm of brightness with full weight."""
_MIN_GAIN = 0.025
"""Least relative reduction of the residual by a further lamp."""
_MAX_LAMPS = 3
_MIN_CELLS, _MAX_CELLS = 300, 1500
"""Least and largest number of cells in the estimation."""
_SCAN_CELLS = 800
"""Largest number of cells in the search over candidates."""
_RAY_BLOCK = 16
"""Number of steps along shadow rays that are tested together."""
_MIN_AMBIENT = 0.02
"""Least share of ambient light."""
_MIN_LAMP_SHARE = 0.08
"""Least share of the light for a lamp."""
_SKY_DIRECTIONS = 256
"""Number of directions of ambient light."""


@dataclass(frozen=True, eq=False)
class ShadingLamp:
    """A lamp estimated from shading.

    Attributes:
        position: Position of its centre, shape (3,) [m].
        size: Edge of the lamp [m].
        irradiance: Irradiance (linear RGB) at the centre of the surface; the total of all light is 1 on average, shape
            (3,).
    """

    position: Float64Array
    size: float
    irradiance: Float64Array


@dataclass(frozen=True, eq=False)
class ShadingLight:
    """Light on a surface.

    Attributes:
        lamps: Lamps, the strongest first.
        ambient: Ambient irradiance without occlusion, linear RGB.
    """

    lamps: tuple[ShadingLamp, ...]
    ambient: Float64Array

    @property
    def ambient_share(self) -> float:
        """Share of ambient light at the centre."""
        total = self.ambient + sum((lamp.irradiance for lamp in self.lamps), np.zeros(3))
        return float((self.ambient @ LUMINANCE) / (total @ LUMINANCE))


def light_of_shading(
    colours: Float64Array, heights: Float64Array, open_to_view: BoolArray, cell: float
) -> ShadingLight | None:
    """Estimate the lamps that explain the brightness of the cells of a level surface.

    Args:
        colours: Observed linear RGB of each cell, first axis x, shape (X, Y, 3).
        heights: Height of the thing on each cell, 0 without one, shape (X, Y) [m].
        open_to_view: True for cells whose colour is that of the bare surface, shape (X, Y).
        cell: Edge of a cell [m].

    Returns:
        Lamps relative to the centre of the cells, or None if shading does not determine any.
    """
    surface = _Surface(colours, heights, open_to_view, cell, _MAX_CELLS)
    if surface.too_few:
        return None
    lamps = list[tuple[Float64Array, float]]()
    columns = [surface.sky_irradiance()]
    left, _ = surface.fit(columns)
    scan = _Surface(colours, heights, open_to_view, cell, _SCAN_CELLS)
    candidates = [distance * way for distance in _DISTANCES for way in _candidate_directions()]
    shades = [scan.lamp_irradiance(place, 0.0) for place in candidates]
    while len(lamps) < _MAX_LAMPS:
        known = [scan.sky_irradiance(), *(scan.lamp_irradiance(*lamp) for lamp in lamps)]
        tried = [scan.fit([*known, shade])[0] for shade in shades]
        place, size = surface.refine_lamp(columns, candidates[int(np.argmin(tried))])
        column = surface.lamp_irradiance(place, size)
        now, weights = surface.fit([*columns, column])
        if now > (1 - _MIN_GAIN) * left or weights[-1] < _MIN_LAMP_SHARE * weights.sum():
            break
        lamps.append((place, size))
        columns.append(column)
        for k in range(len(lamps) - 1):  # refine the earlier lamps, which were estimated without this one
            others = columns[: k + 1] + columns[k + 2 :]
            lamps[k] = surface.refine_lamp(others, *lamps[k])
            columns[k + 1] = surface.lamp_irradiance(*lamps[k])
        left, _ = surface.fit(columns)
    if not lamps:
        return None
    _, weights = surface.fit(columns)
    weights[0] = max(weights[0], _MIN_AMBIENT * weights.sum())
    tinted = np.array([surface.fit(columns, channel / channel.mean())[1][1:] for channel in surface.colours.T])
    tinted *= weights[1:].sum() / np.maximum(tinted.sum(axis=1, keepdims=True), 1e-9) / weights.sum()
    order = np.argsort(-weights[1:])
    return ShadingLight(
        tuple(ShadingLamp(lamps[k][0], lamps[k][1], tinted[:, k]) for k in order),
        np.full(3, weights[0] / weights.sum()),
    )


def _candidate_directions() -> list[Float64Array]:
    """Return the directions of candidates from the centre, shape (3,) each."""
    return [
        np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        for rise in np.radians(np.arange(_MIN_ELEVATION, 90, _ELEVATION_STEP))
        for turn in np.linspace(0, 2 * np.pi, max(1, round(360 / _AZIMUTH_STEP * np.cos(rise))), endpoint=False)
    ]


class _Surface:
    """Cells of a level surface, their brightness, and their irradiance from candidate lamps."""

    def __init__(
        self, colours: Float64Array, heights: Float64Array, open_to_view: BoolArray, cell: float, most: int
    ) -> None:
        chosen = np.argwhere(open_to_view & (heights <= 0))
        self.too_few = len(chosen) < _MIN_CELLS
        if len(chosen) > most:
            chosen = chosen[np.random.default_rng(0).choice(len(chosen), most, replace=False)]
        self.colours = colours[tuple(chosen.T)]
        self._cells, self._heights, self._cell = chosen, heights, cell
        middle = (np.array(heights.shape) - 1) / 2
        self.places = np.column_stack([(chosen - middle) * cell, np.zeros(len(chosen))])
        seen = self.colours @ LUMINANCE
        self.seen = seen / max(float(seen.mean()), 1e-9)
        x, y = (self.places / (cell * max(heights.shape)))[:, :2].T
        self._smooth = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)

    def _unoccluded(self, ways: Float64Array) -> BoolArray:
        """Return True for cells (N,) whose upward ray in direction (N, 3) or (3,) is not occluded."""
        ways = np.broadcast_to(ways, self.places.shape)
        flat = np.maximum(np.linalg.norm(ways[:, :2], axis=1), 1e-9)
        rise, (ahead, aside), (x, y) = ways[:, 2] / flat * self._cell, ways[:, :2].T / flat, self._cells.T
        free, rows = np.ones(len(ways), dtype=bool), np.arange(len(ways))
        (width, depth), tall = self._heights.shape, float(self._heights.max())
        around = np.pad(self._heights, 1)  # no occluders outside the cells
        for first in range(1, int(np.hypot(width, depth)) + 1, _RAY_BLOCK):
            number = np.arange(first, first + _RAY_BLOCK)[:, None]
            at = [
                np.rint(start + number * step).clip(-1, most).astype(np.int64) + 1
                for start, step, most in ((x, ahead, width), (y, aside, depth))
            ]
            met = ((around[at[0], at[1]] > (number - 0.5) * rise) & (number * rise < tall)).any(axis=0)
            free[rows[met]] = False
            left = ~met & (number[-1] * rise < tall)
            if not left.any():
                break
            rows, rise, ahead, aside, x, y = (values[left] for values in (rows, rise, ahead, aside, x, y))
        return free

    def fit(self, columns: Sequence[Float64Array], seen: Float64Array | None = None) -> tuple[float, Float64Array]:
        """Fit the brightness by columns of irradiance; return the mean absolute log residual and the weights.

        Least absolute deviations by iteratively reweighted least squares; slow variations over the surface are fitted
        and ignored.
        """
        seen, matrix = self.seen if seen is None else seen, np.column_stack(columns)
        weights, share, smooth = np.zeros(len(columns)), np.ones(len(seen)), np.zeros(len(seen))
        for _ in range(3):  # errors are relative to the light, because reflectances are factors
            weights, _ = nnls(matrix * share[:, None], seen * np.exp(-smooth) * share)
            light = np.maximum(matrix @ weights, 0.02)
            ratio = np.log(np.maximum(seen, 1e-3) / light)
            counted = 1 / np.sqrt(np.maximum(np.abs(ratio - smooth), _FULL_WEIGHT_RESIDUAL))
            smooth = self._smooth @ np.linalg.lstsq(self._smooth * counted[:, None], ratio * counted, rcond=None)[0]
            share = counted / light
        return float(np.mean(np.abs(ratio - smooth))), weights

    def sky_irradiance(self) -> Float64Array:
        """Return the ambient irradiance of the cells, 1 without occlusion."""
        points = qmc.Sobol(2, seed=0).random(_SKY_DIRECTIONS)
        radius, turn = np.sqrt(points[:, 0]), 2 * np.pi * points[:, 1]
        ways = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - points[:, 0])], axis=1)
        seen = np.zeros(len(self.places))
        for way in ways:
            seen += self._unoccluded(way)
        return seen / _SKY_DIRECTIONS

    def lamp_irradiance(self, place: Float64Array, size: float) -> Float64Array:
        """Return the irradiance of the cells from a lamp that faces the centre, 1 at an unoccluded centre."""
        points = place + self._spread(place, size)
        light = np.zeros(len(self.places))
        for point in points:
            towards = point - self.places
            away = np.linalg.norm(towards, axis=1)
            facing = (towards @ place) / (away * np.linalg.norm(place))
            light += self._unoccluded(towards) * facing.clip(0) * towards[:, 2].clip(0) / away**3
        cosine = place[2] / np.linalg.norm(place)
        return np.asarray(light / len(points) * (place @ place) / cosine)

    @staticmethod
    def _spread(place: Float64Array, size: float) -> Float64Array:
        """Return sample points of a square that faces the centre of the surface, relative to its own centre, (P, 3)."""
        if size == 0:
            return np.zeros((1, 3))
        flat = size * (qmc.Sobol(2, seed=1).random(_LAMP_SAMPLES) - 0.5)
        return np.asarray(flat @ rectangle_axes(place / np.linalg.norm(place)))

    def refine_lamp(
        self, columns: Sequence[Float64Array], place: Float64Array, size: float = _SIZES[1]
    ) -> tuple[Float64Array, float]:
        """Refine position and size of a lamp so that it explains most in addition to the given columns."""
        best, _ = self.fit([*columns, self.lamp_irradiance(place, size)])
        for step in _DIRECTION_STEPS:
            for _ in range(6):
                moved = [(self._rotated(place, step, turn), size) for turn in np.radians(np.arange(0, 360, 60))]
                moved += [(place * (1 + sign * step / 30), size) for sign in (-1, 1)]
                moved += [(place, other) for other in _SIZES if other != size]
                moved = [one for one in moved if self._is_allowed(one[0])]
                tried = [self.fit([*columns, self.lamp_irradiance(*one)])[0] for one in moved]
                if min(tried) >= best:
                    break
                best, (place, size) = min(tried), moved[int(np.argmin(tried))]
        return place, size

    @staticmethod
    def _is_allowed(place: Float64Array) -> bool:
        away = float(np.linalg.norm(place))
        return _MIN_DISTANCE <= away <= _MAX_DISTANCE and place[2] > _MIN_SINE * away

    @staticmethod
    def _rotated(place: Float64Array, step: float, turn: float) -> Float64Array:
        """Rotate a position about the centre by ``step`` degrees, in the tangential direction ``turn`` [rad]."""
        way = place / np.linalg.norm(place)
        across = np.cross(way, [0.0, 0.0, 1.0] if abs(way[2]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        side = np.cos(turn) * across + np.sin(turn) * np.cross(way, across)
        angle = np.radians(step)
        return np.asarray(np.linalg.norm(place) * (np.cos(angle) * way + np.sin(angle) * side))
