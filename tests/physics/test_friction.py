"""Sliding, spinning and rolling friction against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.bodies import GRAVITY, STEPPERS, body_of, pose_at, run_until, table, world_of

pytestmark = pytest.mark.usefixtures("physics")
FRICTIONS = [(0.2, 0.6), (0.6, 0.2), (0.05, 0.8), (0.8, 0.05), (0.35, 0.5), (0.9, 0.0), (0.0, 0.9), (0.4, 0.4)]
"""Friction coefficients of a block and of the surface below."""


def inclines(angle, frictions):
    """Return tables side by side, inclined towards +x by an angle [rad], and the frame of each one's surface."""
    frames = [
        pose_at((0, 1.1 * i, 0)) @ pose_at((0, 0, 0), Rotation.from_euler("y", angle)) for i in range(len(frictions))
    ]
    return [table(frame, friction=friction) for frame, friction in zip(frames, frictions, strict=True)], frames


@pytest.mark.parametrize("stepper", STEPPERS)
def test_sliding_on_an_incline_equals_its_closed_form(stepper):
    """On 25 degrees a block slides by g (sin a - mu cos a) t (t + h) / 2; mu is the geometric mean, h the step."""
    angle = np.radians(25.0)
    tables, frames = inclines(angle, [friction for _, friction in FRICTIONS])
    starts = np.stack([frame @ pose_at((-0.45, 0, 0.005)) for frame in frames])
    block = trimesh.creation.box((0.04, 0.04, 0.01))
    world = world_of(stepper, [body_of(block, friction=friction) for friction, _ in FRICTIONS], tables, starts)
    run_until(world, 0.5)
    way = (world.poses[:, :3, 3] - starts[:, :3, 3]) @ frames[0][:3, 0]
    acceleration = 2 * way / (world.time * (world.time + 0.002))
    mu = np.tan(angle) - acceleration / (GRAVITY * np.cos(angle))
    np.testing.assert_allclose(mu, np.sqrt(np.prod(FRICTIONS, axis=1)), rtol=0.003, atol=1e-4)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_block_slides_beyond_the_friction_angle_only(stepper):
    """A block slides iff tan a > sqrt(mu mu'), whichever surface is the smoother, on a table or on a slab."""
    angle = np.radians(20.0)
    pairs = [(low, (share * np.tan(angle)) ** 2 / low) for share in (0.9, 1.1) for low in (0.1, 0.3, 1.0)]
    block, slab = trimesh.creation.box((0.02, 0.02, 0.01)), trimesh.creation.box((0.3, 0.1, 0.02))
    rough = 9.0  # friction of tables under slabs, which must not slide
    tables, frames = inclines(angle, [mu for _, mu in pairs] + [rough] * len(pairs))
    bodies = [body_of(block, friction=mu) for mu, _ in pairs * 2]
    bodies += [body_of(slab, friction=mu) for _, mu in pairs]
    height = [0.005] * len(pairs) + [0.0251] * len(pairs)
    starts = [frame @ pose_at((-0.1, 0, z)) for frame, z in zip(frames, height, strict=True)]
    starts += [frame @ pose_at((0, 0, 0.01)) for frame in frames[len(pairs) :]]
    world = world_of(stepper, bodies, tables, starts)
    run_until(world, 0.1)  # settle into contact
    before = world.poses[:, :3, 3]
    run_until(world, 0.4)
    way = np.linalg.norm(world.poses[:, :3, 3] - before, axis=1)
    np.testing.assert_array_equal(way > 0.005, [True] * 3 + [False] * 3 + [True] * 3 + [False] * 9)
    assert way[way < 0.005].max() < 1e-4


@pytest.mark.parametrize("stepper", STEPPERS)
def test_spin_friction_equals_its_closed_form(stepper):
    """A spinning top on a square foot is decelerated by g m mu sqrt(p^2 + r^2) / I.

    Its corners at distance p from the axis slide and spin. Spin friction of each corner is mu r, with r = 10 mm the
    radius of contact; the cone of both is an ellipsoid.
    """
    foot = trimesh.creation.box((0.004, 0.004, 0.004)).apply_translation((0, 0, 0.002))
    disc = trimesh.creation.box((0.05, 0.05, 0.006)).apply_translation((0, 0, 0.007))
    tables, frames = inclines(0.0, [mu for _, mu in FRICTIONS])
    bodies = [body_of(foot, disc, friction=mu) for mu, _ in FRICTIONS]
    world = world_of(stepper, bodies, tables, frames)
    run_until(world, 0.1)
    velocities = np.zeros((len(bodies), 2, 3))
    velocities[:, 1, 2] = 40.0
    world.reset(world.poses, velocities)
    run_until(world, 0.3)
    mass, mu = bodies[0].mass, np.sqrt(np.prod(FRICTIONS, axis=1))
    slowing = GRAVITY * mass.mass * mu * np.hypot(0.002 * np.sqrt(2), 0.01) / mass.inertia[2, 2]
    slowed = (40.0 - world.velocities[:, 1, 2]) / world.time
    np.testing.assert_allclose(slowed, slowing, rtol=0.01, atol=0.6)


def test_stated_lengths_of_friction_replace_those_of_the_size():
    """Of 0.1 m: 10 mm and 0.5 mm; of 0.02 m: a fifth and a hundredth. Static shapes state none unless given."""
    from mitsplat.physics.friction import ContactMaterial

    given = ContactMaterial(rolling_friction=1e-5, torsional_friction=0.0)
    lengths = [(ContactMaterial(), size) for size in (0.1, 0.02, 0.0)] + [(given, 0.1), (given, 0.0)]
    found = [material.shape_config(1.0, 1.0, size=size) for material, size in lengths]
    assert [(one.mu_torsional, one.mu_rolling) for one in found] == [
        *(pytest.approx(pair) for pair in [(0.01, 5e-4), (0.004, 2e-4), (0.0, 0.0)]),
        *[(0.0, 1e-5)] * 2,
    ]


@pytest.mark.parametrize("stepper", STEPPERS)
def test_creep_on_an_incline_is_below_a_tenth_of_a_millimetre(stepper):
    """tan 20 = 0.36 < mu = 0.5: a block at rest does not move for 3 s."""
    block = trimesh.creation.box((0.04, 0.04, 0.01))
    tilt = pose_at((0, 0, 0), Rotation.from_euler("y", 20, degrees=True))
    world = world_of(stepper, [body_of(block)], [table(tilt)], [tilt @ pose_at((0, 0, 0.005))])
    run_until(world, 0.2)  # settle into contact
    before = world.poses
    run_until(world, 3.2)
    assert np.linalg.norm(world.poses[0, :3, 3] - before[0, :3, 3]) < 1e-4


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_block_without_friction_stays_where_it_is(stepper):
    """At a sliding friction of 2e-5, rolling friction made the solver diverge in single precision after 0.9 s."""
    block = trimesh.creation.box((0.04, 0.03, 0.02))
    world = world_of(stepper, [body_of(block, friction=0.0)], [table(friction=0.0)], [pose_at((0, 0, 0.01))])
    while world.time < 1.2:
        world.advance()
    np.testing.assert_allclose(world.poses[0], pose_at((0, 0, 0.01)), atol=1e-5)
    np.testing.assert_allclose(world.velocities, 0, atol=1e-4)
