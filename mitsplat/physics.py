"""Rigid bodies that fall until they rest: a Newton model, stepped by MuJoCo's solver on Warp or in C.

Import it, and call what it holds, within :func:`mitsplat.settle.warp_settings`, which keeps compilation short.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import mujoco
import newton
import numpy as np
import trimesh
import warp as wp
from newton.solvers import SolverMuJoCo
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsplat.mesh import MassProperties, join_meshes

FloatArray = NDArray[np.float64]
Stepper = Literal["warp", "mujoco"]

QUIET_SPEED, QUIET_SPIN = 1e-3, 0.05
"""A body below both [m/s, rad/s] may be at rest."""

_GRAVITY = (0.0, 0.0, -9.81)
_QUIET_TIME = 0.25  # how long every body must have been quiet [s]
_MOTION, _MOTION_TIME = 5e-4, 0.5  # how far a surface may have moved [m] in how long [s]
# Critically damped contact: MuJoCo's stiffness 1/t^2 and damping 2/t; at rest bodies sink by ~ g t^2 (1 - d)/d = 27 um.
_CONTACT_TIME = 0.005
# Spin and roll friction [m], at most these shares of the size: round parts stop, thin ones do not stand on their rim.
_TORSIONAL, _ROLLING = (5e-3, 0.1), (5e-4, 0.01)
_LEAST_FRICTION = 1e-5  # below it MuJoCo divides by almost nothing
_STEPS = 4  # per captured graph; even, so that the two states end as they began
# Some kernels are compiled for the number of bodies: bodies without shape fill it up to a multiple of this.
_BATCH = 4


class ContactOverflow(Exception):
    """More contacts than the buffers hold: some were dropped, and bodies may have passed through one another."""


@dataclass(frozen=True, eq=False)
class Body:
    """What falls. Bodies of one asset share it."""

    pieces: tuple[trimesh.Trimesh, ...]
    mass: MassProperties
    friction: float

    @cached_property
    def outline(self) -> FloatArray:
        """Vertices of the convex hull [m], shape (N, 3); nothing of the body moves farther than one of them."""
        return np.asarray(join_meshes(self.pieces).convex_hull.vertices, dtype=np.float64)

    @cached_property
    def size(self) -> float:
        """Longest extent [m]."""
        return float(np.ptp(self.outline, axis=0).max())

    @cached_property
    def hulls(self) -> list[newton.Mesh]:
        """The pieces for Newton."""
        return [_newton_hull(piece) for piece in self.pieces]


@dataclass(frozen=True, eq=False)
class Collider:
    """What does not move: convex pieces in world space, or a box by its full ``size`` [m] and pose (4, 4)."""

    friction: float
    pieces: tuple[trimesh.Trimesh, ...] = ()
    box: tuple[tuple[float, float, float], FloatArray] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a drop ended.

    Attributes:
        refused: Why it cannot be used, or empty.
        time: Simulated time [s].
        max_speed, max_spin: Of the fastest body at the end [m/s, rad/s].
        surface_motion: Farthest that a point of any body moved during the last half second [m].
        poses: World-from-body transforms, shape (N, 4, 4).
    """

    refused: str
    time: float
    max_speed: float
    max_spin: float
    surface_motion: float
    poses: FloatArray = field(repr=False)


class World:
    """Bodies above colliders, in motion.

    Args:
        bodies: What falls.
        colliders: What it falls on.
        poses: World-from-body transforms at the start, shape (N, 4, 4).
        stepper: ``warp`` for Newton's contacts and mujoco_warp in one captured graph, ``mujoco`` for MuJoCo in C.
        timestep: [s].
        capacity: Factor on the size of the contact buffers.

    Newton finds the contacts for ``warp``: those of mujoco_warp flicker where many coplanar pieces touch in single
    precision, and a cup of fifty pieces then creeps at 5 mm/s for ever.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        colliders: Sequence[Collider],
        poses: FloatArray,
        *,
        stepper: Stepper = "warp",
        timestep: float = 0.002,
        capacity: float = 1.0,
    ) -> None:
        self.bodies = tuple(bodies)
        self.time = 0.0
        self.interval = _STEPS * timestep  # simulated by each call of advance [s]
        self._timestep = timestep
        model = _build_model(self.bodies, colliders, poses)
        contacts = max(16, int(capacity * (40 * len(bodies) + model.shape_count)))
        self._solver = SolverMuJoCo(
            model,
            nconmax=contacts,
            njmax=6 * contacts,
            integrator="implicitfast",
            solver="newton",
            cone="elliptic",
            impratio=100.0,
            enable_multiccd=True,
            disable_sensors=True,
            include_sites=False,
            kinematic_switchable_roots=False,
            use_mujoco_cpu=stepper == "mujoco",
            use_mujoco_contacts=stepper == "mujoco",
        )
        self._states = model.state(), model.state()
        self._control = model.control()
        self._pipeline: newton.CollisionPipeline | None = None
        if stepper == "warp":
            # Overflow is read from flags: the kernels would print it at every step.
            self._solver.mjw_model.opt.warn_overflow = 0
            self._pipeline = newton.CollisionPipeline(model, broad_phase="nxn", rigid_contact_max=contacts)
            self._contacts = self._pipeline.contacts()
            overflow = SolverMuJoCo.ObservableKind.OVERFLOW
            self._observables = [self._solver.observables({overflow}) for _ in range(_STEPS)]
        self._graph: wp.Graph | None = None

    def advance(self) -> None:
        """Step a few times.

        Raises:
            ContactOverflow: The contact buffers were too small in one of the steps.
        """
        if self._pipeline is None:
            self._step()
        elif self._graph is None:
            self._step()  # loads the kernels, which a capture must not
            with wp.ScopedCapture(device="cpu") as capture:
                self._step()
            self._graph = capture.graph
        else:
            wp.capture_launch(self._graph)
        self.time += self.interval
        if self._overflowed():
            raise ContactOverflow

    @property
    def poses(self) -> FloatArray:
        """World-from-body transforms, shape (N, 4, 4)."""
        stored = _array(self._states[0].body_q)[: len(self.bodies)]
        poses = np.tile(np.eye(4), (len(stored), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(stored[:, 3:]).as_matrix()
        poses[:, :3, 3] = stored[:, :3]
        return poses

    @property
    def velocities(self) -> FloatArray:
        """Linear velocity of the centre of mass [m/s] and angular velocity [rad/s] in world axes, shape (N, 2, 3)."""
        return _array(self._states[0].body_qd)[: len(self.bodies)].reshape(-1, 2, 3)

    def _step(self) -> None:
        here, there = self._states
        for i in range(_STEPS):
            if self._pipeline is None:
                self._solver.step(here, there, self._control, None, self._timestep)
            else:
                self._pipeline.collide(here, self._contacts)
                self._solver.step(
                    here, there, self._control, self._contacts, self._timestep, observables=self._observables[i]
                )
            here, there = there, here

    def _overflowed(self) -> bool:
        if self._pipeline is None:
            full = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
            return any(self._solver.mj_data.warning[kind].number for kind in full)
        return any(_array(observed.overflow).any() for observed in self._observables)


def run_to_rest(world: World, *, max_time: float, bounds: tuple[FloatArray, FloatArray]) -> Outcome:
    """Advance a world until its bodies rest, or until it is clear that they will not.

    At rest every body has been slow for a quarter of a second, and no surface moved by half a millimetre in half a
    second.

    Args:
        world: Changed in place.
        max_time: When to give up [s].
        bounds: Corners of what centres of mass must not leave [m], shape (3,) each.
    """
    centres = np.array([body.mass.centre for body in world.bodies])
    frames = max(2, round(_MOTION_TIME / world.interval) + 1)
    past: deque[FloatArray] = deque(maxlen=frames)
    moved_at = 0.0

    def end(refused: str) -> Outcome:
        motion = _surface_motion(world.bodies, past[0], past[-1])
        return Outcome(refused, world.time, speed, spin, motion, past[-1])

    while True:
        try:
            world.advance()
        except ContactOverflow:
            return Outcome("contact buffer overflow", world.time, np.inf, np.inf, np.inf, world.poses)
        velocities = world.velocities
        if not np.isfinite(velocities).all():
            return Outcome("the simulation diverged", world.time, np.inf, np.inf, np.inf, velocities)
        poses = world.poses
        past.append(poses)
        speed, spin = np.linalg.norm(velocities, axis=2).max(axis=0).tolist()
        if speed >= QUIET_SPEED or spin >= QUIET_SPIN:
            moved_at = world.time
        positions = np.einsum("nij,nj->ni", poses[:, :3, :3], centres) + poses[:, :3, 3]
        outside = ((positions < bounds[0]) | (positions > bounds[1])).any(axis=1)
        if outside.any():
            return end(f"{int(outside.sum())} left the enclosure")
        quiet = world.time - moved_at >= _QUIET_TIME and len(past) == frames
        if quiet and _surface_motion(world.bodies, past[0], poses) < _MOTION:
            return end("")
        if world.time >= max_time:
            return end(f"not at rest within {max_time:g} s")


def _array(values: Any) -> FloatArray:
    """A Warp array as a copy in double precision."""
    return np.array(values.numpy(), dtype=np.float64)


def _surface_motion(bodies: Sequence[Body], before: FloatArray, after: FloatArray) -> float:
    """Farthest that a point of any body is displaced between two sets of poses [m]."""
    moved = after - before
    return max(
        float(np.linalg.norm(body.outline @ change[:3, :3].T + change[:3, 3], axis=1).max())
        for body, change in zip(bodies, moved, strict=True)
    )


def _build_model(bodies: Sequence[Body], colliders: Sequence[Collider], poses: FloatArray) -> newton.Model:
    builder = newton.ModelBuilder(gravity=_GRAVITY)
    builder.validate_inertia_detailed = True  # in Python: the other way compiles a kernel for 4 s
    SolverMuJoCo.register_custom_attributes(builder)
    for collider in colliders:
        # MuJoCo takes the larger friction of a pair: size 0 leaves spin and roll friction to the bodies.
        config = _shape_config(collider.friction, size=0.0)
        if collider.box is not None:
            size, pose = collider.box
            hx, hy, hz = np.divide(size, 2).tolist()
            builder.add_shape_box(
                -1, xform=_transform(pose), hx=hx, hy=hy, hz=hz, cfg=config, custom_attributes={"mujoco:condim": 6}
            )
        _add_hulls(builder, -1, [_newton_hull(piece) for piece in collider.pieces], config)
    for body, pose in zip(bodies, poses, strict=True):
        link = _add_body(builder, body.mass, pose)
        _add_hulls(builder, link, body.hulls, _shape_config(body.friction, size=body.size))
    for _ in range(-len(bodies) % _BATCH):
        _add_body(builder, bodies[0].mass, np.eye(4))
    return builder.finalize(device="cpu")


def _add_body(builder: newton.ModelBuilder, mass: MassProperties, pose: FloatArray) -> int:
    return builder.add_body(
        xform=_transform(pose),
        mass=mass.mass,
        com=wp.vec3(*mass.centre),
        inertia=wp.mat33(*mass.inertia.ravel()),
        lock_inertia=True,
    )


def _add_hulls(
    builder: newton.ModelBuilder, link: int, hulls: Sequence[newton.Mesh], config: newton.ModelBuilder.ShapeConfig
) -> None:
    for hull in hulls:
        builder.add_shape_convex_hull(link, mesh=hull, cfg=config, custom_attributes={"mujoco:condim": 6})


def _shape_config(friction: float, *, size: float) -> newton.ModelBuilder.ShapeConfig:
    return newton.ModelBuilder.ShapeConfig(
        density=0.0,
        ke=1 / _CONTACT_TIME**2,
        kd=2 / _CONTACT_TIME,
        mu=max(friction, _LEAST_FRICTION),
        mu_torsional=max(_LEAST_FRICTION, min(_TORSIONAL[0], _TORSIONAL[1] * size)),
        mu_rolling=max(_LEAST_FRICTION, min(_ROLLING[0], _ROLLING[1] * size)),
        margin=0.0,
        gap=0.0,
    )


def _newton_hull(piece: trimesh.Trimesh) -> newton.Mesh:
    return newton.Mesh(piece.vertices, np.asarray(piece.faces).ravel(), maxhullvert=-1, compute_inertia=False)


def _transform(pose: FloatArray) -> wp.transform:
    return wp.transform(wp.vec3(*pose[:3, 3]), wp.quat(*Rotation.from_matrix(pose[:3, :3]).as_quat()))
