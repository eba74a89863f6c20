"""Differentiable rendering of splats: a Dr.Jit operation whose backward pass is in module `record_gradients`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.quality import KERNELS, Quality
from mitsplat.renderer.differentiation.record_gradients import PAIRS_AT_ONCE, march_backward, tile_gradient
from mitsplat.renderer.projection.clouds import SCALE_RATIO_MIN, Cloud, CloudSet, Placement, placement_table
from mitsplat.renderer.projection.projector import Projector
from mitsplat.renderer.projection.records import RECORD, GaussianRecord, Geometry, ViewRecords
from mitsplat.renderer.rays.camera_rays import CameraView, Kind, ViewNumbers
from mitsplat.renderer.splatting.lanes import Lanes
from mitsplat.renderer.splatting.march import march
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians, bin_records
from mitsplat.runtime.recorded_kernels import Table, recorded


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


def gather_gradients(cloud: Cloud, kind: Kind, numbers: ViewNumbers, quality: Quality, found: mi.Float) -> None:
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
    return tile_gradient(lists, view, quality, seen, gradient, slopes or Lanes(lists, view).centre_slopes())


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
    """Render the result of :func:`project_cloud`.

    Args:
        records: Evaluated view records.
        least: Evaluated least depths [m].
        box: Evaluated boxes of tiles.
        view: Camera; one sample per pixel.
        quality: Cut-offs; with infinite tolerance.
        depth: True for a :class:`DepthRendering`.

    Raises:
        ValueError: As for :func:`render_differentiable`.
        CrowdedError: If there are too many pairs of a Gaussian and a tile.
    """
    _check(view, quality)
    lists = bin_records(ViewRecords(records, None, least, box), view, quality, _PLACEMENT.instance, for_gradients=True)
    return (DepthRendering if depth else RenderOp)(lists, view, quality)


def pack_cloud(
    means: mi.Float, quats: mi.Float, scales: mi.Float, opacities: mi.Float, sh: mi.Float, sh_count: int
) -> Cloud:
    """Pack differentiable parameters like :func:`mitsplat.renderer.projection.clouds.upload_cloud`.

    Args:
        means: Flat device array of N x 3 centres.
        quats: Flat N x 4, xyzw; normalised here.
        scales: Flat N x 3.
        opacities: N.
        sh: Flat N x K x 3.
        sh_count: K, the number of coefficients per channel.
    """
    count = dr.width(opacities)
    i = dr.arange(mi.UInt32, count)
    own = dr.ReduceMode.NoConflicts
    mean, sigma = dr.gather(mi.Vector3f, means, i, mode=own), dr.gather(mi.Vector3f, scales, i, mode=own)
    quat = dr.normalize(mi.Vector4f(*dr.gather(mi.Array4f, quats, i, mode=own)))
    sigma = dr.maximum(sigma, SCALE_RATIO_MIN * dr.max(dr.detach(sigma)))
    stride = -(-3 * sh_count // 4) * 4
    geometry, padded = dr.zeros(mi.Float, Geometry.WIDTH * count), dr.zeros(mi.Float, 4 * count)
    dr.scatter(geometry, mi.ArrayXf([*mean, opacities, *quat]), i)
    dr.scatter(padded, mi.Array4f(sigma.x, sigma.y, sigma.z, 0), i)
    coefficients = sh
    if stride != 3 * sh_count:
        coefficients = dr.zeros(mi.Float, stride * count)
        j = dr.arange(mi.UInt32, 3 * sh_count * count)
        row = j // (3 * sh_count)
        dr.scatter(coefficients, sh, row * stride + (j - row * (3 * sh_count)))
    return Cloud(count, geometry, padded, coefficients, sh_count, stride)


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
