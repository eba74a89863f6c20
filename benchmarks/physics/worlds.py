"""Timing of several layouts in one simulation (Newton's worlds), for ``python -m benchmarks.physics.settle worlds``."""

from __future__ import annotations

import time
from collections.abc import Sequence

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from benchmarks.record import figure
from mitsplat.arrays import Float64Array
from mitsplat.physics import newton_model as physics
from mitsplat.physics.bodies import Body, Collider
from mitsplat.physics.contact_solver import PairContactSolver
from mitsplat.physics.rest import run_to_rest
from mitsplat.physics.warp_world import assign_array
from mitsplat.physics.worlds import STEPS, World

WORLDS = 1, 8, 64, 256
DURATION = 2.5  # simulated time to rest and one second after [s]
REPORTED = 64  # launches of the graph between lines of progress


def time_worlds(
    bodies: Sequence[Body],
    colliders: Sequence[Collider],
    starts: Sequence[Float64Array],
    bounds: tuple[Float64Array, Float64Array],
    *,
    timestep: float,
    device: str,
) -> None:
    """Print the time of 1, 8, 64 and 256 worlds on a Warp device, limited by the number of initial poses."""
    for worlds in [worlds for worlds in WORLDS if worlds < len(starts)] + [len(starts)]:
        print(f"{worlds} worlds on {device}: building the model and compiling kernels", flush=True)
        wall = time.perf_counter()
        batch = Batch(bodies, colliders, starts[:worlds], timestep=timestep, device=device)
        print(f"  ready after {time.perf_counter() - wall:.1f} s", flush=True)
        wall, cpu = time.perf_counter(), time.process_time()
        frames = batch.run()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        rested = sum(has_rested(bodies, world, batch.interval, bounds) for world in frames.swapaxes(0, 1))
        figure(60 * rested / wall, "1/min", f"{worlds} worlds", "layouts")
        figure(rested, "", f"{worlds} worlds", "rested")
        per_world = 1e3 / DURATION / worlds
        print(
            f"{worlds} worlds of {len(bodies)} objects on {device}: {wall * per_world:.1f} ms of wall time and "
            f"{cpu * per_world:.1f} of CPU time per simulated second and world; {rested} at rest for a second after "
            f"{DURATION:g} s: {60 * rested / wall:.1f} layouts a minute",
            flush=True,
        )


class Batch:
    """Steps of :class:`mitsplat.physics.warp_world.WarpWorld` in several worlds at once, including roll friction."""

    def __init__(
        self,
        bodies: Sequence[Body],
        colliders: Sequence[Collider],
        starts: Sequence[Float64Array],
        *,
        timestep: float,
        device: str,
    ) -> None:
        one = physics.build_scene(bodies, colliders, physics.IMPEDANCE_WARP, True)
        contacts = 2 * physics.max_contacts(len(bodies), one.shape_count)  # no second draw
        builder = newton.ModelBuilder(gravity=physics.GRAVITY_VECTOR)
        SolverMuJoCo.register_custom_attributes(builder)
        builder.replicate(one, len(starts))
        model = builder.finalize(device=device)
        self._solver = PairContactSolver(
            model, nconmax=contacts, njmax=6 * contacts, use_mujoco_contacts=False, **physics.SOLVER_OPTIONS
        )
        self._solver.mjw_model.opt.warn_overflow = 0
        self._pipeline = newton.CollisionPipeline(
            model, broad_phase="sap", rigid_contact_max=len(starts) * contacts + 1
        )
        self._contacts, self._control = self._pipeline.contacts(), model.control()
        self._states, self._timestep = (model.state(), model.state()), timestep
        overflow = {SolverMuJoCo.ObservableKind.OVERFLOW}
        self._observables = [self._solver.observables(overflow) for _ in range(STEPS)]
        self.interval = STEPS * timestep
        self._record()
        with wp.ScopedCapture(device=device) as capture:
            self._record()
        self._graph = capture.graph
        self._shape = len(starts), len(builder.body_mass) // len(starts), 7
        coordinates = np.concatenate([physics.body_coordinates(bodies, poses) for poses in starts])
        state = self._states[0]
        self._solver.reset(state)
        assign_array(state.joint_q, coordinates.ravel())
        assign_array(state.body_q, coordinates)
        assign_array(state.joint_qd, np.zeros(6 * len(coordinates)))
        assign_array(state.body_qd, np.zeros((len(coordinates), 6)))

    def _record(self) -> None:
        here, there = self._states
        for observables in self._observables:
            self._pipeline.collide(here, self._contacts)
            self._solver.step(here, there, self._control, self._contacts, self._timestep, observables=observables)
            here, there = there, here

    def run(self) -> Float64Array:
        """Return positions and xyzw quaternions after each launch of the graph, shape (frames, worlds, bodies, 7)."""
        frames: list[Float64Array] = []
        count, start = round(DURATION / self.interval), time.perf_counter()
        for number in range(1, count + 1):
            wp.capture_launch(self._graph)
            frames.append(self._states[0].body_q.numpy().astype(np.float64).reshape(self._shape))
            if any(observed.overflow.numpy().any() for observed in self._observables):
                raise RuntimeError("contact buffer overflow")
            if number % REPORTED == 0:
                simulated, elapsed = number * self.interval, time.perf_counter() - start
                print(f"  {simulated:.1f} of {DURATION:g} s simulated after {elapsed:.1f} s", flush=True)
        return np.stack(frames)


def has_rested(
    bodies: Sequence[Body], frames: Float64Array, interval: float, bounds: tuple[Float64Array, Float64Array]
) -> bool:
    """Return True if the bodies of one world were at rest for a second, by the rule of :func:`physics.run_to_rest`."""

    class Recorded(World):
        """A recorded simulation, frame by frame."""

        def __init__(self) -> None:
            super().__init__(bodies, timestep=interval / STEPS)
            self._frames = iter(frames[:, : len(bodies)])
            self._frame = next(self._frames)

        @property
        def velocities(self) -> Float64Array:
            return np.zeros((len(bodies), 2, 3))

        def _reset(self, coordinates: Float64Array) -> None:
            raise NotImplementedError

        def _set_velocities(self, velocities: Float64Array) -> None:
            pass

        def _set_forces(self, forces: Float64Array) -> None:
            pass

        def _advance(self) -> None:
            self._frame = next(self._frames)

        def _set_rolling_friction(self, enabled: bool) -> None:
            pass

        def _set_restitution(self, enabled: bool) -> None:
            pass

        def _coordinates(self) -> Float64Array:
            return self._frame

    try:
        return not run_to_rest(Recorded(), max_time=DURATION, bounds=bounds).rejection
    except StopIteration:
        return False
