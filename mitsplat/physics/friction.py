"""Contact materials, and the friction of a pair of surfaces from that of each.

Sliding
    The geometric mean of the two coefficients, as in Box2D (``b2MixFriction``) and Jolt (``DefaultCombineFriction``).
    Two surfaces of one material have that material's coefficient. A frictionless surface slides on everything. Both
    surfaces always count. MuJoCo's default is the larger coefficient, so that the smaller one has no effect.
Spin, about the contact's normal
    The sliding coefficient times the contact radius [m], the larger of the two surfaces' radii.
Rolling
    A length [m], the larger of the two. It does not depend on sliding friction, because deformation causes it.

:mod:`mitsplat.physics.restitution` states the rule of rebounds.

MuJoCo's ``geom_friction`` holds these values of each geom: coefficient, contact radius, rolling length.
"""

from __future__ import annotations

from dataclasses import dataclass

import newton
import numpy as np

from mitsplat.arrays import Float64Array

GRAVITY = 9.81
"""[m/s^2]"""
MIN_FRICTION = 2e-5
"""Minimum friction. MuJoCo divides by the friction, and smaller values are unstable."""

# Contact radius and rolling-friction length of materials that state none [m], limited to these shares of the size, so
# that round parts stop and thin parts do not stand on their rim.
_CONTACT_RADIUS, _ROLLING = (0.01, 0.2), (5e-4, 0.01)


@dataclass(frozen=True)
class ContactMaterial:
    """Contact properties of a surface.

    Attributes:
        friction: Coulomb friction coefficient.
        restitution: Coefficient of restitution.
        rolling_friction: Length of rolling friction [m], or None: 0.5 mm, at most 1 % of a body's size.
        torsional_friction: Contact radius of spin friction [m], or None: 10 mm, at most a fifth of a body's size.
    """

    friction: float = 0.5
    restitution: float = 0.0
    rolling_friction: float | None = None
    torsional_friction: float | None = None

    def shape_config(self, stiffness: float, damping: float, *, size: float) -> newton.ModelBuilder.ShapeConfig:
        """Return Newton's description of a shape.

        Args:
            stiffness: Stiffness of contacts per unit of mass [1/s^2].
            damping: Damping of contacts per unit of mass [1/s].
            size: Size of the body [m]; 0 for static shapes, so that bodies determine lengths that are None.
        """
        rolling, radius = self.rolling_friction, self.torsional_friction
        return newton.ModelBuilder.ShapeConfig(
            density=0.0,
            ke=stiffness,
            kd=damping,
            mu=self.friction,
            mu_torsional=min(_CONTACT_RADIUS[0], _CONTACT_RADIUS[1] * size) if radius is None else radius,
            mu_rolling=min(_ROLLING[0], _ROLLING[1] * size) if rolling is None else rolling,
            restitution=self.restitution,
            margin=0.0,
            gap=0.0,
        )


def pair_friction(first: Float64Array, second: Float64Array) -> Float64Array:
    """Compute the friction of contacts (N, 5), as 2 x sliding, spin, 2 x rolling, from that of their geoms (N, 3)."""
    slide = np.sqrt(first[:, 0] * second[:, 0])
    spin, roll = np.maximum(first[:, 1:], second[:, 1:]).T
    return np.asarray(np.maximum(np.stack([slide, slide, slide * spin, roll, roll], axis=1), MIN_FRICTION))
