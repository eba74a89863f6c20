"""Detection of rest, rolling friction and drag while bodies come to rest, and bodies that start again."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.bodies import EVERYWHERE, GRAVITY, STEPPERS, body_of, pose_at, table, world_of

pytestmark = pytest.mark.usefixtures("physics")


def test_mean_speeds_equal_displacement_by_time():
    """A rotation of t about an axis through the centre of mass in s seconds has the speed t / s.

    A displacement of w has the speed w / s.
    """
    from mitsplat.physics.rest import _mean_speeds

    body = body_of(trimesh.creation.box((0.02, 0.03, 0.01)))
    before = pose_at((0.1, 0, 0), Rotation.from_rotvec((0.3, -1, 2)))[None]
    for turn in (1e-4, 0.5, np.pi):
        after = pose_at((0.1, 0, 3e-4), Rotation.from_rotvec((0, turn, 0)) * Rotation.from_rotvec((0.3, -1, 2)))[None]
        assert _mean_speeds([body], before, after, 0.05) == pytest.approx((6e-3, turn / 0.05), rel=1e-6)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_box_dropped_in_any_pose_rests_on_a_face(stepper):
    """Starts on each face, on edges, and on a corner below the centre of mass: the energy is least on a face."""
    from mitsplat.physics.rest import run_to_rest

    box = trimesh.creation.box((0.02, 0.03, 0.01))
    on_corner = Rotation.align_vectors([[0, 0, -1]], [[2, 3, 1]])[0]
    turns = [
        Rotation.identity(),
        Rotation.from_euler("x", 90, degrees=True),
        Rotation.from_euler("y", 90, degrees=True),
        Rotation.from_euler("x", 45, degrees=True),
        Rotation.from_euler("y", 30, degrees=True),
        # An exactly balanced box would stay; this one starts three degrees off.
        on_corner * Rotation.from_euler("x", 3, degrees=True),
    ]
    poses = [pose_at((0.1 * i - 0.25, 0, 0.05), turn) for i, turn in enumerate(turns)]
    world = world_of(stepper, [body_of(box)] * len(turns), [table()], poses)
    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    steepest = np.abs(outcome.poses[:, 2, :3]).max(axis=1)
    assert np.degrees(np.arccos(np.minimum(steepest, 1.0))).max() < 0.1
    np.testing.assert_array_equal(np.abs(outcome.poses[:3, 2, :3]).argmax(axis=1), [2, 1, 0])


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_box_does_not_balance_on_its_edge(stepper):
    """The centre of mass is above the edge at a tilt of atan(d / b), where only rolling friction could hold it."""
    from mitsplat.physics.rest import run_to_rest

    breadth, depth = 0.03, 0.009
    slab = trimesh.creation.box((breadth, breadth, depth))
    upright = Rotation.from_euler("y", 90, degrees=True)
    poses = []
    for i, degrees in enumerate((-0.3, 0.3)):
        tilt = np.arctan(depth / breadth) + np.radians(degrees)
        height = (breadth * np.cos(tilt) + depth * np.sin(tilt)) / 2
        poses.append(pose_at((0, 0.1 * i, height), Rotation.from_euler("y", tilt) * upright))
    world = world_of(stepper, [body_of(slab)] * 2, [table()], poses)
    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    # It falls back onto the narrow face, or over onto the large one.
    np.testing.assert_allclose(np.abs(outcome.poses[:, 2, 2]), [0, 1], atol=1e-3)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_rolling_friction_starts_after_the_free_time(stepper):
    """A rolling cylinder slows down by a = g b / (1.5 r): it would stop within the time v / a and the way v^2 / 2 a."""
    from mitsplat.physics.rest import FREE_TIME, run_to_rest

    radius, speed, rolling = 0.01, 0.3, 5e-4
    cylinder = trimesh.creation.cylinder(radius=radius, height=0.02, sections=256)
    lying = Rotation.from_euler("x", 90, degrees=True)
    world = world_of(
        stepper, [body_of(cylinder, rolling_friction=rolling)], [table()], [pose_at((-0.4, 0, radius), lying)]
    )
    world.set_velocities(np.array([[[speed, 0, 0], [0, speed / radius, 0]]]))
    outcome = run_to_rest(world, max_time=3.0, bounds=EVERYWHERE, free_time=FREE_TIME)
    slowing = GRAVITY * rolling / (1.5 * radius)
    assert outcome.poses[0, 0, 3] + 0.4 > 1.5 * speed**2 / (2 * slowing)
    assert 1.5 < outcome.time < 1.5 + speed / slowing


@pytest.mark.parametrize("stepper", STEPPERS)
def test_slow_sliding_is_not_rest(stepper):
    """A block at 0.3 mm/s moves by less than 0.1 mm in 0.25 s and 0.5 mm in 1 s, unless it accelerates."""
    from mitsplat.physics import rest as physics

    block = trimesh.creation.box((0.04, 0.04, 0.01))
    world = world_of(stepper, [body_of(block, friction=0.0)], [table(friction=0.0)], [pose_at((0, 0, 0.005))])
    start, velocities = world.poses, np.zeros((1, 2, 3))
    velocities[0, 0, 0] = 3e-4
    world.reset(start, velocities)

    def push(time, poses, again):
        world.set_velocities(velocities * (3 if time > 0.3 else 1))

    refused = physics.run_to_rest(world, max_time=1.0, bounds=EVERYWHERE, observe=push).rejection
    assert refused == "not at rest within 1 s"
    world.reset(start, velocities)

    def keep(time, poses, again):
        world.set_velocities(velocities)

    outcome = physics.run_to_rest(world, max_time=1.0, bounds=EVERYWHERE, observe=keep)
    assert outcome.rejection == ""
    assert 2e-4 < outcome.surface_motion < 4.5e-4


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_poured_ball_keeps_its_speed_limit(stepper):
    """A ball falls 0.5 m in h / v + v / 2 g = 0.55 s at v = 1 m/s, and no faster."""
    from mitsplat.physics import rest as physics

    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    world = world_of(stepper, [body_of(ball)], [table()], [pose_at((0, 0, 0.52))])
    speeds, heights = [], []

    def observe(time, poses, again):
        speeds.append(np.linalg.norm(world.velocities[0, 0]))
        heights.append((time, poses[0, 2, 3]))

    physics.run_to_rest(world, max_time=3.0, bounds=EVERYWHERE, fastest=1.0, observe=observe)
    assert max(speeds) == pytest.approx(1.0, rel=1e-3)
    landed = next(time for time, height in heights if height < 0.025)
    assert landed == pytest.approx(0.5 / 1.0 + 1.0 / (2 * GRAVITY), abs=0.04)


@pytest.mark.parametrize("stepper", ["mujoco", pytest.param("warp", marks=pytest.mark.extended)])
def test_the_drag_on_late_bodies_equals_its_closed_form(stepper):
    """A block without friction slides at v for the time t = 1.5 s; with drag, it stops after another v T, T = 0.2 s.

    The least friction of a stepper slows it by a. From a speed u it moves (u + a T) T (1 - exp(-t / T)) - a T t.
    """
    from mitsplat.physics.rest import run_to_rest

    block, speed = trimesh.creation.box((0.04, 0.04, 0.01)), 0.4
    world = world_of(stepper, [body_of(block, friction=0.0)], [table(friction=0.0)], [pose_at((-0.4, 0, 0.005))])
    velocities = np.zeros((1, 2, 3))
    velocities[0, 0, 0] = speed
    world.reset(world.poses, velocities)
    outcome = run_to_rest(world, max_time=4.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    assert outcome.poses[0, 0, 3] + 0.4 == pytest.approx(speed * (1.5 + 0.2), rel=0.01)
    # Rest begins when it moves by less than 0.1 mm in 0.25 s, or up to 0.25 s later.
    slowing = 0.2 * GRAVITY * {"warp": 1e-4, "mujoco": 2e-5}[stepper]
    last = (1e-4 + 0.25 * slowing) / (0.2 * (1 - np.exp(-0.25 / 0.2)))
    begin = 1.5 + 0.2 * np.log((speed - 1.5 / 0.2 * slowing + slowing) / last)
    assert begin - 0.01 < outcome.time < begin + 0.26


@pytest.mark.parametrize("stepper", STEPPERS)
def test_bodies_that_lose_no_energy_rebound_for_a_second_and_a_half(stepper):
    """With a restitution of 1, a box that falls flat returns to its height, and all bodies rest in the end."""
    from mitsplat.physics.rest import run_to_rest

    rod = trimesh.creation.cylinder(radius=0.003, height=0.03, sections=24)
    bodies = [body_of(trimesh.creation.box((0.02, 0.02, 0.02)), restitution=1.0)]
    bodies += [body_of(rod, restitution=1.0)] * 5
    turns = Rotation.random(5, random_state=np.random.default_rng(0))
    starts = [pose_at((0, 0, 0.11)), *(pose_at((0.1 * i + 0.1, 0, 0.1), turn) for i, turn in enumerate(turns))]
    wide = table(restitution=1.0, size=20.0)
    world = world_of(stepper, bodies, [wide], starts)
    heights = []
    outcome = run_to_rest(
        world,
        max_time=6.0,
        bounds=EVERYWHERE,
        observe=lambda time, poses, again: heights.append((time, poses[0, 2, 3])),
    )
    assert outcome.rejection == ""
    for first, last, share in [(0.2, 0.4, 0.95), (1.3, 1.5, 0.8)]:
        assert max(height - 0.01 for time, height in heights if first < time < last) > share * 0.1
    assert outcome.time < 3.0


@pytest.mark.parametrize(("leans", "reason"), [(False, "keeps moving"), (True, "rests against the enclosure")])
def test_a_body_that_fails_starts_again_while_the_others_stay(leans, reason):
    """Four of five blocks rest. The fifth is pushed, or stands 0.5 mm from a wall."""
    from mitsplat.physics.rest import run_to_rest

    block = body_of(trimesh.creation.box((0.02, 0.02, 0.01)), friction=0.0)
    start = np.stack([pose_at((0.1, 0.1 * i - 0.2, 0.005)) for i in range(5)])
    world = world_of("mujoco", [block] * 5, [table()], start)
    walls = np.full((5, 3), -np.inf), np.full((5, 3), np.inf)
    walls[1][4, 0] = 0.1105 if leans else np.inf
    asked = []

    def observe(time, poses, again):
        if not leans and not asked:
            velocities = world.velocities
            velocities[4, 0] = (0.01, 0, 0)
            world.set_velocities(velocities)

    def redraw(poses, failed):
        asked.append((world.time, failed, poses))
        drawn = poses.copy()
        drawn[failed, :3, 3] += (-0.05, 0, 0.02)
        return drawn

    def run(**options):
        world.reset(start)
        return run_to_rest(world, max_time=6.0, bounds=EVERYWHERE, walls=walls, observe=observe, **options)

    refused = run()
    assert (refused.rejection, refused.causes) == (reason, (4,))
    outcome = run(redraw=redraw)
    assert outcome.rejection == ""
    ((time, failed, before),) = asked
    assert time == pytest.approx(0.25 if leans else 2.5, abs=0.03)
    assert failed.tolist() == [False] * 4 + [True]
    np.testing.assert_allclose(outcome.poses[:4], before[:4], atol=1e-4)
    assert outcome.poses[4, 0, 3] == pytest.approx(before[4, 0, 3] - 0.05, abs=1e-3)
    assert outcome.time > time


def test_a_body_that_never_rests_starts_again_once():
    """One of five blocks without friction moves at 10 mm/s after each new start, and fails 2.5 s later."""
    from mitsplat.physics.rest import LATE, run_to_rest

    block = body_of(trimesh.creation.box((0.02, 0.02, 0.01)), friction=0.0)
    start = np.stack([pose_at((0.1, 0.1 * i - 0.2, 0.005)) for i in range(5)])
    world = world_of("mujoco", [block] * 5, [table(friction=0.0)], start)
    times = []

    def push(time, poses, again):
        velocities = world.velocities
        velocities[4, 0] = (0.01, 0, 0)
        world.set_velocities(velocities)

    def redraw(poses, failed):
        times.append(world.time)
        return start

    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE, redraw=redraw, observe=push)
    assert (outcome.rejection, outcome.causes) == (LATE, (4,))
    assert times == pytest.approx([2.5], abs=0.05)
    assert outcome.time == pytest.approx(5.0, abs=0.1)


def test_a_body_that_moves_in_turns_is_late_after_two_seconds():
    """One of five blocks moves by 4 mm in each second, and rests at its end: as objects held by rolling friction."""
    from mitsplat.physics.rest import LATE, run_to_rest

    block = body_of(trimesh.creation.box((0.02, 0.02, 0.01)), friction=0.0)
    start = np.stack([pose_at((0.1, 0.1 * i - 0.2, 0.005)) for i in range(5)])
    world = world_of("mujoco", [block] * 5, [table(friction=0.0)], start)

    def push(time, poses, again):
        velocities = world.velocities
        velocities[4, 0] = (0.01 if 0.2 < (time + 0.5) % 1.0 < 0.6 else 0.0, 0, 0)
        world.set_velocities(velocities)

    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE, observe=push)
    assert (outcome.rejection, outcome.causes) == (LATE, (4,))
    assert outcome.time == pytest.approx(3.5, abs=0.05)
