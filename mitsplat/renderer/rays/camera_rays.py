"""Camera model of the splat renderer: ray slopes per pixel, image tiles, and the tiles of slope ranges."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.lens import FISHEYE_MAX, NEWTON_STEPS, Lens, fisheye_radius, fisheye_rate, opencv_distort, padded

TILE_WIDTH, TILE_HEIGHT = 8, 4
"""Size of a tile [px]. Smaller tiles create more pairs to sort. Larger tiles leave more lanes idle, deviate more from
the order of each ray, and bound depths less tightly. A packet of eight lanes covers a whole tile and fetches each
record once.
"""

TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT

Kind = tuple[int, int, int, Lens, int, int]
"""Width, height, number of distortion coefficients, lens, samples and zoom of a view."""

ViewNumbers = dict[str, "mi.Float | tuple[mi.Float, ...]"]
"""Device values of a view by name; ``extent`` is a box of slopes."""


@dataclass(frozen=True, eq=False)
class CameraView:
    """Intrinsics, lens distortion and pose of one camera, see :class:`mitsplat.geometry.camera.Camera`.

    Attributes:
        width, height: Image size [px].
        fx, fy, cx, cy: Intrinsics [px].
        distortion: OpenCV coefficients k1, k2, p1, p2, k3, k4, k5, k6[, s1, s2, s3, s4], or empty; k1, k2, k3, k4 of a
            fisheye lens.
        near: Smallest visible depth [m].
        world_from_camera: Pose, OpenCV axes, shape (4, 4).
        samples: Rays per pixel along each axis.
        lens: Lens model.
        aperture_radius, focus_distance: Parameters of a thin lens [m].
        zoom: Number of pixels of this view along one pixel of the picture, see :meth:`finer`.
        shift: Offset of slopes that is subtracted for a view through another point of the lens than its centre.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: Float64Array
    distortion: tuple[float, ...] = ()
    near: float = 0.01
    samples: int = 1
    lens: Lens = "opencv"
    aperture_radius: float = 0.0
    focus_distance: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    zoom: int = 1
    _opaque: dict[str, mi.Float] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.lens == "opencv":
            object.__setattr__(self, "distortion", padded(self.distortion) if any(self.distortion) else ())
        # Opaque values let a new camera reuse the compiled kernels.
        for name in ("fx", "fy", "cx", "cy", "near"):
            self._opaque[name] = dr.opaque(mi.Float, getattr(self, name))
        for i, value in enumerate(self.distortion):
            self._opaque[f"k{i}"] = dr.opaque(mi.Float, value)
        if self.distortion:
            self._opaque["du"], self._opaque["dv"] = (dr.opaque(mi.Float, value) for value in self.shift)

    @property
    def near_plane(self) -> mi.Float:
        """``near`` as an opaque value."""
        return self._opaque["near"]

    @property
    def key(self) -> tuple[object, ...]:
        """Values that identify a view."""
        lens = self.fx, self.fy, self.cx, self.cy, self.distortion, self.lens, self.shift
        return self.width, self.height, *lens, self.near, self.samples, self.world_from_camera.tobytes()

    @property
    def kind(self) -> Kind:
        """Values that determine the kernels of a view; :attr:`numbers` are their inputs."""
        return self.width, self.height, len(self.distortion), self.lens, self.samples, self.zoom

    @property
    def numbers(self) -> ViewNumbers:
        """Device values that differ between views of one kind; the pose is in the table of placements."""
        return self._opaque | ({"extent": self._extent} if self.distortion else {})

    @classmethod
    def of_numbers(cls, kind: Kind, numbers: ViewNumbers) -> CameraView:
        """Create a view from its kind and :attr:`numbers` only, sufficient for projection but not for the march."""
        view = object.__new__(cls)
        width, height, coefficients, lens, samples, zoom = kind
        known = {"width": width, "height": height, "distortion": (0.0,) * coefficients, "lens": lens}
        known |= {"samples": samples, "zoom": zoom, "_opaque": dict(numbers)}
        if coefficients:
            known["_extent"] = numbers["extent"]
        view.__dict__.update(known)
        return view

    @property
    def tiles_x(self) -> int:
        """Number of tiles along x."""
        return -(-self.width // TILE_WIDTH)

    @property
    def tiles_y(self) -> int:
        """Number of tiles along y."""
        return -(-self.height // TILE_HEIGHT)

    def sampled(self, samples: int) -> CameraView:
        """Return the same view with ``samples`` x ``samples`` rays per pixel."""
        return self if samples == self.samples else replace(self, samples=samples)

    def finer(self, zoom: int) -> CameraView:
        """Return the same view with each pixel divided into ``zoom`` x ``zoom`` pixels."""
        numbers: dict[str, Any] = {n: zoom * getattr(self, n) for n in ("width", "height", "fx", "fy", "cx", "cy")}
        return replace(self, zoom=zoom * self.zoom, **numbers)

    @property
    def camera(self) -> Camera:
        """The same camera on the host, with one ray per pixel."""
        return Camera(**{f.name: getattr(self, f.name) for f in fields(Camera)})

    def apertures(self, rings: int) -> list[CameraView]:
        """Return views through evenly spaced points of the aperture: the centre and ``rings`` hexagonal rings.

        All views see the plane at ``focus_distance`` at the same pixels. A pinhole has one view.
        """
        if self.aperture_radius == 0:
            return [self]
        points, count = [(0.0, 0.0)], 1 + 3 * rings * (rings + 1)
        for ring in range(1, rings + 1):
            # Radius that halves, by area, the annulus that belongs to the ring's 6 n points.
            radius = self.aperture_radius * np.sqrt((1 + 3 * ring * ring) / count)
            angles = (np.arange(6 * ring) + 0.5 * (ring % 2)) * np.pi / (3 * ring)
            points += [(radius * np.cos(angle), radius * np.sin(angle)) for angle in angles]
        return [self._through(float(x), float(y)) for x, y in points]

    def _through(self, x: float, y: float) -> CameraView:
        pose = self.world_from_camera.copy()
        pose[:3, 3] += pose[:3, 0] * x + pose[:3, 1] * y
        du, dv = x / self.focus_distance, y / self.focus_distance
        if self.distortion:
            return replace(self, world_from_camera=pose, shift=(du, dv))
        return replace(self, world_from_camera=pose, cx=self.cx + self.fx * du, cy=self.cy + self.fy * dv)

    def rows(self, start: int, stop: int) -> CameraView:
        """Return the part of the view from pixel row ``start`` to ``stop`` (exclusive)."""
        return replace(self, height=stop - start, cy=self.cy - start)

    def rays(self) -> mi.Ray3f:
        """Return the world-space rays through pixel centres, row-major, with unit direction."""
        ray = self.rays_through(*self.centres())
        dr.eval(ray)
        return ray

    def centres(self) -> tuple[mi.Float, mi.Float]:
        """Return the positions (x, y) of pixel centres, row-major [px]."""
        pixel = dr.arange(mi.UInt32, self.width * self.height)
        row = pixel // self.width
        return mi.Float(pixel - row * self.width) + 0.5, mi.Float(row) + 0.5

    def rays_through(self, x: mi.Float, y: mi.Float) -> mi.Ray3f:
        """Return the world-space rays through pixel positions (x, y) [px], with unit direction."""
        ray = dr.zeros(mi.Ray3f, dr.width(x))
        ray.d = self.direction(x, y)
        ray.o = mi.Point3f(*[dr.opaque(mi.Float, float(value)) for value in self.world_from_camera[:3, 3]])
        ray.maxt = dr.inf
        return ray

    def direction(self, x: mi.Float, y: mi.Float) -> mi.Vector3f:
        """Return the world-space unit vectors of the rays through pixel positions (x, y) [px]."""
        u, v = self.slopes(x, y)
        axes = [[dr.opaque(mi.Float, float(value)) for value in column] for column in self.world_from_camera[:3, :3].T]
        right, down, forward = axes
        return dr.normalize(mi.Vector3f(*[right[i] * u + down[i] * v + forward[i] for i in range(3)]))

    def cosine(self, rays: mi.Ray3f) -> mi.Float:
        """Return the depth along z per unit of distance along each ray."""
        forward = mi.Vector3f(*[dr.opaque(mi.Float, float(value)) for value in self.world_from_camera[:3, 2]])
        return dr.dot(rays.d, forward)

    def slopes(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return the undistorted slopes (u, v) of the rays through pixel positions (x, y) [px]."""
        o = self._opaque
        xd, yd = (x - o["cx"]) / o["fx"], (y - o["cy"]) / o["fy"]
        if not self.distortion:
            return xd, yd
        if self.lens == "fisheye":
            u, v = self._fisheye_slopes(xd, yd)
            return u - o["du"], v - o["dv"]
        u, v = xd, yd
        # Newton's method on the 2-D distortion map with its analytic Jacobian converges in 3 to 5 steps.
        for _ in range(NEWTON_STEPS):
            pu, pv, j = self.distort(u, v)
            ru, rv = xd - pu, yd - pv
            det = j[0] * j[3] - j[1] * j[2]
            u, v = u + (j[3] * ru - j[1] * rv) / det, v + (j[0] * rv - j[2] * ru) / det
        return u - o["du"], v - o["dv"]

    def _fisheye_slopes(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        radius = dr.maximum(dr.sqrt(x * x + y * y), 1e-9)
        angle = mi.Float(radius)
        for _ in range(NEWTON_STEPS):
            angle -= (fisheye_radius(angle, self._k) - radius) / fisheye_rate(angle, self._k)
        scale = dr.tan(dr.clip(angle, 0, FISHEYE_MAX)) / radius
        return x * scale, y * scale

    @property
    def _k(self) -> list[mi.Float]:
        return [self._opaque[f"k{i}"] for i in range(len(self.distortion))]

    def _fisheye_distort(
        self, u: mi.Float, v: mi.Float
    ) -> tuple[mi.Float, mi.Float, tuple[mi.Float, mi.Float, mi.Float, mi.Float]]:
        slope2 = dr.maximum(u * u + v * v, 1e-12)
        slope = dr.sqrt(slope2)
        angle = dr.atan(slope)
        rate, scale = fisheye_rate(angle, self._k), fisheye_radius(angle, self._k) / slope
        # The map's derivative is d(shown)/d(slope) along the radius and the scale across it.
        growth = (rate / (1 + slope2) - scale) / slope2
        return u * scale, v * scale, (scale + growth * u * u, growth * u * v, growth * u * v, scale + growth * v * v)

    def distort(
        self, u: mi.Float, v: mi.Float
    ) -> tuple[mi.Float, mi.Float, tuple[mi.Float, mi.Float, mi.Float, mi.Float]]:
        """Apply the lens distortion to slopes; return them with the Jacobian (du'/du, du'/dv, dv'/du, dv'/dv).

        Source: OpenCV documentation, "Fisheye camera model" (Kannala and Brandt 2006), and :func:`opencv_distort`.
        """
        if self.lens == "fisheye":
            return self._fisheye_distort(u, v)
        distorted: tuple[mi.Float, mi.Float, tuple[mi.Float, mi.Float, mi.Float, mi.Float]]
        distorted = opencv_distort(u, v, self._k)
        return distorted

    def pixel_covariance(self, u: mi.Float, v: mi.Float, variance: float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return the covariance (uu, uv, vv) in slopes at (u, v) of an isotropic ``variance`` [px^2]."""
        o = self._opaque
        variance = dr.opaque(mi.Float, variance)
        if not self.distortion:
            return variance / dr.square(o["fx"]), mi.Float(0), variance / dr.square(o["fy"])
        lo_u, hi_u, lo_v, hi_v = self._extent
        _, _, (a, b, c, d) = self.distort(dr.clip(u, lo_u, hi_u) + o["du"], dr.clip(v, lo_v, hi_v) + o["dv"])
        # Inverse of the map from slopes to pixels, diag(f) J.
        det = (a * d - b * c) * o["fx"] * o["fy"]
        a, b, c, d = d * o["fy"] / det, -b * o["fx"] / det, -c * o["fy"] / det, a * o["fx"] / det
        return variance * (a * a + b * b), variance * (a * c + b * d), variance * (c * c + d * d)

    def tile_box(
        self, u0: mi.Float, u1: mi.Float, v0: mi.Float, v1: mi.Float
    ) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.UInt32]:
        """Return half-open tile ranges (x0, x1, y0, y1) that a box of slopes may intersect, clipped to the image."""
        o = self._opaque
        if not self.distortion:
            box = u0 * o["fx"] + o["cx"], u1 * o["fx"] + o["cx"], v0 * o["fy"] + o["cy"], v1 * o["fy"] + o["cy"]
            return self._clip_tiles(*box, 0.0)
        # Distortion may fold back outside the image's slopes, so the box is clipped to them before its outline is
        # projected.
        lo_u, hi_u, lo_v, hi_v = self._extent
        empty = (u1 < lo_u) | (u0 > hi_u) | (v1 < lo_v) | (v0 > hi_v)
        u0, u1 = dr.clip(u0, lo_u, hi_u), dr.clip(u1, lo_u, hi_u)
        v0, v1 = dr.clip(v0, lo_v, hi_v), dr.clip(v1, lo_v, hi_v)
        lo_x = lo_y = mi.Float(dr.inf)
        hi_x = hi_y = mi.Float(-dr.inf)
        for s in (0.0, 0.25, 0.5, 0.75, 1.0):
            for t in (0.0, 0.25, 0.5, 0.75, 1.0):
                if s not in (0.0, 1.0) and t not in (0.0, 1.0):
                    continue
                pu, pv, _ = self.distort(dr.lerp(u0, u1, s) + o["du"], dr.lerp(v0, v1, t) + o["dv"])
                x, y = pu * o["fx"] + o["cx"], pv * o["fy"] + o["cy"]
                lo_x, hi_x = dr.minimum(lo_x, x), dr.maximum(hi_x, x)
                lo_y, hi_y = dr.minimum(lo_y, y), dr.maximum(hi_y, y)
        margin = TILE_WIDTH / 2 + 0.05 * dr.maximum(hi_x - lo_x, hi_y - lo_y)
        x0, x1, y0, y1 = self._clip_tiles(lo_x, hi_x, lo_y, hi_y, margin)
        return x0, dr.select(empty, x0, x1), y0, y1

    def tile_columns(self, u0: mi.Float, u1: mi.Float) -> tuple[mi.UInt32, mi.UInt32]:
        """Return the half-open range of tile columns that a range of slopes intersects in an undistorted view."""
        o = self._opaque
        return self._tile_range(u0 * o["fx"] + o["cx"], u1 * o["fx"] + o["cx"], TILE_WIDTH, self.tiles_x)

    def _clip_tiles(
        self, x0: mi.Float, x1: mi.Float, y0: mi.Float, y1: mi.Float, margin: mi.Float
    ) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.UInt32]:
        columns = self._tile_range(x0 - margin, x1 + margin, TILE_WIDTH, self.tiles_x)
        return *columns, *self._tile_range(y0 - margin, y1 + margin, TILE_HEIGHT, self.tiles_y)

    def _tile_range(self, low: mi.Float, high: mi.Float, size: int, tiles: int) -> tuple[mi.UInt32, mi.UInt32]:
        # Pixels are sampled at their centres, so ranges that end before the first or start after the last centre are
        # empty.
        half = 0.5 if self.samples == 1 else 0.0
        first, last = dr.floor((low + half) / size), dr.floor((high - half) / size) + 1.0
        return mi.UInt32(dr.clip(first, 0.0, float(tiles))), mi.UInt32(dr.clip(last, 0.0, float(tiles)))

    def tile_slopes(self, tile: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        """Return the box (u_min, u_max, v_min, v_max) of the slopes of a tile's rays."""
        if self.distortion:
            box = dr.gather(mi.Array4f, self._tile_table, tile)
            return box.x, box.y, box.z, box.w
        o = self._opaque
        half = 0.5 if self.samples == 1 else 0.0
        row = tile // self.tiles_x
        x, y = mi.Float((tile - row * self.tiles_x) * TILE_WIDTH), mi.Float(row * TILE_HEIGHT)
        return (
            (x + half - o["cx"]) / o["fx"],
            (x + (TILE_WIDTH - half) - o["cx"]) / o["fx"],
            (y + half - o["cy"]) / o["fy"],
            (y + (TILE_HEIGHT - half) - o["cy"]) / o["fy"],
        )

    def tile_grid(self) -> tuple[tuple[mi.Float, mi.Float, mi.Float], tuple[mi.Float, mi.Float, mi.Float]]:
        """Return slope of the first tile's centre, step between tiles, and tile width, along u and along v.

        The view must be undistorted.
        """
        o, inset = self._opaque, 1.0 if self.samples == 1 else 0.0
        return (
            ((0.5 * TILE_WIDTH - o["cx"]) / o["fx"], TILE_WIDTH / o["fx"], (TILE_WIDTH - inset) / o["fx"]),
            ((0.5 * TILE_HEIGHT - o["cy"]) / o["fy"], TILE_HEIGHT / o["fy"], (TILE_HEIGHT - inset) / o["fy"]),
        )

    @cached_property
    def _tile_table(self) -> mi.Float:
        """Slope boxes of all tiles of a distorted view, 4 floats each, from the slopes along each tile's border."""
        tiles = self.tiles_x * self.tiles_y
        tile = dr.arange(mi.UInt32, tiles)
        x, y = mi.Float(tile % self.tiles_x * TILE_WIDTH), mi.Float(tile // self.tiles_x * TILE_HEIGHT)
        lo_u = lo_v = mi.Float(dr.inf)
        hi_u = hi_v = mi.Float(-dr.inf)
        edge = {(i, dy) for i in range(TILE_WIDTH + 1) for dy in (0, TILE_HEIGHT)}
        edge |= {(dx, i) for dx in (0, TILE_WIDTH) for i in range(TILE_HEIGHT + 1)}
        # Pixels beyond the image are not rendered. The lens may have no rays there.
        width, height = dr.opaque(mi.Float, self.width), dr.opaque(mi.Float, self.height)
        for dx, dy in sorted(edge):
            u, v = self.slopes(dr.minimum(x + dx, width), dr.minimum(y + dy, height))
            lo_u, hi_u = dr.minimum(lo_u, u), dr.maximum(hi_u, u)
            lo_v, hi_v = dr.minimum(lo_v, v), dr.maximum(hi_v, v)
        table = dr.empty(mi.Float, 4 * tiles)
        dr.scatter(table, mi.Array4f(lo_u, hi_u, lo_v, hi_v), tile)
        dr.eval(table)
        return table

    @cached_property
    def _extent(self) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        rows = np.array(self._tile_table).reshape(-1, 4)
        lo, hi = rows.min(axis=0), rows.max(axis=0)
        return tuple(dr.opaque(mi.Float, float(v)) for v in (lo[0], hi[1], lo[2], hi[3]))
