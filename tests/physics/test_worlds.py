"""Rigid body simulation against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.bodies import STEPPERS, body_of, lowest, pose_at, table, world_of

GRAVITY = 9.81
pytestmark = pytest.mark.usefixtures("physics")
EVERYWHERE = np.full(3, -1e3), np.full(3, 1e3)


def test_mujoco_makes_the_hulls_that_newton_analyses(monkeypatch):
    """The pieces of bodies and colliders give the same bytes of MuJoCo's model, as meshes and as convex hulls."""
    import mujoco

    from mitsplat.physics import worlds

    def model_bytes():
        model = worlds.MujocoWorld([body], [ground], timestep=0.002)._model
        found = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, found)
        return found.tobytes()

    body = body_of(trimesh.creation.icosphere(1, 0.02), trimesh.creation.box((0.05, 0.01, 0.01)))
    ground, build = (
        worlds.Collider(worlds.ContactMaterial(), (trimesh.creation.box((1.0, 1.0, 0.1)),)),
        worlds._build_model,
    )
    as_meshes = model_bytes()
    monkeypatch.setattr(worlds, "_build_model", lambda *args: build(*args[:3], True))
    assert model_bytes() == as_meshes


def run_until(world, time):
    while world.time < time - 1e-9:
        world.advance()


def centres(world):
    """Return the centres of mass [m], shape (N, 3)."""
    return np.array([(pose @ [*body.mass.centre, 1])[:3] for body, pose in zip(world.bodies, world.poses, strict=True)])


def energy(world):
    """Return the kinetic and potential energy of the bodies [J]."""
    total = 0.0
    for body, pose, centre, (speed, spin) in zip(
        world.bodies, world.poses, centres(world), world.velocities, strict=True
    ):
        inertia = pose[:3, :3] @ body.mass.inertia @ pose[:3, :3].T
        total += body.mass.mass * (GRAVITY * centre[2] + speed @ speed / 2) + spin @ inertia @ spin / 2
    return total


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


def test_stepping_mujoco_in_stages_changes_no_bit(monkeypatch):
    """With MuJoCo's friction, separate calls of the stages give the same bits as mj_step."""
    import mujoco

    from mitsplat.physics import worlds as physics

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
    from mitsplat.physics.contacts import ContactFinder
    from mitsplat.physics.worlds import WarpWorld, all_pieces

    few = [body_of(trimesh.creation.box((0.02, 0.03, 0.01)))] * 2
    many = [body_of(trimesh.creation.icosphere(subdivisions=1, radius=0.01))] * 6
    poses = np.stack([pose_at((0.05 * i, 0, 0.03), Rotation.from_euler("xy", (20 * i, 35))) for i in range(6)])

    def made(bodies, finder):
        world = WarpWorld(bodies, [table()], timestep=0.002, capacity=1.0, contact_finder=finder)
        world.reset(poses[: len(bodies)])
        return world

    alone = made(few, None)
    run_until(alone, 0.3)
    finder = ContactFinder(all_pieces([*few, *many], [table()]))
    first, second = made(few, finder), made(many, finder)
    while first.time < 0.3 - 1e-9:
        first.advance()
        second.advance()
    np.testing.assert_array_equal(first.poses, alone.poses)
    assert (second.poses[:, 2, 3] > 0.009).all()


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


def test_light_parts_carry_a_plate_a_hundred_times_as_heavy():
    """A plate a hundred times as heavy rests on two nuts, which sink by at most 0.1 mm."""
    from mitsplat.physics.rest import run_to_rest

    nut, plate = trimesh.creation.box((0.01, 0.01, 0.005)), trimesh.creation.box((0.15, 0.05, 0.0135))
    bodies = [body_of(nut), body_of(nut), body_of(plate)]
    assert bodies[2].mass.mass > 100 * bodies[0].mass.mass
    poses = [pose_at((-0.05, 0, 0.003)), pose_at((0.05, 0, 0.003)), pose_at((0, 0, 0.014))]
    world = world_of("warp", bodies, [table()], poses)
    outcome = run_to_rest(world, max_time=6.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    assert [lowest(mesh, pose) for mesh, pose in zip((nut, nut, plate), outcome.poses, strict=True)] == pytest.approx(
        [0.0, 0.0, 0.005], abs=1e-4
    )


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
    from mitsplat.physics.worlds import Collider, ContactMaterial

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


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_ball_rests_inside_a_cup(stepper):
    """The floor of the cup is 6 mm thick: the ball's centre rests one radius above it, not above the rim."""
    from mitsplat.physics.rest import run_to_rest
    from mitsplat.physics.worlds import Collider, ContactMaterial

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


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_block_without_friction_stays_where_it_is(stepper):
    """At a sliding friction of 2e-5, rolling friction made the solver diverge in single precision after 0.9 s."""
    block = trimesh.creation.box((0.04, 0.03, 0.02))
    world = world_of(stepper, [body_of(block, friction=0.0)], [table(friction=0.0)], [pose_at((0, 0, 0.01))])
    while world.time < 1.2:
        world.advance()
    np.testing.assert_allclose(world.poses[0], pose_at((0, 0, 0.01)), atol=1e-5)
    np.testing.assert_allclose(world.velocities, 0, atol=1e-4)


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
    """A block without friction slides at v for the time t = 1.5 s; with drag, it stops after another v T, T = 0.2 s."""
    from mitsplat.physics.rest import run_to_rest

    block, speed = trimesh.creation.box((0.04, 0.04, 0.01)), 0.4
    world = world_of(stepper, [body_of(block, friction=0.0)], [table(friction=0.0)], [pose_at((-0.4, 0, 0.005))])
    velocities = np.zeros((1, 2, 3))
    velocities[0, 0, 0] = speed
    world.reset(world.poses, velocities)
    outcome = run_to_rest(world, max_time=4.0, bounds=EVERYWHERE)
    assert outcome.rejection == ""
    assert outcome.poses[0, 0, 3] + 0.4 == pytest.approx(speed * (1.5 + 0.2), rel=0.01)
    # It is slower than 0.1 mm in 0.25 s.
    assert outcome.time == pytest.approx(1.5 + 0.2 * np.log(speed / 4e-4), abs=0.15)


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


def test_warnings_of_mujoco_leave_no_file(tmp_path, monkeypatch):
    import mujoco

    monkeypatch.chdir(tmp_path)
    world = world_of("mujoco", [body_of(trimesh.creation.box((0.02, 0.02, 0.02)))], [table()], [pose_at((0, 0, 0.1))])
    world._data.qvel[:] = np.nan
    mujoco.mj_step(world._model, world._data)
    assert world._data.warning[mujoco.mjtWarning.mjWARN_BADQVEL].number == 1
    assert list(tmp_path.iterdir()) == []
