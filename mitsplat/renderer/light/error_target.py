"""Standard errors of light, estimated and tolerated, and automatic exposure."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

MID_GREY = 0.5
"""Mid-grey irradiance as a share of white. The wanted standard error applies at this level."""

MIN_LIGHT = 0.05
"""Light level below which the tolerated error does not decrease further."""

DISPLAY = 1 / 2.2
"""Exponent of displayed light. Displayed values are perceptually even, and files store them in even steps."""

_STEPS = 1 << 20
"""Integer steps of displayed light 1, fine enough for light of 1e-8; integer sums do not depend on the number of
threads.
"""


def allowed_error(error: float, light: mi.Float) -> mi.Float:
    """Return the tolerated standard error at a light level, given that at ``MID_GREY``.

    It follows the slope of the display curve.
    """
    return error * dr.power(dr.clip(light, MIN_LIGHT, 1) / MID_GREY, 1 - DISPLAY)


def share_variance(share: mi.Float, draws: mi.Float) -> mi.Float:
    """Return the variance of a light share that a number of binary ``draws`` has estimated.

    Half a draw of each outcome is added (Jeffreys), so that a few equal draws do not count as certain.
    """
    likely = (share * draws + 0.5) / (draws + 1)
    return likely * (1 - likely) / draws


def exposure_factor(light: mi.Float, area: mi.Int32, others: mi.UInt32) -> mi.Float:
    """Return the factor of an automatic exposure, which makes the mean of a picture look like ``MID_GREY``.

    Each value of ``light`` represents ``area`` pixels. The ``others`` count as 1.
    """
    # Opaque, because the sum of a literal would enter the kernel.
    area = mi.UInt64(area + dr.opaque(mi.Int32, 0, dr.width(light)))
    looks = mi.UInt64(dr.power(dr.maximum(light, 0), DISPLAY) * _STEPS + 0.5)
    mean = mi.Float(dr.sum(looks * area) + mi.UInt64(others) * _STEPS) / mi.Float(dr.sum(area) + others)
    return MID_GREY * dr.power(dr.maximum(mean / _STEPS, 1e-6), -1 / DISPLAY)
