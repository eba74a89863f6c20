"""Loss of one photo of a fit, with gradients with respect to the rendered image: colour, mask and depth."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from mitsplat.fit.training_view import unpacked
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.differentiation.photometric_loss import photometric_loss
from mitsplat.renderer.rays.device_arrays import number
from mitsplat.runtime.recorded_kernels import recorded


class LossConstants(NamedTuple):
    """Constants of the loss that determine its kernels.

    Attributes:
        width, height: Size of the photo [px].
        ssim_share: Weight of D-SSIM relative to L1.
        alpha_weight: Weight of the difference between alpha and mask; None without this term.
        background: True to composite photo and rendering over a background.
    """

    width: int
    height: int
    ssim_share: float
    alpha_weight: float | None
    background: bool


@recorded
def photo_gradients(
    rgb: list[mi.Float],
    alpha: mi.Float,
    depth: tuple[mi.Float, mi.Float] | None,
    photo: tuple[mi.UInt32, mi.Bool | None],
    numbers: mi.Float,
    constants: LossConstants,
) -> tuple[list[mi.Float], mi.Float, mi.Float | None, mi.Float]:
    """Return the gradients of the loss of one photo, and the mean squared error of its pixels.

    Args:
        rgb: Rendered colours, three flat row-major arrays.
        alpha: Rendered opacity.
        depth: Depth moment of the rendering, and known inverse depths from :func:`depth_image`.
        photo: Packed pixels, and a mask of the pixels where the object may be hidden, or None.
        numbers: Background red, green and blue; weight of depth; inverse number of known depths.
        constants: Constants of the loss.

    Returns:
        Gradients of colours, opacity, and depth moment, None without ``depth``; and the error.
    """
    colours, opacity = [mi.Float(c) for c in rgb], mi.Float(alpha)
    moment = None if depth is None else mi.Float(depth[0])
    dr.enable_grad(colours, opacity, moment)
    rgb, alpha, loss = colours, opacity, mi.Float(0)
    if depth is not None:
        loss += number(numbers, 3) * number(numbers, 4) * depth_error(alpha, moment, depth[1])
    target, mask = unpacked(photo[0])
    if constants.background:
        behind = [number(numbers, channel) for channel in range(3)]
        rgb = [c + b * (1 - alpha) for c, b in zip(rgb, behind, strict=True)]
        target = [c + b * (1 - mask) for c, b in zip(target, behind, strict=True)]
    if photo[1] is not None:  # no loss where the object may be hidden
        target = [dr.select(photo[1], dr.detach(c), t) for c, t in zip(rgb, target, strict=True)]
        mask = dr.select(photo[1], dr.detach(alpha), mask)
    loss += photometric_loss(rgb, target, constants.width, constants.height, constants.ssim_share)
    if constants.alpha_weight is not None:
        loss += constants.alpha_weight * dr.mean(dr.abs(alpha - mask))
    error = dr.mean(sum(dr.square(dr.detach(c) - t) for c, t in zip(rgb, target, strict=True))) / 3
    dr.backward(loss)
    return [dr.grad(c) for c in colours], dr.grad(opacity), None if moment is None else dr.grad(moment), error


def depth_image(camera: Camera, pixel: mi.UInt32, inverse: mi.Float) -> mi.Float:
    """Return inverse depths [1/m] at distinct pixels as a flat row-major image, NaN elsewhere."""
    image = dr.full(mi.Float, dr.nan, camera.width * camera.height)
    dr.scatter(image, inverse, pixel)
    dr.eval(image)
    return image


def depth_error(alpha: mi.Float, moment: mi.Float, inverse: mi.Float) -> mi.Float:
    """Return the sum of absolute differences between the inverse depths of splats and of an image [1/m]."""
    known = dr.isfinite(inverse)
    wanted = dr.select(known, inverse, 0)
    # Gathered copies keep the gradients of this term apart; added to the other gradients of the layers they would be
    # rounded.
    pixel = dr.arange(mi.UInt32, dr.width(inverse))
    cover, depth = (dr.gather(mi.Float, layer, pixel, mode=dr.ReduceMode.NoConflicts) for layer in (alpha, moment))
    seen = known & (cover > 0.1) & (depth > 0)
    found = dr.select(seen, cover / dr.select(seen, depth, 1), wanted)
    return dr.sum(dr.abs(found - wanted))
