"""Clouds of Gaussians on the device, and their placements in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import AnyArray, Float64Array
from mitsplat.renderer.projection.records import Geometry, PlacementRow
from mitsplat.renderer.projection.splat_appearance import SplatAppearance, appearance_rows
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import concatenated, wrapped

SCALE_RATIO_MIN = 1e-6
"""Smallest ratio of an axis to the largest axis. Thinner axes are widened to it: a disk stays a disk, and 1/sigma stays
finite.
"""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Gaussians on the device, in their own frame.

    Attributes:
        count: Number of Gaussians, N.
        geometry: Mean, opacity and quaternion xyzw, one row of :class:`Geometry` per Gaussian.
        scales: Standard deviations (3) and a zero per Gaussian: 4 N floats.
        sh: Coefficients per Gaussian, channel-last, ``sh_stride`` floats each.
        sh_count: Number of SH coefficients per channel, 1, 4, 9 or 16.
        sh_stride: Floats per Gaussian in ``sh``, padded so that packets of 4 stay aligned.
    """

    count: int
    geometry: mi.Float
    scales: mi.Float
    sh: mi.Float
    sh_count: int
    sh_stride: int


def upload_cloud(means: AnyArray, quats: AnyArray, scales: AnyArray, opacities: AnyArray, sh: AnyArray) -> Cloud:
    """Copy N Gaussians to the device, with scales of at least :data:`SCALE_RATIO_MIN` of the largest one.

    Args:
        means: Centres [m], shape (N, 3).
        quats: Unit quaternions xyzw, shape (N, 4).
        scales: Standard deviations along the axes [m], shape (N, 3).
        opacities: Peak opacities, shape (N,).
        sh: Coefficients of the spherical harmonics of the colour, shape (N, K, 3).
    """
    count, sh_count = len(means), sh.shape[1]
    stride = -(-3 * sh_count // 4) * 4
    padded = np.zeros((count, stride), np.float32)
    padded[:, : 3 * sh_count] = sh.reshape(count, 3 * sh_count)
    widest = scales.max(axis=1, keepdims=True) if count else scales[:, :1]
    sigma = np.zeros((count, 4), np.float32)
    sigma[:, :3] = np.maximum(scales, SCALE_RATIO_MIN * widest)
    geometry = np.empty((count, Geometry.WIDTH), np.float32)
    geometry[:, Geometry.MEAN], geometry[:, Geometry.OPACITY], geometry[:, Geometry.QUATERNION] = (
        means,
        opacities,
        quats,
    )
    rows, sigmas, coefficients = (wrapped(mi.Float, values) for values in (geometry, sigma, padded))
    return Cloud(count, rows, sigmas, coefficients, sh_count, stride)


@dataclass(frozen=True, eq=False)
class Placement:
    """Pose of a cloud in the world.

    Attributes:
        cloud: Index of the cloud.
        world_from_cloud: Rotation, translation and uniform scale, shape (4, 4).
        instance: Instance id; 0 is the environment.
        appearance: Change of its colours, or None.
    """

    cloud: int
    world_from_cloud: Float64Array
    instance: int
    appearance: SplatAppearance | None = None


@dataclass(frozen=True, eq=False)
class CloudSet:
    """Several clouds in one set of device arrays, so that one kernel serves all placements of a scene.

    Attributes:
        counts: Number of Gaussians of each cloud.
        first: Number of the first Gaussian of each cloud.
        geometry, scales, sh: Rows of all clouds, as in :class:`Cloud`.
        sh_count, sh_stride: The largest values of the clouds, as in :class:`Cloud`.
    """

    counts: tuple[int, ...]
    first: tuple[int, ...]
    geometry: mi.Float
    scales: mi.Float
    sh: mi.Float
    sh_count: int
    sh_stride: int
    _numbers: dict[tuple[int, ...], tuple[mi.UInt32, mi.UInt32]] = field(default_factory=dict, init=False, repr=False)

    def numbers(self, indices: Sequence[int]) -> tuple[mi.UInt32, mi.UInt32]:
        """Return, for every Gaussian of the clouds ``indices``, its index into ``indices`` and its number.

        The last two results are cached: all placements of a layout, and its objects alone.
        """
        key = tuple(indices)
        if key not in self._numbers:
            while len(self._numbers) > 1:
                del self._numbers[next(iter(self._numbers))]
            self._numbers[key] = self._enumerate(key)
        return self._numbers[key]

    def _enumerate(self, indices: tuple[int, ...]) -> tuple[mi.UInt32, mi.UInt32]:
        counts = [self.counts[cloud] for cloud in indices]
        total = int(sum(counts))
        number = dr.arange(mi.UInt32, total)
        if total == 0:
            return number, number
        if len(indices) == 1:
            return dr.zeros(mi.UInt32, total), number + dr.opaque(mi.UInt32, self.first[indices[0]])
        begins = np.cumsum(counts) - counts
        owner = dr.zeros(mi.UInt32, total)
        # An empty cloud has the same start as the next one, so each start is counted as often as it occurs.
        starts, repeats = np.unique(begins[(begins > 0) & (begins < total)], return_counts=True)
        if len(starts):
            repeats, starts = (wrapped(mi.UInt32, values.astype(np.uint32)) for values in (repeats, starts))
            dr.scatter(owner, repeats, starts)
            owner = dr.cumsum(owner)
        if not counts[0]:  # empty clouds before the first non-empty one
            owner += dr.opaque(mi.UInt32, int(np.count_nonzero(begins == 0)) - 1)
        shift = wrapped(mi.Int32, (np.array([self.first[cloud] for cloud in indices]) - begins).astype(np.int32))
        local = mi.UInt32(mi.Int32(number) + dr.gather(mi.Int32, shift, owner))
        dr.eval(owner, local)
        return owner, local


def merge_clouds(clouds: Sequence[Cloud]) -> CloudSet:
    """Concatenate clouds on the device; SH are padded with zeros to the largest degree."""
    counts = tuple(c.count for c in clouds)
    first = tuple(int(i) for i in np.concatenate([[0], np.cumsum(counts)[:-1]]))
    if len(clouds) == 1:
        (c,) = clouds
        return CloudSet(counts, first, c.geometry, c.scales, c.sh, c.sh_count, c.sh_stride)
    stride = max(c.sh_stride for c in clouds)
    geometry, scales = concatenated([c.geometry for c in clouds]), concatenated([c.scales for c in clouds])
    if all(c.sh_stride == stride for c in clouds):
        sh = concatenated([c.sh for c in clouds])
    else:
        sh = dr.zeros(mi.Float, stride * sum(counts))
        for start, c in zip(first, clouds, strict=True):
            if c.count == 0:  # Dr.Jit cannot add to empty arrays
                continue
            i = dr.arange(mi.UInt32, c.count * c.sh_stride)
            # An opaque start lets another set of clouds reuse the compiled kernels.
            row = i // c.sh_stride + dr.opaque(mi.UInt32, start)
            dr.scatter(sh, c.sh, row * stride + i % c.sh_stride, mode=dr.ReduceMode.Permute)
    dr.eval(geometry, scales, sh)
    return CloudSet(counts, first, geometry, scales, sh, max(c.sh_count for c in clouds), stride)


def placement_table(
    clouds: CloudSet, placements: Sequence[Placement], view: CameraView
) -> tuple[mi.Float, mi.UInt32, mi.UInt32]:
    """Return the placements of a view on the device.

    Returns:
        One :class:`PlacementRow` per placement; and for every placed Gaussian, its row and its number in the clouds.
    """
    rows = np.zeros((max(1, len(placements)), PlacementRow.WIDTH), np.float32)
    if placements:
        matrix = np.array([p.world_from_cloud for p in placements], dtype=np.float64)
        turn, shift = matrix[:, :3, :3], matrix[:, :3, 3]
        scale = np.cbrt(np.linalg.det(turn))
        pose = view.world_from_camera
        centre = np.linalg.solve(turn, (pose[:3, 3] - shift)[..., None])[..., 0]
        coarse = centre.astype(np.float32)
        axes = pose[:3, :3].T @ (turn / scale[:, None, None])
        for column, axis in zip((PlacementRow.RIGHT, PlacementRow.DOWN, PlacementRow.FORWARD), range(3), strict=True):
            rows[:, column] = axes[:, axis]
        rows[:, PlacementRow.SCALE] = scale
        rows[:, PlacementRow.INSTANCE] = [p.instance for p in placements]
        rows[:, PlacementRow.CENTRE] = coarse
        rows[:, PlacementRow.CENTRE_REST] = centre - coarse
        rows[:, PlacementRow.APPEARANCE] = appearance_rows([p.appearance for p in placements])
    return wrapped(mi.Float, rows), *clouds.numbers([p.cloud for p in placements])
