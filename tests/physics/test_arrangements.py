"""Arrangements: poses of dropped, upright, packed and stacked objects in their regions."""

from __future__ import annotations

import re
from collections import Counter

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.asset import Asset
from mitsplat.dataset.preflight import layout_faults
from mitsplat.errors import InputError
from mitsplat.physics.placement import standing_turns
from mitsplat.physics.settle import settle_layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.contents import draw_regions
from tests.bodies import lowest, pose_at
from tests.conftest import box_asset

pytestmark = pytest.mark.usefixtures("physics")


def drop_layout(scene_data, write_scene, **changes):
    scene = load_scene(write_scene({**scene_data, **changes}))
    return scene, settle_layout(scene, 0, cached=False)


def placed_clearances(scene, layout):
    """Return the clearances of a layout's objects from one another and from the colliders."""
    from mitsplat.geometry.mesh_distance import all_clearances
    from mitsplat.physics.drop import drop_of

    drop = drop_of(scene, lambda text: None)
    placed = [drop.start_poses.placed(instance.asset, instance.world_from_object) for instance in layout.instances]
    return all_clearances(placed, [], reach=0.005)


BIN = {"name": "bin", "bin": {"size": [0.12, 0.09, 0.05], "position": [0, 0, 0.004]}, "visible": True}


def test_a_bin_has_five_walls_around_its_interior(scene_data, write_scene):
    """The volume of the walls is outer minus inner.

    The inside is empty, and the middle of its floor is where stated.
    """
    from mitsplat.geometry.mesh_distance import DistanceSurface

    scene_data["shapes"].append(BIN)
    mesh = load_scene(write_scene(scene_data)).shape_meshes[1]
    assert mesh.is_watertight
    outer, inner = 0.128 * 0.098 * 0.054, 0.12 * 0.09 * 0.05
    assert mesh.volume == pytest.approx(outer - inner, rel=1e-6)
    floor = np.array([0, 0, 0.004])
    inside = np.array([[0, 0, 0.001], [0.059, 0.044, 0.049], [-0.059, 0.044, 0.001]]) + floor
    walls = np.array([[0, 0, -0.002], [0.062, 0, 0.02], [0, -0.047, 0.049]]) + floor
    assert (DistanceSurface(mesh).signed_distances(np.array([*inside, *walls])) < 0).tolist() == [False] * 3 + [
        True
    ] * 3


def test_a_pile_fills_a_bin(scene_data, write_scene):
    """A dozen parts, more than fit in the region, come to rest in the bin; none rests beside it."""
    scene_data["shapes"].append(BIN)
    _, layout = drop_layout(
        scene_data,
        write_scene,
        objects=[{"asset": "assets/nut", "count": 7}, {"asset": "assets/bolt", "count": 5}],
        region={"min": [-0.04, -0.03, 0.02], "max": [0.04, 0.03, 0.06]},
        settle={"arrangement": "pile"},
    )
    assert len(layout.instances) == 12
    positions = np.array([instance.world_from_object[:3, 3] for instance in layout.instances]) - [0, 0, 0.004]
    assert (np.abs(positions[:, :2]) < [0.06, 0.045]).all()
    assert layout.certificate.collider_penetration < 3e-4
    assert layout.certificate.pair_penetration < 5e-4


@pytest.mark.extended
def test_a_pile_without_room_is_refused(scene_data, write_scene):
    with pytest.raises(InputError, match=r"region must be large enough .* settle\.arrangement pile"):
        drop_layout(
            scene_data,
            write_scene,
            objects=[{"asset": "assets/nut", "count": 150}],
            region={"min": [-0.02, -0.02, 0.02], "max": [0.02, 0.02, 0.06]},
            settle={"arrangement": "pile"},
        )


def test_scattered_objects_do_not_touch(scene_data, write_scene):
    scene, layout = drop_layout(
        scene_data,
        write_scene,
        objects=[{"asset": "assets/nut", "count": 6}, {"asset": "assets/bolt", "count": 3}],
        settle={"arrangement": "scatter"},
    )
    assert min(pair.distance for pair in placed_clearances(scene, layout)) > 5e-4


def test_a_stack_lies_on_its_largest_faces(scene_data, write_scene):
    """Box i of thickness h has its centre at (i + 1/2) h; all boxes have the same rotation and one vertical axis."""
    scene_data["objects"] = [{"asset": "assets/nut", "count": 4}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "stack"})
    poses = np.array(sorted((one.world_from_object for one in layout.instances), key=lambda pose: pose[2, 3]))
    np.testing.assert_allclose(poses[:, 2, 3], 0.01 * (np.arange(4) + 0.5), atol=3e-4)
    np.testing.assert_allclose(np.abs(poses[:, 2, 2]), 1.0, atol=1e-4)
    assert np.ptp(poses[:, :2, 3], axis=0).max() < 5e-4
    assert layout.certificate.surface_motion < 1e-4


@pytest.mark.parametrize("arrangement", ["stack", "upright", "tower", "packed"])
def test_placed_objects_start_below_the_lid_of_an_enclosure(scene_data, write_scene, arrangement):
    """Objects start at the region's top, where the lid is, but are placed on the ground before the first step."""
    scene_data["objects"] = [{"asset": "assets/nut", "count": 2}]
    scene_data["enclosure"] = {"margin": 0.05}
    settle = {"arrangement": arrangement, "attempts": 1}
    _, layout = drop_layout(scene_data, write_scene, settle=settle)
    assert layout.certificate.time_to_rest < 0.1


def test_upright_objects_keep_their_vertical(scene_data, write_scene):
    """Bolts of 10 x 10 x 50 mm, which would lie down when dropped, stand: the vertical is fixed, the yaw random."""
    scene_data["objects"] = [{"asset": "assets/bolt", "count": 5}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "upright"})
    poses = np.array([instance.world_from_object for instance in layout.instances])
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=1e-4)
    np.testing.assert_allclose(poses[:, 2, 3], 0.025, atol=3e-4)
    assert np.ptp(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])) > 0.5


def test_an_upright_ball_does_not_roll_away(scene_data, write_scene, tmp_path):
    """A ball that is put down has rolling friction from the start."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    Asset(name="ball", class_name="ball", splats=box_asset("ball").splats, mesh=ball, pieces=(ball,)).save(
        tmp_path / "assets/ball"
    )
    scene_data["objects"] = [{"asset": "assets/ball", "count": 2}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "upright", "stepper": "mujoco"})
    assert len(layout.instances) == 2
    for one in layout.instances:
        assert one.world_from_object[2, 2] > np.cos(np.radians(5))


def test_packed_objects_stand_in_rows(scene_data, write_scene):
    """Bolts of 10 x 10 mm, rotated by quarter turns up to 3 degrees off, take at most 11 mm by 11 mm.

    Gaps are 2 to 5 mm. At most five stand in a row of 60 mm. The number of rows is minimal, and no row is far from the
    next.
    """
    scene_data["objects"] = [{"asset": "assets/bolt", "count": 9}]
    scene_data["region"] = {"min": [-0.03, -0.03, 0.0], "max": [0.03, 0.03, 0.08]}
    scene, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "packed"})
    poses = np.array([instance.world_from_object for instance in layout.instances])
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=1e-4)
    turns = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert np.abs((turns + 45) % 90 - 45).max() < 3.1
    assert np.ptp(np.round(turns / 90)) > 0
    rows = np.round((poses[:, 1, 3] - poses[:, 1, 3].min()) / 0.014)
    assert sorted(np.unique_counts(rows).counts.tolist()) in ([1, 4, 4], [4, 5], [2, 3, 4])
    gaps = [pair.distance for pair in placed_clearances(scene, layout)]
    nearest = np.sort(np.linalg.norm(poses[:, None, :2, 3] - poses[None, :, :2, 3], axis=-1), axis=1)[:, 1]
    assert min(gaps) > 5e-4 and nearest.max() < 0.0165
    scene_data["objects"][0]["count"] = 40
    with pytest.raises(InputError, match=r"region must be large enough .* settle.arrangement packed"):
        drop_layout(scene_data, write_scene, settle={"arrangement": "packed"})


def test_a_tower_stands_on_its_widest_object(scene_data, write_scene):
    """A bolt of 50 mm stands on three nuts of 10 mm in any order of the list; each has its own random yaw."""
    scene_data["objects"] = [{"asset": "assets/bolt", "count": 1}, {"asset": "assets/nut", "count": 3}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "tower"})
    poses = {one.asset: [] for one in layout.instances}
    for one in layout.instances:
        poses[one.asset].append(one.world_from_object)
    bolt, nuts = poses[0][0], np.array(poses[1])
    np.testing.assert_allclose(np.sort(nuts[:, 2, 3]), [0.005, 0.015, 0.025], atol=3e-4)
    np.testing.assert_allclose(bolt[2, 3], 0.055, atol=3e-4)
    np.testing.assert_allclose(np.linalg.norm(nuts[:, :2, 3] - bolt[:2, 3], axis=1), 0, atol=0.017)
    assert np.ptp(np.arctan2(nuts[:, 1, 0], nuts[:, 0, 0])) > 0.1
    scene_data["objects"][1]["count"] = 30
    with pytest.raises(InputError, match=r"region must be large enough .* settle.arrangement tower"):
        drop_layout(scene_data, write_scene, settle={"arrangement": "tower"})


@pytest.mark.parametrize("arrangement", ["upright", "tower", "packed"])
def test_yaw_limits_the_direction_of_fronts(scene_data, write_scene, arrangement):
    scene_data["objects"] = [{"asset": "assets/nut", "count": 8}]
    settle = {"arrangement": arrangement, "yaw": [80, 110]}
    _, layout = drop_layout(scene_data, write_scene, settle=settle)
    poses = np.array([instance.world_from_object for instance in layout.instances])
    turns = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert turns.min() > 79.9 and turns.max() < 110.1 and np.ptp(turns) > 5


def test_yaw_is_refused_for_dropped_objects(scene_data, write_scene):
    scene_data["settle"] = {"arrangement": "pile", "yaw": [0, 90]}
    with pytest.raises(InputError, match=r"settle.yaw: needs settle.arrangement upright, tower or packed \(got pile\)"):
        load_scene(write_scene(scene_data))
    scene_data["settle"] = {"arrangement": "pile", "turned_over": 0.2}
    with pytest.raises(InputError, match=r"settle.turned_over: needs settle.arrangement upright, tower or packed"):
        load_scene(write_scene(scene_data))


@pytest.mark.parametrize(
    ("mesh", "quarters"),
    [
        (trimesh.creation.box((0.08, 0.03, 0.05)), [1, 2, 3]),
        (trimesh.creation.box((0.20, 0.01, 0.05)), [2]),  # a thin board does not stand on its short edge
        (trimesh.creation.cylinder(0.033, 0.084, sections=64), [2]),
        (trimesh.creation.cone(0.03, 0.09, sections=64), []),
        (trimesh.creation.icosphere(4, 0.03), []),
    ],
    ids=["box", "board", "can", "cone", "ball"],
)
def test_standing_turns_are_those_of_stable_sides(mesh, quarters):
    turns = [Rotation.from_matrix(turn).as_euler("YXZ", degrees=True)[0] for turn in standing_turns(mesh.vertices)]
    np.testing.assert_allclose(np.mod(turns, 360), np.multiply(quarters, 90.0), atol=1e-9)


@pytest.mark.parametrize("arrangement", ["upright", "tower", "packed"])
def test_turned_over_places_objects_on_other_sides(scene_data, write_scene, tmp_path, arrangement):
    box_asset("block", (0.05, 0.03, 0.04)).save(tmp_path / "assets/block")
    scene_data["objects"] = [{"asset": "assets/block", "count": 3}]
    settle = {"arrangement": arrangement, "yaw": [-10, 10], "turned_over": 0.8}
    _, layout = drop_layout(scene_data, write_scene, settle=settle)
    poses = np.array([instance.world_from_object for instance in layout.instances])
    assert (poses[:, 1, 1] > np.cos(np.radians(11))).all()  # yaw stays in its range
    ups = {round(np.degrees(np.arctan2(pose[0, 2], pose[2, 2])) / 90) % 4 for pose in poses}
    assert ups - {0}


def test_objects_with_given_poses_stay_there(scene_data, write_scene):
    """A nut with a given pose, rotated by 30 degrees, keeps it.

    A nut with a pose above it comes down by its clearance. Other objects avoid both.
    """
    given = [
        {"position": [0.05, 0.02, 0.005], "rotate": [0, 0, 30]},
        {"position": [0.05, 0.02, 0.0153], "rotate": [0, 0, 30]},
    ]
    scene_data["objects"] = [{"asset": "assets/nut", "poses": given}, {"asset": "assets/bolt", "count": 2}]
    _, layout = drop_layout(scene_data, write_scene)
    assert len(layout.instances) == 4
    for i, instance in enumerate(layout.instances[:2]):
        expected = pose_at((0.05, 0.02, 0.005 + 0.01 * i), Rotation.from_euler("z", 30, degrees=True))
        np.testing.assert_allclose(instance.world_from_object, expected, atol=5e-4)
    scene_data["objects"][0]["count"] = 2
    with pytest.raises(InputError, match=r"objects\[0\].count: must not be given together with poses"):
        load_scene(write_scene(scene_data))


@pytest.mark.parametrize(
    ("height", "other", "overlap"), [(0.002, "collider 'table'", "3.0"), (0.013, r"objects\[0\].poses\[1\]", "2.0")]
)
def test_given_poses_must_not_overlap(scene_data, write_scene, height, other, overlap):
    """Refuses a nut of 10 mm whose centre is 2 mm above the table, or 8 mm above that of the nut below."""
    given = [{"position": [0.05, 0.02, height], "rotate": [0, 0, 30]}, {"position": [0.05, 0.02, 0.005]}]
    given = given if height > 0.005 else given[:1]
    scene_data["objects"] = [{"asset": "assets/nut", "poses": given}]
    match = rf"scene.yaml: objects\[0\].poses\[0\]: must not start in {other} \(got an overlap of {overlap} mm"
    with pytest.raises(InputError, match=match):
        drop_layout(scene_data, write_scene)


@pytest.fixture
def shelf(scene_data):
    """Return a scene of a table, a board above it and a bin beside it, with three object entries."""
    scene_data["shapes"] += [
        {"name": "board", "box": {"size": [0.5, 0.5, 0.02], "position": [0, 0, 0.29]}},
        {"name": "bin", "bin": {"size": [0.15, 0.15, 0.06], "position": [0.4, 0, 0.004]}, "visible": True},
    ]
    scene_data["regions"] = [
        {"name": "board", "min": [-0.2, -0.2, 0.32], "max": [0.2, 0.2, 0.5], "arrangement": "upright",
         "enclosure": {"floor": 0.3}},
        {"name": "bin", "min": [0.33, -0.07, 0.02], "max": [0.47, 0.07, 0.06], "arrangement": "pile"},
    ]  # fmt: skip
    scene_data["objects"] = [
        {"asset": "assets/nut", "count": 3},
        {"asset": "assets/bolt", "count": 2, "region": "bin"},
        {"asset": "assets/nut", "count": 2, "region": ["main", "board"]},
    ]
    return {**scene_data, "enclosure": {"margin": 0.03}}


def test_each_object_lies_in_its_region(shelf, write_scene):
    """Objects lie upright on the board at 0.3 m, on the table below, and within the walls of the bin."""
    scene = load_scene(write_scene(shelf))
    seen = set()
    for index in range(2):
        layout = settle_layout(scene, index, cached=False)
        regions = draw_regions(scene.spec, index)
        assert regions[3:5] == (2, 2) and set(regions[5:]) <= {0, 1}
        seen |= set(regions)
        for instance, region in zip(layout.instances, regions, strict=True):
            mesh, pose = scene.assets[instance.asset].mesh, instance.world_from_object
            low = lowest(mesh, pose)
            if region == 1:
                assert low == pytest.approx(0.3, abs=5e-4)
                assert pose[2, 2] > 0.999
            elif region == 0:
                assert -5e-4 < low < 0.25 and (np.abs(pose[:2, 3]) < 0.25).all()
            else:
                assert 0.0 < low < 0.06 and np.abs(pose[:2, 3] - (0.4, 0)).max() < 0.075
    assert seen == {0, 1, 2}
    assert [shape.name for shape in scene.spec.shapes[-5:]] == [
        f"enclosure board {side}" for side in ("-x", "+x", "-y", "+y", "lid")
    ]


def test_objects_are_drawn_among_regions_by_floor_area(shelf, write_scene):
    shelf["output"]["layouts"] = 200
    spec = load_scene(write_scene(shelf)).spec
    drawn = Counter(region for index in range(200) for region in draw_regions(spec, index)[:3])
    areas = np.array([0.16, 0.16, 0.14 * 0.14])
    expected = 600 * areas / areas.sum()
    assert all(abs(drawn[i] - expected[i]) < 4 * expected[i] ** 0.5 for i in range(3))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"objects": [{"asset": "assets/nut", "region": "shelf"}]},
         "objects[0].region: must be one of the regions, main, board, bin (got 'shelf')"),
        ({"objects": [{"asset": "assets/nut", "region": []}]}, "objects[0].region: must name at least one region"),
        ({"objects": [{"asset": "assets/nut", "region": "bin", "poses": [{"position": [0, 0, 1]}]}]},
         "objects[0].region: must not be given together with poses"),
        ({"objects": [{"asset": "assets/nut", "scale": 6}]},
         "objects[0].asset: asset 'nut' must fit into region 'bin' of 0.14 x 0.14 m (it measures 0.12 x 0.18 m)"),
        ({"regions": [{"name": "main", "min": [0, 0, 0], "max": [1, 1, 1]}]},
         "regions[0].name: must be unique (got 'main' again)"),
        ({"regions": [{"name": "a", "min": [0, 0, 0], "max": [1, 1, 1], "enclosure": {"floor": 2}}]},
         "regions[0].enclosure.floor: must be below the region's top at 1 m (got 2)"),
    ],
)  # fmt: skip
def test_wrong_regions_are_refused(shelf, write_scene, changes, sentence):
    shelf["objects"] = [shelf["objects"][0]]
    with pytest.raises(InputError, match=re.escape(sentence)):
        load_scene(write_scene({**shelf, **changes}))


def test_a_region_without_a_collider_below_is_a_fault(shelf, write_scene):
    shelf["regions"][1] |= {"min": [0.9, 0.9, 0.02], "max": [1.1, 1.1, 0.2]}
    found = [fault.text for fault in layout_faults(load_scene(write_scene(shelf)))]
    assert found == ["regions[1]: no collider is below it, so all objects fall forever"]


def test_a_bin_in_millimetres_is_refused_with_the_unit_of_its_size(scene_data, write_scene):
    scene_data["shapes"] = [{"name": "bin", "bin": {"size": [260, 200, 60], "thickness": 4}}]
    (fault,) = layout_faults(load_scene(write_scene(scene_data)))
    assert "got 268 m" in fault.text and fault.remedy == "correct its size, in metres, or set collider: false"
