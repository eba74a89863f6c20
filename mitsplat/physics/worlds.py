"""Rigid-body simulation with the solver of MuJoCo: in C, or its port to Warp.

Both worlds are built from one model of the library Newton.

Import and use this module within :func:`mitsplat.physics.settle.warp_settings`, which shortens compilation.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import mujoco
import newton
import numpy as np
import trimesh
import warp as wp
from newton.solvers import SolverMuJoCo
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.mesh import MassProperties, join_meshes
from mitsplat.physics.contacts import ContactFinder, newton_hull
from mitsplat.physics.friction import (
    GRAVITY,
    IMPACT_IMPEDANCE,
    ContactMaterial,
    PairContactSolver,
    pair_friction,
)
from mitsplat.physics.restitution import MIN_IMPACT_SPEED, SIMULTANEOUS, rebound_speed

_logger = logging.getLogger(__name__)

GRAVITY_VECTOR = (0.0, 0.0, -GRAVITY)
# Contact of damping 2/t and stiffness 1/(t z)^2, as in MuJoCo, for all contacts that are no impacts (see
# :mod:`mitsplat.physics.restitution`). At a damping ratio z of 1, a body would rebound from a drop of 0.3 m by 5 mm,
# because contact cannot pull. From 1.5 on it does not leave the table. At 2 it penetrates deeper without benefit.
CONTACT_TIME, DAMPING_RATIO = 0.004, 1.5
CONTACT_STIFFNESS, CONTACT_DAMPING = 1 / (CONTACT_TIME * DAMPING_RATIO) ** 2, 2 / CONTACT_TIME
# Contact dimensions: normal, two sliding, spin, and two rolling.
WITH_ROLL, _WITHOUT_ROLL = 6, 4
# Impedance of contacts as MuJoCo's solimp: at the surface, from a depth [m] on, that depth, and the curve between. At
# MuJoCo's default of 0.9, a nut under a plate of a hundred times its mass sinks by 1 mm. MuJoCo's own contacts flicker
# when stiffer: from 0.98 on, a pile of 29 packages creeps at 1 to 10 mm/s, and another one at 2 to 4 mm/s at 0.97. At
# 0.96 such piles rest sooner, and friction is still exact to 0.3 %. Contacts under load are deeper, and stiff from
# 0.3 mm on: with 1 mm, a bolt under a plate of a hundred times its mass sinks by 0.5 mm.
IMPEDANCE_WARP, IMPEDANCE_MUJOCO = (0.996, 0.9999, 1e-3, 0.5, 2.0), (0.96, 0.999, 3e-4, 0.5, 2.0)
# Moment of inertia below which Newton corrects it [kg m^2], below that of any part of 0.5 mm. By default, Newton adds
# 1e-6 kg m^2 to moments below 1e-10, which a steel cube of 2 mm has.
_MIN_INERTIA = 1e-20
# Solver tolerance of MuJoCo in double precision. At its default of 1e-8, errors of one step cost iterations in the next
# step: 18 instead of 9 per step in a pile of 29 packages.
_TOLERANCE = 1e-12
STEPS = 4  # per captured graph; even, so that the two states return to their roles
SOLVER_OPTIONS: dict[str, Any] = {
    "integrator": "implicitfast",
    "solver": "newton",
    "cone": "elliptic",
    "impratio": 100.0,
    "enable_multiccd": True,
    "disable_sensors": True,
    "include_sites": False,
    "kinematic_switchable_roots": False,
}
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
# Some kernels are compiled for the number of bodies. Bodies without shape pad it to a multiple of this.
_BATCH = 4


class ContactOverflow(Exception):
    """Overflow of the contact buffers: contacts were dropped, and bodies may have passed through one another."""


@dataclass(frozen=True, eq=False)
class Body:
    """Dynamic rigid body. Bodies of one asset share it."""

    pieces: tuple[trimesh.Trimesh, ...]
    mass: MassProperties
    material: ContactMaterial

    @cached_property
    def outline(self) -> Float64Array:
        """Vertices of the convex hull [m], shape (N, 3). The largest displacement of the body occurs at one of them."""
        return np.asarray(join_meshes(self.pieces).convex_hull.vertices, dtype=np.float64)

    @cached_property
    def size(self) -> float:
        """Longest extent [m]."""
        return float(np.ptp(self.outline, axis=0).max())

    @cached_property
    def hulls(self) -> list[newton.Mesh]:
        """The pieces as Newton meshes."""
        return [newton_hull(piece) for piece in self.pieces]


@dataclass(frozen=True, eq=False)
class Collider:
    """Static collider: convex pieces in world space, or a box by its full ``size`` [m] and pose (4, 4)."""

    material: ContactMaterial
    pieces: tuple[trimesh.Trimesh, ...] = ()
    box: tuple[tuple[float, float, float], Float64Array] | None = None

    def moved(self, motion: Float64Array) -> Collider:
        """Return the collider after a rigid transform (4, 4)."""
        pieces = tuple(piece.copy().apply_transform(motion) for piece in self.pieces)
        return replace(self, pieces=pieces, box=None if self.box is None else (self.box[0], motion @ self.box[1]))


def all_pieces(bodies: Iterable[Body], colliders: Iterable[Collider]) -> Iterator[trimesh.Trimesh]:
    """Yield the convex pieces of all bodies and colliders."""
    for body in bodies:
        yield from body.pieces
    for collider in colliders:
        yield from collider.pieces


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
        """Set the velocities of the bodies, as in :attr:`velocities`; poses do not change."""
        self._set_velocities(np.pad(velocities, ((0, -len(velocities) % _BATCH), (0, 0), (0, 0))))

    def set_forces(self, forces: Float64Array) -> None:
        """Set the force [N] and torque [N m] on the centre of mass of each body in world axes, shape (N, 2, 3).

        They act until they are changed, or until :meth:`reset`.
        """
        self._set_forces(np.pad(forces, ((0, -len(forces) % _BATCH), (0, 0), (0, 0))))

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
        model = _build_model(bodies, colliders, IMPEDANCE_WARP, True)
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
        finder = contact_finder or ContactFinder(all_pieces(bodies, colliders))
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


class MujocoWorld(World):
    """Simulation of the same model with MuJoCo in C: double precision, MuJoCo's contacts, and larger buffers."""

    def __init__(self, bodies: Sequence[Body], colliders: Sequence[Collider], *, timestep: float) -> None:
        super().__init__(bodies, timestep=timestep)
        if mujoco.get_mju_user_warning() is None:  # else MuJoCo writes MUJOCO_LOG.TXT into the working folder
            mujoco.set_mju_user_warning(_logger.debug)
        solver = PairContactSolver(
            _build_model(bodies, colliders, IMPEDANCE_MUJOCO, False),
            use_mujoco_cpu=True,
            **SOLVER_OPTIONS,
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
            data.contact.dim[:] = _WITHOUT_ROLL
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
        rebound = rebound_speed(restitution[fast], approach, since, gravity, timestep)
        contact.solreffriction[fast] = contact.solref[fast]  # sliding does not rebound
        contact.solref[fast] = np.stack([np.zeros(len(fast)), -(approach + rebound) / (approach * timestep)], axis=1)
        contact.solimp[fast, :2] = IMPACT_IMPEDANCE
        return late

    def _set_rolling_friction(self, enabled: bool) -> None:
        self._model.geom_friction[:] = self._friction * (1.0, 1.0, 1.0 if enabled else 0.0)

    def _set_restitution(self, enabled: bool) -> None:
        self._restitution = self._geom_restitution * enabled

    def _coordinates(self) -> Float64Array:
        return np.array(self._data.qpos).reshape(-1, 7)[:, [0, 1, 2, 4, 5, 6, 3]]


def _array(values: Any) -> Float64Array:
    """Copy a Warp array in double precision."""
    return np.array(values.numpy(), dtype=np.float64)


def assign_array(array: Any, values: Float64Array) -> None:
    """Copy values to a Warp array in single precision."""
    array.assign(values.astype(np.float32))


def _initial_coordinates(bodies: Sequence[Body]) -> Float64Array:
    """Return initial coordinates in a row high above the scene, far apart, shape (M, 7).

    Bodies without shape stay there. Models are built with these coordinates, so that no constant of the solver depends
    on the poses of a drop.
    """
    spacing = 2 * max(body.size for body in bodies)
    count = len(bodies) + -len(bodies) % _BATCH
    coordinates = np.tile([0.0, 0.0, 100.0, 0.0, 0.0, 0.0, 1.0], (count, 1))
    coordinates[:, 0] = spacing * np.arange(count)
    return coordinates


def body_coordinates(bodies: Sequence[Body], poses: Float64Array) -> Float64Array:
    """Return position and xyzw quaternion of bodies at poses (N, 4, 4), and of those without shape, shape (M, 7)."""
    coordinates = _initial_coordinates(bodies)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    coordinates[: len(poses)] = np.concatenate([poses[:, :3, 3], turns], axis=1)
    return coordinates


def max_contacts(bodies: int, shapes: int) -> int:
    """Return the capacity for contacts; tumbling parts use 0.5 to 0.8 of it, and most kernels run over all of it."""
    return 24 * bodies + shapes


def _build_model(
    bodies: Sequence[Body], colliders: Sequence[Collider], impedance: tuple[float, ...], newton_contacts: bool
) -> newton.Model:
    return build_scene(bodies, colliders, impedance, newton_contacts).finalize(device="cpu")


def build_scene(
    bodies: Sequence[Body], colliders: Sequence[Collider], impedance: tuple[float, ...], newton_contacts: bool
) -> newton.ModelBuilder:
    """Build a scene for Newton's contacts, or else for those of MuJoCo.

    Newton analyses convex hulls for its contacts, which takes as long as all other steps. MuJoCo makes the hulls of
    meshes itself.
    """
    contact = {"mujoco:condim": WITH_ROLL, "mujoco:geom_solimp": impedance}
    builder = newton.ModelBuilder(gravity=GRAVITY_VECTOR)
    builder.validate_inertia_detailed = True  # in Python: the alternative compiles a kernel for 4 s
    builder.inertia_absolute_tolerance = builder.inertia_correction = _MIN_INERTIA
    SolverMuJoCo.register_custom_attributes(builder)
    add_hull = builder.add_shape_convex_hull if newton_contacts else builder.add_shape_mesh
    for collider in colliders:
        config = collider.material.shape_config(CONTACT_STIFFNESS, CONTACT_DAMPING, size=0.0)
        if collider.box is not None:
            size, pose = collider.box
            hx, hy, hz = np.divide(size, 2).tolist()
            xform = wp.transform(wp.vec3(*pose[:3, 3]), wp.quat(*Rotation.from_matrix(pose[:3, :3]).as_quat()))
            builder.add_shape_box(-1, xform=xform, hx=hx, hy=hy, hz=hz, cfg=config, custom_attributes=contact)
        for piece in collider.pieces:
            add_hull(-1, mesh=newton_hull(piece), cfg=config, custom_attributes=contact)
    for i, place in enumerate(_initial_coordinates(bodies)):
        body = bodies[i] if i < len(bodies) else None
        mass = bodies[0].mass if body is None else body.mass
        link = builder.add_body(
            xform=wp.transform(wp.vec3(*place[:3]), wp.quat(*place[3:])),
            mass=mass.mass,
            com=wp.vec3(*mass.centre),
            inertia=wp.mat33(*mass.inertia.ravel()),
            lock_inertia=True,
        )
        if body is not None:
            config = body.material.shape_config(CONTACT_STIFFNESS, CONTACT_DAMPING, size=body.size)
            for hull in body.hulls:
                add_hull(link, mesh=hull, cfg=config, custom_attributes=contact)
    return builder
