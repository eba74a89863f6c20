"""Checks of the values of splats in PLY files: logarithms, logits and coefficients, and contradictory colours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import sh_to_rgb

_MIN_JUDGED = 100
"""Number of Gaussians from which their values show how they are encoded."""
_MIN_SPREAD = 0.7
"""Range of stored opacities from which those from 0 to 1 are no logits."""
_MIN_VALUES = 10
"""Number of different opacities from which whole numbers are no logits. Splats of a program may have one logit, 4."""
_MAX_COEFFICIENT = 10.0
"""Median of constant coefficients above which they are no colours: 1.8 is white."""
_EQUAL_COLOURS = 6.0
"""Median difference of colours from 0 to 255 above which they are other colours."""
_MIN_COLOUR_RANGE = 0.9
"""Range of constant coefficients in 0 to 1 from which they are probably colours."""
_MAX_SIZE = 100.0
"""Size of a Gaussian, relative to all positions, above which sizes are no logarithms."""
_MAX_STEP = 0.25
"""Maximum step of 32-bit positions relative to the usual size of a Gaussian."""
_COLOUR_SPACE = "color_space"
"""Element of the files of SHARP (Apple): 0 for sRGB, 1 for linear colours."""


def check_encoding(means: Float32Array, scales: Float32Array, opacities: Float32Array, colours: Float32Array) -> None:
    """Refuse sizes, opacities and colours in place of the logarithms, logits and coefficients of a PLY file.

    The arrays are those of N Gaussians before activation: means and scales (N, 3), opacities (N, 1),
    colours (N, 3).

    Trained splats have logits outside of 0 to 1, and most of their Gaussians are smaller than the cloud. A file is
    refused in five cases:

    * All logits lie in 0 to 1, and they cover this range or all Gaussians are larger than one unit.
    * All Gaussians are larger than one unit, and most of them are as large as the cloud, or one is 100 times as large.
    * Only the third scale is the same for all Gaussians, and it is larger than most of the others.
    * The coefficients are as large as colours from 0 to 255.
    * All opacities are whole numbers from 0 up, as of bytes or percent, with several values.
    """
    if len(scales) < _MIN_JUDGED:
        return
    low, high = float(opacities.min()), float(opacities.max())
    if 0 <= low <= high <= 1 and (scales.min() > 0 or high - low > _MIN_SPREAD):
        raise InputError(
            "scale_0 to scale_2 and opacity of a PLY file must be logarithms and logits (got "
            f"{scales.min():.3g} to {scales.max():.3g}, and {low:.3g} to {high:.3g}): apply log "
            "to the scales and log(o / (1 - o)) to the opacities"
        )
    is_whole = low >= 0 and high > 1 and np.isfinite(high) and np.array_equal(opacities, np.rint(opacities))
    if is_whole and len(np.unique(opacities)) >= _MIN_VALUES:
        raise InputError(
            f"opacity of a PLY file must be logits (got whole numbers from {low:.0f} to {high:.0f}): divide them by "
            "their maximum (255 or 100), and apply log(o / (1 - o))"
        )
    extent = float(np.ptp(np.percentile(means, (5, 95), axis=0), axis=0).max())
    if scales.min() > 0 and (size := float(np.exp(np.median(scales)))) > 0.5 * extent:
        raise InputError(
            f"scale_0 to scale_2 of a PLY file must be logarithms (got {scales.min():.3g} to {scales.max():.3g}, which "
            f"are Gaussians of {size:.3g} units in a cloud of {extent:.3g} units): apply log to the scales"
        )
    with np.errstate(all="ignore"):
        size, whole = float(np.exp(np.float64(scales.max()))), float(np.ptp(means, axis=0).max())
    if scales.min() > 0 and np.isfinite(scales.max()) and size > _MAX_SIZE * whole:
        raise InputError(
            f"scale_0 to scale_2 of a PLY file must be logarithms (got {scales.min():.3g} to {scales.max():.3g}, "
            f"of which the last is a Gaussian of {size:.3g} units): apply log to the scales"
        )
    others, last = scales[:, :2], scales[:, 2:]
    is_constant = last.size and last.min() == last.max() and others.min() < others.max()
    if is_constant and last[0, 0] > np.median(others):
        raise InputError(
            f"scale_2 of a PLY file must be the logarithm of each third scale (got {last[0, 0]:g} for all): if the "
            "Gaussians are flat (2DGS), remove the column"
        )
    if (usual := float(np.median(np.abs(colours)))) > _MAX_COEFFICIENT:
        raise InputError(
            "f_dc_0 to f_dc_2 of a PLY file must be coefficients of spherical harmonics (got values of "
            f"{usual:.3g}): convert colours from 0 to 255 by (c / 255 - 0.5) / 0.2821"
        )


def check_precision(means: Float32Array, scales: Float32Array) -> None:
    """Refuse positions so far from the origin that 32-bit numbers are too coarse, such as coordinates on a map."""
    if not len(means) or not np.isfinite(means).all():
        return
    farthest = float(np.median(np.abs(means), axis=0).max())
    step, size = float(np.spacing(np.float32(farthest))), float(np.median(scales.max(axis=1)))
    if 0 < _MAX_STEP * size < step:
        raise InputError(
            f"positions must be near the origin (got up to {farthest:.3g}, where 32-bit numbers have steps of "
            f"{step:.2g}, for Gaussians of {size:.2g} units): export the splats relative to their centre"
        )


def are_colours(coefficients: Float32Array) -> bool:
    """Return True if constant coefficients (N, 3) lie in 0 to 1 and cover this range, as colours do."""
    if len(coefficients) < _MIN_JUDGED:
        return False
    low, high = float(coefficients.min()), float(coefficients.max())
    return low >= 0 and high <= 1 and high - low > _MIN_COLOUR_RANGE


def check_colour_space(data: bytes, elements: Mapping[str, tuple[int, np.dtype[np.void]]], start: int) -> None:
    """Refuse a PLY file whose element ``color_space`` states linear colours.

    Args:
        data: The file.
        elements: Numbers and row types of its elements, in their order.
        start: Offset of the first row [bytes].

    Raises:
        InputError: If the value is not 0.
    """
    before = list(elements)[: list(elements).index(_COLOUR_SPACE)] if _COLOUR_SPACE in elements else []
    if not before or any(elements[name][1].hasobject for name in (*before, _COLOUR_SPACE)):
        return
    kind = elements[_COLOUR_SPACE][1]
    start += sum(count * row.itemsize for count, row in (elements[name] for name in before))
    if len(data) < start + kind.itemsize:
        return
    value = np.frombuffer(data, kind, 1, start)[0]
    if any(value[name] for name in kind.names or ()):
        raise InputError(f"its colours must be sRGB (its element {_COLOUR_SPACE} is {value[0]}, linear): export sRGB")


def colours_differ(colours: Float32Array, coefficients: Float32Array) -> bool:
    """Return True if colours (N, 3), from 0 to 255 or to 1, are not those of constant coefficients (N, 3)."""
    if not len(colours):
        return False
    scale = 1.0 if colours.max() > 1 else 255.0
    expected = 255 * np.clip(sh_to_rgb(coefficients.astype(np.float64)), 0, 1)
    return bool(np.median(np.abs(scale * colours - expected).max(axis=1)) > _EQUAL_COLOURS)
