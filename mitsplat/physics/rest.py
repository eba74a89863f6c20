"""Detection of rest, and of drops that will not come to rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.physics.bodies import Body
from mitsplat.physics.handling import NO_HANDLING, Handling
from mitsplat.physics.worlds import ContactOverflow, World

CONTACT_OVERFLOW = "contact buffer overflow"
"""Reason of :func:`run_to_rest` for rejecting a drop that may succeed with a larger capacity."""
LEANING, LATE = "rests against the enclosure", "keeps moving"
"""Reasons that concern the first body that causes the rejection."""

# Rest means that no surface moves farther than a limit [m] within a time [s]. The stricter first stage ends before
# rolling friction is disabled. Speeds are less reliable: contacts of rounded hulls flicker from step to step, and so do
# the velocities of resting bodies.
_REST_MOTION, _REST_TIME = 5e-4, 1.0
_QUIET_MOTION, _QUIET_TIME = 1e-4, 0.25
WALL_DISTANCE = 1e-3
"""Distance from a wall below which a body leans against it [m]."""
FREE_TIME = 1.5
"""Time with rebounds, and without rolling friction for bodies that fall in random poses [s].

Without this limit, rebounds would last longer from a restitution of about 0.75 on.
"""
_SPEED_WINDOW = 0.05  # averaging time of the reported speeds [s]
_DRAG_TIME = 0.2  # time constant of the drag on bodies that still move after FREE_TIME [s]
# Bodies are late if they roll or rock while the others rest: they move farther than bodies at rest may within the same
# time. At least one body may be late, and at most this share of all.
_MAX_LATE = 0.5
# Time after the handling in which failed bodies start again [s], twice that of a typical pile of thirty packages. Late
# bodies start again only once: a second failure, after 5 s at the earliest, shows a pile that creeps, and a new one
# rests sooner.
_REDRAW_TIME, _LATE_REDRAW_TIME = 7.0, 4.0


@dataclass(frozen=True, eq=False)
class RestOutcome:
    """Result of a drop.

    Attributes:
        rejection: Reason of a rejection, or empty.
        time: Simulated time from which the bodies were at rest [s].
        max_speed, max_spin: Maxima over the bodies at the end of the second after that [m/s, rad/s].
        surface_motion: Largest displacement of a surface point in that second [m]; infinite if rejected.
        poses: World-from-body transforms at the end of that second, shape (N, 4, 4).
        causes: Positions of the bodies that cause the rejection.
    """

    rejection: str
    time: float
    max_speed: float
    max_spin: float
    surface_motion: float
    poses: Float64Array = field(repr=False)
    causes: tuple[int, ...] = ()


Redraw = Callable[[Float64Array, BoolArray], Float64Array | None]
"""Function that gets poses (N, 4, 4) and a mask (N,), and returns the poses with new ones for the masked bodies.

It returns None if there is no room.
"""

Observe = Callable[[float, Float64Array, BoolArray], None]
"""Callback that gets the time [s], the poses (N, 4, 4), and a mask (N,) of the bodies that were dropped again."""


def observe_nothing(time: float, poses: Float64Array, again: BoolArray) -> None:
    """Ignore a moment of a drop."""


def run_to_rest(
    world: World,
    *,
    max_time: float,
    bounds: tuple[Float64Array, Float64Array],
    walls: tuple[Float64Array, Float64Array] | None = None,
    free_time: float = 0.0,
    fastest: float = np.inf,
    handling: Handling = NO_HANDLING,
    redraw: Redraw | None = None,
    observe: Observe = observe_nothing,
) -> RestOutcome:
    """Advance a world until its bodies have been at rest for a second, or until rest is ruled out.

    At rest, no surface point moves by 0.5 mm within one second, and by 0.1 mm within its first quarter. After that
    quarter, rolling friction is disabled, because it would let a box balance on its edge. It is also disabled in the
    first seconds of bodies that tumble, because discs would stop on their rim.

    Bodies that still move after 1.5 s no longer rebound, and are slowed by a drag with a time constant of 0.2 s, which
    ends together with rolling friction. A body fails if it leaves the bounds or leans against a wall. It also fails if
    it still moves, or has moved for two seconds, after half of the bodies, or all but one, have moved by less than
    0.5 mm for a second. With ``redraw``, bodies that fail in the first seven seconds, or four if they still move, start
    again from new poses, while the others stay where they are. Otherwise, the drop is rejected.

    Args:
        world: Simulation; changed in place.
        max_time: Time limit for coming to rest, from the end of the handling or the last redraw on [s].
        bounds: Corners of the box in which the centres of mass must stay [m], shape (3,) each, or (N, 3) for each body.
        walls: Corners of the box of walls that no body may lean against [m], in the same shapes; infinite without a
            wall.
        free_time: Time without rolling friction, from the end of the handling or the last redraw on [s].
        fastest: Speed limit to which faster bodies are slowed down after each advance [m/s].
        handling: Actions on the bodies. Before they end, the bodies are not at rest.
        redraw: Function that draws new poses of failed bodies.
        observe: Callback after each advance.
    """
    failures = _Failures(world, bounds, walls or (np.full(3, -np.inf), np.full(3, np.inf)))
    try:
        return _run_to_rest(world, max_time, failures, free_time, fastest, handling, redraw, observe)
    except ContactOverflow:
        refused = _Rejected(CONTACT_OVERFLOW, np.zeros(len(world.bodies), dtype=bool))
    except _Rejected as error:
        refused = error
    return RestOutcome(str(refused), world.time, np.inf, np.inf, np.inf, world.poses, refused.causes)


class _Rejected(Exception):
    """Rejection of a drop, with the bodies that cause it."""

    def __init__(self, reason: str, bodies: npt.ArrayLike) -> None:
        super().__init__(reason)
        self.causes = tuple(np.flatnonzero(bodies).tolist())


def _run_to_rest(
    world: World,
    max_time: float,
    failures: _Failures,
    free_time: float,
    fastest: float,
    handling: Handling,
    redraw: Redraw | None,
    observe: Observe,
) -> RestOutcome:
    """Run :func:`run_to_rest` up to the first rejection, which is raised as ``_Rejected``."""
    mean_frames = max(1, round(_SPEED_WINDOW / world.interval))
    past: deque[Float64Array] = deque([world.poses], maxlen=mean_frames + 1)
    begin, since, rest = handling.end, 0.0, world.poses
    motion = np.zeros(len(world.bodies))
    while world.time - since < _REST_TIME:
        quiet = world.time - since >= _QUIET_TIME
        world.set_rolling_friction(not (world.time - begin < free_time or quiet))
        world.set_restitution(world.time - begin < FREE_TIME)
        handling.apply(world)
        poses = _advance(world, fastest, drag=world.time - begin >= FREE_TIME and not quiet)
        past.append(poses)
        motion = np.maximum(motion, surface_motion(world.bodies, rest, poses))
        moving = motion > (_QUIET_MOTION if world.time - since < _QUIET_TIME else _REST_MOTION)
        if moving.any() or world.time < handling.end:
            since, rest = world.time, poses
            motion = np.zeros(len(world.bodies))
        reason, failed = failures.find(poses, moving, begin)
        if not failed.any() and since - begin >= max_time:
            reason, failed = f"not at rest within {max_time:g} s", moving
        if failed.any():
            in_time = world.time < handling.end + (_LATE_REDRAW_TIME if reason == LATE else _REDRAW_TIME)
            drawn = redraw(poses, failed) if redraw is not None and in_time else None
            if drawn is None:
                raise _Rejected(reason, failed)
            _restart(world, drawn, failed)
            begin, since = max(world.time, handling.end), world.time
            rest, motion = drawn, np.zeros(len(world.bodies))
        observe(world.time, rest if failed.any() else poses, failed)
    speed, spin = _mean_speeds(world.bodies, past[0], poses, (len(past) - 1) * world.interval)
    return RestOutcome("", since, speed, spin, float(motion.max()), world.poses)


def _advance(world: World, fastest: float, *, drag: bool) -> Float64Array:
    """Advance the world, reduce its velocities, and return the poses."""
    world.advance()
    poses, velocities = world.poses, world.velocities
    if not np.isfinite(poses).all() or not np.isfinite(velocities).all():
        raise _Rejected("the simulation diverged", ~np.isfinite(poses).all(axis=(1, 2)))
    if drag:
        velocities *= np.exp(-world.interval / _DRAG_TIME)
    speeds = np.linalg.norm(velocities[:, 0], axis=1)
    too_fast = speeds.max() > fastest
    if too_fast:
        velocities[:, 0] *= np.minimum(1.0, fastest / np.maximum(speeds, fastest))[:, None]
    if drag or too_fast:
        world.set_velocities(velocities)
    return poses


def _restart(world: World, poses: Float64Array, bodies: BoolArray) -> None:
    """Set new poses (N, 4, 4). The given bodies (N,) start at rest, the others keep their velocities."""
    time, velocities = world.time, world.velocities
    velocities[bodies] = 0.0
    world.reset(poses, velocities)
    world.time = time


class _Failures:
    """Detection of bodies that will not come to rest where they may.

    Args:
        world: Simulation.
        bounds: Corners of the box in which the centres of mass must stay [m].
        walls: Corners of the box of walls that no body may lean against [m].
    """

    def __init__(
        self, world: World, bounds: tuple[Float64Array, Float64Array], walls: tuple[Float64Array, Float64Array]
    ) -> None:
        count = len(world.bodies)
        self._world, self._bounds = world, bounds
        self._low, self._high = (np.broadcast_to(side, (count, 3)) for side in walls)
        self._last_motion = np.zeros(count)
        self._before: tuple[float, Float64Array] | None = None  # time and poses
        self._moved_before = np.zeros(count, dtype=bool)  # in the second before that
        self._reach = np.array([np.linalg.norm(body.outline - body.mass.centre, axis=1).max() for body in world.bodies])

    def find(self, poses: Float64Array, moving: BoolArray, begin: float) -> tuple[str, BoolArray]:
        """Return the reason of a failure, and a mask (N,) of the bodies that failed.

        Args:
            poses: World-from-body transforms, shape (N, 4, 4).
            moving: Mask of the bodies that move, shape (N,).
            begin: Time at which the handling ended, or bodies were dropped again [s].
        """
        time = self._world.time
        self._last_motion[moving] = time
        centres = _centres(self._world.bodies, poses)
        outside = np.any((centres < self._bounds[0]) | (centres > self._bounds[1]), axis=1)
        if outside.any():
            return f"{int(outside.sum())} left the enclosure", outside
        calm = time - self._last_motion >= _QUIET_TIME
        reach = self._reach[:, None] + WALL_DISTANCE
        leaning = calm & ((centres - reach < self._low) | (centres + reach > self._high)).any(axis=1)
        for i in np.flatnonzero(leaning):
            points = self._world.bodies[i].outline @ poses[i, :3, :3].T + poses[i, :3, 3]
            beyond = (points < self._low[i] + WALL_DISTANCE) | (points > self._high[i] - WALL_DISTANCE)
            leaning[i] = beyond.any()
        if leaning.any():
            return LEANING, leaning
        return LATE, self._find_late(poses, calm, begin)

    def _find_late(self, poses: Float64Array, calm: BoolArray, begin: float) -> BoolArray:
        """Return a mask (N,) of the bodies that move while the others rest."""
        time, late = self._world.time, np.zeros(len(calm), dtype=bool)
        if time < begin + FREE_TIME:
            self._before, self._moved_before = None, late
        elif self._before is None:
            self._before = time, poses
        elif time - self._before[0] >= _REST_TIME:
            moved = surface_motion(self._world.bodies, self._before[1], poses) > _REST_MOTION
            if moved.sum() <= max(1, int(_MAX_LATE * len(moved))) < len(moved):
                late = moved & (~calm | self._moved_before)
            self._before, self._moved_before = (time, poses), moved
        return late


def _centres(bodies: Sequence[Body], poses: Float64Array) -> Float64Array:
    """Compute the centres of mass [m], shape (N, 3)."""
    local = np.array([body.mass.centre for body in bodies])
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], local) + poses[:, :3, 3])


def _mean_speeds(
    bodies: Sequence[Body], before: Float64Array, after: Float64Array, seconds: float
) -> tuple[float, float]:
    """Compute the largest mean speed [m/s] and spin [rad/s] of any body between two sets of poses."""
    way = np.linalg.norm(_centres(bodies, after) - _centres(bodies, before), axis=1)
    # Rotations that differ by an angle t have a difference matrix of Frobenius norm 2 sqrt(2) sin(t / 2).
    apart = np.linalg.norm(after[:, :3, :3] - before[:, :3, :3], axis=(1, 2))
    turn = 2 * np.arcsin(np.minimum(1.0, apart / np.sqrt(8.0)))
    return float(way.max()) / seconds, float(turn.max()) / seconds


def surface_motion(bodies: Sequence[Body], before: Float64Array, after: Float64Array) -> Float64Array:
    """Compute the largest displacement of a point of each body between two sets of poses [m], shape (N,)."""
    largest = np.zeros(len(bodies))
    for i, (body, change) in enumerate(zip(bodies, after - before, strict=True)):
        moved = body.outline @ change[:3, :3].T + change[:3, 3]
        largest[i] = np.sqrt(np.einsum("ni,ni->n", moved, moved).max())
    return largest
