"""Blending of a Gaussian into the state of a ray, with an estimate or a correction of order errors.

Blending order and colour error. Suppose that Gaussians were blended in the order of their peaks, with weights w_i and
colours c_i. One more Gaussian with opacity a and colour c follows, whose peak lies in front of some of them, the set B.
In its correct place it takes the share a of the light of B and is attenuated only by the Gaussians in front of B.
Blended last, it is attenuated by B as well:

    in its place   sum_front w_i c_i + a (T + W) c + (1 - a) C
    at the end     sum_front w_i c_i + C + a T c

W and C are the sums of w_i and of w_i c_i over B, and T is the transmittance behind all. The difference is

    a (W c - C),

which for one neighbour is the well-known a_i a_j T (c_j - c_i). The sum over all Gaussians is the exact error of a ray,
and the sum of absolute values is a bound of it. Finding B exactly would need a search through all blended Gaussians. A
late Gaussian mostly lies just in front of the deepest ones. W and C are therefore estimated from decaying sums of w_i,
w_i c_i and w_i z_i: a new deepest Gaussian of weight w scales them by S / (S + 2 w), where S is the sum of weights. The
share of these sums behind the late peak counts. It assumes that they extend evenly from the deepest peak to the same
distance in front of their mean. The state of a ray grows by seven numbers for this. A Gaussian so late that its ray has
already ended is not detected.

`fast` adds the difference to the colour instead (`correct_late_gaussians`), so that a late Gaussian takes light from
those it occludes. Its weight and theirs change by the same amount, so that a uniform colour stays uniform. Here the
sums decay faster, by S / (S + 8 w).
"""

from __future__ import annotations

from typing import Literal

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Quality
from mitsplat.renderer.projection.records import GaussianRecord
from mitsplat.renderer.splatting.instance_votes import add_to_tally, new_tally
from mitsplat.renderer.splatting.walk import TRANSMITTANCE, FieldsOnAccess, Pixel

RED, GREEN, BLUE, SUM_Z, HALF_Z, TALLY = range(1, 7)
"""Indices of a ray's state after the transmittance: red, green, blue, sum of weighted depths, depth at half
transmittance, and first entry of the instance tally (if there are several instances). The state of late peaks comes
last, see :data:`_EXTRA_STATE`.
"""

OutOfOrder = Literal["ignored", "estimated", "corrected"]
"""Treatment of out-of-order Gaussians: ignored, blended with an error estimate, or with a colour correction."""

_EXTRA_STATE: dict[OutOfOrder, int] = {"ignored": 0, "estimated": 7, "corrected": 6}
"""Numbers in a ray's state for late peaks."""

ERROR, DEEPEST, SUMS = -7, -6, slice(-5, None)
"""Indices of the state of late peaks: error estimate; deepest peak; and decaying sums of weights and of weights times
depth, red, green, blue.
"""

_DECAY = 8
"""Decay rate of the sums where late peaks are corrected, in weights of a new deepest Gaussian. From 2 on, larger values
are better for solid walls and worse for solid objects: between 2 and 16 the PSNR of captures changes by up to 1.4 dB.
"""


def new_state(several: bool, late: OutOfOrder) -> Pixel:
    """Return the initial state of a ray."""
    nothing = [mi.Float(0.0) for _ in range(TALLY - 1)]
    tally, extra = new_tally() if several else [], [mi.Float(0.0) for _ in range(_EXTRA_STATE[late])]
    return [mi.Float(1.0), *nothing, *tally, *extra]


def blend(
    pixel: Pixel, alpha: mi.Float, record: GaussianRecord | FieldsOnAccess, z: mi.Float, several: bool, late: OutOfOrder
) -> Pixel:
    """Return the state of a ray after one more Gaussian.

    Args:
        pixel: State of the ray.
        alpha: Opacity of the Gaussian on the ray; 0 leaves the state unchanged.
        record: Gaussian, for colour and instance.
        z: Depth of its peak [m].
        several: True if the state has a tally of instances.
        late: How the state treats Gaussians that come late in the order.
    """
    weight = pixel[TRANSMITTANCE] * alpha
    transmittance = pixel[TRANSMITTANCE] - weight
    colour = record.colour
    sums = [dr.fma(weight, c, sum_c) for c, sum_c in zip(colour, pixel[RED : BLUE + 1], strict=True)]
    extra: list[mi.Float] = []
    if late == "estimated":
        extra = _add_to_error(pixel, alpha, weight, colour, z)
    elif late == "corrected":
        change, extra = _corrected(pixel, alpha, weight, colour, z)
        sums = [a + b for a, b in zip(sums, change, strict=True)]
    return [
        transmittance,
        *sums,
        dr.fma(weight, z, pixel[SUM_Z]),
        dr.select((pixel[TRANSMITTANCE] >= 0.5) & (transmittance < 0.5), z, pixel[HALF_Z]),
        *(add_to_tally(pixel[TALLY : len(pixel) - len(extra)], weight, record.instance) if several else []),
        *extra,
    ]


def _shares(pixel: Pixel, weight: mi.Float, late: mi.Bool, z: mi.Float, decay: int) -> tuple[mi.Float, mi.Float]:
    """Return the share of the sums behind a late peak, and the share kept after a new deepest peak.

    See the module. Both cases use the same division.
    """
    total, moment, *_ = pixel[SUMS]
    gap, reach = (pixel[DEEPEST] - z) * total, 2 * dr.fma(pixel[DEEPEST], total, -moment)
    ratio = dr.select(late, gap, total) / dr.select(late, reach, dr.fma(decay, weight, total))
    return dr.select(gap < reach, ratio, 1.0), ratio


def _add_to_error(
    pixel: Pixel, alpha: mi.Float, weight: mi.Float, colour: list[mi.Float], z: mi.Float
) -> list[mi.Float]:
    """Return the state of late peaks with the error estimate after one more Gaussian, see the module."""
    total, _, *colours = pixel[SUMS]
    deepest, met = pixel[DEEPEST], weight > 0
    late = met & (z < deepest)
    change = mi.Float(0.0)
    for c, sum_c in zip(colour, colours, strict=True):
        change = dr.maximum(change, dr.abs(dr.fma(total, c, -sum_c)))
    behind, kept = _shares(pixel, weight, late, z, 2)
    keep = dr.select(met & ~late, kept, 1.0)
    return [
        dr.select(late, dr.fma(alpha * behind, change, pixel[ERROR]), pixel[ERROR]),
        dr.select(met, dr.maximum(z, deepest), deepest),
        *(dr.fma(keep, old, weight * f) for old, f in zip(pixel[SUMS], [1.0, z, *colour], strict=True)),
    ]


def _corrected(
    pixel: Pixel, alpha: mi.Float, weight: mi.Float, colour: list[mi.Float], z: mi.Float
) -> tuple[list[mi.Float], list[mi.Float]]:
    """Return the colour correction for a late Gaussian, and the state of late peaks after it."""
    change, sums = _late_change(pixel, alpha, weight, z, [1.0, z, *colour], pixel[SUMS])
    return change[2:], [dr.select(weight > 0, dr.maximum(z, pixel[DEEPEST]), pixel[DEEPEST]), *sums]


def _late_change(
    pixel: Pixel, alpha: mi.Float, weight: mi.Float, z: mi.Float, values: list[mi.Float | float], sums: list[mi.Float]
) -> tuple[list[mi.Float], list[mi.Float]]:
    """Return the corrections of blended ``values`` for a late Gaussian, and their decaying ``sums`` after it."""
    met, total = weight > 0, pixel[SUMS][0]
    late = met & (z < pixel[DEEPEST])
    behind, kept = _shares(pixel, weight, late, z, _DECAY)
    taken = dr.select(late, alpha * behind, 0.0)
    keep, own = dr.select(met & ~late, kept, 1.0 - taken), dr.fma(taken, total, weight)
    return (
        [taken * dr.fma(total, value, -old) for value, old in zip(values, sums, strict=True)],
        [dr.fma(keep, old, own * value) for value, old in zip(values, sums, strict=True)],
    )


SHARE = 9
"""Numbers that follow the state of a ray in :func:`blend_share`: an instance id; weight, red, green and blue of this
instance; and their decaying sums.
"""


def blend_share(
    pixel: Pixel, alpha: mi.Float, record: GaussianRecord | FieldsOnAccess, z: mi.Float, several: bool, late: OutOfOrder
) -> Pixel:
    """Return the state of a ray after one more Gaussian, and the share that one instance has of it."""
    state, own, share, decaying = pixel[:-SHARE], pixel[-SHARE], pixel[1 - SHARE : -4], pixel[-4:]
    weight, counts = state[TRANSMITTANCE] * alpha, record.instance == own
    values = [dr.select(counts, value, 0.0) for value in (1.0, *record.colour)]
    share = [dr.fma(weight, value, total) for value, total in zip(values, share, strict=True)]
    if late == "corrected":
        change, decaying = _late_change(state, alpha, weight, z, values, decaying)
        share = [a + b for a, b in zip(share, change, strict=True)]
    return [*blend(state, alpha, record, z, several, late), own, *share, *decaying]


def out_of_order(quality: Quality) -> OutOfOrder:
    """Return how late peaks are blended without an error estimate; in the order of rays no peak is late."""
    return "corrected" if quality.correct_late_gaussians and quality.order == "tile" else "ignored"


def without_late_state(pixels: list[Pixel], late: OutOfOrder) -> list[Pixel]:
    """Return the states of rays without the state of late peaks."""
    return [pixel[: len(pixel) - _EXTRA_STATE[late]] for pixel in pixels]
