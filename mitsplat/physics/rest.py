"""Detection of rest, and of drops that will not come to rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.physics.handling import NO_HANDLING, Handling
from mitsplat.physics.worlds import Body, ContactOverflow, World

CONTACT_OVERFLOW = "contact buffer overflow"
"""Reason of :func:`run_to_rest` for rejecting a drop that may succeed with a larger capacity."""

# Rest means that no surface moves farther than a limit [m] within a time [s]. The stricter first stage ends before
# rolling friction is disabled. Speeds are less reliable: contacts of rounded hulls flicker from step to step, and so do
# the velocities of resting bodies.
_REST_MOTION, _REST_TIME = 5e-4, 1.0
_QUIET_MOTION, _QUIET_TIME = 1e-4, 0.25
FREE_TIME = 1.5
"""Time without rolling friction for bodies that fall in random poses [s], longer than rebounds last."""
_SPEED_WINDOW = 0.05  # averaging time of the reported speeds [s]


@dataclass(frozen=True, eq=False)
class RestOutcome:
    """Result of a drop.

    Attributes:
        rejection: Reason of a rejection, or empty.
        time: Simulated time from which the bodies were at rest [s].
        surface_motion: Largest displacement of a surface point in the second after that [m]; infinite if rejected.
        max_speed, max_spin: Maxima over the bodies at the end of that second [m/s, rad/s].
        poses: World-from-body transforms at that time, shape (N, 4, 4).
        causes: Positions of the bodies that cause the rejection.
    """

    rejection: str
    time: float
    max_speed: float
    max_spin: float
    surface_motion: float
    poses: Float64Array = field(repr=False)
    causes: tuple[int, ...] = ()


def run_to_rest(
    world: World,
    *,
    max_time: float,
    bounds: tuple[Float64Array, Float64Array],
    free_time: float = 0.0,
    fastest: float = np.inf,
    handling: Handling = NO_HANDLING,
    observe: Callable[[float, Float64Array], None] = lambda time, poses: None,
) -> RestOutcome:
    """Advance a world until its bodies have been at rest for a second, or until rest is ruled out.

    At rest, no surface point moves by 0.5 mm within one second, and by 0.1 mm within its first quarter. After that
    quarter, rolling friction is disabled, because it would let a box balance on its edge. It is also disabled in the
    first seconds of bodies that tumble, because discs would stop on their rim.

    Args:
        world: Simulation; changed in place.
        max_time: Time limit for coming to rest, from the end of the handling on [s].
        bounds: Corners of the box in which the centres of mass must stay [m], shape (3,) each, or (N, 3) for each body.
        free_time: Time without rolling friction, from the end of the handling on [s].
        fastest: Speed limit to which faster bodies are slowed down after each advance [m/s].
        handling: Actions on the bodies. Before they end, the bodies are not at rest.
        observe: Callback that receives the time [s] and the poses (N, 4, 4) after each advance.
    """
    try:
        return _run_to_rest(world, max_time, bounds, free_time, fastest, handling, observe)
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
    bounds: tuple[Float64Array, Float64Array],
    free_time: float,
    fastest: float,
    handling: Handling,
    observe: Callable[[float, Float64Array], None],
) -> RestOutcome:
    mean_frames = max(1, round(_SPEED_WINDOW / world.interval))
    past: deque[Float64Array] = deque([world.poses], maxlen=mean_frames + 1)
    since, rest = 0.0, world.poses
    motion = np.zeros(len(world.bodies))
    while world.time - since < _REST_TIME:
        world.allow_rolling(world.time < handling.end + free_time or world.time - since >= _QUIET_TIME)
        handling.apply(world)
        poses = _advance_within(world, bounds, fastest)
        past.append(poses)
        observe(world.time, poses)
        motion = np.maximum(motion, _surface_motion(world.bodies, rest, poses))
        moving = motion > (_QUIET_MOTION if world.time - since < _QUIET_TIME else _REST_MOTION)
        if moving.any() or world.time < handling.end:
            since, rest = world.time, poses
            motion = np.zeros(len(world.bodies))
        if since >= handling.end + max_time:
            raise _Rejected(f"not at rest within {max_time:g} s", moving)
    speed, spin = _mean_speeds(world.bodies, past[0], poses, (len(past) - 1) * world.interval)
    return RestOutcome("", since, speed, spin, float(motion.max()), world.poses)


def _advance_within(world: World, bounds: tuple[Float64Array, Float64Array], fastest: float) -> Float64Array:
    """Advance the world, check the bounds, and return the poses."""
    world.advance()
    poses, velocities = world.poses, world.velocities
    if not np.isfinite(poses).all() or not np.isfinite(velocities).all():
        raise _Rejected("the simulation diverged", ~np.isfinite(poses).all(axis=(1, 2)))
    speeds = np.linalg.norm(velocities[:, 0], axis=1)
    if speeds.max() > fastest:
        velocities[:, 0] *= np.minimum(1.0, fastest / np.maximum(speeds, fastest))[:, None]
        world.set_velocities(velocities)
    centres = _centres(world.bodies, poses)
    outside = ((centres < bounds[0]) | (centres > bounds[1])).any(axis=1)
    if outside.any():
        raise _Rejected(f"{int(outside.sum())} left the enclosure", outside)
    return poses


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


def _surface_motion(bodies: Sequence[Body], before: Float64Array, after: Float64Array) -> Float64Array:
    """Compute the largest displacement of a point of each body between two sets of poses [m], shape (N,)."""
    moved = after - before
    return np.array(
        [
            np.linalg.norm(body.outline @ change[:3, :3].T + change[:3, 3], axis=1).max()
            for body, change in zip(bodies, moved, strict=True)
        ],
        dtype=np.float64,
    )
