"""Lamps told by the shadows on a level surface that photographs show.

A matt surface sends to the eye its reflectance times the light that reaches it. The reflectance is unknown, but prints
and grain know nothing of where lamps are, while light ends where something stands in its way. Candidates of lamps all
around, each with the shadows that the things on the surface would throw, are held against what is seen; the one that
explains most is moved to where it explains more, and another is added as long as one explains enough. The rest is light
from all sides, less of it beside what stands there. Slow changes over the surface, as reflectance may have them, too,
say nothing; nor do the colours of light from all sides and of all lamps together, which are taken for white.
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
"""From the middle to candidates [m]."""
_TURN, _RISE = 10.0, 8.0
"""Steps between candidates [degrees]."""
_LOWEST = 14.0
"""Elevation of the lowest candidates [degrees]."""
_NEAREST, _FARTHEST = 0.8, 4.0
"""Distances of lamps [m]."""
_SINE = np.sin(np.radians(10.0))
_SIZES = (0.1, 0.2, 0.4, 0.8)
"""Edges of lamps that are tried [m]."""
_POINTS = 8
"""Of a lamp whose shadows are soft."""
_STEPS = (6.0, 3.0, 1.5)
"""By which a lamp is moved to where it explains more [degrees]."""
_COMMON = 0.1
"""Logarithm of a reflectance within which it counts fully."""
_GAIN = 0.025
"""Share of what is left unexplained by which another lamp must lessen it."""
_MOST = 3
_FEWEST, _CELLS = 300, 1500
"""Cells that shading is told by."""
_SCANNED = 800
"""Of these, by which candidates are looked through."""
_STRIDES = 16
"""Steps of a way from cell to cell that are looked at together."""
_DARKEST = 0.02
"""Share of the light that comes from all sides at least."""
_LEAST = 0.08
"""Share of the light below which a lamp is none."""
_SKY = 256
"""Directions by which light from all sides is told."""


@dataclass(frozen=True, eq=False)
class ShadingLamp:
    """A lamp, as shading tells it.

    Attributes:
        position: Of its middle, shape (3,) [m].
        size: Its edge [m].
        irradiance: Linear RGB that it sends to the middle of the surface, of 1 in all on average, shape (3,).
    """

    position: Float64Array
    size: float
    irradiance: Float64Array


@dataclass(frozen=True, eq=False)
class ShadingLight:
    """What lights a surface.

    Attributes:
        lamps: The strongest first.
        ambient: Irradiance from all sides at an open place, linear RGB.
    """

    lamps: tuple[ShadingLamp, ...]
    ambient: Float64Array

    @property
    def ambient_share(self) -> float:
        """Of the light at the middle."""
        whole = self.ambient + sum((lamp.irradiance for lamp in self.lamps), np.zeros(3))
        return float((self.ambient @ LUMINANCE) / (whole @ LUMINANCE))


def light_of_shading(
    colours: Float64Array, heights: Float64Array, open_to_view: BoolArray, cell: float
) -> ShadingLight | None:
    """The lamps that explain how bright the cells of a level surface are, or None if shading does not tell any.

    Args:
        colours: What is seen of each cell, linear RGB, first axis x, shape (X, Y, 3).
        heights: Of what stands in each, 0 where nothing does, shape (X, Y) [m].
        open_to_view: Cells whose colour is that of the bare surface, shape (X, Y).
        cell: Their edge [m].

    Returns:
        Lamps relative to the middle of the cells.
    """
    surface = _Surface(colours, heights, open_to_view, cell, _CELLS)
    if surface.few:
        return None
    lamps = list[tuple[Float64Array, float]]()
    columns = [surface.sky()]
    left, _ = surface.explain(columns)
    scan = _Surface(colours, heights, open_to_view, cell, _SCANNED)
    candidates = [distance * way for distance in _DISTANCES for way in _ways()]
    shades = [scan.lit(place, 0.0) for place in candidates]
    while len(lamps) < _MOST:
        known = [scan.sky(), *(scan.lit(*lamp) for lamp in lamps)]
        tried = [scan.explain([*known, shade])[0] for shade in shades]
        place, size = surface.improved(columns, candidates[int(np.argmin(tried))])
        column = surface.lit(place, size)
        now, weights = surface.explain([*columns, column])
        if now > (1 - _GAIN) * left or weights[-1] < _LEAST * weights.sum():
            break
        lamps.append((place, size))
        columns.append(column)
        for k in range(len(lamps) - 1):  # those before were told when this one was not known
            others = columns[: k + 1] + columns[k + 2 :]
            lamps[k] = surface.improved(others, *lamps[k])
            columns[k + 1] = surface.lit(*lamps[k])
        left, _ = surface.explain(columns)
    if not lamps:
        return None
    _, weights = surface.explain(columns)
    weights[0] = max(weights[0], _DARKEST * weights.sum())
    tinted = np.array([surface.explain(columns, channel / channel.mean())[1][1:] for channel in surface.colours.T])
    tinted *= weights[1:].sum() / np.maximum(tinted.sum(axis=1, keepdims=True), 1e-9) / weights.sum()
    order = np.argsort(-weights[1:])
    return ShadingLight(
        tuple(ShadingLamp(lamps[k][0], lamps[k][1], tinted[:, k]) for k in order),
        np.full(3, weights[0] / weights.sum()),
    )


def _ways() -> list[Float64Array]:
    """Directions from the middle, shape (3,) each."""
    return [
        np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        for rise in np.radians(np.arange(_LOWEST, 90, _RISE))
        for turn in np.linspace(0, 2 * np.pi, max(1, round(360 / _TURN * np.cos(rise))), endpoint=False)
    ]


class _Surface:
    """Cells of a level surface, how bright they are, and what candidates of lamps would make of them."""

    def __init__(
        self, colours: Float64Array, heights: Float64Array, open_to_view: BoolArray, cell: float, most: int
    ) -> None:
        chosen = np.argwhere(open_to_view & (heights <= 0))
        self.few = len(chosen) < _FEWEST
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

    def _sees(self, ways: Float64Array) -> BoolArray:
        """Whether nothing stands in ways (N, 3) or (3,) from the places, that lead upwards, shape (N,)."""
        ways = np.broadcast_to(ways, self.places.shape)
        flat = np.maximum(np.linalg.norm(ways[:, :2], axis=1), 1e-9)
        rise, (ahead, aside), (x, y) = ways[:, 2] / flat * self._cell, ways[:, :2].T / flat, self._cells.T
        free, rows = np.ones(len(ways), dtype=bool), np.arange(len(ways))
        (width, depth), tall = self._heights.shape, float(self._heights.max())
        around = np.pad(self._heights, 1)  # nothing stands beyond the cells
        for first in range(1, int(np.hypot(width, depth)) + 1, _STRIDES):
            number = np.arange(first, first + _STRIDES)[:, None]
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

    def explain(self, columns: Sequence[Float64Array], seen: Float64Array | None = None) -> tuple[float, Float64Array]:
        """Mean deviation of the logarithms that columns leave unexplained, and their weights.

        Least absolute deviations by iteratively reweighted least squares, with what varies slowly left out.
        """
        seen, matrix = self.seen if seen is None else seen, np.column_stack(columns)
        weights, share, smooth = np.zeros(len(columns)), np.ones(len(seen)), np.zeros(len(seen))
        for _ in range(3):  # errors are shares of the light, as reflectances are factors
            weights, _ = nnls(matrix * share[:, None], seen * np.exp(-smooth) * share)
            light = np.maximum(matrix @ weights, 0.02)
            ratio = np.log(np.maximum(seen, 1e-3) / light)
            counted = 1 / np.sqrt(np.maximum(np.abs(ratio - smooth), _COMMON))
            smooth = self._smooth @ np.linalg.lstsq(self._smooth * counted[:, None], ratio * counted, rcond=None)[0]
            share = counted / light
        return float(np.mean(np.abs(ratio - smooth))), weights

    def sky(self) -> Float64Array:
        """Light from all sides, 1 at an open place."""
        points = qmc.Sobol(2, seed=0).random(_SKY)
        radius, turn = np.sqrt(points[:, 0]), 2 * np.pi * points[:, 1]
        ways = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - points[:, 0])], axis=1)
        seen = np.zeros(len(self.places))
        for way in ways:
            seen += self._sees(way)
        return seen / _SKY

    def lit(self, place: Float64Array, size: float) -> Float64Array:
        """Light of a lamp that faces the middle from a place relative to it, 1 in the open middle."""
        points = place + self._spread(place, size)
        light = np.zeros(len(self.places))
        for point in points:
            towards = point - self.places
            away = np.linalg.norm(towards, axis=1)
            facing = (towards @ place) / (away * np.linalg.norm(place))
            light += self._sees(towards) * facing.clip(0) * towards[:, 2].clip(0) / away**3
        cosine = place[2] / np.linalg.norm(place)
        return np.asarray(light / len(points) * (place @ place) / cosine)

    @staticmethod
    def _spread(place: Float64Array, size: float) -> Float64Array:
        """Points of a square that faces the middle, relative to its own, (P, 3)."""
        if size == 0:
            return np.zeros((1, 3))
        flat = size * (qmc.Sobol(2, seed=1).random(_POINTS) - 0.5)
        return np.asarray(flat @ rectangle_axes(place / np.linalg.norm(place)))

    def improved(
        self, columns: Sequence[Float64Array], place: Float64Array, size: float = _SIZES[1]
    ) -> tuple[Float64Array, float]:
        """A place near one, and a size, at which a lamp explains most beside what columns do."""
        best, _ = self.explain([*columns, self.lit(place, size)])
        for step in _STEPS:
            for _ in range(6):
                moved = [(self._turned(place, step, turn), size) for turn in np.radians(np.arange(0, 360, 60))]
                moved += [(place * (1 + sign * step / 30), size) for sign in (-1, 1)]
                moved += [(place, other) for other in _SIZES if other != size]
                moved = [one for one in moved if self._may_be(one[0])]
                tried = [self.explain([*columns, self.lit(*one)])[0] for one in moved]
                if min(tried) >= best:
                    break
                best, (place, size) = min(tried), moved[int(np.argmin(tried))]
        return place, size

    @staticmethod
    def _may_be(place: Float64Array) -> bool:
        away = float(np.linalg.norm(place))
        return _NEAREST <= away <= _FARTHEST and place[2] > _SINE * away

    @staticmethod
    def _turned(place: Float64Array, step: float, turn: float) -> Float64Array:
        """A place as far away, so many degrees beside one."""
        way = place / np.linalg.norm(place)
        across = np.cross(way, [0.0, 0.0, 1.0] if abs(way[2]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        side = np.cos(turn) * across + np.sin(turn) * np.cross(way, across)
        angle = np.radians(step)
        return np.asarray(np.linalg.norm(place) * (np.cos(angle) * way + np.sin(angle) * side))
