"""Motion that people give to objects: initial velocities, a sweep, and shaking.

All of it acts on bodies through velocities at the start and through forces between the steps of a
:class:`mitsplat.physics.worlds.World`, so that both steppers share it.

Sweep
    A vertical plane without friction moves at a constant speed ``v`` along its normal. It acts on a body at the height
    of the centre of mass, beside it at the mean of the body's corners behind the plane, weighted by their depths. If
    this point moves at a speed ``u`` and the deepest corner is at a depth ``d``, the point is accelerated by
    ``k d + c (v - u)``, at least 0. The force is limited, so that bodies between the plane and a wall are not crushed.
    A body whose centre of mass is behind the plane is left behind.
Shaking
    In the frame of a ground with the acceleration ``a(t)``, a body of mass ``m`` feels the force ``-m a(t)``. With
    ``a = v w cos(w t)`` for whole periods, the ground starts and ends at rest at the same place, and ``v`` is its
    maximum speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.physics.bodies import Body
from mitsplat.physics.worlds import World
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.spec.shape_spec import Region

_DROP_TIME = 1.0  # time after which dropped objects are pushed or shaken [s]
_SWEPT = (0.2, 0.7)  # share of the region's length along which a plane sweeps
_PERIOD, _PERIODS = 0.32, 3  # of shaking [s]
# Contact of the plane: stiffness k [1/s^2], damping c [1/s], maximum force by mass [m/s^2]. Forces are constant for
# four timesteps, 8 ms: with a larger stiffness, bodies leave the plane at more than 7/6 of its speed.
_STIFFNESS, _DAMPING, _MAX_ACCELERATION = 1500.0, 120.0, 50.0


@dataclass(frozen=True, eq=False)
class Sweep:
    """Vertical plane that pushes bodies.

    Attributes:
        bodies: Mask of the bodies that it pushes, shape (N,).
        direction: Horizontal unit vector of the motion, shape (3,).
        start: Position along the direction at which it starts [m].
        length: Length of the way [m].
        speed: Its speed [m/s].
    """

    bodies: BoolArray
    direction: Float64Array
    start: float
    length: float
    speed: float

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.length / self.speed

    def forces(self, world: World, time: float) -> Float64Array:
        """Compute force and torque on each body, shape (N, 2, 3), at a time since the start [s]."""
        forces = np.zeros((len(world.bodies), 2, 3))
        poses, velocities, position = world.poses, world.velocities, self.start + self.speed * time
        for i in np.flatnonzero(self.bodies):
            body, turn = world.bodies[i], poses[i, :3, :3]
            arms = (body.outline - body.mass.centre) @ turn.T
            beyond = float((poses[i, :3, 3] + turn @ body.mass.centre) @ self.direction) - position
            depths = -beyond - arms @ self.direction
            touching = depths > 0
            if beyond <= 0 or not touching.any():
                continue
            point = np.average(arms[touching], axis=0, weights=depths[touching]) * (1.0, 1.0, 0.0)
            lever = np.cross(point, self.direction)
            mobility = 1 / body.mass.mass + lever @ turn @ np.linalg.solve(body.mass.inertia, turn.T @ lever)
            speed = velocities[i, 0] @ self.direction + velocities[i, 1] @ lever
            wanted = _STIFFNESS * depths.max() + _DAMPING * (self.speed - speed)
            force = np.clip(wanted / mobility, 0.0, _MAX_ACCELERATION * body.mass.mass)
            forces[i] = force * self.direction, force * lever
        return forces


@dataclass(frozen=True, eq=False)
class Shaking:
    """Horizontal motion of the ground to and fro.

    Attributes:
        bodies: Mask of the bodies on this ground, shape (N,).
        direction: Horizontal unit vector, shape (3,).
        speed: Maximum speed [m/s].
        duration: Duration of whole periods [s].
    """

    bodies: BoolArray
    direction: Float64Array
    speed: float
    duration: float = _PERIOD * _PERIODS

    def forces(self, world: World, time: float) -> Float64Array:
        """Compute force and torque on each body, shape (N, 2, 3), at a time since the start [s]."""
        rate = 2 * np.pi / _PERIOD
        acceleration = self.speed * rate * np.cos(rate * (time + world.interval / 2))
        forces = np.zeros((len(world.bodies), 2, 3))
        masses = np.array([body.mass.mass for body in world.bodies])
        forces[:, 0] = -acceleration * (masses * self.bodies)[:, None] * self.direction
        return forces


@dataclass(frozen=True, eq=False)
class Handling:
    """Motion that bodies are given.

    Attributes:
        velocities: Initial velocities as in :attr:`mitsplat.physics.worlds.World.velocities`, shape (N, 2, 3), or None.
        actions: Actions that start one second after the drop.
    """

    velocities: Float64Array | None = None
    actions: tuple[Sweep | Shaking, ...] = ()

    @property
    def end(self) -> float:
        """Time at which the last action ends [s]; 0 without actions."""
        return max((_DROP_TIME + action.duration for action in self.actions), default=0.0)

    def apply(self, world: World) -> None:
        """Set the forces on the bodies of a world for its next advance."""
        if not self.actions or world.time > self.end + world.interval:
            return
        forces = np.zeros((len(world.bodies), 2, 3))
        for action in self.actions:
            since = world.time - _DROP_TIME + 1e-9  # the sum of steps is rounded
            if 0 <= since < action.duration:
                forces += action.forces(world, since)
        world.set_forces(forces)


NO_HANDLING = Handling()


def draw_handling(
    bodies: Sequence[Body],
    poses: Float64Array,
    regions: Sequence[tuple[Region, Arrangement]],
    members: Sequence[BoolArray],
    rng: np.random.Generator,
    *,
    speed: tuple[float, float],
    spin: tuple[float, float],
) -> Handling:
    """Draw the motion of bodies for the arrangements ``tossed``, ``tipped``, ``pushed`` and ``shaken``.

    Args:
        bodies: The bodies.
        poses: Their start poses, shape (N, 4, 4).
        regions: Regions with their arrangements.
        members: For each region, a mask of the bodies that start in it, shape (N,).
        rng: Random generator.
        speed: Range of speeds [m/s].
        spin: Range of angular speeds [degrees/s].
    """
    velocities, actions = np.zeros((len(bodies), 2, 3)), list[Sweep | Shaking]()
    centres = poses[:, :3, 3] + np.einsum("nij,nj->ni", poses[:, :3, :3], [body.mass.centre for body in bodies])
    for (region, arrangement), mask in zip(regions, members, strict=True):
        count = int(mask.sum())
        if not count:
            continue
        low, high = np.array(region.min), np.array(region.max)
        if arrangement in ("tossed", "tipped"):
            together = arrangement == "tipped"
            origins = centres[mask].mean(axis=0, keepdims=True) if together else centres[mask]
            ways = rng.uniform(low, high, size=origins.shape) - origins
            ways[:, 2] = -np.linalg.norm(ways[:, :2], axis=1) if together else 0.0
            ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
            velocities[mask, 0] = ways * rng.uniform(*speed, size=(len(ways), 1))
            if not together:
                axes = Rotation.random(count, rng=rng).as_matrix()[:, 2]
                velocities[mask, 1] = axes * np.radians(rng.uniform(*spin, size=(count, 1)))
        elif arrangement in ("pushed", "shaken"):
            angle = rng.uniform(0, 2 * np.pi)
            direction = np.array([np.cos(angle), np.sin(angle), 0.0])
            drawn = rng.uniform(*speed)
            if arrangement == "shaken":
                actions.append(Shaking(mask, direction, drawn))
                continue
            length = float((high - low) @ np.abs(direction))
            start = float((low + high) / 2 @ direction) - length / 2
            actions.append(Sweep(mask, direction, start, length * rng.uniform(*_SWEPT), drawn))
    return Handling(velocities, tuple(actions))
