"""Projection of the Gaussians of all placements to view records of those that a camera sees.

All clouds lie in one set of device arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.quality import KERNELS, Quality
from mitsplat.renderer.projection.clouds import CloudSet
from mitsplat.renderer.projection.gaussian import (
    LOG2_E_HALF,
    PlacedGaussian,
    Response,
    ellipse_bounds,
    evaluate_sh,
    project_gaussian,
    respond_at_plane,
    rotation_axes,
)
from mitsplat.renderer.projection.records import RECORD, GaussianRecord, Geometry, PlacementRow, ViewRecords
from mitsplat.renderer.projection.splat_appearance import apply_appearance
from mitsplat.renderer.rays.camera_rays import CameraView, Kind, ViewNumbers
from mitsplat.renderer.rays.tile_subset import TileSubset
from mitsplat.runtime.recorded_kernels import Table, recorded

_ADJOINT = dr.ReduceMode.NoConflicts
"""Mode in which gradients are added to a cloud. Gradients need a cloud that is placed once, so that each Gaussian
receives one sum. The default mode would write the number of Gaussians into the kernels and recompile them at each
change.
"""


@dataclass(frozen=True, eq=False)
class _Input:
    """Placed Gaussians as fetched by a kernel.

    Attributes:
        gaussian: Geometry.
        opacity, instance: Opacity, and instance id of the placement.
        appearance: Columns of :class:`~mitsplat.renderer.projection.records.AppearanceRow` of the placement.
        point: Centre in the cloud's frame.
    """

    gaussian: PlacedGaussian
    opacity: mi.Float
    instance: mi.Float
    appearance: list[mi.Float]
    point: mi.Vector3f


@dataclass(frozen=True, eq=False)
class _Bounds:
    """Response and bounds of Gaussians.

    Attributes:
        response, opacity: Response and opacity under the low-pass filter.
        at_plane: True if the Gaussian reaches the camera's plane z = 0.
        visible: True if it may be visible.
        slope_box: Limits (u0, u1, v0, v1) of the cut-off ellipsoid.
        least_depth: Depth [m] in front of which the ellipsoid does not reach.
    """

    response: Response
    opacity: mi.Float
    at_plane: mi.Bool
    visible: mi.Bool
    slope_box: tuple[mi.Float, mi.Float, mi.Float, mi.Float]
    least_depth: mi.Float


class Projector:
    """Projection of Gaussians to a view.

    Args:
        clouds: Gaussians on the device.
        table: Rows of :class:`PlacementRow`, flat.
        view: The camera.
        quality: Kernel, response and cut-off of the opacity.
        at_camera: True if Gaussians that reach the camera's plane are visible.
        changed: True if any placement has an appearance.
    """

    def __init__(
        self,
        clouds: CloudSet,
        table: mi.Float,
        view: CameraView,
        quality: Quality,
        at_camera: bool,
        changed: bool = False,
    ) -> None:
        self.clouds, self.table, self.view, self.quality, self.at_camera = clouds, table, view, quality, at_camera
        self.changed = changed
        self.cut = dr.opaque(mi.Float, quality.alpha_min)

    def _load(self, owner: mi.UInt32, local: mi.UInt32) -> _Input:
        row = dr.gather(mi.ArrayXf, self.table, owner, shape=(PlacementRow.WIDTH, dr.width(owner)))
        packet = dr.gather(
            mi.ArrayXf, self.clouds.geometry, local, mode=_ADJOINT, shape=(Geometry.WIDTH, dr.width(local))
        )
        sigma = dr.gather(mi.ArrayXf, self.clouds.scales, local, mode=_ADJOINT, shape=(4, dr.width(local)))
        point, centre, rest = packet[Geometry.MEAN], row[PlacementRow.CENTRE], row[PlacementRow.CENTRE_REST]
        columns = PlacementRow.RIGHT, PlacementRow.DOWN, PlacementRow.FORWARD
        right, down, forward = (mi.Vector3f(*row[column]) for column in columns)
        gaussian = PlacedGaussian(
            mean=mi.Vector3f(*[point[i] - centre[i] - rest[i] for i in range(3)]),
            axes=rotation_axes(packet[Geometry.QUATERNION]),
            sigma=[sigma[i] for i in range(3)],
            right=right,
            down=down,
            forward=forward,
            scale=row[PlacementRow.SCALE],
        )
        appearance = [*row[PlacementRow.APPEARANCE]]
        return _Input(gaussian, packet[Geometry.OPACITY], row[PlacementRow.INSTANCE], appearance, mi.Vector3f(*point))

    def _bounds(self, g: _Input) -> _Bounds:
        """Return response, opacity and bounds of Gaussians.

        Gaussians that reach the camera's plane keep the exact response without a filter, because they are large
        relative to a pixel and have no central ray.
        """
        view, kernel, gaussian = self.view, KERNELS[self.quality.kernel], g.gaussian
        k = dr.safe_sqrt(2 * dr.log(g.opacity / self.cut))
        reach = [
            gaussian.scale
            * k
            * dr.norm(mi.Vector3f(*[dr.dot(a, v) * s for a, s in zip(gaussian.axes, gaussian.sigma, strict=True)]))
            for v in (gaussian.right, gaussian.down, gaussian.forward)
        ]
        centre = [
            gaussian.scale * dr.dot(axis, gaussian.mean) for axis in (gaussian.right, gaussian.down, gaussian.forward)
        ]
        response, opacity = project_gaussian(gaussian), g.opacity
        if kernel.variance > 0:
            # A filter is as wide as the view's pixels. The variance that trainers add refers to the picture's pixels,
            # however fine the view is.
            variance = kernel.variance * (1 if kernel.conserves_light else view.zoom**2)
            covariance = view.pixel_covariance(response.u0, response.v0, variance)
            response, det = response.filtered(*covariance)
            if kernel.conserves_light:
                opacity = opacity * dr.rsqrt(det)
        if self.quality.response == "ewa":
            response = response.parallel()
        k2 = 2 * dr.log(opacity / self.cut)
        du0, du1, dv0, dv1, ellipse = ellipse_bounds(response.cutoff(k2))
        at_plane = ~ellipse | (centre[2] - reach[2] < view.near_plane)
        opacity, k2 = dr.select(at_plane, g.opacity, opacity), dr.select(at_plane, k * k, k2)
        farthest = dr.maximum(centre[2] + reach[2], view.near_plane)

        # Slopes of the ellipsoid's box behind the near plane: a loose bound, but few Gaussians need it.
        def slopes(axis: int) -> tuple[mi.Float, mi.Float]:
            lo, hi = centre[axis] - reach[axis], centre[axis] + reach[axis]
            return (
                lo / dr.select(lo < 0, view.near_plane, farthest),
                hi / dr.select(hi > 0, view.near_plane, farthest),
            )

        (loose_u0, loose_u1), (loose_v0, loose_v1) = slopes(0), slopes(1)
        box = (
            dr.select(at_plane, loose_u0, response.u0 + du0),
            dr.select(at_plane, loose_u1, response.u0 + du1),
            dr.select(at_plane, loose_v0, response.v0 + dv0),
            dr.select(at_plane, loose_v1, response.v0 + dv1),
        )
        visible = (k2 > 0) & (centre[2] + reach[2] > view.near_plane)
        if not self.at_camera:
            visible &= ~at_plane
        return _Bounds(response, opacity, at_plane, visible, box, centre[2] - reach[2])

    def cull(self, owner: mi.UInt32, local: mi.UInt32, subset: TileSubset | None = None) -> tuple[mi.Bool, mi.Bool]:
        """Test Gaussians by the exact box of their cut-off ellipsoid on the screen.

        Args:
            owner: Placement row of each Gaussian.
            local: Number of each Gaussian in the clouds.
            subset: Tiles that count; None for all tiles of the view.

        Returns:
            True for Gaussians in view, and True for Gaussians that reach the camera's plane.
        """
        bounds = self._bounds(self._load(owner, local))
        x0, x1, y0, y1 = self.view.tile_box(*bounds.slope_box)
        visible, at_plane = dr.detach(bounds.visible & (x1 > x0) & (y1 > y0)), dr.detach(bounds.at_plane)
        if subset is not None:
            visible &= subset.any_in(x0, x1, y0, y1, visible)
        dr.eval(visible, at_plane)
        return visible, at_plane

    def records(self, owner: mi.UInt32, local: mi.UInt32, at_plane: mi.Bool) -> ViewRecords:
        """Project Gaussians to view records.

        Args:
            owner: Placement row of each Gaussian.
            local: Number of each Gaussian in the clouds.
            at_plane: True for Gaussians that reach the camera's plane, from :meth:`cull`.
        """
        g = self._load(owner, local)
        bounds = self._bounds(g)
        record = self._record(g, bounds, local)
        plane_records = None
        index, number = dr.compress(at_plane), dr.zeros(mi.UInt32, dr.width(local))
        if dr.width(index) > 0:
            plane_records = self._plane_records(index, owner, local)
            dr.scatter(number, dr.arange(mi.UInt32, dr.width(index)), index)
        record = record._replace(
            u0=dr.select(at_plane, mi.Float(number), record.u0), a=dr.select(at_plane, -1.0, record.a)
        )
        records, tile_box = _rows(mi.Float, [*record]), _rows(mi.UInt32, self._tile_box(bounds))
        least = dr.detach(bounds.least_depth)
        dr.eval(records, tile_box, least)
        return ViewRecords(records, plane_records, least, tile_box)

    def all_records(self, owner: mi.UInt32, local: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.UInt32, mi.Bool, mi.Bool]:
        """Return view records of all Gaussians, least depths, tile boxes, visibility, and flags of the camera's plane.

        Invisible Gaussians have empty boxes. Records of Gaussians that reach the camera's plane are not marked. Unlike
        after :meth:`cull`, no array size depends on the view.
        """
        g = self._load(owner, local)
        bounds = self._bounds(g)
        x0, x1, y0, y1 = self._tile_box(bounds)
        visible = dr.detach(bounds.visible) & (x1 > x0) & (y1 > y0)
        record = self._record(g, bounds, local)
        boxes = _rows(mi.UInt32, [x0, x1, y0, dr.select(visible, y1, y0)])
        at_plane = visible & dr.detach(bounds.at_plane)
        return _rows(mi.Float, [*record]), dr.detach(bounds.least_depth), boxes, visible, at_plane

    def records_unculled(self, owner: mi.UInt32, local: mi.UInt32) -> ViewRecords:
        """Return the view records of all Gaussians, visible or not, with recorded kernels and without gradients."""
        clouds, view = self.clouds, self.view
        shape = self.quality, self.at_camera, self.changed, clouds.sh_count, clouds.sh_stride
        arrays = Table(clouds.geometry), Table(clouds.scales), Table(clouds.sh), Table(self.table)
        records, least, boxes, at_plane = _all_records(view.kind, view.numbers, shape, arrays, owner, local)
        if not dr.any(at_plane):
            return ViewRecords(records, None, least, boxes)
        index = dr.compress(at_plane)
        plane_records, row = self._plane_records(index, owner, local), index * RECORD
        number = mi.Float(dr.arange(mi.UInt32, dr.width(index)))
        dr.scatter(records, number, row + GaussianRecord.place("u0"))
        dr.scatter(records, mi.Float(-1.0), row + GaussianRecord.place("a"))
        dr.eval(records)
        return ViewRecords(records, plane_records, least, boxes)

    def _record(self, g: _Input, bounds: _Bounds, local: mi.UInt32) -> GaussianRecord:
        """Return view records of Gaussians that do not reach the camera's plane."""
        response, colour = bounds.response, self._colour(g.gaussian.mean, local)
        if self.changed:
            colour = apply_appearance(colour, g.appearance, g.point)
        red, green, blue = colour
        return GaussianRecord(
            u0=response.u0,
            v0=response.v0,
            a=response.a * LOG2_E_HALF,
            b2=response.b2 * LOG2_E_HALF,
            c=response.c * LOG2_E_HALF,
            log_opacity=dr.log2(bounds.opacity),
            red=red,
            green=green,
            blue=blue,
            depth=response.depth,
            e=response.e,
            f=response.f,
            g=response.g,
            h=response.h,
            i=response.i,
            instance=g.instance,
        )

    def _tile_box(self, bounds: _Bounds) -> list[mi.UInt32]:
        return list(self.view.tile_box(*(dr.detach(side) for side in bounds.slope_box)))

    def _plane_records(self, index: mi.UInt32, owner: mi.UInt32, local: mi.UInt32) -> mi.Float:
        """Return the records of Gaussians at the camera's plane."""
        g = self._load(dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index))
        rows = dr.empty(mi.Float, RECORD * dr.width(index))
        record = respond_at_plane(g.gaussian)
        dr.scatter(rows, mi.ArrayXf([*record]), dr.arange(mi.UInt32, dr.width(index)))
        dr.eval(rows)
        return rows

    def _colour(self, mean: mi.Vector3f, local: mi.UInt32) -> list[mi.Float]:
        clouds = self.clouds
        sh_count = min(clouds.sh_count, (self.quality.sh_degree + 1) ** 2)
        floats = -(-3 * sh_count // 4) * 4
        base = local * (clouds.sh_stride // 4)
        packets = [dr.gather(mi.Array4f, clouds.sh, base + j, mode=_ADJOINT) for j in range(floats // 4)]

        def coefficient(k: int) -> list[mi.Float]:
            return [packets[(3 * k + c) // 4][(3 * k + c) % 4] for c in range(3)]

        # A Gaussian centred on the camera has no direction, so only its constant band counts.
        direction = mean * dr.rsqrt(dr.maximum(dr.squared_norm(mean), 1e-30))
        return evaluate_sh(direction, coefficient, sh_count)


@recorded
def _all_records(
    kind: Kind,
    numbers: ViewNumbers,
    shape: tuple[Quality, bool, bool, int, int],
    arrays: tuple[mi.Float, mi.Float, mi.Float, mi.Float],
    owner: mi.UInt32,
    local: mi.UInt32,
) -> tuple[mi.Float, mi.Float, mi.UInt32, mi.Bool]:
    """Return records, least depths, tile boxes and flags of the camera's plane, see ``Projector.all_records``."""
    quality, at_camera, changed, sh_count, sh_stride = shape
    geometry, scales, sh, table = arrays
    clouds = CloudSet((dr.width(owner),), (0,), geometry, scales, sh, sh_count, sh_stride)
    projector = Projector(clouds, table, CameraView.of_numbers(kind, numbers), quality, at_camera, changed)
    records, least, boxes, _, at_plane = projector.all_records(owner, local)
    return records, least, boxes, at_plane


def _rows(kind: type[dr.ArrayBase], columns: list[dr.ArrayBase]) -> dr.ArrayBase:
    """Interleave columns into a flat array of type ``kind``."""
    count = dr.width(columns)
    rows = dr.empty(kind, len(columns) * count)
    dr.scatter(rows, (mi.ArrayXf if kind is mi.Float else mi.ArrayXu)(columns), dr.arange(mi.UInt32, count))
    return rows
