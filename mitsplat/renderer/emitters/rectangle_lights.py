"""Table of rectangular area lights of uniform radiance, evaluated without calls of Mitsuba's plugins.

Most lamps are of this kind. Their unoccluded light in closed form takes 0.1 to 0.5 times the time of 34 points, and its
only error is rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.rays.device_arrays import wrapped


class _Columns:
    """Columns of a rectangle: corner [m], two edges [m], normal times area [m^2], and radiance."""

    CORNER, ACROSS, UP, NORMAL, RADIANCE = (slice(start, start + 3) for start in range(0, 15, 3))
    WIDTH = 16


class _Rectangle(NamedTuple):
    """One rectangle per lane, with the values of :class:`_Columns`."""

    corner: mi.Vector3f
    across: mi.Vector3f
    up: mi.Vector3f
    normal: mi.Vector3f
    radiance: mi.Color3f


@dataclass(frozen=True, eq=False)
class Rectangles:
    """Rectangular emitters, indexed like the emitters of the scene.

    Attributes:
        rows: One row of ``_Columns`` per emitter.
    """

    rows: mi.Float

    @classmethod
    def of(cls, emitters: Sequence[mi.Emitter], sky: int | None) -> Rectangles | None:
        """Collect all emitters except the sky; return None if one of them is not a rectangle of uniform radiance."""
        rows = np.zeros((len(emitters), _Columns.WIDTH), np.float32)
        for i, emitter in enumerate(emitters):
            if i == sky:
                continue
            shape = emitter.get_shape()
            if emitter.class_name() != "AreaLight" or shape.class_name() != "Rectangle":
                return None
            light = mi.traverse(emitter)
            if set(light.keys()) != {"sampling_weight", "radiance.value"}:  # textured
                return None
            pose = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
            across, up, middle = 2 * pose[:3, 0], 2 * pose[:3, 1], pose[:3, 3]
            if abs(across @ up) > 1e-4 * np.linalg.norm(across) * np.linalg.norm(up):  # a parallelogram
                return None
            normal = np.linalg.inv(pose[:3, :3])[2]
            normal *= np.linalg.norm(np.cross(across, up)) / np.linalg.norm(normal)
            normal *= -1 if shape.has_flipped_normals() else 1
            rows[i, _Columns.CORNER] = middle - (across + up) / 2
            rows[i, _Columns.ACROSS], rows[i, _Columns.UP], rows[i, _Columns.NORMAL] = across, up, normal
            rows[i, _Columns.RADIANCE] = np.array(light["radiance.value"]).ravel()
        return cls(wrapped(mi.Float, rows))

    def _at(self, index: mi.UInt32, lanes: int, active: mi.Bool = True) -> _Rectangle:
        """Return the rectangles ``index`` of as many lanes."""
        row = dr.gather(mi.ArrayXf, self.rows, index, active, shape=(_Columns.WIDTH, lanes))
        columns = _Columns.CORNER, _Columns.ACROSS, _Columns.UP, _Columns.NORMAL
        corner, across, up, normal = (mi.Vector3f(*row[column]) for column in columns)
        return _Rectangle(corner, across, up, normal, mi.Color3f(*row[_Columns.RADIANCE]))

    def towards(
        self, place: mi.Point3f, index: mi.UInt32, point: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.Float, mi.Color3f, mi.Float]:
        """Return unit vectors and distances [m] to points of rectangles, radiance over density, and density [1/sr]."""
        corner, across, up, normal, radiance = self._at(index, dr.width(index))
        way = corner + across * point.x + up * point.y - mi.Vector3f(place)
        inverse = dr.rsqrt(dr.squared_norm(way))
        direction = way * inverse
        seen = dr.maximum(-dr.dot(direction, normal), 0) * dr.square(inverse)
        return (
            direction,
            dr.rcp(inverse),
            radiance * seen,
            dr.select(seen > 0, dr.rcp(seen), 0),
        )

    def irradiance(self, place: mi.Point3f, normal: mi.Vector3f, active: mi.Bool) -> mi.Color3f:
        """Compute the unoccluded irradiance (Color3f) of all rectangles at places with unit normals in closed form.

        It is half the radiance times the sum of angle and axis along the normal of all edges of the part above the
        horizon (Lambert 1760, "Photometria").

        The terms nearly cancel for a small distant lamp: the rounding error is up to 0.5 % of the irradiance of a lamp
        of 4 x 8 mm at 7 m, and falls with size over distance.
        """
        count, lanes = dr.opaque(mi.UInt32, dr.width(self.rows) // _Columns.WIDTH), dr.width(place)

        def add(i: mi.UInt32, total: mi.Color3f) -> tuple[mi.UInt32, mi.Color3f]:
            corner, across, up, luminous, radiance = self._at(i, lanes, active)
            start = corner - mi.Vector3f(place)
            lit = active & (dr.dot(start, luminous) < 0)
            swept, sets, rises = mi.Float(0), mi.Vector3f(0), mi.Vector3f(0)
            for edge in (across, up, -across, -up):
                height, change = dr.dot(start, normal), dr.dot(edge, normal)
                end = height + change
                crossing = -height / change
                first, last = dr.select(height > 0, 0, crossing), dr.select(end > 0, 1, crossing)
                low, high = dr.fma(edge, first, start), dr.fma(edge, last, start)
                swept += dr.select((height > 0) | (end > 0), _swept(low, edge * (last - first), high, normal), 0)
                sets = dr.select((height > 0) & (end <= 0), high, sets)
                rises = dr.select((height <= 0) & (end > 0), low, rises)
                start = start + edge
            swept += _swept(sets, rises - sets, rises, normal)
            return i + 1, total + dr.select(lit, radiance * (dr.abs(swept) / 2), 0)

        state = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Color3f, lanes)
        return dr.while_loop(state, lambda i, _: active & (i < count), add, label="light of rectangles")[1]

    def along(self, ray: mi.Ray3f) -> tuple[mi.UInt32, mi.Float, mi.Color3f, mi.Float]:
        """Intersect rays with the luminous sides of all rectangles.

        Returns:
            Index of the nearest rectangle, its distance [m] (infinite for a miss), its radiance, and the density [1/sr]
            of :meth:`towards` in the direction of the ray.
        """
        count, lanes = dr.opaque(mi.UInt32, dr.width(self.rows) // _Columns.WIDTH), dr.width(ray.d)
        origin, direction = mi.Vector3f(ray.o), mi.Vector3f(ray.d)

        def nearest(
            i: mi.UInt32, number: mi.UInt32, distance: mi.Float, radiance: mi.Color3f, density: mi.Float
        ) -> tuple[mi.UInt32, mi.UInt32, mi.Float, mi.Color3f, mi.Float]:
            corner, across, up, normal, emitted = self._at(i, lanes)
            facing = -dr.dot(direction, normal)
            reach = dr.dot(origin - corner, normal) / facing
            point = origin + direction * reach - corner
            x, y = (dr.dot(point, edge) / dr.squared_norm(edge) for edge in (across, up))
            inside = (facing > 0) & (reach > 0) & (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1) & (reach < distance)
            return (
                i + 1,
                dr.select(inside, i, number),
                dr.select(inside, reach, distance),
                dr.select(inside, emitted, radiance),
                dr.select(inside, dr.square(reach) / facing, density),
            )

        nothing = [dr.zeros(kind, lanes) for kind in (mi.UInt32, mi.UInt32, mi.Color3f, mi.Float)]
        state = nothing[0], nothing[1], dr.full(mi.Float, dr.inf, lanes), nothing[2], nothing[3]
        _, *found = dr.while_loop(state, lambda i, *_: i < count, nearest, label="rectangles along rays")
        number, distance, radiance, density = found
        return number, distance, radiance, density


def _swept(start: mi.Vector3f, edge: mi.Vector3f, end: mi.Vector3f, normal: mi.Vector3f) -> mi.Float:
    """Return the angle between the ends of an edge, seen from the origin, times the share of its axis along a normal.

    The product with the ``edge`` keeps the small angles of distant lamps exact.
    """
    axis = dr.cross(start, edge)
    length = dr.norm(axis)
    return dr.select(length > 0, dr.dot(axis, normal) / length * dr.atan2(length, dr.dot(start, end)), 0)
