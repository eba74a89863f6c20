"""Simulation with MuJoCo in C: double precision, MuJoCo's contacts, and larger buffers."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import mujoco
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.physics.bodies import Body, Collider
from mitsplat.physics.contact_solver import PairContactSolver
from mitsplat.physics.friction import GRAVITY, pair_friction
from mitsplat.physics.newton_model import IMPEDANCE_MUJOCO, SOLVER_OPTIONS, WITHOUT_ROLL, build_model
from mitsplat.physics.restitution import IMPACT_IMPEDANCE, MIN_IMPACT_SPEED, SIMULTANEOUS, impact_damping
from mitsplat.physics.worlds import STEPS, ContactOverflow, World

_logger = logging.getLogger(__name__)

# Solver tolerance of MuJoCo in double precision. At its default of 1e-8, errors of one step cost iterations in the next
# step: 18 instead of 9 per step in a pile of 29 packages.
_TOLERANCE = 1e-12
# Stages of mj_step (mj_forward, then the integrator) for models without sensors, before and after collision.
_BEFORE_CONTACTS = (
    *(mujoco.mj_checkPos, mujoco.mj_checkVel),
    *(mujoco.mj_fwdKinematics, mujoco.mj_makeM, mujoco.mj_factorM),
)
_AFTER_CONTACTS = (
    *(mujoco.mj_makeConstraint, mujoco.mj_island, mujoco.mj_transmission, mujoco.mj_projectConstraint),
    *(mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation, mujoco.mj_fwdAcceleration, mujoco.mj_fwdConstraint),
    *(mujoco.mj_checkAcc, mujoco.mj_implicit),
)


class MujocoWorld(World):
    """Simulation with MuJoCo in C."""

    def __init__(self, bodies: Sequence[Body], colliders: Sequence[Collider], *, timestep: float) -> None:
        super().__init__(bodies, timestep=timestep)
        if mujoco.get_mju_user_warning() is None:  # else MuJoCo writes MUJOCO_LOG.TXT into the working folder
            mujoco.set_mju_user_warning(_logger.debug)
        solver = PairContactSolver(
            build_model(bodies, colliders, IMPEDANCE_MUJOCO, False), use_mujoco_cpu=True, **SOLVER_OPTIONS
        )
        self._model, self._data = solver.mj_model, solver.mj_data
        self._model.opt.timestep, self._model.opt.tolerance = timestep, _TOLERANCE
        self._restitution = self._geom_restitution = solver.geom_restitution()
        self._friction = np.array(self._model.geom_friction)
        self._centres = np.array([body.mass.centre for body in bodies])

    @property
    def velocities(self) -> Float64Array:
        """See :attr:`World.velocities`. MuJoCo stores the velocity of the frame's origin, and the spin in body axes."""
        rotations = self.poses[:, :3, :3]
        of_origin = np.array(self._data.qvel).reshape(-1, 2, 3)[: len(self.bodies)]
        spin = np.einsum("nij,nj->ni", rotations, of_origin[:, 1])
        arms = np.einsum("nij,nj->ni", rotations, self._centres)
        return np.stack([of_origin[:, 0] + np.cross(spin, arms), spin], axis=1)

    def _reset(self, coordinates: Float64Array) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = coordinates[:, [0, 1, 2, 6, 3, 4, 5]].ravel()

    def _set_velocities(self, velocities: Float64Array) -> None:
        rotations = self.poses[:, :3, :3]
        of_centre, spin = velocities[: len(self.bodies), 0], velocities[: len(self.bodies), 1]
        arms = np.einsum("nij,nj->ni", rotations, self._centres)
        of_origin = np.stack([of_centre - np.cross(spin, arms), np.einsum("nji,nj->ni", rotations, spin)], axis=1)
        self._data.qvel[: of_origin.size] = of_origin.ravel()

    def _set_forces(self, forces: Float64Array) -> None:
        self._data.xfrc_applied[1:] = forces.reshape(-1, 6)

    def _advance(self) -> None:
        for _ in range(STEPS):
            self._step()
        full = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
        if any(self._data.warning[kind].number for kind in full):
            raise ContactOverflow

    def _step(self) -> None:
        """Run ``mj_step`` for this integrator with friction and restitution of pairs.

        See :mod:`mitsplat.physics.friction` and :mod:`mitsplat.physics.restitution`.

        MuJoCo has no callback between contact detection and constraint assembly, so that its stages are called
        separately.
        """
        model, data = self._model, self._data
        for stage in (*_BEFORE_CONTACTS, mujoco.mj_collision):
            stage(model, data)
        pairs, friction = data.contact.geom, model.geom_friction
        data.contact.friction[:] = pair_friction(friction[pairs[:, 0]], friction[pairs[:, 1]])
        if not self._has_rolling_friction:
            data.contact.dim[:] = WITHOUT_ROLL
        late = self._rebound() if self._restitution.any() and len(pairs) else None
        before = np.array(data.qvel)
        for stage in _AFTER_CONTACTS:
            stage(model, data)
        if late is not None:
            gained = np.array(data.qvel) - before
            mujoco.mj_integratePos(model, data.qpos, np.repeat(late[1:], 6) * gained, 1.0)

    def _rebound(self) -> Float64Array | None:
        """Give impacts the reference acceleration of :mod:`mitsplat.physics.restitution`, as damping.

        Return the time of each body since its first impact [s], or None if there is no impact.
        """
        model, data, contact, timestep = self._model, self._data, self._data.contact, self._model.opt.timestep
        velocity, spin = np.zeros((2, model.nbody, 3))
        velocity[1:], local = np.array(data.qvel).reshape(-1, 2, 3).swapaxes(0, 1)
        spin[1:] = np.einsum("nij,nj->ni", data.xmat[1:].reshape(-1, 3, 3), local)
        bodies = model.geom_bodyid[contact.geom]
        moving = velocity[bodies] + np.cross(spin[bodies], contact.pos[:, None] - data.xpos[bodies])
        speeds = np.einsum("ni,ni->n", contact.frame[:, :3], moving[:, 0] - moving[:, 1])
        restitution = np.sqrt(self._restitution[contact.geom].prod(axis=1))
        fast = np.flatnonzero((speeds > MIN_IMPACT_SPEED) & (restitution > 0))
        if not len(fast):
            return None
        approach, bodies = speeds[fast], bodies[fast]
        since = np.clip(-contact.dist[fast] / approach, 0.0, timestep)
        _, pair = np.unique(np.sort(bodies) @ [model.nbody, 1], return_inverse=True)
        longest, late = np.zeros(len(fast)), np.zeros(model.nbody)
        np.maximum.at(longest, pair, since)
        np.maximum.at(late, bodies, since[:, None])
        contact.exclude[fast] = since < longest[pair] - SIMULTANEOUS  # no force in this step
        gravity = GRAVITY * np.abs(contact.frame[fast, 2])
        contact.solreffriction[fast] = contact.solref[fast]  # sliding does not rebound
        contact.solref[fast, 0] = 0.0
        contact.solref[fast, 1] = -impact_damping(restitution[fast], approach, since, gravity, timestep)
        contact.solimp[fast, :2] = IMPACT_IMPEDANCE
        return late

    def _set_rolling_friction(self, enabled: bool) -> None:
        self._model.geom_friction[:] = self._friction * (1.0, 1.0, 1.0 if enabled else 0.0)

    def _set_restitution(self, enabled: bool) -> None:
        self._restitution = self._geom_restitution * enabled

    def _coordinates(self) -> Float64Array:
        return np.array(self._data.qpos).reshape(-1, 7)[:, [0, 1, 2, 4, 5, 6, 3]]
