"""Gradients of the splat renderer: a second march that walks the same lists and scatters per-Gaussian derivatives.

Blending front to back, ``C = sum_i T_i a_i c_i`` with ``T_i = prod_{j<i} (1 - a_j)``. Let S_i be the sum up to and
with i; what lies behind is ``C - S_i``, so that no list is walked backwards (the remaining-radiance trick):

    dC / da_i = T_i c_i - (C - S_i) / (1 - a_i),     dC / dc_i = T_i a_i,     dA / da_i = T_end / (1 - a_i)

With ``a = exp2(log2 o - q)`` and ``q = N / D`` as in module `gaussian`, the chain rule gives the derivatives of the
view records; Dr.Jit's own differentiation carries them on through the projection to the Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.plugins.gaussian import RECORD, SCALE_RATIO_MIN, Cloud
from mitsplat.plugins.march import Lanes, march
from mitsplat.plugins.rays import View
from mitsplat.plugins.tiles import CloudSet, Placement, TileLists, bin_gaussians
from mitsplat.quality import KERNELS, Quality

LN_2 = 0.6931471805599453


def render_differentiable(cloud: Cloud, view: View, quality: Quality) -> tuple[list[Any], Any]:
    """Display-encoded colour (three flat row-major arrays, times alpha) and alpha, with gradients to the cloud.

    Args:
        cloud: Gaussians from :func:`pack_cloud`, in world space.
        view: Camera; one sample per pixel.
        quality: Cut-offs and SH degree; the order must be ``tile``.

    Gaussians that reach the camera's plane are rendered but get no gradient.

    Raises:
        ValueError: If the quality asks for another order, several samples or a kernel that limits opacity.
    """
    if quality.order != "tile" or quality.samples != 1 or view.samples != 1:
        raise ValueError("gradients need quality.order 'tile' and one sample per pixel")
    if KERNELS[quality.kernel].alpha_max < 1:
        raise ValueError(f"gradients need a kernel that does not limit opacity (got {quality.kernel!r})")
    clouds = CloudSet((cloud.count,), (0,), cloud.geometry, cloud.scales, cloud.sh, cloud.sh_count, cloud.sh_stride)
    eye = Placement(0, _IDENTITY, 1)
    lists = bin_gaussians(clouds, [eye], view, quality)
    # A function hides the rest from Dr.Jit, which would take data classes apart to differentiate them.
    *rgb, alpha = dr.custom(_March, lists.records, lambda: (lists, view, quality))
    return rgb, alpha


_IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def pack_cloud(means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, bands: int) -> Cloud:
    """Differentiable counterpart of :func:`mitsplat.plugins.gaussian.upload_cloud`.

    Args:
        means: Flat device array of N x 3 centres.
        quats: Flat N x 4, xyzw; normalised here.
        scales: Flat N x 3.
        opacities: N.
        sh: Flat N x K x 3.
        bands: K.
    """
    count = dr.width(opacities)
    i = dr.arange(mi.UInt32, count)
    mean, sigma = dr.gather(mi.Vector3f, means, i), dr.gather(mi.Vector3f, scales, i)
    quat = dr.normalize(mi.Vector4f(*dr.gather(mi.Array4f, quats, i)))
    sigma = dr.maximum(sigma, SCALE_RATIO_MIN * dr.max(dr.detach(sigma)))
    stride = -(-3 * bands // 4) * 4
    geometry, padded = dr.zeros(mi.Float, 8 * count), dr.zeros(mi.Float, 4 * count)
    dr.scatter(geometry, mi.ArrayXf([*mean, opacities, *quat]), i)
    dr.scatter(padded, mi.Array4f(sigma.x, sigma.y, sigma.z, 0), i)
    coefficients = sh
    if stride != 3 * bands:
        coefficients = dr.zeros(mi.Float, stride * count)
        j = dr.arange(mi.UInt32, 3 * bands * count)
        row = j // (3 * bands)
        dr.scatter(coefficients, sh, row * stride + (j - row * (3 * bands)))
    return Cloud(count, geometry, padded, coefficients, bands, stride)


class _March(dr.CustomOp):
    """The march as a function of the view records."""

    def eval(self, records: Any, context: Callable[[], tuple[TileLists, View, Quality]]) -> tuple[Any, ...]:
        lists, view, quality = context()
        self.lists, self.view, self.quality = replace(lists, records=records), view, quality
        image = march(self.lists, view, quality)
        dr.eval(image.rgb, image.alpha)
        self.image = image
        return (*image.rgb, image.alpha)

    def backward(self) -> None:
        gradient = [dr.zeros(mi.Float, dr.width(self.image.alpha)) + g for g in self.grad_out()]
        dr.eval(gradient)
        self.set_grad_in("records", march_backward(self.lists, self.view, self.quality, self.image, gradient))

    def name(self) -> str:
        return "march"


def march_backward(lists: TileLists, view: View, quality: Quality, image: Any, gradient: list[Any]) -> Any:
    """Gradient of the view records (flat, as ``lists.records``) from gradients of red, green, blue and alpha."""
    lanes = Lanes(lists, view)
    us, vs = lanes.slopes(0.5, 0.5)
    result = dr.zeros(mi.Float, RECORD * max(1, lists.visible))
    if lists.pairs == 0:
        return result
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    end, near = dr.opaque(mi.Float, quality.transmittance_min), view.near_plane

    def load(values: Any) -> list[Any]:
        return [dr.gather(mi.Float, values, p, m) for p, m in zip(lanes.pixel, lanes.inside, strict=True)]

    d_colour = list(zip(*(load(g) for g in gradient[:3]), strict=True))
    whole = list(zip(*(load(c) for c in image.rgb), strict=True))
    total = [sum(c * d for c, d in zip(cs, ds, strict=True)) for cs, ds in zip(whole, d_colour, strict=True)]
    d_end = [(1 - a) * d for a, d in zip(load(image.alpha), load(gradient[3]), strict=True)]

    def body(i: Any, light: list[Any], seen: list[Any]) -> tuple[Any, list[Any], list[Any]]:
        number = dr.gather(mi.UInt32, lists.entries, i)
        record = dr.gather(mi.ArrayXf, lists.records, number, shape=(RECORD, dr.width(i)))
        u0, v0, a, b2, c, log_opacity, red, green, blue, depth, e, f, g, h, k, _ = record
        sums = [mi.Float(0) for _ in range(RECORD)]
        new_light, new_seen = [], []
        for u, v, t, s, ds, behind, d_alpha_end in zip(us, vs, light, seen, d_colour, total, d_end, strict=True):
            du, dv = u - u0, v - v0
            inverse = dr.rcp(1 + du * (e + g * du + h * dv) + dv * (f + k * dv))
            q = (du * (a * du + b2 * dv) + dv * dv * c) * inverse
            z = depth * (1 + 0.5 * (e * du + f * dv)) * inverse
            hit = (log_opacity - q > cut) & (z > near) & (t > end) & (a >= 0)
            alpha = dr.select(hit, dr.exp2(log_opacity - q), 0)
            weight = t * alpha
            d_own = red * ds[0] + green * ds[1] + blue * ds[2]
            s = s + weight * d_own
            d_alpha = t * d_own - (behind - s - d_alpha_end) / dr.maximum(1 - alpha, 1e-5)
            d_log = dr.select(hit, d_alpha * alpha * LN_2, 0)
            d_top, d_bottom = -d_log * inverse, d_log * q * inverse
            d_du = d_top * (2 * a * du + b2 * dv) + d_bottom * (e + 2 * g * du + h * dv)
            d_dv = d_top * (2 * c * dv + b2 * du) + d_bottom * (f + 2 * k * dv + h * du)
            parts = [-d_du, -d_dv, d_top * du * du, d_top * du * dv, d_top * dv * dv, d_log]
            parts += [weight * d for d in ds]
            parts += [0, d_bottom * du, d_bottom * dv, d_bottom * du * du, d_bottom * du * dv, d_bottom * dv * dv, 0]
            sums = [total_part + part for total_part, part in zip(sums, parts, strict=True)]
            new_light.append(t - weight)
            new_seen.append(s)
        dr.scatter_reduce(dr.ReduceOp.Add, result, mi.ArrayXf(sums), number, mode=dr.ReduceMode.Local)
        return i + 1, new_light, new_seen

    def alive(i: Any, light: list[Any], seen: list[Any]) -> Any:
        brightest = light[0]
        for t in light[1:]:
            brightest = dr.maximum(brightest, t)
        return (i < lanes.stop) & (brightest > end)

    state = lanes.start, [mi.Float(1) for _ in us], [mi.Float(0) for _ in us]
    dr.while_loop(state, alive, body, label="march backward")
    dr.eval(result)
    return result
