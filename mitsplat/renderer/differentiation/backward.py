"""Gradients of the splat renderer: a second march over the same lists that scatters per-Gaussian derivatives.

Front-to-back blending computes ``C = sum_i T_i a_i c_i`` with ``T_i = prod_{j<i} (1 - a_j)``. Let S_i be the partial
sum including i. The light behind i is ``C - S_i``, so that no list is walked backwards:

    dC / da_i = T_i c_i - (C - S_i) / (1 - a_i),     dC / dc_i = T_i a_i,     dA / da_i = T_end / (1 - a_i)

With ``a = exp2(log2 o - q)`` and ``q = N / D`` as in module `gaussian`, the chain rule gives the derivatives of the
view records. Dr.Jit's automatic differentiation continues through the projection to the Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.quality import KERNELS, Quality
from mitsplat.renderer.rays.camera_rays import TILE_WIDTH, CameraView, Kind, ViewNumbers
from mitsplat.renderer.splatting.gaussian import SCALE_RATIO_MIN, Cloud
from mitsplat.renderer.splatting.march import march
from mitsplat.renderer.splatting.projection import CloudSet, Placement, Projector, placement_table
from mitsplat.renderer.splatting.records import RECORD, GaussianRecord, Geometry
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians, bin_records
from mitsplat.renderer.splatting.walk import Lanes, max_of
from mitsplat.runtime.recorded_kernels import Table, recorded

LN_2 = 0.6931471805599453

PAIRS_AT_ONCE = 1 << 20
"""Number of pairs of a Gaussian and a tile whose gradients are stored at once, 512 bytes each."""


def render_differentiable(cloud: Cloud, view: CameraView, quality: Quality) -> tuple[list[mi.Float], mi.Float]:
    """Render display-encoded colour (three flat row-major arrays, times alpha) and alpha with gradients.

    Gaussians that reach the camera's plane are omitted, because they would have no gradient and a fit could not move
    them.

    Args:
        cloud: Gaussians from :func:`pack_cloud`, in world space.
        view: Camera; one sample per pixel.
        quality: Cut-offs and SH degree; with infinite tolerance.

    Raises:
        ValueError: If the quality has a finite tolerance, several samples or a kernel that limits opacity.
    """
    _check(view, quality)
    lists = bin_gaussians(_cloud_set(cloud), [_PLACEMENT], view, quality, at_camera=False, for_gradients=True)
    # The lambda hides the other arguments from Dr.Jit, which would traverse dataclasses for differentiation.
    *rgb, alpha = dr.custom(_March, lists.records, lambda: (lists, view, quality))
    return rgb, alpha


def _with_depth_as_red(records: mi.Float) -> mi.Float:
    """Return view records with the depth of the centre as red."""
    row = dr.arange(mi.UInt32, dr.width(records) // RECORD) * RECORD
    with_depth = dr.copy(records)
    depth = dr.gather(mi.Float, records, row + _DEPTH, mode=dr.ReduceMode.NoConflicts)
    dr.scatter(with_depth, depth, row + _RED)
    return with_depth


_RED, _DEPTH = GaussianRecord.place("red"), GaussianRecord.place("depth")
"""Indices in a view record."""


def _check(view: CameraView, quality: Quality) -> None:
    if quality.order != "tile" or quality.samples != 1 or view.samples != 1:
        raise ValueError("gradients need an infinite quality.tolerance and one sample per pixel")
    if quality.normalise_ended_rays:
        raise ValueError("gradients need quality.normalise_ended_rays = False")
    if quality.correct_late_gaussians:
        raise ValueError("gradients need quality.correct_late_gaussians = False")
    if KERNELS[quality.kernel].alpha_max < 1:
        raise ValueError(f"gradients need a kernel that does not limit opacity (got {quality.kernel!r})")


def _cloud_set(cloud: Cloud) -> CloudSet:
    return CloudSet((cloud.count,), (0,), cloud.geometry, cloud.scales, cloud.sh, cloud.sh_count, cloud.sh_stride)


_PLACEMENT = Placement(0, np.eye(4), 1)


class Eye:
    """Camera for those parts of a training step that do not depend on the number of visible Gaussians.

    Attributes:
        view: The camera.
        numbers: Device values that differ between cameras of its kind.
    """

    def __init__(self, view: CameraView) -> None:
        nothing = CloudSet((1,), (0,), None, None, None, 0, 0)
        table, _, _ = placement_table(nothing, [_PLACEMENT], view)
        self.view, self.numbers = view, view.numbers | {"table": table}


def project_cloud(
    cloud: Cloud, kind: Kind, numbers: ViewNumbers, quality: Quality
) -> tuple[mi.Float, mi.Float, mi.UInt32, mi.Bool]:
    """Return view records, least depths, tile boxes and visibility of all Gaussians, not evaluated.

    Args:
        cloud: Gaussians in world space.
        kind: Kind of the camera's view.
        numbers: Numbers of an :class:`Eye`.
        quality: Cut-offs and SH degree.
    """
    projector = Projector(
        _cloud_set(cloud), numbers["table"], CameraView.of_numbers(kind, numbers), quality, at_camera=False
    )
    return projector.all_records(dr.zeros(mi.UInt32, cloud.count), dr.arange(mi.UInt32, cloud.count))[:4]


def gather_gradients(
    cloud: Cloud,
    kind: Kind,
    numbers: ViewNumbers,
    quality: Quality,
    found: mi.Float,
) -> None:
    """Add the gradients of view records to those of a cloud's parameters.

    Gradients of invisible Gaussians are zero, where the chain rule would give 0 times infinity.

    Args:
        cloud: From :func:`pack_cloud`, with gradients.
        kind: Kind of the camera's view.
        numbers: Numbers of an :class:`Eye`.
        quality: Cut-offs and SH degree.
        found: Gradients of the records of :func:`project_cloud`.
    """
    packed = cloud.geometry, cloud.scales, cloud.sh
    leaves = [mi.Float(dr.detach(values)) for values in packed]
    dr.enable_grad(leaves)
    leaf_cloud = replace(cloud, geometry=leaves[0], scales=leaves[1], sh=leaves[2])
    records, _, _, visible = project_cloud(leaf_cloud, kind, numbers, quality)
    _propagate(records, found)
    for values, leaf, width in zip(packed, leaves, (Geometry.WIDTH, 4, cloud.sh_stride), strict=True):
        own = dr.gather(mi.Bool, visible, dr.arange(mi.UInt32, width * cloud.count) // width)
        _propagate(values, dr.select(own, dr.grad(leaf), 0))


def _propagate(values: mi.Float, gradient: mi.Float) -> None:
    """Propagate a gradient to all inputs of ``values``."""
    dr.set_grad(values, gradient)
    dr.enqueue(dr.ADMode.Backward, values)
    dr.traverse(dr.ADMode.Backward)


class RenderOp:
    """Image of view records, with back-propagation of image gradients to the records.

    Args:
        lists: Records per tile.
        view: Camera.
        quality: Cut-offs.

    Attributes:
        rgb: Display-encoded colour times alpha, three flat row-major arrays.
        alpha: Opacity.
    """

    def __init__(self, lists: TileLists, view: CameraView, quality: Quality) -> None:
        self._lists, self._view, self._quality = lists, view, quality
        tiles = Table(lists.entries), lists.records, lists.start, lists.stop
        self.rgb, self.alpha, self._slopes = _image(view.kind, view.numbers, quality, *tiles)

    def gradient(self, colour: list[mi.Float], alpha: mi.Float) -> mi.Float:
        """Return the gradient of the flat records from evaluated gradients of colour and alpha."""
        lists, view, seen = self._lists, self._view, [*self.rgb, self.alpha]
        gradient = [*colour, alpha]
        if not 0 < lists.pairs <= PAIRS_AT_ONCE:
            return march_backward(lists, view, self._quality, seen, gradient, self._slopes)
        tiles = Table(lists.entries), Table(lists.slots), lists.first, lists.records, lists.start, lists.stop
        max_pairs = _rounded_up(lists.pairs)
        return _image_gradient(view.kind, view.numbers, self._quality, max_pairs, *tiles, seen, gradient, self._slopes)


def _rounded_up(pairs: int) -> int:
    """Round a number of pairs up by at most a quarter, so that many views share it."""
    step = max(1024, 1 << max(0, pairs.bit_length() - 3))
    return -(-pairs // step) * step


@recorded
def _image(
    kind: Kind,
    numbers: ViewNumbers,
    quality: Quality,
    entries: mi.UInt32,
    records: mi.Float,
    start: mi.UInt32,
    stop: mi.UInt32,
) -> tuple[list[mi.Float], mi.Float, tuple[list[mi.Float], list[mi.Float]] | None]:
    """Return colours and alpha of the rays of a view, and the slopes of the rays of a distorted lens."""
    view = CameraView.of_numbers(kind, numbers)
    lists = _bare_lists(entries, None, None, records, start, stop, dr.width(entries))
    # The backward pass reuses the slopes, because the inversion of a lens distortion takes longer than a march.
    slopes = Lanes(lists, view).centre_slopes() if view.distortion else None
    image = march(lists, view, quality, slopes=slopes)
    return image.rgb, image.alpha, slopes


@recorded
def _image_gradient(
    kind: Kind,
    numbers: ViewNumbers,
    quality: Quality,
    max_pairs: int,
    entries: mi.UInt32,
    slots: mi.UInt32,
    first: mi.UInt32,
    records: mi.Float,
    start: mi.UInt32,
    stop: mi.UInt32,
    seen: list[mi.Float],
    gradient: list[mi.Float],
    slopes: tuple[list[mi.Float], list[mi.Float]] | None,
) -> mi.Float:
    """Return the gradient of the view records from those of colours and alpha, for at most ``max_pairs`` pairs."""
    view = CameraView.of_numbers(kind, numbers)
    lists = _bare_lists(entries, slots, first, records, start, stop, max_pairs)
    return _gradient(lists, view, quality, seen, gradient, slopes or Lanes(lists, view).centre_slopes())


def _bare_lists(
    entries: mi.UInt32,
    slots: mi.UInt32 | None,
    first: mi.UInt32 | None,
    records: mi.Float,
    start: mi.UInt32,
    stop: mi.UInt32,
    pairs: int,
) -> TileLists:
    """Return tile lists of one instance for the order per tile."""
    visible = dr.width(records) // RECORD
    return TileLists(records, None, entries, slots, first, None, start, stop, visible, pairs, _PLACEMENT.instance, None)


class DepthRendering(RenderOp):
    """Rendering with the ``moment``: the sum of the centres' depths [m], weighted by their share of alpha."""

    def __init__(self, lists: TileLists, view: CameraView, quality: Quality) -> None:
        super().__init__(lists, view, quality)
        self._depths = RenderOp(replace(lists, records=_with_depth_as_red(lists.records)), view, quality)
        self.moment = self._depths.rgb[0]

    def gradient_of_moment(self, moment: mi.Float) -> mi.Float:
        """Return the gradient of the records from an evaluated gradient of the moment."""
        nothing = dr.zeros(mi.Float, dr.width(moment))
        with_depth = self._depths.gradient([moment, nothing, nothing], nothing)
        entry = dr.arange(mi.UInt32, dr.width(with_depth))
        place = entry % RECORD
        red = dr.gather(mi.Float, with_depth, entry - (_DEPTH - _RED), place == _DEPTH)
        return dr.select(place == _DEPTH, red, dr.select(place == _RED, 0, with_depth))


def render_records(
    records: mi.Float, least: mi.Float, box: mi.UInt32, view: CameraView, quality: Quality, *, depth: bool = False
) -> RenderOp:
    """Render the result of :func:`project_cloud`; with ``depth``, as a :class:`DepthRendering`.

    Raises:
        ValueError: As for :func:`render_differentiable`.
        CrowdedError: If there are too many pairs of a Gaussian and a tile.
    """
    _check(view, quality)
    lists = bin_records(records, None, least, box, view, quality, _PLACEMENT.instance, for_gradients=True)
    return (DepthRendering if depth else RenderOp)(lists, view, quality)


def pack_cloud(
    means: mi.Float, quats: mi.Float, scales: mi.Float, opacities: mi.Float, sh: mi.Float, bands: int
) -> Cloud:
    """Pack differentiable parameters like :func:`mitsplat.renderer.splatting.gaussian.upload_cloud`.

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
    own = dr.ReduceMode.NoConflicts
    mean, sigma = dr.gather(mi.Vector3f, means, i, mode=own), dr.gather(mi.Vector3f, scales, i, mode=own)
    quat = dr.normalize(mi.Vector4f(*dr.gather(mi.Array4f, quats, i, mode=own)))
    sigma = dr.maximum(sigma, SCALE_RATIO_MIN * dr.max(dr.detach(sigma)))
    stride = -(-3 * bands // 4) * 4
    geometry, padded = dr.zeros(mi.Float, Geometry.WIDTH * count), dr.zeros(mi.Float, 4 * count)
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
    """March as a differentiable function of the view records."""

    def eval(
        self, records: mi.Float, context: Callable[[], tuple[TileLists, CameraView, Quality]]
    ) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        lists, view, quality = context()
        self.rendering = RenderOp(replace(lists, records=records), view, quality)
        return (*self.rendering.rgb, self.rendering.alpha)

    def backward(self) -> None:
        gradient = [dr.zeros(mi.Float, dr.width(self.rendering.alpha)) + g for g in self.grad_out()]
        dr.eval(gradient)
        self.set_grad_in("records", self.rendering.gradient(gradient[:3], gradient[3]))

    def name(self) -> str:
        return "march"


def march_backward(
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    seen: list[mi.Float],
    gradient: list[mi.Float],
    slopes: tuple[list[mi.Float], list[mi.Float]] | None,
) -> mi.Float:
    """Return the gradient of the flat view records from gradients of red, green, blue and alpha.

    Args:
        lists: Records per tile.
        view: Camera.
        quality: Cut-offs.
        seen: Rendered red, green, blue and alpha.
        gradient: Gradients of these.
        slopes: Slopes of the rays if already known.
    """
    if lists.pairs == 0:
        return dr.zeros(mi.Float, RECORD * max(1, lists.visible))
    slopes = slopes or Lanes(lists, view).centre_slopes()
    if lists.pairs <= PAIRS_AT_ONCE:
        return _gradient(lists, view, quality, seen, gradient, slopes)
    total = dr.zeros(mi.Float, RECORD * lists.visible)
    for part, lane in _parts(lists):
        us, vs = ([dr.gather(mi.Float, values, lane) for values in axis] for axis in slopes)
        total += _gradient(part, view, quality, seen, gradient, (us, vs))
        dr.eval(total)
    return total


def _parts(lists: TileLists) -> Iterator[tuple[TileLists, mi.UInt32]]:
    """Yield lists of consecutive tiles with at most :data:`PAIRS_AT_ONCE` pairs, and their lane numbers.

    A single tile may have more pairs. Positions by record are counted within each part.
    """
    begins = np.append(np.array(lists.start), lists.pairs).astype(np.int64)
    first = 0
    while first < len(begins) - 1:
        last = int(np.searchsorted(begins, begins[first] + PAIRS_AT_ONCE, side="right")) - 1
        last = min(max(last, first + 1), len(begins) - 1)
        begin, pairs = int(begins[first]), int(begins[last] - begins[first])
        if pairs:
            entry = dr.arange(mi.UInt32, pairs) + dr.opaque(mi.UInt32, begin)
            mine = dr.zeros(mi.UInt32, lists.pairs + 1)
            dr.scatter(mine, mi.UInt32(1), dr.gather(mi.UInt32, lists.slots, entry))
            place = dr.prefix_sum(mine)
            tile = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
            part = replace(
                lists,
                slots=dr.gather(mi.UInt32, place, lists.slots),
                first=dr.gather(mi.UInt32, place, lists.first),
                start=dr.gather(mi.UInt32, lists.start, tile),
                stop=dr.gather(mi.UInt32, lists.stop, tile),
                pairs=pairs,
                tiles=tile,
            )
            dr.eval(part.slots, part.first, part.start, part.stop, tile)
            yield part, dr.arange(mi.UInt32, (last - first) * TILE_WIDTH) + dr.opaque(mi.UInt32, first * TILE_WIDTH)
        first = last


def _gradient(
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    seen: list[mi.Float],
    gradient: list[mi.Float],
    slopes: tuple[list[mi.Float], list[mi.Float]],
) -> mi.Float:
    """Return the gradient from the tiles of lists; ``lists.pairs`` is an upper bound of their pairs."""
    lanes = Lanes(lists, view)
    us, vs = slopes
    column = dr.arange(mi.UInt32, dr.width(lanes.start)) % TILE_WIDTH
    shares = dr.zeros(mi.Float, RECORD * TILE_WIDTH * lists.pairs)
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    end, near = dr.opaque(mi.Float, quality.transmittance_min), view.near_plane

    def load(values: mi.Float) -> list[mi.Float]:
        return [dr.gather(mi.Float, values, p, m) for p, m in zip(lanes.pixel, lanes.inside, strict=True)]

    d_colour = list(zip(*(load(g) for g in gradient[:3]), strict=True))
    whole = list(zip(*(load(c) for c in seen[:3]), strict=True))
    # Light behind, weighted with the gradient, minus the gradient of alpha through the final transmittance.
    behind = [
        sum(c * d for c, d in zip(cs, ds, strict=True)) - (1 - a) * d_alpha
        for cs, ds, a, d_alpha in zip(whole, d_colour, load(seen[3]), load(gradient[3]), strict=True)
    ]

    def body(
        i: mi.UInt32, light: list[mi.Float], rest: list[mi.Float]
    ) -> tuple[mi.UInt32, list[mi.Float], list[mi.Float]]:
        record = GaussianRecord.fetch(lists.records, dr.gather(mi.UInt32, lists.entries, i))
        u0, v0, a, b2, c, log_opacity, red, green, blue, depth, e, f, g, h, k, _ = record
        sums = [mi.Float(0) for _ in range(RECORD)]
        new_light, new_rest = [], []
        for u, v, t, r, ds in zip(us, vs, light, rest, d_colour, strict=True):
            du, dv = u - u0, v - v0
            inverse = dr.rcp(1 + du * (e + g * du + h * dv) + dv * (f + k * dv))
            q = (du * (a * du + b2 * dv) + dv * dv * c) * inverse
            z = depth * (1 + 0.5 * (e * du + f * dv)) * inverse
            hit = (log_opacity - q > cut) & (z > near) & (t > end)
            # A response that overflows beyond the cut-off, or that rounding raises above the peak, has no gradient.
            inverse, q = dr.select(hit & (q > 0), inverse, 0), dr.select(hit & (q > 0), q, 0)
            alpha = dr.select(hit, dr.exp2(log_opacity - q), 0)
            weight = t * alpha
            d_own = red * ds[0] + green * ds[1] + blue * ds[2]
            r = r - weight * d_own
            d_alpha = t * d_own - r / dr.maximum(1 - alpha, 1e-5)
            d_log = d_alpha * alpha * LN_2
            d_top, d_bottom = -d_log * inverse, d_log * q * inverse
            d_du = d_top * (2 * a * du + b2 * dv) + d_bottom * (e + 2 * g * du + h * dv)
            d_dv = d_top * (2 * c * dv + b2 * du) + d_bottom * (f + 2 * k * dv + h * du)
            parts = GaussianRecord(
                u0=-d_du,
                v0=-d_dv,
                a=d_top * du * du,
                b2=d_top * du * dv,
                c=d_top * dv * dv,
                log_opacity=d_log,
                red=weight * ds[0],
                green=weight * ds[1],
                blue=weight * ds[2],
                depth=0,
                e=d_bottom * du,
                f=d_bottom * dv,
                g=d_bottom * du * du,
                h=d_bottom * du * dv,
                i=d_bottom * dv * dv,
                instance=0,
            )
            sums = [total + part for total, part in zip(sums, parts, strict=True)]
            new_light.append(t - weight)
            new_rest.append(r)
        dr.scatter(shares, mi.ArrayXf(sums), dr.gather(mi.UInt32, lists.slots, i) * TILE_WIDTH + column)
        return i + 1, new_light, new_rest

    def alive(i: mi.UInt32, light: list[mi.Float], rest: list[mi.Float]) -> mi.Bool:
        return (i < lanes.stop) & (max_of(light) > end)

    state = lanes.start, [mi.Float(1) for _ in us], behind
    dr.while_loop(state, alive, body, label="march backward")
    dr.eval(shares)
    return _sum_shares(shares, lists)


def _sum_shares(shares: mi.Float, lists: TileLists) -> mi.Float:
    """Sum the gradients of each record over the columns of its tiles.

    The order of additions is fixed, so that every run is bit-identical; atomic additions are not. A record that covers
    many tiles is summed by several lanes, so that other lanes do not wait for it.
    """
    record = dr.arange(mi.UInt32, lists.visible)
    first = dr.gather(mi.UInt32, lists.first, record)
    pairs = dr.gather(mi.UInt32, lists.first, record + 1) - first
    runs = dr.maximum((pairs + (_TILES_PER_LANE - 1)) // _TILES_PER_LANE, 1)
    begin = dr.prefix_sum(runs)
    lanes = lists.visible + lists.pairs // _TILES_PER_LANE  # upper bound of the number of runs; spare lanes add nothing
    marks = dr.zeros(mi.UInt32, lanes)
    dr.scatter(marks, mi.UInt32(1), begin, begin > 0)
    owner = dr.cumsum(marks)
    run = dr.arange(mi.UInt32, lanes) - dr.gather(mi.UInt32, begin, owner)
    start = dr.gather(mi.UInt32, first, owner) + run * _TILES_PER_LANE
    stop = dr.minimum(start + _TILES_PER_LANE, dr.gather(mi.UInt32, lists.first, owner + 1))
    partial = _sum_rows(shares, start * TILE_WIDTH, stop * TILE_WIDTH)
    return _sum_rows(partial, begin, begin + runs)


_TILES_PER_LANE = 32
"""Number of tiles whose gradients one lane adds."""


def _sum_rows(rows: mi.Float, start: mi.UInt32, stop: mi.UInt32) -> mi.Float:
    """Sum the rows of :data:`RECORD` floats from ``start`` to ``stop`` (exclusive); return one row per range."""
    width = dr.width(start)

    def add(i: mi.UInt32, sums: list[mi.Float]) -> tuple[mi.UInt32, list[mi.Float]]:
        row = dr.gather(mi.ArrayXf, rows, i, shape=(RECORD, dr.width(i)))
        return i + 1, [total + own for total, own in zip(sums, row, strict=True)]

    zeros = [mi.Float(0) for _ in range(RECORD)]
    _, sums = dr.while_loop((start, zeros), lambda i, sums: i < stop, add, label="sum rows")
    result = dr.empty(mi.Float, RECORD * width)
    dr.scatter(result, mi.ArrayXf(sums), dr.arange(mi.UInt32, width))
    dr.eval(result)
    return result
