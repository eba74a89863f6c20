"""Layouts of the rows of floats that kernels write and read.

Kernels fetch a row in packets of four floats, which is faster than fetching separate arrays.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import drjit as dr
import mitsuba as mi


class GaussianRecord(NamedTuple):
    """View record of a Gaussian, see :mod:`mitsplat.renderer.projection.gaussian` for the symbols.

    ``a``, ``b2`` and ``c`` include the factor log2(e)/2, so that opacity along a ray is ``exp2(log_opacity - q)``.

    Attributes:
        u0, v0: Slopes of the centre. For a Gaussian that reaches the camera's plane, ``u0`` is the number of its
            :class:`PlaneRecord`.
        a, b2, c: A, 2B and C. For a Gaussian that reaches the camera's plane, ``a`` is -1.
        log_opacity: log2 of the opacity.
        red, green, blue: Display-encoded colour.
        depth: Depth of the centre along z, m_z [m].
        e, f, g, h, i: Other coefficients of the response.
        instance: Instance id.
    """

    u0: mi.Float
    v0: mi.Float
    a: mi.Float
    b2: mi.Float
    c: mi.Float
    log_opacity: mi.Float
    red: mi.Float
    green: mi.Float
    blue: mi.Float
    depth: mi.Float
    e: mi.Float
    f: mi.Float
    g: mi.Float
    h: mi.Float
    i: mi.Float
    instance: mi.Float

    @property
    def colour(self) -> list[mi.Float]:
        """Red, green and blue."""
        return [self.red, self.green, self.blue]

    @property
    def at_plane(self) -> mi.Bool:
        """True if the Gaussian reaches the camera's plane."""
        return self.a < 0

    @classmethod
    def fetch(cls, rows: mi.Float, number: mi.UInt32) -> Self:
        """Return the rows ``number``."""
        return cls(*dr.gather(mi.ArrayXf, rows, number, shape=(RECORD, dr.width(number))))

    @classmethod
    def place(cls, field: str) -> int:
        """Return the position of a field in a row."""
        return cls._fields.index(field)


class PlaneRecord(NamedTuple):
    """Response of a Gaussian that reaches the camera's plane.

    Along a ray (u, v, 1), the squared Mahalanobis distance is q = n / d and the peak depth is z / d. The numerators n,
    z and the denominator d are polynomials with these coefficients, named by their powers of u and v. Those of n
    include the factor log2(e)/2.
    """

    n_uu: mi.Float
    n_uv: mi.Float
    n_vv: mi.Float
    n_u: mi.Float
    n_v: mi.Float
    n_1: mi.Float
    d_uu: mi.Float
    d_uv: mi.Float
    d_vv: mi.Float
    d_u: mi.Float
    d_v: mi.Float
    d_1: mi.Float
    z_u: mi.Float
    z_v: mi.Float
    z_1: mi.Float
    padding: mi.Float

    @classmethod
    def fetch(cls, rows: mi.Float, number: mi.UInt32) -> Self:
        """Return the rows ``number``."""
        return cls(*dr.gather(mi.ArrayXf, rows, number, shape=(RECORD, dr.width(number))))

    def respond(self, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return log2(e)/2 times the squared Mahalanobis distance q, and the peak depth, along rays of slopes u, v."""
        inverse, depth = self._inverse_and_depth(u, v)
        numerator = (self.n_uu * u + self.n_uv * v + self.n_u) * u + (self.n_vv * v + self.n_v) * v + self.n_1
        return numerator * inverse, depth

    def depth(self, u: mi.Float, v: mi.Float) -> mi.Float:
        """Return the peak depth along rays of slopes u, v."""
        return self._inverse_and_depth(u, v)[1]

    def _inverse_and_depth(self, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        denominator = (self.d_uu * u + self.d_uv * v + self.d_u) * u + (self.d_vv * v + self.d_v) * v + self.d_1
        inverse = dr.rcp(denominator)
        return inverse, (self.z_u * u + self.z_v * v + self.z_1) * inverse


RECORD = len(GaussianRecord._fields)
"""Floats of a :class:`GaussianRecord`, and of a :class:`PlaneRecord`."""


class ViewRecords(NamedTuple):
    """Gaussians projected to a view.

    Attributes:
        rows: One :class:`GaussianRecord` per Gaussian, flat.
        plane_rows: One :class:`PlaneRecord` per Gaussian that reaches the camera's plane, flat; None if there are none.
        least: Depth [m] in front of which the peak of a Gaussian cannot lie.
        tile_boxes: Half-open box of tiles (x0, x1, y0, y1) of each Gaussian, flat; empty boxes of invisible Gaussians.
    """

    rows: mi.Float
    plane_rows: mi.Float | None
    least: mi.Float
    tile_boxes: mi.UInt32


class Geometry:
    """Columns of the geometry of a cloud, one row per Gaussian."""

    MEAN, OPACITY, QUATERNION = slice(0, 3), 3, slice(4, 8)
    WIDTH = 8


class AppearanceRow:
    """Columns of an appearance: flag, matrix row by row, coverage of dirt, its seed, and its cells per unit length."""

    PRESENT, MATRIX, WEAR, SEED, CELLS = 0, slice(1, 10), 10, 11, 12
    WIDTH = 13


class PlacementRow:
    """Columns of a placement.

    These are the camera's axes in the cloud's frame, the cloud's scale, the instance id, the camera's centre in the
    cloud's frame, and the appearance. The centre is a sum of two floats, which keeps differences exact far from the
    origin.
    """

    RIGHT, DOWN, FORWARD = slice(0, 3), slice(3, 6), slice(6, 9)
    SCALE, INSTANCE = 9, 10
    CENTRE, CENTRE_REST = slice(12, 15), slice(16, 19)
    APPEARANCE = slice(19, 19 + AppearanceRow.WIDTH)
    WIDTH = 32
