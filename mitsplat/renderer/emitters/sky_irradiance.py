"""Table of the irradiance of a sky for every orientation.

Light from infinity depends on the normal only. One set of directions, sampled in proportion to their radiance, serves
all normals of the table. A point then costs four look-ups instead of a set of directions of its own.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

CELLS = 64
"""Cells along each axis of the table. Its normals are 1 to 3 degrees apart. The interpolated cosine of a sun has an
error below 0.01 at the horizon of the surface, and below 0.001 elsewhere.
"""


class SkyIrradiance:
    """Unoccluded irradiance by normal, interpolated on an octahedral map.

    For the map see Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors". The
    normals are the corners of the cells, so that border normals are defined on both sides of the fold.
    """

    def __init__(self, direction: mi.Vector3f, radiance: mi.Color3f) -> None:
        """Integrate N directions towards light (Vector3f) with their radiance over sampling density (Color3f)."""
        corner = dr.arange(mi.UInt32, (CELLS + 1) ** 2)
        normal = _unfolded(mi.Float(corner % (CELLS + 1)) / CELLS, mi.Float(corner // (CELLS + 1)) / CELLS)
        dr.eval(direction, radiance, normal)
        count = dr.width(radiance)
        rounds = dr.opaque(mi.UInt32, count)

        def add(i: mi.UInt32, total: mi.Color3f) -> tuple[mi.UInt32, mi.Color3f]:
            cosine = dr.maximum(dr.dot(normal, dr.gather(mi.Vector3f, direction, i)), 0)
            return i + 1, total + cosine * dr.gather(mi.Color3f, radiance, i)

        state = dr.zeros(mi.UInt32, dr.width(corner)), dr.zeros(mi.Color3f, dr.width(corner))
        self._table = dr.while_loop(state, lambda i, _: i < rounds, add, label="sky")[1] / mi.Float(count)
        dr.eval(self._table)

    def at(self, normal: mi.Normal3f, active: mi.Bool) -> mi.Color3f:
        """Return the irradiance (Color3f) on surfaces with unit normals (Vector3f)."""
        x, y = _folded(normal)
        column, row = (dr.minimum(mi.UInt32(dr.maximum(v * CELLS, 0)), CELLS - 1) for v in (x, y))
        right, down = x * CELLS - mi.Float(column), y * CELLS - mi.Float(row)

        def corner(i: int, j: int) -> mi.Color3f:
            return dr.gather(mi.Color3f, self._table, (row + j) * (CELLS + 1) + column + i, active)

        return dr.lerp(dr.lerp(corner(0, 0), corner(1, 0), right), dr.lerp(corner(0, 1), corner(1, 1), right), down)


def _unfolded(x: mi.Float, y: mi.Float) -> mi.Vector3f:
    """Return the unit vectors of points of the octahedral map (unit square)."""
    x, y = 2 * x - 1, 2 * y - 1
    z = 1 - abs(x) - abs(y)
    back = dr.maximum(-z, 0)
    return dr.normalize(mi.Vector3f(x - dr.copysign(back, x), y - dr.copysign(back, y), z))


def _folded(vector: mi.Normal3f) -> tuple[mi.Float, mi.Float]:
    """Return the points of the octahedral map (unit square) of unit vectors."""
    length = abs(vector.x) + abs(vector.y) + abs(vector.z)
    x, y = vector.x / length, vector.y / length
    lower = vector.z < 0
    over_x, over_y = dr.copysign(1 - abs(y), x), dr.copysign(1 - abs(x), y)
    return 0.5 * dr.select(lower, over_x, x) + 0.5, 0.5 * dr.select(lower, over_y, y) + 0.5
