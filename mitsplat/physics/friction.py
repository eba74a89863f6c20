"""Friction of a pair of surfaces from the friction of each, for MuJoCo on Warp and in C.

Sliding
    The geometric mean of the two coefficients, as in Box2D (``b2MixFriction``) and Jolt (``DefaultCombineFriction``).
    Two surfaces of one material have that material's coefficient. A frictionless surface slides on everything. Both
    surfaces always count. MuJoCo's default is the larger coefficient, so that the smaller one has no effect.
Spin, about the contact's normal
    The sliding coefficient times the contact radius [m], the larger of the two surfaces' radii.
Rolling
    A length [m], the larger of the two. It does not depend on sliding friction, because deformation causes it.

MuJoCo's ``geom_friction`` holds these values of each geom: coefficient, contact radius, rolling length.
"""

from __future__ import annotations

import warnings
from typing import Any, no_type_check

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from mitsplat.arrays import Float64Array

MIN_FRICTION = 2e-5
"""Minimum friction. MuJoCo divides by the friction, and smaller values are unstable."""

_vec5 = wp.types.vector(length=5, dtype=wp.float32)


def pair_friction(first: Float64Array, second: Float64Array) -> Float64Array:
    """Compute the friction of contacts (N, 5), as 2 x sliding, spin, 2 x rolling, from that of their geoms (N, 3)."""
    slide = np.sqrt(first[:, 0] * second[:, 0])
    spin, roll = np.maximum(first[:, 1:], second[:, 1:]).T
    return np.asarray(np.maximum(np.stack([slide, slide, slide * spin, roll, roll], axis=1), MIN_FRICTION))


class PairFrictionSolver(SolverMuJoCo):
    """MuJoCo solver on Warp with Newton's contacts and the friction of :func:`pair_friction`."""

    def __init__(self, model: newton.Model, **options: Any) -> None:
        with warnings.catch_warnings():
            # The friction of a geom is one factor of a pair's friction, which is at least MIN_FRICTION.
            warnings.filterwarnings("ignore", message=r"geom \d+: friction.* < MJ_MINMU")
            super().__init__(model, **options)

    def _convert_contacts_to_mjwarp(self, model: newton.Model, state_in: newton.State, contacts: Any) -> None:
        super()._convert_contacts_to_mjwarp(model, state_in, contacts)
        found = self.mjw_data.contact
        wp.launch(
            _mix_friction,
            dim=self.mjw_data.naconmax,
            inputs=[self.mjw_data.nacon, found.geom, found.worldid, self.mjw_model.geom_friction, found.friction],
            device=model.device,
        )


@wp.kernel(enable_backward=False, module="unique")
@no_type_check
def _mix_friction(
    count: wp.array[wp.int32],
    geoms: wp.array[wp.vec2i],
    worlds: wp.array[wp.int32],
    geom_friction: wp.array2d[wp.vec3],
    friction: wp.array[_vec5],
):
    """Apply :func:`pair_friction` to the contacts of one step, in place."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    pair, world = geoms[contact], worlds[contact]
    first, second = geom_friction[world, pair[0]], geom_friction[world, pair[1]]
    slide = wp.sqrt(first[0] * second[0])
    spin = wp.max(MIN_FRICTION, slide * wp.max(first[1], second[1]))
    roll = wp.max(MIN_FRICTION, wp.max(first[2], second[2]))
    slide = wp.max(MIN_FRICTION, slide)
    friction[contact] = _vec5(slide, slide, spin, roll, roll)
