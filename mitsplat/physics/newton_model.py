"""Newton model of bodies above colliders, from which both simulations are built.

Import and use this module within :func:`mitsplat.physics.settle.warp_settings`, which shortens compilation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.physics.bodies import Body, Collider
from mitsplat.physics.contacts import newton_hull
from mitsplat.physics.friction import GRAVITY

GRAVITY_VECTOR = (0.0, 0.0, -GRAVITY)
# Contact of damping 2/t and stiffness 1/(t z)^2, as in MuJoCo, for all contacts that are no impacts (see
# :mod:`mitsplat.physics.restitution`). At a damping ratio z of 1, a body would rebound from a drop of 0.3 m by 5 mm,
# because contact cannot pull. From 1.5 on it does not leave the table. At 2 it penetrates deeper without benefit.
CONTACT_TIME, DAMPING_RATIO = 0.004, 1.5
CONTACT_STIFFNESS, CONTACT_DAMPING = 1 / (CONTACT_TIME * DAMPING_RATIO) ** 2, 2 / CONTACT_TIME
# Contact dimensions: normal, two sliding, spin, and two rolling.
WITH_ROLL, WITHOUT_ROLL = 6, 4
# Impedance of contacts as MuJoCo's solimp: at the surface, from a depth [m] on, that depth, and the curve between. At
# MuJoCo's default of 0.9, a nut under a plate of a hundred times its mass sinks by 1 mm. MuJoCo's own contacts flicker
# when stiffer: from 0.98 on, a pile of 29 packages creeps at 1 to 10 mm/s, and another one at 2 to 4 mm/s at 0.97. At
# 0.96 such piles rest sooner, and friction is still exact to 0.3 %. Contacts under load are deeper, and stiff from
# 0.3 mm on: with 1 mm, a bolt under a plate of a hundred times its mass sinks by 0.5 mm.
IMPEDANCE_WARP, IMPEDANCE_MUJOCO = (0.996, 0.9999, 1e-3, 0.5, 2.0), (0.96, 0.999, 3e-4, 0.5, 2.0)
# Moment of inertia below which Newton corrects it [kg m^2], below that of any part of 0.5 mm. By default, Newton adds
# 1e-6 kg m^2 to moments below 1e-10, which a steel cube of 2 mm has.
_MIN_INERTIA = 1e-20
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
BATCH = 4
"""The number of bodies is padded by bodies without shape to a multiple of this, because some kernels depend on it."""


def max_contacts(bodies: int, shapes: int) -> int:
    """Return the capacity for contacts; tumbling parts use 0.5 to 0.8 of it, and most kernels run over all of it."""
    return 24 * bodies + shapes


def build_model(
    bodies: Sequence[Body], colliders: Sequence[Collider], impedance: tuple[float, ...], newton_contacts: bool
) -> newton.Model:
    """Build the finished model of :func:`build_scene` on the CPU."""
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


def _initial_coordinates(bodies: Sequence[Body]) -> Float64Array:
    """Return initial coordinates in a row high above the scene, far apart, shape (M, 7).

    Bodies without shape stay there. Models are built with these coordinates, so that no constant of the solver depends
    on the poses of a drop.
    """
    spacing = 2 * max(body.size for body in bodies)
    count = len(bodies) + -len(bodies) % BATCH
    coordinates = np.tile([0.0, 0.0, 100.0, 0.0, 0.0, 0.0, 1.0], (count, 1))
    coordinates[:, 0] = spacing * np.arange(count)
    return coordinates


def body_coordinates(bodies: Sequence[Body], poses: Float64Array) -> Float64Array:
    """Return position and xyzw quaternion of bodies at poses (N, 4, 4), and of those without shape, shape (M, 7)."""
    coordinates = _initial_coordinates(bodies)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    coordinates[: len(poses)] = np.concatenate([poses[:, :3, 3], turns], axis=1)
    return coordinates
