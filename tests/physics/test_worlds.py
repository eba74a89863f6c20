"""Simulation of rigid bodies with both steppers against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.bodies import EVERYWHERE, GRAVITY, STEPPERS, body_of, centres, lowest, pose_at, run_until, table, world_of

pytestmark = pytest.mark.usefixtures("physics")


def test_mujoco_makes_the_hulls_that_newton_analyses(monkeypatch):
    """The pieces of bodies and colliders give the same bytes of MuJoCo's model, as meshes and as convex hulls."""
    import mujoco

    from mitsplat.physics import mujoco_world
    from mitsplat.physics.bodies import Collider
    from mitsplat.physics.friction import ContactMaterial

    def model_bytes():
        model = mujoco_world.MujocoWorld([body], [ground], timestep=0.002)._model
        found = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, found)
        return found.tobytes()

    body = body_of(trimesh.creation.icosphere(1, 0.02), trimesh.creation.box((0.05, 0.01, 0.01)))
    ground = Collider(ContactMaterial(), (trimesh.creation.box((1.0, 1.0, 0.1)),))
    build = mujoco_world.build_model
    as_meshes = model_bytes()
    monkeypatch.setattr(mujoco_world, "build_model", lambda *args: build(*args[:3], True))
    assert model_bytes() == as_meshes


@pytest.mark.parametrize("stepper", STEPPERS)
def test_free_fall_equals_its_closed_form(stepper):
    """z = z0 - g t^2 / 2 and v = -g t; semi-implicit steps of h add g h t / 2."""
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    world = world_of(stepper, [body_of(box)], [table()], [pose_at((0, 0, 2.0))])
    run_until(world, 0.4)
    assert world.velocities[0, 0, 2] == pytest.approx(-GRAVITY * world.time, rel=1e-3)
    fallen = GRAVITY * world.time**2 / 2 + GRAVITY * 0.002 * world.time / 2
    assert 2.0 - world.poses[0, 2, 3] == pytest.approx(fallen, rel=1e-3)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_poses_are_those_of_the_mesh_frame(stepper):
    """A body spinning in free fall rotates about its centre of mass, which follows the parabola.

    Its origin does not.
    """
    box = trimesh.creation.box((0.02, 0.04, 0.06)).apply_translation((0.3, -0.2, 0.1))
    start = pose_at((0, 0, 2), Rotation.from_rotvec((0.4, -1.0, 0.3)))
    world = world_of(stepper, [body_of(box)], [table()], [start])
    np.testing.assert_allclose(world.poses[0], start, atol=1e-6)
    run_until(world, 0.2)
    centre = (world.poses[0] @ [0.3, -0.2, 0.1, 1])[:3] - (start @ [0.3, -0.2, 0.1, 1])[:3]
    np.testing.assert_allclose(centre, (0, 0, -GRAVITY * 0.2 * 0.202 / 2), atol=2e-5)
    np.testing.assert_allclose(world.poses[0, :3, :3], start[:3, :3], atol=1e-4)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_small_parts_come_to_rest_on_the_table(stepper):
    """A box of 10 mm lies flat, one starts on its edge, a washer-thin disc on its rim; one has its origin elsewhere."""
    from mitsplat.physics.rest import run_to_rest

    box = trimesh.creation.box((0.010, 0.010, 0.010))
    disc = trimesh.creation.cylinder(radius=0.006, height=0.0015, sections=32)
    slab = trimesh.creation.box((0.15, 0.06, 0.012)).apply_translation((0.5, 0.5, 0.5))
    meshes = [box, box, disc, slab]
    poses = [
        pose_at((0, 0, 0.02)),
        pose_at((0.1, 0, 0.02), Rotation.from_euler("x", 40, degrees=True)),
        pose_at((0.2, 0, 0.45), Rotation.from_euler("xy", (75, 10), degrees=True)),
        pose_at((-0.7, -0.7, -0.4), Rotation.from_euler("z", 5, degrees=True)),
    ]
    world = world_of(stepper, [body_of(mesh) for mesh in meshes], [table()], poses)
    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    for mesh, pose, thickness in zip(meshes, outcome.poses, (0.01, 0.01, 0.0015, 0.012), strict=True):
        assert lowest(mesh, pose) == pytest.approx(0.0, abs=3e-4)
        heights = (mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2]
        assert np.ptp(heights) == pytest.approx(thickness, abs=3e-4)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    first = outcome.poses
    run_until(world, world.time + 1.0)
    np.testing.assert_allclose(world.poses[:, :3, 3], first[:, :3, 3], atol=1e-4)


def test_stepping_mujoco_in_stages_changes_no_bit(monkeypatch):
    """With MuJoCo's friction, separate calls of the stages give the same bits as mj_step."""
    import mujoco

    from mitsplat.physics import mujoco_world as physics

    box = trimesh.creation.box((0.02, 0.03, 0.01))
    poses = [pose_at((0.004 * i, 0, 0.02 + 0.03 * i), Rotation.from_rotvec((i, 1, 0.3))) for i in range(5)]
    ours, own = (world_of("mujoco", [body_of(box)] * 5, [table(friction=0.4)], poses) for _ in range(2))

    def larger(first, second):
        slide, spin, roll = np.maximum(first, second).T
        return np.maximum(np.stack([slide, slide, spin, roll, roll], axis=1), 1e-5)

    monkeypatch.setattr(physics, "pair_friction", larger)
    run_until(ours, 0.6)
    mujoco.mj_step(own._model, own._data, nstep=300)
    assert own._data.ncon > 8
    np.testing.assert_array_equal(ours._data.qpos, own._data.qpos)
    np.testing.assert_array_equal(ours._data.qvel, own._data.qvel)


def test_a_full_contact_buffer_is_an_error():
    from mitsplat.physics.rest import CONTACT_OVERFLOW, run_to_rest

    boxes = [body_of(trimesh.creation.box((0.03, 0.03, 0.03)))] * 4
    poses = [pose_at((0.1 * i, 0, 0.016)) for i in range(4)]
    world = world_of("warp", boxes, [table()], poses, capacity=0.001)
    assert run_to_rest(world, max_time=1.0, bounds=EVERYWHERE).rejection == CONTACT_OVERFLOW


def test_worlds_in_one_simulation_do_not_interact():
    """A world falls as it does alone while a second world with more pieces runs on the same kernels."""
    from mitsplat.physics.bodies import all_pieces
    from mitsplat.physics.contacts import ContactFinder
    from mitsplat.physics.warp_world import WarpWorld

    few = [body_of(trimesh.creation.box((0.02, 0.03, 0.01)))] * 2
    many = [body_of(trimesh.creation.icosphere(subdivisions=1, radius=0.01))] * 6
    poses = np.stack([pose_at((0.05 * i, 0, 0.03), Rotation.from_euler("xy", (20 * i, 35))) for i in range(6)])

    def made(bodies, finder):
        world = WarpWorld(bodies, [table()], timestep=0.002, capacity=1.0, contact_finder=finder)
        world.reset(poses[: len(bodies)])
        return world

    alone = made(few, None)
    run_until(alone, 0.3)
    finder = ContactFinder(lambda: all_pieces([*few, *many], [table()]))
    first, second = made(few, finder), made(many, finder)
    while first.time < 0.3 - 1e-9:
        first.advance()
        second.advance()
    np.testing.assert_array_equal(first.poses, alone.poses)
    assert (second.poses[:, 2, 3] > 0.009).all()


@pytest.mark.parametrize(("stepper", "depth"), [("warp", 1e-4), ("mujoco", 2e-4)])
def test_light_parts_carry_a_plate_a_hundred_times_as_heavy(stepper, depth):
    """A plate a hundred times as heavy rests on two nuts. Its contacts and theirs are at most as deep as stated."""
    from mitsplat.physics.rest import run_to_rest

    nut, plate = trimesh.creation.box((0.01, 0.01, 0.005)), trimesh.creation.box((0.15, 0.05, 0.0135))
    bodies = [body_of(nut), body_of(nut), body_of(plate)]
    assert bodies[2].mass.mass > 100 * bodies[0].mass.mass
    poses = [pose_at((-0.05, 0, 0.003)), pose_at((0.05, 0, 0.003)), pose_at((0, 0, 0.014))]
    world = world_of(stepper, bodies, [table()], poses)
    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    first, second, above = (lowest(mesh, pose) for mesh, pose in zip((nut, nut, plate), outcome.poses, strict=True))
    assert [first, second] == pytest.approx([0.0, 0.0], abs=depth)
    assert above == pytest.approx((first + second) / 2 + 0.005, abs=depth)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_loads_press_light_bodies_by_less_than_certificates_allow(stepper):
    """Pins on their side sink by at most 0.3 mm under up to 400 times their weight, the end of a heavy plate."""
    pin = trimesh.creation.cylinder(radius=0.003, height=0.02, sections=24)
    pin.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    ratios = np.array([1, 50, 100, 200, 400])
    body = body_of(pin)
    poses = [pose_at((0.05 * i, 0, 0.003)) for i in range(len(ratios))]
    world = world_of(stepper, [body] * len(ratios), [table()], poses)
    forces = np.zeros((len(ratios), 2, 3))
    forces[:, 0, 2] = -(ratios - 1) * body.mass.mass * GRAVITY
    world.set_forces(forces)
    run_until(world, 0.5)
    sunk = [-lowest(pin, pose) for pose in world.poses]
    run_until(world, 1.0)
    assert max(sunk) < 3e-4
    np.testing.assert_allclose([-lowest(pin, pose) for pose in world.poses], sunk, atol=5e-6)


@pytest.mark.parametrize("stepper", ["mujoco", pytest.param("warp", marks=pytest.mark.extended)])
def test_a_stack_of_five_drifts_by_less_than_a_tenth_of_a_millimetre(stepper):
    """Drift below 0.1 mm in 5 s."""
    box = trimesh.creation.box((0.04, 0.04, 0.02))
    poses = [pose_at((0, 0, 0.01 + 0.0201 * i)) for i in range(5)]
    world = world_of(stepper, [body_of(box)] * 5, [table()], poses)
    run_until(world, 0.5)
    before = world.poses[:, :3, 3]
    run_until(world, 5.5)
    assert np.linalg.norm(world.poses[:, :3, 3] - before, axis=1).max() < 1e-4


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_ball_rests_inside_a_cup(stepper):
    """The floor of the cup is 6 mm thick: the ball's centre rests one radius above it, not above the rim."""
    from mitsplat.physics.bodies import Collider
    from mitsplat.physics.friction import ContactMaterial
    from mitsplat.physics.rest import run_to_rest

    wall = [(0.0275, (0.005, 0.06)), (-0.0275, (0.005, 0.06))]
    cup = [trimesh.creation.box((0.06, 0.06, 0.006)).apply_translation((0, 0, 0.003))]
    cup += [trimesh.creation.box((*size, 0.024)).apply_translation((x, 0, 0.018)) for x, size in wall]
    cup += [trimesh.creation.box((*size[::-1], 0.024)).apply_translation((0, y, 0.018)) for y, size in wall]
    ball = trimesh.creation.icosphere(3, 0.012)
    world = world_of(
        stepper, [body_of(ball)], [Collider(ContactMaterial(), pieces=tuple(cup)), table()], [pose_at((0.005, 0, 0.06))]
    )
    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    assert lowest(ball, outcome.poses[0]) == pytest.approx(0.006, abs=5e-4)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_thrown_bodies_follow_their_closed_form(stepper):
    """The position after t is r + v t - g t (t + h) / 2 with semi-implicit steps of h.

    Spin w about a principal axis is constant. MuJoCo integrates the frame's origin: at a distance a from it, the centre
    of mass is off by the centripetal h w^2 a t / 2.
    """
    box = trimesh.creation.box((0.02, 0.04, 0.06)).apply_translation((0.1, 0, 0))
    start = pose_at((0, 0, 1.0), Rotation.from_euler("z", 30, degrees=True))
    velocities = np.array([[[0.5, -0.3, 1.0], [0, 0, 4.0]]])
    world = world_of(stepper, [body_of(box)], [table()], [start])
    centre = centres(world)[0]
    world.reset(start[None], velocities)
    np.testing.assert_allclose(world.velocities, velocities, atol=1e-5)
    run_until(world, 0.2)
    fallen = np.array([0, 0, GRAVITY * 0.2 * 0.202 / 2])
    np.testing.assert_allclose(
        centres(world)[0], centre + velocities[0, 0] * 0.2 - fallen, atol=0.002 * 4**2 * 0.1 * 0.2 / 2
    )
    turned = Rotation.from_euler("z", np.radians(30) + 4.0 * 0.2).as_matrix()
    np.testing.assert_allclose(world.poses[0, :3, :3], turned, atol=1e-3)


def test_warnings_of_mujoco_leave_no_file(tmp_path, monkeypatch):
    import mujoco

    monkeypatch.chdir(tmp_path)
    world = world_of("mujoco", [body_of(trimesh.creation.box((0.02, 0.02, 0.02)))], [table()], [pose_at((0, 0, 0.1))])
    world._data.qvel[:] = np.nan
    mujoco.mj_step(world._model, world._data)
    assert world._data.warning[mujoco.mjtWarning.mjWARN_BADQVEL].number == 1
    assert list(tmp_path.iterdir()) == []
