"""Motion that people give to objects: forces, tossing, tipping, pushing and shaking."""

from __future__ import annotations

import re
from collections import Counter

import numpy as np
import pytest
import trimesh

from mitsplat.errors import InputError
from mitsplat.physics.settle import replay_layout, settle_layout, try_alone
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.contents import draw_arrangements
from mitsplat.scene.spec.shape_spec import Region
from tests.bodies import EVERYWHERE, GRAVITY, STEPPERS, body_of, draw_start_poses, pose_at, table, world_of

WAYS = ["tossed", "tipped", "pushed", "shaken"]
EVERY = np.ones(1, dtype=bool)
X = np.array([1.0, 0.0, 0.0])
pytestmark = pytest.mark.usefixtures("physics")


def block(**material):
    return body_of(trimesh.creation.box((0.04, 0.03, 0.02)), **material)


def on_table(stepper, **material):
    """Return a world of one block, whose rear face is at x = 0, on a table of its material."""
    return world_of(stepper, [block(**material)], [table(**material)], [pose_at((0.02, 0, 0.01))])


def run(world, action):
    """Settle a world under an action; return positions (T, 3) and velocities (T, 3) of its first body."""
    from mitsplat.physics.handling import Handling
    from mitsplat.physics.rest import run_to_rest

    seen = []
    outcome = run_to_rest(
        world,
        max_time=6.0,
        bounds=EVERYWHERE,
        handling=Handling(actions=(action,)),
        observe=lambda time, poses, again: seen.append((time, *poses[0, :3, 3], *world.velocities[0, 0])),
    )
    return outcome, np.array(seen)


@pytest.mark.parametrize("size", [1.0, 0.02])
@pytest.mark.parametrize("stepper", STEPPERS)
def test_forces_accelerate_by_newtons_and_eulers_laws(stepper, size):
    """In free fall, v = F t / m - g t and w = M t / I about a principal axis, until the forces are reset."""
    body = body_of(trimesh.creation.box((0.04, 0.03, 0.02)).apply_translation((0.01, 0, 0)).apply_scale(size))
    world = world_of(stepper, [body], [table()], [pose_at((0, 0, 2.0))])
    force, torque = np.array([0.5, -0.2, 0.3]) * body.mass.mass, 3.0 * body.mass.inertia[2, 2]
    world.set_forces(np.array([[force, [0, 0, torque]]]))
    for _ in range(10):
        world.advance()
    time = world.time
    expected = [np.array([0.5, -0.2, 0.3 - GRAVITY]) * time, [0, 0, 3.0 * time]]
    np.testing.assert_allclose(world.velocities[0], expected, atol=2e-4)
    world.reset(np.stack([pose_at((0, 0, 2.0))]))
    world.advance()
    np.testing.assert_allclose(world.velocities[0, 0, :2], 0, atol=1e-6)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_pushed_block_takes_the_speed_of_the_plane(stepper):
    """Almost without friction it keeps this speed, at most a sixth more, because it leaves the plane as a spring."""
    from mitsplat.physics.handling import Handling, Sweep

    world, handling = on_table(stepper, friction=0.01), Handling(actions=(Sweep(EVERY, X, -0.02, 0.1, 0.4),))
    while world.time < handling.end:
        handling.apply(world)
        world.advance()
    before = world.poses[0, :3, 3]
    world.advance()
    speed = (world.poses[0, :3, 3] - before) / world.interval
    assert 0.39 < speed[0] < 0.4 * 7 / 6
    np.testing.assert_allclose(speed[1:], 0, atol=0.01)


def test_a_pushed_block_slides_on_by_its_stopping_distance():
    """Its rear face ends v^2 / (2 mu g) beyond the end of the plane's way, for speeds v that differ by a sixth."""
    from mitsplat.physics.handling import Sweep

    outcome, _ = run(on_table("mujoco", friction=0.4), Sweep(EVERY, X, -0.02, 0.1, 0.4))
    assert not outcome.rejection
    stops = 0.08 + (0.4 * np.array([5 / 6, 7 / 6])) ** 2 / (2 * 0.4 * GRAVITY)
    assert stops[0] - 0.4 * GRAVITY / 1500 < outcome.poses[0, 0, 3] - 0.02 < stops[1]
    np.testing.assert_allclose(outcome.poses[0, 1:3, 3], [0, 0.01], atol=3e-4)


def test_a_plane_turns_a_block_until_its_face_lies_against_it():
    from mitsplat.physics.handling import Sweep

    start = trimesh.transformations.rotation_matrix(np.radians(20), (0, 0, 1), (0, 0, 0))
    start[:3, 3] = 0.03, 0, 0.01
    world = world_of("mujoco", [block(friction=0.4)], [table(friction=0.4)], [start])
    outcome, _ = run(world, Sweep(EVERY, X, -0.02, 0.2, 0.1))
    turn = np.degrees(np.arctan2(outcome.poses[0, 1, 0], outcome.poses[0, 0, 0]))
    assert abs((turn + 45) % 90 - 45) < 3


def test_a_pushed_block_pushes_others():
    """Three blocks of 40 mm, of which the plane touches one, end in a row. They are 3 mu g / k behind the plane."""
    from mitsplat.physics.handling import Sweep

    places = [pose_at((x, y, 0.01)) for x, y in ((0.02, 0), (0.07, 0.004), (0.14, -0.004))]
    world = world_of("mujoco", [block()] * 3, [table()], places)
    outcome, _ = run(world, Sweep(np.ones(3, dtype=bool), X, -0.02, 0.14, 0.2))
    assert not outcome.rejection
    places = outcome.poses[np.argsort(outcome.poses[:, 0, 3]), :3, 3]
    assert places[0, 0] > 0.14 - 3 * 0.5 * GRAVITY / 1500
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert (gaps > 0.0395).all() and (gaps < 0.05).all()


def test_a_block_between_the_plane_and_a_wall_is_left_behind():
    """The plane passes it without pressing it into the wall."""
    from mitsplat.physics.bodies import Collider
    from mitsplat.physics.handling import Sweep

    wall = Collider(block().material, box=((0.02, 0.2, 0.1), pose_at((0.06, 0, 0.05))))  # its face is at x = 0.05
    world = world_of("mujoco", [block()], [table(), wall], [pose_at((0.02, 0, 0.01))])
    outcome, seen = run(world, Sweep(EVERY, X, -0.02, 0.1, 0.3))
    assert not outcome.rejection
    assert 0.01 < outcome.poses[0, 0, 3] < 0.0301
    assert seen[:, 1].max() < 0.0305


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_shaken_ground_moves_to_and_fro_below_a_block_without_friction(stepper):
    """Relative to the ground, the block moves by v / w (cos(w t) - 1): the sum of all forces is zero."""
    from mitsplat.physics.handling import Shaking

    world = on_table(stepper, friction=0.0)
    outcome, seen = run(world, Shaking(EVERY, X, 0.4))
    assert not outcome.rejection
    assert outcome.poses[0, 0, 3] == pytest.approx(0.02, abs=1e-3)
    assert np.abs(seen[seen[:, 0] > 1.98, 4]).max() < 2e-3
    rate = 2 * np.pi / 0.32
    shaken = (seen[:, 0] > 1) & (seen[:, 0] < 1.96)
    expected = 0.02 + 0.4 / rate * (np.cos(rate * (seen[:, 0] - 1)) - 1)
    np.testing.assert_allclose(seen[shaken, 1], expected[shaken], atol=2e-3)


def test_friction_carries_a_block_with_a_gently_shaken_ground():
    """It does not slide while the acceleration v w is below mu g."""
    from mitsplat.physics.handling import Shaking

    world = on_table("mujoco", friction=0.6)
    speed = 0.8 * 0.6 * GRAVITY / (2 * np.pi / 0.32)
    _, seen = run(world, Shaking(EVERY, X, speed))
    assert np.ptp(seen[:, 1]) < 5e-4


def drawn_motion(arrangement, count=400, **ranges):
    """Return the motion of balls in the middle of a region of 0.4 m."""
    from mitsplat.physics.handling import draw_handling

    ball = body_of(trimesh.creation.icosphere(1, 0.01))
    ranges = {"speed": (0.3, 0.6), "spin": (90.0, 360.0)} | ranges
    region = Region(min=(-0.2, -0.2, 0.1), max=(0.2, 0.2, 0.3))
    poses = np.tile(pose_at((0, 0, 0.2)), (count, 1, 1))
    members = [np.ones(count, dtype=bool)]
    return draw_handling([ball] * count, poses, [(region, arrangement)], members, np.random.default_rng(3), **ranges)


def test_tossed_objects_have_speeds_and_spins_of_the_ranges_in_all_directions():
    velocities = drawn_motion("tossed").velocities
    speeds, spins = np.linalg.norm(velocities, axis=2).T
    assert 0.3 <= speeds.min() < 0.32 and 0.58 < speeds.max() <= 0.6
    assert np.radians(90) <= spins.min() < np.radians(100) and np.radians(350) < spins.max() <= np.radians(360)
    np.testing.assert_allclose(velocities[:, 0, 2], 0, atol=1e-12)
    for directions in (velocities[:, 0] / speeds[:, None], velocities[:, 1] / spins[:, None]):
        assert np.abs(directions.mean(axis=0)).max() < 4 / np.sqrt(400)


def test_a_tossed_object_flies_by_its_ballistic_range():
    """It is v sqrt(2 h / g)."""
    motion = drawn_motion("tossed", count=1)
    ball = body_of(trimesh.creation.icosphere(1, 0.01))
    world = world_of("mujoco", [ball], [table(pose_at((0, 0, -10)))], [pose_at((0, 0, 0.2))])
    world.reset(np.stack([pose_at((0, 0, 0.2))]), motion.velocities)
    while world.poses[0, 2, 3] > 0:
        before = world.poses[0, :3, 3]
        world.advance()
    after = world.poses[0, :3, 3]
    flown = before + (after - before) * before[2] / (before[2] - after[2])
    speed = np.linalg.norm(motion.velocities[0, 0])
    assert np.linalg.norm(flown[:2]) == pytest.approx(speed * np.sqrt(2 * 0.2 / GRAVITY), rel=0.01)


def test_tipped_objects_leave_their_container_together():
    velocities = drawn_motion("tipped").velocities
    assert np.ptp(velocities, axis=0).max() == 0
    np.testing.assert_allclose(velocities[0, 0, 2], -np.linalg.norm(velocities[0, 0, :2]))
    assert not velocities[:, 1].any()


def test_tipped_objects_start_close_together(scene_data, write_scene):
    from mitsplat.physics.drop import drop_of

    scene_data["objects"] = [{"asset": "assets/nut", "count": 8}]
    drop, spread = drop_of(load_scene(write_scene(scene_data)), lambda text: None), {}
    for way in ("drop", "tipped"):
        positions = draw_start_poses(drop, (0,) * 8, np.random.default_rng(0), way)[:, :3, 3]
        spread[way] = np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean()
    assert spread["tipped"] < 0.05 < 0.08 < spread["drop"]


@pytest.mark.parametrize("way", WAYS)
def test_handled_objects_rest_and_replay(scene_data, write_scene, way):
    """The same layout again has equal values, and its replay ends in its poses."""
    scene_data["objects"] = [{"asset": "assets/nut", "count": 3}, {"asset": "assets/bolt"}]
    scene_data["settle"] = {"arrangement": way, "speed": [0.3, 0.3]}
    scene = load_scene(write_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    assert layout.certificate.rested and len(layout.instances) == 4
    assert (layout.certificate.time_to_rest > 1.0) == (way in ("pushed", "shaken"))
    again = settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)
    assert again.to_json() == layout.to_json()
    if way in ("tossed", "pushed"):
        *_, last, _ = replay_layout(scene, layout)
        for one, other in zip(last.layout.instances, layout.instances, strict=True):
            np.testing.assert_allclose(one.world_from_object[:3, 3], other.world_from_object[:3, 3], atol=5e-3)


def test_each_layout_draws_an_arrangement_of_a_list(scene_data, write_scene):
    """Each round has every entry of the list once, in random order; regions are drawn independently."""
    scene_data["settle"] = {"arrangement": ["drop", "pushed", "tossed", "drop"]}
    scene_data["regions"] = [
        {"name": "a", "min": [0, 0, 0.1], "max": [1, 1, 1], "arrangement": ["drop", "upright"]},
        {"name": "b", "min": [0, 0, 0.1], "max": [1, 1, 1], "arrangement": "scatter"},
    ]
    spec = load_scene(write_scene(scene_data)).spec
    drawn = np.array([draw_arrangements(spec, index) for index in range(400)])
    rounds = drawn[:, 0].reshape(100, 4)
    assert all(Counter(one) == {"drop": 2, "pushed": 1, "tossed": 1} for one in rounds)
    assert len({tuple(one) for one in rounds}) == 12
    both = np.mean((drawn[:, 0] == "drop") & (drawn[:, 1] == "upright"))
    assert abs(both - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 400)
    assert set(drawn[:, 2]) == {"scatter"}


@pytest.mark.parametrize(
    ("settle", "sentence"),
    [
        ({"arrangement": "tosed"}, "settle.arrangement: must be 'drop', 'tossed'"),
        ({"arrangement": []}, "settle.arrangement: must have 1 or more items"),
        ({"speed": [0.1, 0.3]}, "settle.speed: needs settle.arrangement tossed, tipped, pushed or shaken (got drop)"),
        ({"arrangement": ["drop", "pushed"], "spin": [0, 90]},
         "settle.spin: needs settle.arrangement tossed (got drop, pushed)"),
        ({"arrangement": "tossed", "speed": [0.6, 0.3]}, "settle.speed: must be [low, high] with low <= high"),
    ],
)  # fmt: skip
def test_wrong_arrangements_are_refused(scene_data, write_scene, settle, sentence):
    scene_data["settle"] = settle
    with pytest.raises(InputError, match=re.escape(sentence)):
        load_scene(write_scene(scene_data))


def test_objects_are_tried_alone_in_one_arrangement_of_random_poses(scene_data, write_scene):
    scene_data["objects"] = [{"asset": "assets/nut"}]
    scene_data["settle"] = {"arrangement": ["pushed", "upright", "drop", "upright"]}
    found = list(try_alone(load_scene(write_scene(scene_data))))
    assert found == [("nut", "pushed", []), ("nut", "upright", [])]
