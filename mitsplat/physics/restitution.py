"""Restitution of contacts: Newton's law of impact for MuJoCo's soft contacts, in C and on Warp.

MuJoCo's contact is a spring and damper with a reference acceleration ``a = b v - k r`` for the approach speed ``v`` and
the distance ``r``. It cannot pull. A contact of damping ratio ``z = sin(B)`` that the timestep resolves rebounds with

    e = exp(-tan(B) (pi - 2 B)),

because its force vanishes at the phase ``pi - 2 B`` of the oscillation. The contacts of this package last about two
steps, so that ``e`` would depend on the phase at which a step meets the surface. A contact that approaches faster than
:data:`MIN_IMPACT_SPEED` is therefore given an impact at the moment ``t = p / v`` before the step, at which its points
met; ``p`` is its depth, and at most one step ``h`` has passed since. Its reference acceleration changes its speed
within the step from ``-v`` to ``w``, where

    w (w + g (h + 2 t)) = e^2 v (v + g (h - 2 t)).

Without the terms of gravity this is Newton's law, ``w = e v``. They belong to the energy of semi-implicit steps; ``g``
is the component of gravity along the normal. After the step, the change of velocity of both bodies is also applied to
the time ``t`` of their motion. A body that falls from ``h0`` then rises to ``e^2 h0`` at any timestep. Slower contacts
are damped and do not rebound, so that resting bodies are not disturbed. At the limit, ``v^2 / 2``
is 5 mJ per kilogram.

A step meets a thin part several millimetres deep. Some of its points in contact would have touched later or not at all,
because the first impact turns the part away from them. Only the point of a pair of bodies that has been below the
surface for the longest time ``t`` is therefore given an impact. Points that follow within :data:`SIMULTANEOUS` share
it. The other fast points have no force in this step, and the motion since the first impact is that of a body that they
did not touch.

The restitution of a contact is the geometric mean of the coefficients of both sides, as for friction: two surfaces of
one material have that material's coefficient, and nothing rebounds from a surface of coefficient 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

MIN_IMPACT_SPEED = 0.1
"""Approach speed below which a contact is damped [m/s]."""

SIMULTANEOUS = 1e-5
"""Time between impacts of one pair of bodies that count as one [s]."""

IMPACT_IMPEDANCE = 0.9999
"""Impedance of impacts: the largest of MuJoCo, so that a contact reaches its reference acceleration."""


def impact_damping(restitution: Any, approach: Any, since: Any, gravity: Any, timestep: Any) -> Any:
    """Compute the damping ``b = (v + w) / (v h)`` of impacts [1/s]; see :mod:`mitsplat.physics.restitution`.

    The arguments are arrays of NumPy, shape (N,), or numbers of a kernel in :data:`impact_damping_on_warp`.

    Args:
        restitution: Coefficients of the contacts.
        approach: Approach speeds ``v`` [m/s].
        since: Times ``t`` since the impacts [s].
        gravity: Gravity along the normals [m/s^2].
        timestep: Timestep ``h`` [s].
    """
    half = 0.5 * gravity * (timestep + 2.0 * since)
    energy = restitution * restitution * approach * (approach + gravity * (timestep - 2.0 * since))
    rebound = np.sqrt(half * half + energy) - half
    return (approach + rebound) / (approach * timestep)


impact_damping_on_warp = wp.func(impact_damping)
"""Function of a kernel that computes :func:`impact_damping`."""
