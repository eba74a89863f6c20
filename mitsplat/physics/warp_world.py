"""Simulation with Newton's contacts and the solver of mujoco_warp, the port of MuJoCo to Warp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from mitsplat.arrays import Float64Array
from mitsplat.physics.bodies import Body, Collider, all_pieces
from mitsplat.physics.contact_solver import PairContactSolver
from mitsplat.physics.contacts import ContactFinder
from mitsplat.physics.newton_model import IMPEDANCE_WARP, SOLVER_OPTIONS, build_model, max_contacts
from mitsplat.physics.worlds import STEPS, ContactOverflow, World


class WarpWorld(World):
    """Simulation with Newton's contacts and mujoco_warp's solver in one captured graph.

    The contacts of mujoco_warp itself flicker in single precision where many coplanar pieces touch. A cup of fifty
    pieces then creeps at 5 mm/s and never rests. Newton's contacts come to rest.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        colliders: Sequence[Collider],
        *,
        timestep: float,
        capacity: float,
        contact_finder: ContactFinder | None = None,
    ) -> None:
        super().__init__(bodies, timestep=timestep)
        self._timestep = timestep
        model = build_model(bodies, colliders, IMPEDANCE_WARP, True)
        contacts = max(8, int(capacity * max_contacts(len(bodies), model.shape_count)))
        self._solver = PairContactSolver(
            model, nconmax=contacts, njmax=6 * contacts, use_mujoco_contacts=False, **SOLVER_OPTIONS
        )
        self._friction = _array(self._solver.mjw_model.geom_friction)
        self._restitution = _array(model.shape_material_restitution)
        # Overflow is read from flags, because the kernels would print it at every step.
        self._solver.mjw_model.opt.warn_overflow = 0
        # The pipeline has room for one contact more than the solver, because it stops counting when it is full and sets
        # no flag.
        finder = contact_finder or ContactFinder(lambda: all_pieces(bodies, colliders))
        self._pipeline = finder.pipeline(model, max_contacts=contacts + 1)
        self._contacts = self._pipeline.contacts()
        self._states = model.state(), model.state()
        self._control = model.control()
        self._observables = [self._solver.observables({SolverMuJoCo.ObservableKind.OVERFLOW}) for _ in range(STEPS)]
        self._record(self._observables[:1])  # loads the kernels; a graph capture must not load them
        with wp.ScopedCapture(device="cpu") as capture:
            self._record(self._observables)
        self._graph = capture.graph

    @property
    def velocities(self) -> Float64Array:
        """See :attr:`World.velocities`."""
        return _array(self._states[0].body_qd)[: len(self.bodies)].reshape(-1, 2, 3)

    def _record(self, steps: Sequence[Any]) -> None:
        current, after = self._states
        for observables in steps:
            self._pipeline.collide(current, self._contacts)
            self._solver.step(current, after, self._control, self._contacts, self._timestep, observables=observables)
            current, after = after, current

    def _reset(self, coordinates: Float64Array) -> None:
        state = self._states[0]
        self._solver.reset(state)
        assign_array(state.joint_q, coordinates.ravel())
        assign_array(state.body_q, coordinates)

    def _set_velocities(self, velocities: Float64Array) -> None:
        state = self._states[0]
        assign_array(state.joint_qd, velocities.ravel())
        assign_array(state.body_qd, velocities.reshape(-1, 6))

    def _set_forces(self, forces: Float64Array) -> None:
        assign_array(self._control.joint_f, forces.ravel())

    def _advance(self) -> None:
        wp.capture_launch(self._graph)
        if any(_array(observed.overflow).any() for observed in self._observables):
            raise ContactOverflow

    def _set_rolling_friction(self, enabled: bool) -> None:
        assign_array(self._solver.mjw_model.geom_friction, self._friction * (1.0, 1.0, 1.0 if enabled else 0.0))

    def _set_restitution(self, enabled: bool) -> None:
        assign_array(self._solver.model.shape_material_restitution, self._restitution * enabled)

    def _coordinates(self) -> Float64Array:
        return _array(self._states[0].body_q)


def _array(values: Any) -> Float64Array:
    """Copy a Warp array in double precision."""
    return np.array(values.numpy(), dtype=np.float64)


def assign_array(array: Any, values: Float64Array) -> None:
    """Copy values to a Warp array in single precision."""
    array.assign(values.astype(np.float32))
