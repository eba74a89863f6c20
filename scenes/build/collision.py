"""Convex pieces of the parts for physics, in the millimetres and frames of :mod:`scenes.build.parts`.

They omit threads and fillets. :func:`mitsplat.geometry.hull_fit.fit_to_hull` gives them the convex hull of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import trimesh

Pieces = list[trimesh.Trimesh]
Outline = npt.NDArray[np.float64]
SECTORS = 12


def hull(points: npt.ArrayLike) -> trimesh.Trimesh:
    return trimesh.convex.convex_hull(np.asarray(points, dtype=np.float64).reshape(-1, 3))


def prism(outline: npt.ArrayLike, low: float, high: float) -> trimesh.Trimesh:
    """Convex prism over the hull of ``outline`` (N, 2) between two heights."""
    flat = np.asarray(outline, dtype=np.float64).reshape(-1, 2)
    return hull([np.column_stack([flat, np.full(len(flat), z)]) for z in (low, high)])


def arc(radius: float, start: float, end: float, count: int = 3) -> Outline:
    """Points (``count``, 2) on a circle between two angles [rad]."""
    angle = np.linspace(start, end, count)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def disc(radius: float, low: float, high: float) -> trimesh.Trimesh:
    return prism(arc(radius, 0.0, 2.0 * np.pi, 33), low, high)


def turned_hull(profile: Sequence[tuple[float, float]]) -> trimesh.Trimesh:
    """Hull of the body that (radius, z) points make around z."""
    return hull([np.column_stack([arc(r, 0.0, 2.0 * np.pi, 33), np.full(33, z)]) for r, z in profile])


def ring(outer: float, inner: float, low: float, high: float, *, chamfer: float = 0.0) -> Pieces:
    """Sectors of a tube about z, its outer edges chamfered.

    The outside has 96 sides. With 24 sides, a washer rests on each of them, 0.16 mm below its round mesh.
    """
    pieces = []
    for k in range(SECTORS):
        start, end = 2.0 * np.pi * np.array([k, k + 1]) / SECTORS
        levels = [(low, chamfer), (low + chamfer, 0.0), (high - chamfer, 0.0), (high, chamfer)]
        points = []
        for z, cut in levels:
            outline = np.concatenate([arc(outer - cut, start, end, 9), arc(inner, start, end, 2)])
            points.append(np.column_stack([outline, np.full(len(outline), z)]))
        pieces.append(hull(points))
    return pieces


def hex_ring(across_flats: float, inner: float, low: float, high: float) -> Pieces:
    """Twelve sectors of a hexagonal tube, corners at 30 degrees from x, chamfered as nuts are."""
    corner, face = across_flats / np.sqrt(3.0), 0.475 * across_flats
    drop = (corner - face) * np.tan(np.radians(30.0))
    pieces = []
    for k in range(12):
        angles = np.radians([30.0 * k, 30.0 * (k + 1)])
        # Odd multiples of 30 degrees are corners, even ones the middles of flats.
        radii = np.where(np.arange(k, k + 2) % 2 == 1, corner, 0.5 * across_flats)
        unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        outside, bore = unit * radii[:, None], inner * unit
        ends = unit * np.minimum(radii, face)[:, None]
        points = [
            np.column_stack([np.concatenate([outline, bore]), np.full(4, z)])
            for z, outline in ((low, ends), (low + drop, outside), (high - drop, outside), (high, ends))
        ]
        pieces.append(hull(points))
    return pieces


def block(low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def hex_nut(across_flats: float, height: float, major: float) -> Pieces:
    return hex_ring(across_flats, 0.46 * major, 0.0, height)


def hex_bolt() -> Pieces:
    head = [hull(np.concatenate([piece.vertices for piece in hex_ring(24.0, 5.0, 0.0, 10.0)]))]
    return [*head, turned_hull([(6.4, -50), (7.7, -48.5), (7.7, -13), (7.9, -12), (8.0, 0.5)])]


def washer() -> Pieces:
    return ring(18.5, 10.6, 0.0, 3.0, chamfer=0.35)


def l_bracket() -> Pieces:
    return [block((0, 0, 0), (50, 4, 32)), block((0, 4, 0), (4, 50, 32))]


def spur_gear() -> Pieces:
    """Root ring with hub, and a piece for every tooth (module 2, 24 teeth)."""
    pieces = ring(21.6, 6.0, 0.0, 12.0) + ring(13.0, 6.0, 12.0, 20.0)
    for k in range(24):
        turn = 2.0 * np.pi * k / 24
        halves = [(21.4, 0.092), (24.0, 0.065), (26.0, 0.031)]
        tooth = [arc(r, turn - half, turn + half, 2) for r, half in halves]
        pieces.append(prism(np.concatenate(tooth), 0.0, 12.0))
    return pieces


def bearing(outer: float, inner: float, width: float) -> Pieces:
    return ring(0.5 * outer, 0.5 * inner, 0.0, width, chamfer=0.7)


def cable_clip() -> Pieces:
    """The band around the hose from the tab on, and the tab."""
    angles = np.radians(np.linspace(-65.0, 270.0, 14))
    band = [prism(np.concatenate([arc(11.0, a, b), arc(8.0, a, b, 2)]), 0.0, 15.0) for a, b in pairwise(angles)]
    return [*band, block((0, -11, 0), (30, -8, 15))]


def relay_box() -> Pieces:
    blades = [block((x - 2.5, y - 0.5, -6.4), (x + 2.5, y + 0.5, 0.6)) for x in (-11, 0, 11) for y in (-8, 8)]
    body = [block((-18, -14, 6), (18, 14, 52)), block((-18.75, -14.75, 0), (18.75, 14.75, 9))]
    return [*body, *blades, disc(3.2, 51, 54).apply_translation((-9, 0, 0))]


def brass_fitting() -> Pieces:
    upper = ring(9.2, 5.0, 8.5, 23.4, chamfer=0.8)
    lower = ring(8.0, 5.0, -12.3, 0.5, chamfer=0.6)
    return hex_ring(24.0, 5.0, 0.0, 9.0) + upper + lower


def proximity_sensor() -> Pieces:
    nut = hull(np.concatenate([piece.vertices for piece in hex_ring(24.0, 8.0, 27.0, 31.5)]))
    gland = turned_hull([(6.4, -8.4), (7.2, -6), (7.2, 1)])
    barrel = turned_hull([(8.4, 0), (8.7, 0.7), (8.7, 43), (8.2, 49), (7.4, 50)])
    return [barrel, nut, gland, disc(3.0, -15, -8)]


COLLISION: dict[str, Callable[[], Pieces]] = {
    "hex_nut_m16": lambda: hex_nut(24.0, 14.8, 16.0),
    "hex_nut_m20": lambda: hex_nut(30.0, 18.0, 20.0),
    "hex_bolt": hex_bolt,
    "washer": washer,
    "l_bracket": l_bracket,
    "spur_gear": spur_gear,
    "bearing_6204": lambda: bearing(47.0, 20.0, 14.0),
    "bearing_6206": lambda: bearing(62.0, 30.0, 16.0),
    "cable_clip": cable_clip,
    "relay_box": relay_box,
    "brass_fitting": brass_fitting,
    "proximity_sensor": proximity_sensor,
}
"""Convex pieces of every class."""
