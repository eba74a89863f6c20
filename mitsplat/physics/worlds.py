"""Interface of a rigid-body simulation, whose state is independent of its stepper.

:class:`mitsplat.physics.mujoco_world.MujocoWorld` steps MuJoCo in C, and
:class:`mitsplat.physics.warp_world.WarpWorld` its port to Warp. Both are built from one model of the library Newton.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.physics.bodies import Body
from mitsplat.physics.newton_model import BATCH, body_coordinates

STEPS = 4
"""Timesteps per :meth:`World.advance`; even, so that the two states of a captured graph return to their roles."""


class ContactOverflow(Exception):
    """Overflow of the contact buffers: contacts were dropped, and bodies may have passed through one another."""


class World(ABC):
    """Simulation of bodies above colliders; :meth:`reset` sets its initial state.

    Attributes:
        bodies: Dynamic bodies.
        interval: Simulated time of each :meth:`advance` [s].
        time: Simulated time since :meth:`reset` [s].
    """

    def __init__(self, bodies: Sequence[Body], *, timestep: float) -> None:
        self.bodies = tuple(bodies)
        self.interval = STEPS * timestep
        self.time = 0.0
        self._has_rolling_friction = True
        self._has_restitution = True

    def reset(self, poses: Float64Array, velocities: Float64Array | None = None) -> None:
        """Set the state of all bodies and clear the solver's history.

        Args:
            poses: World-from-body transforms, shape (N, 4, 4).
            velocities: As :attr:`velocities`, shape (N, 2, 3); at rest if None.
        """
        self.time = 0.0
        self.set_rolling_friction(True)
        self.set_restitution(True)
        self._reset(body_coordinates(self.bodies, poses))
        self.set_velocities(np.zeros((len(self.bodies), 2, 3)) if velocities is None else velocities)
        self.set_forces(np.zeros((len(self.bodies), 2, 3)))

    def set_velocities(self, velocities: Float64Array) -> None:
        """Set the velocities of the bodies (N, 2, 3), as in :attr:`velocities`; poses do not change."""
        self._set_velocities(np.pad(velocities, ((0, -len(velocities) % BATCH), (0, 0), (0, 0))))

    def set_forces(self, forces: Float64Array) -> None:
        """Set the force [N] and torque [N m] on the centre of mass of each body in world axes, shape (N, 2, 3).

        They act until they are changed, or until :meth:`reset`.
        """
        self._set_forces(np.pad(forces, ((0, -len(forces) % BATCH), (0, 0), (0, 0))))

    def advance(self) -> None:
        """Advance the simulation by :attr:`interval`.

        Raises:
            ContactOverflow: If the contact buffers were too small in one of the steps.
        """
        self._advance()
        self.time += self.interval

    def set_rolling_friction(self, enabled: bool) -> None:
        """Enable or disable rolling friction."""
        if enabled != self._has_rolling_friction:
            self._has_rolling_friction = enabled
            self._set_rolling_friction(enabled)

    def set_restitution(self, enabled: bool) -> None:
        """Enable rebounds, or damp all impacts."""
        if enabled != self._has_restitution:
            self._has_restitution = enabled
            self._set_restitution(enabled)

    @property
    def poses(self) -> Float64Array:
        """World-from-body transforms, shape (N, 4, 4)."""
        coordinates = self._coordinates()[: len(self.bodies)]
        poses = np.tile(np.eye(4), (len(coordinates), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(coordinates[:, 3:]).as_matrix()
        poses[:, :3, 3] = coordinates[:, :3]
        return poses

    @property
    @abstractmethod
    def velocities(self) -> Float64Array:
        """Linear velocity of the centre of mass [m/s] and angular velocity [rad/s] in world axes, shape (N, 2, 3)."""

    @abstractmethod
    def _reset(self, coordinates: Float64Array) -> None: ...

    @abstractmethod
    def _set_velocities(self, velocities: Float64Array) -> None:
        """Set the velocities of every body, including those without shape, shape (M, 2, 3)."""

    @abstractmethod
    def _set_forces(self, forces: Float64Array) -> None:
        """Set the forces on every body, including those without shape, shape (M, 2, 3)."""

    @abstractmethod
    def _advance(self) -> None: ...

    @abstractmethod
    def _set_rolling_friction(self, enabled: bool) -> None: ...

    @abstractmethod
    def _set_restitution(self, enabled: bool) -> None: ...

    @abstractmethod
    def _coordinates(self) -> Float64Array:
        """Return position and xyzw quaternion of every body, including those without shape, shape (M, 7)."""
