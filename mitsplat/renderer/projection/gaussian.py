"""Ray–Gaussian geometry: from 3D Gaussians and a camera to per-view records that a ray can evaluate.

In camera space a ray is ``d = (u, v, 1)`` with slopes u = x/z and v = y/z. Let ``W`` whiten a Gaussian of mean ``m``
(``W = diag(1/sigma) R^T``) and let ``d0 = m / m_z`` be the ray through its mean. With ``w0 = W d0``, ``w1 = W e_x``,
``w2 = W e_y`` and ``(du, dv) = (u - u0, v - v0)`` the squared Mahalanobis distance at the ray's closest approach is

    q = (A du^2 + 2 B du dv + C dv^2) / (1 + E du + F dv + G du^2 + H du dv + I dv^2)

    A = m_z^2 |w0 x w1|^2 / |w0|^2,   B = m_z^2 (w0 x w1).(w0 x w2) / |w0|^2,   C = m_z^2 |w0 x w2|^2 / |w0|^2
    E = 2 w0.w1 / |w0|^2,  F = 2 w0.w2 / |w0|^2,  G = |w1|^2 / |w0|^2,  H = 2 w1.w2 / |w0|^2,  I = |w2|^2 / |w0|^2

and the depth of that point is ``z = m_z (1 + (E du + F dv) / 2) / (the same denominator)``. Both follow from the
expansion of ``|W m|^2 - (W m . W d)^2 / |W d|^2`` about d0 with Lagrange's identity. Nothing is linearised, so that the
response is exact for every perspective ray. No two large numbers are subtracted, so that float32 is sufficient for
small and distant Gaussians, where the textbook form loses all its digits.

A low-pass filter of covariance K on the image changes the footprint's covariance to M^-1 + K, where M = ((A, B), (B,
C)):

    M' = (M + det(M) adj(K)) / D,   D = det(I + M K) = 1 + tr(M K) + det(M) det(K),   opacity' = opacity / sqrt(D)

As for any joint Gaussian, the slope terms of depth and denominator shrink by P = (I + M K)^-1. The filter spreads a
Gaussian over rays that pass beside it, but does not define its depth there.

The rays on which a Gaussian reaches the cut-off ``q <= k^2`` fill the conic ``numerator - k^2 denominator <= 0``. It is
an ellipse with a closed-form bounding box, unless the cut-off ellipsoid touches the camera's plane z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.projection.records import PlaneRecord

LOG2_E_HALF = 0.5 * 1.4426950408889634
"""Factor log2(e)/2 from a squared Mahalanobis distance to the binary logarithm of the response."""


def evaluate_sh(direction: mi.Vector3f, coefficient: Callable[[int], list[mi.Float]], sh_count: int) -> list[mi.Float]:
    """Evaluate the display-encoded colour of Gaussians along unit vectors.

    The basis is that of 3DGS, real spherical harmonics (Kerbl et al. 2023).

    Args:
        direction: Unit vector from the camera to the Gaussian, in the Gaussians' own frame. A rotated object therefore
            needs no rotation of its coefficients.
        coefficient: Function of the coefficient's index that returns its three channels.
        sh_count: Number of coefficients per channel, 1, 4, 9 or 16.
    """
    x, y, z = direction.x, direction.y, direction.z
    basis: list[mi.Float] = [0.28209479177387814]
    if sh_count > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if sh_count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if sh_count > 9:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    colour = [mi.Float(0.5)] * 3
    for k, value in enumerate(basis):
        c = coefficient(k)
        colour = [dr.fma(c[i], value, colour[i]) for i in range(3)]
    return [dr.maximum(c, 0.0) for c in colour]


def srgb_to_linear(value: mi.Float) -> mi.Float:
    """Apply the electro-optical transfer of IEC 61966-2-1, extended above 1."""
    return dr.select(
        value <= 0.04045, value / 12.92, dr.power(dr.fma(dr.maximum(value, 0), 1 / 1.055, 0.055 / 1.055), 2.4)
    )


def linear_to_srgb(value: mi.Float) -> mi.Float:
    """Apply the inverse of :func:`srgb_to_linear`; values below 0 count as 0."""
    value = dr.maximum(value, 0)
    return dr.select(value <= 0.0031308, 12.92 * value, 1.055 * dr.power(dr.maximum(value, 1e-9), 1 / 2.4) - 0.055)


def rotation_axes(q: mi.Array4f) -> Axes:
    """Return the columns of a quaternion's (xyzw) rotation matrix: the Gaussian's axes in its frame."""
    x, y, z, w = q
    return (
        mi.Vector3f(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        mi.Vector3f(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        mi.Vector3f(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


Axes = tuple["mi.Vector3f", "mi.Vector3f", "mi.Vector3f"]
Conic6 = tuple["mi.Float", "mi.Float", "mi.Float", "mi.Float", "mi.Float", "mi.Float"]
"""Coefficients of u^2, uv, v^2, u, v and 1."""


@dataclass(frozen=True, eq=False)
class Response:
    """Response of a Gaussian to rays: centre, coefficients (module docstring), depth and det(M)."""

    u0: mi.Float
    v0: mi.Float
    a: mi.Float
    b2: mi.Float
    c: mi.Float
    e: mi.Float
    f: mi.Float
    g: mi.Float
    h: mi.Float
    i: mi.Float
    depth: mi.Float
    det: mi.Float

    def filtered(self, k11: mi.Float, k12: mi.Float, k22: mi.Float) -> tuple[Response, mi.Float]:
        """Return the response under a low-pass filter of covariance K in slopes, and det(I + M K).

        See the module docstring.
        """
        b = 0.5 * self.b2
        p, q = self.a * k11 + b * k12, self.a * k12 + b * k22
        r, s = b * k11 + self.c * k12, b * k12 + self.c * k22
        det = 1 + p + s + self.det * (k11 * k22 - k12 * k12)
        inverse = dr.rcp(det)
        p11, p12, p21, p22 = (1 + s) * inverse, -q * inverse, -r * inverse, (1 + p) * inverse
        g, h, i = self.g, 0.5 * self.h, self.i
        response = replace(
            self,
            a=(self.a + self.det * k22) * inverse,
            b2=2 * (b - self.det * k12) * inverse,
            c=(self.c + self.det * k11) * inverse,
            e=p11 * self.e + p12 * self.f,
            f=p21 * self.e + p22 * self.f,
            g=p11 * (p11 * g + p12 * h) + p12 * (p11 * h + p12 * i),
            h=2 * (p11 * (p21 * g + p22 * h) + p12 * (p21 * h + p22 * i)),
            i=p21 * (p21 * g + p22 * h) + p22 * (p21 * h + p22 * i),
            det=self.det * inverse,
        )
        return response, det

    def parallel(self) -> Response:
        """Return the response along rays parallel to the central one, without perspective within the footprint."""
        return replace(self, e=mi.Float(0), f=mi.Float(0), g=mi.Float(0), h=mi.Float(0), i=mi.Float(0))

    def cutoff(self, k2: mi.Float) -> Conic6:
        """Return coefficients of du^2, du dv, dv^2, du, dv and 1 of the conic that is <= 0 where q <= k^2."""
        return (self.a - k2 * self.g, self.b2 - k2 * self.h, self.c - k2 * self.i, -k2 * self.e, -k2 * self.f, -k2)


@dataclass(frozen=True, eq=False)
class PlacedGaussian:
    """Gaussians and the camera in the frame of a cloud.

    Attributes:
        mean: Centre relative to the camera's centre.
        axes: The three principal axes.
        sigma: Standard deviations along them.
        right, down, forward: The camera's x, y and z axes.
        scale: Size of one unit of the frame [m].
    """

    mean: mi.Vector3f
    axes: Axes
    sigma: list[mi.Float]
    right: mi.Vector3f
    down: mi.Vector3f
    forward: mi.Vector3f
    scale: mi.Float


def project_gaussian(gaussian: PlacedGaussian) -> Response:
    """Compute the response coefficients of Gaussians."""
    mean, sigma, right, down, forward = (gaussian.mean, gaussian.sigma, gaussian.right, gaussian.down, gaussian.forward)
    depth = dr.dot(forward, mean)
    inv_depth = dr.rcp(depth)
    u0, v0 = dr.dot(right, mean) * inv_depth, dr.dot(down, mean) * inv_depth
    ray = mean * inv_depth
    thinnest = dr.minimum(dr.minimum(sigma[0], sigma[1]), sigma[2])
    ratio = [thinnest / s for s in sigma]

    def whiten(vector: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f(*[dr.dot(axis, vector) * r for axis, r in zip(gaussian.axes, ratio, strict=True)])

    w0, w1, w2 = whiten(ray), whiten(right), whiten(down)
    n0 = dr.rcp(dr.squared_norm(w0))
    c1, c2 = dr.cross(w0, w1), dr.cross(w0, w2)
    gain = dr.square(depth / thinnest) * n0
    return Response(
        u0=u0,
        v0=v0,
        a=gain * dr.squared_norm(c1),
        b2=2 * gain * dr.dot(c1, c2),
        c=gain * dr.squared_norm(c2),
        e=2 * n0 * dr.dot(w0, w1),
        f=2 * n0 * dr.dot(w0, w2),
        g=n0 * dr.squared_norm(w1),
        h=2 * n0 * dr.dot(w1, w2),
        i=n0 * dr.squared_norm(w2),
        depth=depth * gaussian.scale,
        det=dr.square(gain * dr.dot(w0, dr.cross(w1, w2))) * dr.squared_norm(w0),
    )


def ellipse_bounds(cutoff: Conic6) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Bool]:
    """Return the bounding box (du_min, du_max, dv_min, dv_max) of a conic, and True where it is an ellipse."""
    a, b, c, d, e, f = cutoff
    det = 4 * a * c - b * b
    ellipse = (a > 0) & (c > 0) & (det > 1e-6 * a * c)
    inv = dr.select(ellipse, dr.rcp(det), 0.0)
    mid_u, mid_v = b * e - 2 * c * d, b * d - 2 * a * e
    half_u = dr.safe_sqrt(mid_u * mid_u + det * (e * e - 4 * c * f))
    half_v = dr.safe_sqrt(mid_v * mid_v + det * (d * d - 4 * a * f))
    return (mid_u - half_u) * inv, (mid_u + half_u) * inv, (mid_v - half_v) * inv, (mid_v + half_v) * inv, ellipse


def ellipse_spans(cutoff: Conic6) -> Callable[[mi.Float, mi.Float], tuple[mi.Float, mi.Float, mi.Bool]]:
    """Return a function that clips an ellipse to a band of v.

    The function maps the limits of the band to (du_min, du_max) of the ellipse in it, and to True if they intersect.
    """
    a, b, c, d, e, f = cutoff
    du_min, du_max, _, _, _ = ellipse_bounds(cutoff)
    half = 0.5 * dr.rcp(a)
    extremes = [-0.5 * (b * du + e) / c for du in (du_min, du_max)]

    def edge(v: mi.Float, sign: float) -> tuple[mi.Float, mi.Bool]:
        linear = dr.fma(b, v, d)
        root = dr.square(linear) - 4 * a * dr.fma(dr.fma(c, v, e), v, f)
        return (sign * dr.safe_sqrt(root) - linear) * half, root >= 0

    def span(lo_v: mi.Float, hi_v: mi.Float) -> tuple[mi.Float, mi.Float, mi.Bool]:
        # The outline recedes on both sides of the ellipse's extreme point, so that the nearest v of the band is
        # decisive.
        lo, below = edge(dr.clip(extremes[0], lo_v, hi_v), -1.0)
        hi, above = edge(dr.clip(extremes[1], lo_v, hi_v), 1.0)
        return lo, hi, below & above

    return span


def conic_touches_rectangle(conic: Conic6, lo_u: mi.Float, hi_u: mi.Float, lo_v: mi.Float, hi_v: mi.Float) -> mi.Bool:
    """Return True if a conic is <= 0 anywhere in an axis-aligned rectangle; exact for every kind of conic.

    The minimum of a quadratic over a rectangle lies at a corner, at the vertex of an edge along which it is convex, or,
    if it is convex, at its centre.
    """
    a, b, c, d, e, f = conic

    def along_u(v: mi.Float) -> mi.Float:
        u = dr.clip(dr.select(a > 0, -0.5 * (b * v + d) / a, lo_u), lo_u, hi_u)
        return (a * u + b * v + d) * u + (c * v + e) * v + f

    def along_v(u: mi.Float) -> mi.Float:
        v = dr.clip(dr.select(c > 0, -0.5 * (b * u + e) / c, lo_v), lo_v, hi_v)
        return (c * v + b * u + e) * v + (a * u + d) * u + f

    def at(u: mi.Float, v: mi.Float) -> mi.Float:
        return (a * u + b * v + d) * u + (c * v + e) * v + f

    det = 4 * a * c - b * b
    centre_u, centre_v = (b * e - 2 * c * d) / det, (b * d - 2 * a * e) / det
    inside = (centre_u >= lo_u) & (centre_u <= hi_u) & (centre_v >= lo_v) & (centre_v <= hi_v)
    convex = (a > 0) & (c > 0) & (det > 0)
    least = dr.minimum(dr.minimum(along_u(lo_v), along_u(hi_v)), dr.minimum(along_v(lo_u), along_v(hi_u)))
    least = dr.minimum(least, dr.minimum(at(hi_u, lo_v), at(hi_u, hi_v)))
    least = dr.select(inside & convex, dr.minimum(least, at(centre_u, centre_v)), least)
    return least <= 0


def respond_at_plane(gaussian: PlacedGaussian) -> PlaneRecord:
    """Compute the response of Gaussians at the camera's plane, without a reference ray.

    With d = (u, v, 1): q = |W m x W d|^2 / |W d|^2 and z = (W m . W d) / |W d|^2.
    """
    w1, w2, w3, wm = (
        mi.Vector3f(*[dr.dot(axis, vector) / s for axis, s in zip(gaussian.axes, gaussian.sigma, strict=True)])
        for vector in (gaussian.right, gaussian.down, gaussian.forward, gaussian.mean)
    )
    c1, c2, c3 = dr.cross(wm, w1), dr.cross(wm, w2), dr.cross(wm, w3)

    def quadratic(p: mi.Vector3f, q: mi.Vector3f, r: mi.Vector3f) -> list[mi.Float]:
        return [dr.dot(p, p), 2 * dr.dot(p, q), dr.dot(q, q), 2 * dr.dot(p, r), 2 * dr.dot(q, r), dr.dot(r, r)]

    numerator = [value * LOG2_E_HALF for value in map(dr.detach, quadratic(c1, c2, c3))]
    denominator = map(dr.detach, quadratic(w1, w2, w3))
    depth = (dr.detach(gaussian.scale * dr.dot(wm, w)) for w in (w1, w2, w3))
    return PlaneRecord._make([*numerator, *denominator, *depth, mi.Float(0)])
