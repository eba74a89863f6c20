"""Response of Gaussians along rays: opacity and depth of the peak."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Quality
from mitsplat.renderer.projection.records import GaussianRecord, PlaneRecord


def respond_along(
    record: GaussianRecord,
    plane_records: mi.Float | None,
    us: list[mi.Float],
    vs: list[mi.Float],
    shared_column: bool,
    cap: mi.Float | None,
) -> list[tuple[mi.Float, mi.Float]]:
    """Compute the response of one Gaussian per lane on several rays, by the formula of module `gaussian`.

    Args:
        record: Gaussian of each lane.
        plane_records: Records of the Gaussians that reach the camera's plane; None if there are none.
        us: Slopes u of a lane's rays.
        vs: Slopes v of a lane's rays.
        shared_column: True if all rays of a lane have the same slope u. Its terms are then computed once.
        cap: log2 of the largest opacity; None for no limit.

    Returns:
        For each ray, log2 of the opacity along it and depth of the peak [m].
    """
    u0, v0, a, b2, c, opacity, *_, depth, e, f, g, h, i, _ = record
    result: list[mi.Float] = []
    previous: tuple[mi.Float, ...] | None = None
    slant = 0.5 * depth * f
    for u, v in zip(us, vs, strict=True):
        if previous is None or not shared_column:
            du = u - u0
            ahead = depth * dr.fma(0.5 * du, e, 1)
            previous = a * du * du, b2 * du, dr.fma(du, dr.fma(du, g, e), 1), dr.fma(du, h, f), ahead
        top, top_v, bottom, bottom_v, ahead = previous
        dv = v - v0
        numerator = dr.fma(dv, dr.fma(dv, c, top_v), top)
        inverse = dr.rcp(dr.fma(dv, dr.fma(dv, i, bottom_v), bottom))
        result += [dr.fma(-numerator, inverse, opacity), dr.fma(dv, slant, ahead) * inverse]

    def at_the_camera(result: list[mi.Float], row: mi.Float) -> tuple[list[mi.Float], mi.Float]:
        plane_record = PlaneRecord.fetch(plane_records, mi.UInt32(row))
        found: list[mi.Float] = []
        for u, v in zip(us, vs, strict=True):
            q, depth = plane_record.respond(u, v)
            found += [opacity - q, depth]
        return found, row

    if plane_records is not None:
        result, _ = dr.if_stmt(
            (result, u0), a < 0, at_the_camera, lambda result, row: (result, row), label="gaussian at the camera"
        )
    # Rounding can raise the response of a needle-shaped Gaussian above its peak by any factor.
    most = opacity if cap is None else dr.minimum(opacity, cap)
    log_alphas = [dr.select(log_alpha > most, most, log_alpha) for log_alpha in result[0::2]]
    return list(zip(log_alphas, result[1::2], strict=True))


def min_log_opacity(quality: Quality) -> mi.Float:
    """Return log2 of the smallest opacity that counts, limited to the domain of :func:`exp2`."""
    return dr.maximum(dr.log2(dr.opaque(mi.Float, quality.alpha_min)), -126)


def exp2(x: mi.Float) -> mi.Float:
    """Compute 2^x for x in [-126, 126] with relative error below 2e-7; the result is undefined outside.

    On a CPU, the nearest integer is added to the exponent, and a polynomial that is 1 at 0 covers the remainder. This
    takes half of the instructions of Dr.Jit's own function, which has no limits. A GPU has one instruction for it.
    """
    if dr.backend_v(x) == dr.JitBackend.CUDA:
        return dr.exp2(x)
    rounded = x + _ROUNDS
    rest = x - (rounded - _ROUNDS)
    power = mi.Float(_EXP2[-1])
    for coefficient in reversed(_EXP2[:-1]):
        power = dr.fma(power, rest, coefficient)
    exponent = dr.reinterpret_array(mi.UInt32, rounded) << 23
    return dr.reinterpret_array(mi.Float, dr.reinterpret_array(mi.UInt32, power) + exponent)


_ROUNDS = 1.5 * 2.0**23
"""Float whose addition rounds a number to an integer, stored in the low bits of the sum."""

_EXP2 = 1.0, 0.69314700, 0.24022242, 0.055507336, 0.0096715130, 0.0013264727
"""Polynomial coefficients of 2^x on [-1/2, 1/2] with the smallest relative error."""
