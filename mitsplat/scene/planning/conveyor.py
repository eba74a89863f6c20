"""A belt that carries what lies on it from one moment of a layout to the next.

Objects settle while the belt stands still; it then runs, and the cameras' turns are moments of its run, the middle of
the first and the last of which shows the layout as it settled. What is above the belt moves with it as it lies.
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
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.spec.shape_spec import Box
from mitsplat.scene.walls import stated_pose

if TYPE_CHECKING:
    from mitsplat.scene.layout import Layout

_NEAR = 1e-3
"""Distance from the belt's top within which a point that is seen is one of the belt [m]."""


@dataclass(frozen=True)
class Belt:
    """A conveyor's belt at a moment.

    Attributes:
        box: The belt, which runs along its own x axis.
        speed: Of its surface [m/s].
        time: Since the layout was as it settled [s]; negative before.
        interval: Until the next image of the layout [s]; 0 if that is of the same moment, or there is none.
    """

    box: Box
    speed: float
    time: float
    interval: float

    @property
    def travel(self) -> float:
        """How far it has run since the layout was as it settled [m]."""
        return self.speed * self.time

    @property
    def velocity(self) -> Float64Array:
        """Of its surface in the world [m/s], shape (3,)."""
        return np.asarray(self.speed * stated_pose(self.box)[:3, 0])

    def shows(self, points: Float64Array) -> BoolArray:
        """Which of some points (N, 3) in the world [m] lie on its upper side."""
        return _over(self.box, points, _NEAR)


def _over(box: Box, points: Float64Array, height: float) -> BoolArray:
    """Which of some points (N, 3) in the world [m] are above a box, up to a height [m]."""
    pose, half = stated_pose(box), np.array(box.size) / 2
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    above: BoolArray = (z > half[2] - _NEAR) & (z < half[2] + height) & (abs(x) <= half[0]) & (abs(y) <= half[1])
    return above


def belt_of(spec: SceneSpec, view: int) -> Belt | None:
    """The belt at the moment of a view of a layout; all cameras of a turn look at the same moment."""
    if spec.conveyor is None:
        return None
    box = next(shape.box for shape in spec.shapes if shape.name == spec.conveyor.belt and shape.box is not None)
    seats = len(spec.seats)
    turn, turns = view // seats, -(-spec.output.views // seats)
    follows = view + 1 < spec.output.views and (view + 1) // seats != turn
    interval = spec.conveyor.interval
    return Belt(box, spec.conveyor.speed, interval * (turn - (turns - 1) / 2), interval if follows else 0.0)


def carried(spec: SceneSpec, layout: Layout, view: int) -> Layout:
    """A settled layout as it is at the moment of a view; poses that were given stay as they are.

    Args:
        spec: The scene, whose conveyor it is, if it has one.
        layout: As it settled, or carried to another view.
        view: Position of the view among the layout's.
    """
    belt = belt_of(spec, view)
    return layout if belt is None else carried_by(belt, layout)


def carried_by(belt: Belt, layout: Layout) -> Layout:
    """A settled layout as it is at the moment of a belt; poses that were given stay as they are."""
    settled = layout.settled or layout
    if not settled.certificate.attempts:  # physics had no part in it
        return layout
    return _moved(settled, belt.box, tuple((belt.time * belt.velocity).tolist()))


@lru_cache(maxsize=4)
def _moved(settled: Layout, box: Box, by: Sequence[float]) -> Layout:
    """The same object for all views of a moment, by which the renderer knows that nothing moved."""
    instances = []
    moving = carried_instances(settled, box)
    for instance in settled.instances:
        pose = instance.world_from_object
        if instance.id in moving:
            pose = pose.copy()
            pose[:3, 3] += by
        instances.append(replace(instance, world_from_object=pose))
    return replace(settled, instances=tuple(instances), settled=settled)


def carried_instances(layout: Layout, box: Box) -> frozenset[int]:
    """Ids of the instances that a belt carries: those whose origin was above it when they had settled."""
    settled = (layout.settled or layout).instances
    places = np.array([instance.world_from_object[:3, 3] for instance in settled]).reshape(-1, 3)
    above = _over(box, places, np.inf)
    return frozenset(instance.id for instance, is_above in zip(settled, above, strict=True) if is_above)


def check_belt(spec: SceneSpec) -> None:
    """Refuse a belt that would carry objects of a region beyond its end.

    Raises:
        InputError: With how long it must be.
    """
    belt = belt_of(spec, 0)
    if belt is None:
        return
    pose, (length, width, _) = stated_pose(belt.box), belt.box.size
    reach = 0.0
    for region, _ in spec.all_regions:
        corners = trimesh.bounds.corners(np.array([region.min, region.max]))
        x, y, z = ((corners - pose[:3, 3]) @ pose[:3, :3]).T
        if (
            z.max() > 0
            and x.min() < length / 2
            and x.max() > -length / 2
            and y.min() < width / 2
            and y.max() > -width / 2
        ):
            reach = max(reach, float(abs(x).max()))
    wanted = 2 * (reach + abs(belt.travel))
    if not reach:
        raise InputError("must be below a region, whose objects it carries")
    if wanted > length:
        raise InputError(
            f"its box must be {wanted:.3g} m long, for the objects of its region not to leave it within "
            f"{abs(belt.travel):.3g} m either way (got {length:.3g} m)"
        )
