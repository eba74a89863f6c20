"""Impacts against closed forms: rebounds, spin, and thin or overlapping bodies."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.bodies import GRAVITY, STEPPERS, body_of, centres, energy, lowest, pose_at, run_until, table, world_of

pytestmark = pytest.mark.usefixtures("physics")


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_drop_does_not_rebound_or_gain_energy(stepper):
    """Contact only dissipates E = sum m (g z + v v / 2) + w I w / 2; after impact no body rises by 1 mm."""
    shapes = [
        trimesh.creation.box((0.03, 0.03, 0.03)),
        trimesh.creation.icosphere(3, 0.015),
        trimesh.creation.cylinder(radius=0.015, height=0.02, sections=48),
    ]
    poses = [pose_at((0.1 * i, 0, 0.3)) for i in range(3)]
    world = world_of(stepper, [body_of(shape) for shape in shapes], [table()], poses)
    start = least = energy(world)
    heights = []
    while world.time < 1.5:
        world.advance()
        heights.append([lowest(mesh, pose) for mesh, pose in zip(shapes, world.poses, strict=True)])
        assert energy(world) - least < 0.01 * start
        least = min(least, energy(world))
    for height in np.transpose(heights):
        impact = int(np.argmax(height < 0))
        assert height[impact] < 0
        assert height[impact:].max() < 1e-3


@pytest.mark.parametrize(
    ("stepper", "timestep"), [("warp", 0.002), ("mujoco", 0.001), ("mujoco", 0.002), ("mujoco", 0.004)]
)
def test_the_rebound_height_equals_its_closed_form(stepper, timestep):
    """A body that falls from h rises to e^2 h within 5 %, for any e, h, mass and timestep.

    e is the geometric mean of both sides. The bodies are boxes that land flat.
    """
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    drops = [(0.05, 0.9, 800.0), (0.11, 0.4, 7850.0), (0.2, 0.2, 1000.0), (0.31, 0.6, 2700.0), (0.4, 0.9, 7850.0)]
    bodies = [body_of(box, density=density, restitution=one) for _, one, density in drops]
    poses = [pose_at((0.1 * i, 0, 0.01 + height)) for i, (height, _, _) in enumerate(drops)]
    world = world_of(stepper, bodies, [table(restitution=0.4)], poses, timestep=timestep)
    heights = [world.poses[:, 2, 3] - 0.01]
    while world.time < 0.6:
        world.advance()
        heights.append(world.poses[:, 2, 3] - 0.01)
    for i, (height, one, _) in enumerate(drops):
        rising = np.diff(np.array(heights)[:, i]) > 0
        bounce = int(np.argmax(rising))
        apex = bounce + int(np.argmin(rising[bounce:]))
        # The apex lies between two samples, at most g t^2 / 8 above the higher one.
        missed = GRAVITY * world.interval**2 / 8
        assert heights[apex][i] == pytest.approx(one * 0.4 * height, rel=0.05, abs=missed)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_the_spin_after_an_impact_equals_its_closed_form(stepper):
    """A tilted plate falls on its edge without friction: J = (1 + e) v / (1 / m + x^2 / I), w = J x / I.

    It has turned by w t after the time t since the edge touched the table, at any phase of the steps.
    """
    plate, turn = trimesh.creation.box((0.1, 0.02, 0.002)), Rotation.from_euler("y", -30, degrees=True)
    low = plate.vertices @ turn.as_matrix().T
    arm, depth = low[low[:, 2].argmin(), [0, 2]]
    heights, step, end, restitution = np.linspace(0.2, 0.208, 6), 0.002, 0.216, 0.5
    body = body_of(plate, friction=0.0, restitution=restitution)
    poses = [pose_at((0, 0.05 * i, height - depth), turn) for i, height in enumerate(heights)]
    world = world_of(stepper, [body] * 6, [table(friction=0.0, restitution=restitution)], poses)
    run_until(world, end)
    found = step * np.ceil((np.sqrt(step**2 / 4 + 2 * heights / GRAVITY) - step / 2) / step)
    speed = GRAVITY * found
    since = end - found + (found * (found + step) * GRAVITY / 2 - heights) / speed
    mass, inertia = body.mass.mass, body.mass.inertia[1, 1]
    impulse = (1 + restitution) * speed / (1 / mass + arm**2 / inertia)
    turned = [(turn.inv() * Rotation.from_matrix(pose[:3, :3])).magnitude() for pose in world.poses]
    np.testing.assert_allclose(turned, impulse * abs(arm) / inertia * since, rtol=0.02)


@pytest.mark.parametrize("stepper", ["mujoco", pytest.param("warp", marks=pytest.mark.extended)])
def test_few_discs_that_land_near_their_rim_stop_on_it(stepper):
    """Discs of 40 x 3 mm fall 0.1 m at tilts of 0.5 to 4.25 degrees from upright.

    Their centre is above the rim up to atan(3 / 40) = 4.3 degrees. Without restitution, a third of them or more stop on
    it. The first impact turns a disc that rebounds: at most three of 16 stop on the rim.
    """
    disc = trimesh.creation.cylinder(radius=0.02, height=0.003, sections=48)
    turns = [Rotation.from_euler("zx", (40 * i, 90.5 + 0.25 * i), degrees=True) for i in range(16)]
    poses = [pose_at((0.2 * (i % 4) - 0.3, 0.2 * (i // 4) - 0.3, 0.12), turn) for i, turn in enumerate(turns)]
    standing = {}
    for restitution in (0.0, 0.6):
        material = {"restitution": restitution, "rolling_friction": 1e-5}
        world = world_of(stepper, [body_of(disc, density=7800.0, **material)] * 16, [table(**material)], poses)
        run_until(world, 1.2)
        standing[restitution] = int((np.abs(world.poses[:, 2, 2]) < 0.5).sum())
    assert standing[0.0] >= 6
    assert standing[0.6] <= 3


def test_the_restitution_of_an_underdamped_contact_equals_its_closed_form():
    """The formula of :mod:`mitsplat.physics.restitution`: x'' = -2 z x' - x from x' = -1 until x'' = 0."""
    for ratio in (0.05, 0.36, 0.7, 0.95):
        place, speed, force = 0.0, -1.0, 1.0
        while force > 0:
            force = -2 * ratio * speed - place
            speed += 1e-4 * force
            place += 1e-4 * speed
        phase = np.arcsin(ratio)
        assert np.exp(-np.tan(phase) * (np.pi - 2 * phase)) == pytest.approx(speed, abs=1e-3)


@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("speed", [pytest.param(3.0, marks=pytest.mark.extended), 6.0])
def test_a_thin_plate_does_not_tunnel(stepper, speed):
    """A plate of 2 mm moves 12 mm per step at 6 m/s, thrown flat, on edge and on a corner at table and wall."""
    from mitsplat.physics.bodies import Collider
    from mitsplat.physics.friction import ContactMaterial

    plate = trimesh.creation.box((0.05, 0.04, 0.002))
    wall = Collider(ContactMaterial(), box=((0.05, 1.0, 1.0), pose_at((0.425, 0, 0.5))))
    turns = [Rotation.identity(), Rotation.from_euler("x", 90, degrees=True), Rotation.from_euler("xy", (40, 35), True)]
    to_wall = Rotation.from_euler("y", 90, degrees=True)
    poses = [pose_at((-0.3, 0.2 * i, 0.1), turn) for i, turn in enumerate(turns)]
    poses += [pose_at((0.2, 0.2 * i - 0.2, 0.2), to_wall * turn) for i, turn in enumerate(turns)]
    velocities = np.zeros((6, 2, 3))
    velocities[:3, 0, 2], velocities[3:, 0, 0] = -speed, speed
    world = world_of(stepper, [body_of(plate)] * 6, [table(), wall], poses)
    world.reset(np.stack(poses), velocities)
    least = start = energy(world)
    while world.time < 1.0:
        world.advance()
        assert centres(world)[:, 2].min() > -0.02
        assert centres(world)[:, 0].max() < 0.42
        assert energy(world) - least < 0.01 * start
        least = min(least, energy(world))
    assert min(lowest(plate, pose) for pose in world.poses) > -3e-4


@pytest.mark.parametrize("stepper", STEPPERS)
def test_overlapping_boxes_part_at_less_than_one_metre_per_second(stepper):
    """Boxes that overlap by 10 mm, and one that overlaps the table by 10 mm, part at less than 1 m/s."""
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    poses = [pose_at((0, 0, 0.02)), pose_at((0.03, 0, 0.021)), pose_at((0.2, 0, 0.01))]
    world = world_of(stepper, [body_of(box)] * 3, [table()], poses)
    fastest = 0.0
    while world.time < 1.0:
        world.advance()
        fastest = max(fastest, float(np.linalg.norm(world.velocities[:, 0], axis=1).max()))
    assert fastest < 1.0
    assert [lowest(box, pose) for pose in world.poses] == pytest.approx([0, 0, 0], abs=3e-4)
    assert world.poses[1, 0, 3] - world.poses[0, 0, 3] > 0.04 - 5e-4
