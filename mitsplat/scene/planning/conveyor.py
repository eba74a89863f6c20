"""Motion of objects on a conveyor belt between the views of a layout.

Objects settle while the belt stands still; then the belt runs. Each view is one moment of the run. At the middle
between the first and the last moment, the layout is as it settled. Objects above the belt move with it rigidly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.rigid import transform_points
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.spec.shape_spec import Box
from mitsplat.scene.walls import pose_matrix

if TYPE_CHECKING:
    from mitsplat.scene.layout import Layout
    from mitsplat.scene.scene import Scene

_NEAR = 1e-3
"""Maximum distance of a belt point from the top of the belt [m]."""


@dataclass(frozen=True)
class Belt:
    """Conveyor belt at one moment.

    Attributes:
        box: Box of the belt, which runs along its own x axis.
        speed: Speed of the belt surface [m/s].
        time: Time since the moment at which the layout is as it settled [s]; negative before it.
        interval: Time until the next image of the layout [s]; 0 if there is none. Negative in a film that runs back.
    """

    box: Box
    speed: float
    time: float
    interval: float

    @property
    def travel(self) -> float:
        """Distance that the belt has run since the moment at which the layout is as it settled [m]."""
        return self.speed * self.time

    @property
    def velocity(self) -> Float64Array:
        """Velocity of the belt surface in the world [m/s], shape (3,)."""
        return np.asarray(self.speed * pose_matrix(self.box)[:3, 0])

    def on_surface(self, points: Float64Array) -> BoolArray:
        """Return a mask of the world points (N, 3) [m] that lie on the upper side of the belt."""
        return _above_box(self.box, points, _NEAR)


def _above_box(box: Box, points: Float64Array, height: float) -> BoolArray:
    """Return a mask of the world points (N, 3) [m] that are above a box, up to a height [m]."""
    pose, half = pose_matrix(box), np.array(box.size) / 2
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    above: BoolArray = (z > half[2] - _NEAR) & (z < half[2] + height) & (abs(x) <= half[0]) & (abs(y) <= half[1])
    return above


def belt_of(spec: SceneSpec, view: int) -> Belt | None:
    """Return the belt at the moment of a view of a layout."""
    if spec.conveyor is None:
        return None
    box = next(shape.box for shape in spec.shapes if shape.name == spec.conveyor.belt and shape.box is not None)
    views, interval = spec.output.views, spec.conveyor.interval
    time = interval * (view - (views - 1) / 2)
    return Belt(box, spec.conveyor.speed, time, interval if view + 1 < views else 0.0)


def layout_at_view(scene: Scene, layout: Layout, view: int) -> Layout:
    """Return a settled layout at the moment of a view. Layouts with given poses are returned unchanged.

    Args:
        scene: The scene, with or without a conveyor.
        layout: The layout as it settled, or at the moment of another view.
        view: Index of the view in the layout.
    """
    belt, settled = belt_of(scene.spec, view), layout.settled or layout
    if belt is None or not settled.certificate.attempts:  # without physics, poses are given
        return layout
    moving = carried_instances(scene, settled, belt.box)
    return _shifted_layout(settled, moving, tuple((belt.time * belt.velocity).tolist()))


@lru_cache(maxsize=4)
def _shifted_layout(settled: Layout, moving: frozenset[int], offset: Sequence[float]) -> Layout:
    """Return the layout with the instances ``moving`` moved by a vector [m].

    The cache returns the identical layout for all views of a moment, so that the renderer can skip unchanged geometry.
    """
    instances = []
    for instance in settled.instances:
        pose = instance.world_from_object
        if instance.id in moving:
            pose = pose.copy()
            pose[:3, 3] += offset
        instances.append(replace(instance, world_from_object=pose))
    return replace(settled, instances=tuple(instances), settled=settled)


def carried_instances(scene: Scene, layout: Layout, box: Box) -> frozenset[int]:
    """Return the ids of the instances that a belt carries: those whose centroid was above it after settling."""
    settled = (layout.settled or layout).instances
    places = [transform_points(one.world_from_object, np.array(scene.centroids[one.asset])) for one in settled]
    above = _above_box(box, np.array(places).reshape(-1, 3), np.inf)
    return frozenset(instance.id for instance, is_above in zip(settled, above, strict=True) if is_above)


def check_belt(spec: SceneSpec) -> None:
    """Check that the belt is long enough to carry the objects of its regions.

    Raises:
        InputError: If the belt is not below a region, or if it is too short; the message states the necessary length.
    """
    belt = belt_of(spec, 0)
    if belt is None:
        return
    pose, (length, width, _) = pose_matrix(belt.box), belt.box.size
    reach = 0.0
    for region, _ in spec.all_regions:
        corners = trimesh.bounds.corners(np.array([region.min, region.max]))
        corners = (corners - pose[:3, 3]) @ pose[:3, :3]
        (x0, y0, _), (x1, y1, z1) = corners.min(axis=0), corners.max(axis=0)
        if z1 > 0 and x0 < length / 2 and x1 > -length / 2 and y0 < width / 2 and y1 > -width / 2:
            reach = max(reach, float(abs(x0)), float(abs(x1)))
    wanted = 2 * (reach + abs(belt.travel))
    if not reach:
        raise InputError("must be below a region, so that it carries objects")
    if wanted > length:
        raise InputError(
            f"its box must be {wanted:.3g} m long, so that the objects of its region stay on it for "
            f"{abs(belt.travel):.3g} m in both directions (got {length:.3g} m)"
        )
