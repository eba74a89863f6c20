"""Newton's solver with MuJoCo, with the friction and restitution of pairs of surfaces.

:mod:`mitsplat.physics.friction` and :mod:`mitsplat.physics.restitution` state the rules.
"""

from __future__ import annotations

import warnings
from typing import Any, no_type_check

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from mitsplat.arrays import Float64Array
from mitsplat.physics.friction import GRAVITY, MIN_FRICTION
from mitsplat.physics.restitution import IMPACT_IMPEDANCE, MIN_IMPACT_SPEED, SIMULTANEOUS, impact_damping_on_warp

_MIN_SLIDING_WARP = 1e-4  # at 2e-5, blocks with rolling friction diverge in single precision
_vec5 = wp.types.vector(length=5, dtype=wp.float32)


class PairContactSolver(SolverMuJoCo):
    """Newton's solver with MuJoCo. On Warp it adds the friction and restitution of pairs to Newton's contacts.

    In C, :class:`~mitsplat.physics.mujoco_world.MujocoWorld` does the same between the stages of a step.
    """

    def __init__(self, model: newton.Model, **options: Any) -> None:
        with warnings.catch_warnings():
            # The friction of a geom is one factor of a pair's friction, which is at least MIN_FRICTION.
            warnings.filterwarnings("ignore", message=r"geom \d+: friction.* < MJ_MINMU")
            super().__init__(model, **options)
        self._rebounds = bool(self.geom_restitution().any()) and not self.use_mujoco_cpu
        if self._rebounds:
            nbody = self.mjw_model.nbody
            self._longest: Any = wp.zeros((self.mjw_data.nworld, nbody * nbody), dtype=wp.float32, device=model.device)
            self._impacts = wp.zeros(self.mjw_data.naconmax, dtype=wp.vec2, device=model.device)
            self._velocities = wp.zeros_like(self.mjw_data.qvel)

    def geom_restitution(self) -> Float64Array:
        """Return the coefficients of restitution (G,) of MuJoCo's geoms in one world."""
        shapes: Any = self.mjc_geom_to_newton_shape  # every finished model has these arrays
        restitution: Any = self.model.shape_material_restitution
        return np.asarray(restitution.numpy()[shapes.numpy()[0]], dtype=np.float64)

    def _convert_contacts_to_mjwarp(self, model: newton.Model, state_in: newton.State, contacts: Any) -> None:
        super()._convert_contacts_to_mjwarp(model, state_in, contacts)
        found = self.mjw_data.contact
        geoms = [self.mjw_data.nacon, found.geom, found.worldid]
        wp.launch(
            _mix_friction,
            dim=self.mjw_data.naconmax,
            inputs=[*geoms, self.mjw_model.geom_friction, found.friction],
            device=model.device,
        )
        if not self._rebounds:
            return
        model_bodies = [self.mjw_model.geom_bodyid, self.mjw_model.nbody]
        bodies = [model.shape_body, state_in.body_q, state_in.body_qd, model.body_com]
        shapes = [self.mjc_geom_to_newton_shape, model.shape_material_restitution]
        impacts, timestep = [self._impacts, self._longest], self.mjw_model.opt.timestep
        self._longest.fill_(0.0)
        wp.copy(self._velocities, self.mjw_data.qvel)
        wp.launch(
            _find_impacts,
            dim=self.mjw_data.naconmax,
            inputs=[*geoms, *model_bodies, *shapes, *bodies, found.pos, found.frame, found.dist, timestep, *impacts],
            device=model.device,
        )
        contact = [found.frame, found.dist, found.solref, found.solreffriction, found.solimp]
        wp.launch(
            _rebound,
            dim=self.mjw_data.naconmax,
            inputs=[*geoms, *model_bodies, *shapes, *impacts, timestep, *contact],
            device=model.device,
        )

    def _update_newton_state(
        self, model: newton.Model, state: newton.State, mj_data: Any, state_prev: newton.State, observables: Any = None
    ) -> None:
        if self._rebounds:  # before the state of the solver is copied to Newton's
            wp.launch(
                _move_since_impact,
                dim=(mj_data.nworld, self.mjw_model.nbody - 1),
                inputs=[self.mjw_model.nbody, self._longest, self._velocities, mj_data.qvel, mj_data.qpos],
                device=model.device,
            )
        super()._update_newton_state(model, state, mj_data, state_prev, observables)


@wp.kernel(enable_backward=False, module="unique")
@no_type_check
def _mix_friction(
    count: wp.array[wp.int32],
    geoms: wp.array[wp.vec2i],
    worlds: wp.array[wp.int32],
    geom_friction: wp.array2d[wp.vec3],
    friction: wp.array[_vec5],
):
    """Apply :func:`mitsplat.physics.friction.pair_friction` to the contacts of one step, in place."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    pair, world = geoms[contact], worlds[contact]
    first, second = geom_friction[world, pair[0]], geom_friction[world, pair[1]]
    slide = wp.max(_MIN_SLIDING_WARP, wp.sqrt(first[0] * second[0]))
    spin = wp.max(MIN_FRICTION, slide * wp.max(first[1], second[1]))
    roll = wp.max(MIN_FRICTION, wp.max(first[2], second[2]))
    friction[contact] = _vec5(slide, slide, spin, roll, roll)


@wp.kernel(enable_backward=False, module="unique")
@no_type_check
def _find_impacts(
    count: wp.array[wp.int32],
    geoms: wp.array[wp.vec2i],
    worlds: wp.array[wp.int32],
    geom_body: wp.array[wp.int32],
    nbody: int,
    geom_shape: wp.array2d[wp.int32],
    restitution: wp.array[wp.float32],
    shape_body: wp.array[wp.int32],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    pos: wp.array[wp.vec3],
    frame: wp.array[wp.mat33],
    dist: wp.array[wp.float32],
    timestep: wp.array[wp.float32],
    impacts: wp.array[wp.vec2],
    longest: wp.array2d[wp.float32],
):
    """Compute approach speed and time since each impact, else 0, and the longest time of each pair of bodies."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    pair, world = geoms[contact], worlds[contact]
    first, second = geom_shape[world, pair[0]], geom_shape[world, pair[1]]
    speed = wp.dot(
        frame[contact][0],
        _point_velocity(shape_body[first], pos[contact], body_q, body_qd, body_com)
        - _point_velocity(shape_body[second], pos[contact], body_q, body_qd, body_com),
    )
    impacts[contact] = wp.vec2(0.0)
    if restitution[first] * restitution[second] > 0.0 and speed > MIN_IMPACT_SPEED:
        since = wp.clamp(-dist[contact] / speed, 0.0, timestep[0])
        impacts[contact] = wp.vec2(speed, since)
        wp.atomic_max(longest, world, _pair_index(geom_body[pair[0]], geom_body[pair[1]], nbody), since)


@wp.kernel(enable_backward=False, module="unique")
@no_type_check
def _rebound(
    count: wp.array[wp.int32],
    geoms: wp.array[wp.vec2i],
    worlds: wp.array[wp.int32],
    geom_body: wp.array[wp.int32],
    nbody: int,
    geom_shape: wp.array2d[wp.int32],
    restitution: wp.array[wp.float32],
    impacts: wp.array[wp.vec2],
    longest: wp.array2d[wp.float32],
    timestep: wp.array[wp.float32],
    frame: wp.array[wp.mat33],
    dist: wp.array[wp.float32],
    solref: wp.array[wp.vec2],
    solreffriction: wp.array[wp.vec2],
    solimp: wp.array[_vec5],
):
    """Give impacts the damping of :func:`mitsplat.physics.restitution.impact_damping`."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    speed, since = impacts[contact][0], impacts[contact][1]
    if speed == 0.0:
        return
    pair, world = geoms[contact], worlds[contact]
    place = _pair_index(geom_body[pair[0]], geom_body[pair[1]], nbody)
    if since < longest[world, place] - SIMULTANEOUS:
        dist[contact] = 1.0  # no force in this step
        return
    e = wp.sqrt(restitution[geom_shape[world, pair[0]]] * restitution[geom_shape[world, pair[1]]])
    damping = impact_damping_on_warp(e, speed, since, GRAVITY * wp.abs(frame[contact][0][2]), timestep[0])
    solreffriction[contact] = solref[contact]  # sliding does not rebound
    solref[contact] = wp.vec2(0.0, -damping)
    solimp[contact] = _vec5(IMPACT_IMPEDANCE, IMPACT_IMPEDANCE, 1.0e-3, 0.5, 2.0)


@wp.kernel(enable_backward=False, module="unique")
@no_type_check
def _move_since_impact(
    nbody: int,
    longest: wp.array2d[wp.float32],
    before: wp.array2d[wp.float32],
    after: wp.array2d[wp.float32],
    coordinates: wp.array2d[wp.float32],
):
    """Apply the change of velocity of each free body to its motion since its first impact, in place."""
    world, free = wp.tid()
    body = free + 1
    late = wp.float32(0.0)
    for other in range(nbody):
        late = wp.max(late, longest[world, _pair_index(body, other, nbody)])
    if late == 0.0:
        return
    q, v = 7 * free, 6 * free
    turn = wp.vec3(0.0)
    for i in range(3):
        coordinates[world, q + i] += late * (after[world, v + i] - before[world, v + i])
        turn[i] = late * (after[world, v + 3 + i] - before[world, v + 3 + i])
    angle = wp.length(turn)
    if angle > 0.0:
        rotation = wp.quat(
            coordinates[world, q + 4],
            coordinates[world, q + 5],
            coordinates[world, q + 6],
            coordinates[world, q + 3],
        ) * wp.quat_from_axis_angle(turn / angle, angle)
        coordinates[world, q + 3] = rotation[3]
        for i in range(3):
            coordinates[world, q + 4 + i] = rotation[i]


@wp.func
@no_type_check
def _pair_index(first: int, second: int, nbody: int):
    """Return the index of an unordered pair of bodies."""
    return wp.min(first, second) * nbody + wp.max(first, second)


@wp.func
@no_type_check
def _point_velocity(
    body: int,
    point: wp.vec3,
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
):
    """Return the velocity of a point of a body; Newton stores that of its centre of mass, then its spin."""
    if body < 0:
        return wp.vec3(0.0)
    arm = point - wp.transform_point(body_q[body], body_com[body])
    return wp.spatial_top(body_qd[body]) + wp.cross(wp.spatial_bottom(body_qd[body]), arm)
