"""Settled layouts: clearances, randomness, caching and determinism."""

from __future__ import annotations

import ast
import gc
import hashlib
import json
import shutil
import sys
from dataclasses import replace
from itertools import combinations
from weakref import ref

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.physics.settle import replay_layout, settle_layout, settle_layouts
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.layout_surroundings import draw_surroundings
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.spec.shape_spec import Region
from tests.bodies import STEPPERS, draw_start_poses, lowest, pose_at
from tests.conftest import box_asset

pytestmark = pytest.mark.usefixtures("physics")


def test_clearance_of_boxes_equals_its_closed_form():
    from mitsplat.geometry.mesh_distance import DistanceSurface, PlacedSurface, clearance

    box = DistanceSurface(trimesh.creation.box((0.02, 0.02, 0.02)))
    here = PlacedSurface("here", box)

    def from_here(pose):
        return clearance(here, PlacedSurface("there", box, pose), reach=0.005).distance

    assert from_here(pose_at((0.023, 0, 0))) == pytest.approx(0.003, abs=1e-6)
    assert from_here(pose_at((0.018, 0.005, 0.005))) == pytest.approx(-0.002, abs=1e-6)
    assert from_here(pose_at((0.05, 0, 0))) == 0.005
    # Edges cross with no vertex inside: each is sqrt(2) cm from its centre, less 1 mm.
    crossed = Rotation.from_euler("xz", (45, 90), degrees=True)
    upright = PlacedSurface("edge up", box, pose_at((0, 0, 0), Rotation.from_euler("x", 45, degrees=True)))
    above = PlacedSurface("edge down", box, pose_at((0, 0, 2 * 0.01 * np.sqrt(2) - 0.001), crossed))
    assert clearance(upright, above, reach=0.005).distance == pytest.approx(-0.001 / np.sqrt(2), rel=0.1)


def test_drawn_poses_are_uniform_and_do_not_overlap(scene_data, write_scene):
    from mitsplat.geometry.mesh_distance import all_clearances
    from mitsplat.physics.drop import drop_of

    drop = drop_of(load_scene(write_scene(scene_data)), lambda text: None)
    rng = np.random.default_rng(0)
    rotations = []
    for _ in range(300):
        poses = draw_start_poses(drop, (0, 0, 1), rng)
        rotations.append(poses[:, :3, :3])
        placed = [drop.start_poses.placed(asset, pose) for asset, pose in zip((0, 0, 1), poses, strict=True)]
        bounds = np.stack([item.bounds for item in placed])
        assert (bounds >= np.array(scene_data["region"]["min"]) - 1e-9).all()
        assert (bounds <= np.array(scene_data["region"]["max"]) + 1e-9).all()
        assert (
            min(pair.distance for pair in all_clearances(placed, drop.static_scenes[0].obstacles, reach=0.005)) > 0.0009
        )
    rotations = np.concatenate(rotations)
    # Haar measure: every column is uniform on the sphere, so its z is uniform (Archimedes); the angle t has
    # density (1 - cos t) / pi.
    for column in range(3):
        assert kstest(rotations[:, 2, column], "uniform", args=(-1, 2)).pvalue > 1e-3
    angles = Rotation.from_matrix(rotations).magnitude()
    assert kstest(angles, lambda t: (t - np.sin(t)) / np.pi).pvalue > 1e-3


def test_long_rods_start_together_although_their_bounding_boxes_fill_the_region():
    """Ten rods of 150 x 3 x 3 mm start in a region of 160 mm without contact, but their bounding boxes overlap."""
    from mitsplat.geometry.mesh_distance import DistanceSurface, PlacedSurface, all_clearances
    from mitsplat.physics.placement import Item, draw_poses

    rod = trimesh.creation.box((0.003, 0.003, 0.15))
    item = Item(0, DistanceSurface(rod), np.array(rod.vertices))
    region = Region(min=(-0.08, -0.08, 0.0), max=(0.08, 0.08, 0.16))
    poses = draw_poses([item] * 10, (), [(region, "drop")], np.random.default_rng(1))
    placed = [PlacedSurface("", item.surface, pose) for pose in poses]
    assert min(pair.distance for pair in all_clearances(placed, (), reach=0.005)) >= 1e-3 - 1e-6
    overlaps = [
        ((one.bounds[0] < other.bounds[1]) & (other.bounds[0] < one.bounds[1])).all()
        for one, other in combinations(placed, 2)
    ]
    assert sum(overlaps) > 5


def test_a_layout_satisfies_its_certificate(scene_data, write_scene):
    scene = load_scene(write_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    names = [scene.class_names[instance.class_index] for instance in layout.instances]
    assert [instance.id for instance in layout.instances] == list(range(1, len(names) + 1))
    assert names.count("bolt") == 1
    assert 1 <= names.count("nut") <= 2
    for instance in layout.instances:
        mesh = scene.assets[instance.asset].mesh
        assert lowest(mesh, instance.world_from_object) == pytest.approx(0.0, abs=3e-4)
    certificate = layout.certificate
    assert certificate.rested
    assert certificate.surface_motion < 5e-4
    assert certificate.inside
    assert not certificate.overflow
    assert certificate.collider_penetration < 3e-4
    assert certificate.pair_penetration < 5e-4
    assert certificate.support_gap < 1e-3
    assert certificate.standoff < 1e-6  # a box is its own convex piece
    assert certificate.attempts == len(certificate.refused) + 1


def test_objects_that_rebound_rest_as_still_as_others(scene_data, write_scene, tmp_path):
    """With a restitution of 0.6, motion, penetration and gaps at rest are within the limits of objects without."""
    scene_data["shapes"][0]["restitution"] = 0.6
    path = write_scene(scene_data)
    for name in ("nut", "bolt"):
        folder = tmp_path / "assets" / name
        replace(Asset.load(folder), restitution=0.6).save(folder)
    certificate = settle_layout(load_scene(path), 0, cached=False).certificate
    assert certificate.surface_motion < 5e-4
    assert certificate.collider_penetration < 3e-4
    assert certificate.support_gap < 1e-3


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_replay_ends_in_the_poses_of_the_layout(stepper, scene_data, write_scene):
    """The replay starts high and ends with no object farther than 2 mm from its pose in the layout."""
    scene_data["settle"] = {"stepper": stepper}
    scene = load_scene(write_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    *moments, last = replay_layout(scene, layout, interval=0.01)
    assert last.layout is layout
    positions = np.array([[one.world_from_object[:3, 3] for one in moment.layout.instances] for moment in moments])
    resting = np.array([one.world_from_object[:3, 3] for one in layout.instances])
    assert len(moments) == int(layout.certificate.time_to_rest / 0.01) + 1
    assert positions[0, :, 2].min() > resting[:, 2].max()
    np.testing.assert_allclose(positions[-1], resting, atol=2e-3)


def test_json_keeps_layouts(scene_data, write_scene):
    layout = settle_layout(load_scene(write_scene(scene_data)), 1, cached=False)
    again = Layout.from_json(json.loads(json.dumps(layout.to_json())))
    assert again.certificate == layout.certificate
    assert again.to_json() == layout.to_json()
    for one, other in zip(again.instances, layout.instances, strict=True):
        np.testing.assert_array_equal(one.world_from_object, other.world_from_object)


def test_a_layout_is_settled_once_and_cached(scene_data, write_scene, tmp_path, monkeypatch):
    """Keys that only change the image reuse the layout; seed, index, meshes or a damaged file settle it again."""
    from mitsplat.physics import drop, settle

    monkeypatch.setattr(settle, "cache_folder", lambda: tmp_path / "cache")
    settled = []
    real = drop.Drop.settle
    monkeypatch.setattr(drop.Drop, "settle", lambda self, index: settled.append(index) or real(self, index))
    first = settle_layout(load_scene(write_scene(scene_data)), 0)
    scene_data["lights"], scene_data["output"]["width"] = [], 640
    again = settle_layout(load_scene(write_scene(scene_data)), 0)
    assert settled == [0]
    assert again.to_json() == first.to_json()
    settle_layout(load_scene(write_scene(scene_data)), 1)
    settle_layout(load_scene(write_scene(scene_data), overrides={"seed": 8}), 0)
    scaled = {**scene_data, "objects": [{"asset": "assets/nut", "count": [1, 2], "scale": 1.01}]}
    settle_layout(load_scene(write_scene(scaled)), 0)
    assert settled == [0, 1, 0, 0]
    for path in (tmp_path / "cache").rglob("*.json"):
        path.write_bytes(path.read_bytes()[:50])
    assert settle_layout(load_scene(write_scene(scene_data)), 0).to_json() == first.to_json()
    assert settled == [0, 1, 0, 0, 0]


def test_code_that_decides_layouts_is_hashed():
    """Names that modules of MODULES import from other modules of mitsplat are types, or are hashed as values."""
    from mitsplat.physics import settle

    types = {
        *("arrays.BoolArray", "arrays.Float32Array", "arrays.Float64Array", "arrays.Int64Array", "progress.Note"),
        *("asset.Asset", "errors.InputError", "scene.scene.Scene"),
        *(f"scene.layout.{name}" for name in ("Instance", "Layout", "LeftOut", "RestCertificate")),
        "scene.layout.UnsettledLayoutError",
        *(f"scene.spec.object_spec.{name}" for name in ("Arrangement", "ObjectPose")),
        *(f"scene.spec.shape_spec.{name}" for name in ("Backdrop", "Bin", "Box", "Enclosure", "Region", "Shape")),
        *("scene.spec.scene_spec.Output", "scene.spec.scene_spec.SceneSpec", "storage.field_types.Vec3"),
    }
    given = types | {
        "storage.cache.cache_folder",
        "storage.cache.write_cache_file",
        "scene.layout.NO_PHYSICS",
        "runtime.warp_start.quiet_warp",
        "progress.discard_note",
        "arguments.describe",  # writes the text of errors
        "arguments.real_array",  # refuses values, and copies numbers
    }
    given |= {"storage.content_hash.ContentHash"}  # names the cached files
    given |= {"storage.files.SPLITS"}  # names of counts; scene.contents assigns layouts to splits
    given |= {"scene.spec.scene_spec.BACKDROP"}  # prefix of the names of shapes, which are hashed
    for module in settle.MODULES:
        for node in ast.walk(ast.parse((settle.PACKAGE / f"{module.replace('.', '/')}.py").read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mitsplat."):
                source = node.module.removeprefix("mitsplat.")
                taken = {f"{source}.{name.name}" for name in node.names}
                assert source in settle.MODULES or taken <= given, f"{module} takes {taken - given}"


def test_versions_of_all_libraries_that_decide_layouts_are_hashed():
    from mitsplat.physics import settle

    imported = set()
    for module in settle.MODULES:
        for node in ast.walk(ast.parse((settle.PACKAGE / f"{module.replace('.', '/')}.py").read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            imported |= {name.partition(".")[0] for name in names}
    distributions = {"warp-lang" if name == "warp" else name for name in imported - sys.stdlib_module_names}
    assert distributions - {"mitsplat"} <= {*settle.LIBRARIES}


@pytest.mark.parametrize(
    "change", [("scene/walls", "PILE_HEIGHT = 1.0", "PILE_HEIGHT = 0.9"), ("physics/friction", "sqrt", "cbrt")]
)
def test_a_changed_rule_invalidates_cached_layouts(change, scene_data, write_scene, tmp_path, monkeypatch):
    """The height of piles, the walls of bins and the friction rule are part of a layout's cache key."""
    from mitsplat.physics import settle

    module, text, other = change
    scene = load_scene(write_scene(scene_data))
    package = tmp_path / "mitsplat"
    shutil.copytree(settle.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(settle, "PACKAGE", package)
    kept = settle._scene_hash.__wrapped__(scene)
    (package / "renderer/layers.py").write_text("")
    assert settle._scene_hash.__wrapped__(scene) == kept
    code = (package / f"{module}.py").read_text()
    assert text in code
    (package / f"{module}.py").write_text(code.replace(text, other))
    assert settle._scene_hash.__wrapped__(scene) != kept


@pytest.mark.extended
def test_several_processes_settle_the_same_layouts_as_one(scene_data, write_scene):
    scene = load_scene(write_scene(scene_data))
    found = {layout.index: layout.to_json() for layout in settle_layouts(scene, range(3), workers=2, cached=False)}
    assert found == {index: settle_layout(scene, index, cached=False).to_json() for index in range(3)}


@pytest.mark.parametrize("stepper", STEPPERS)
def test_seed_and_index_determine_every_byte(stepper, scene_data, write_scene, forks):
    """A process that settles only layout 2 and one that settled another layout first agree."""
    scene_data["settle"] = {"stepper": stepper}
    path = write_scene(scene_data)
    scene = load_scene(path)
    settle_layout(scene, 1, cached=False)
    here = json.dumps(settle_layout(scene, 2, cached=False).to_json())
    program = (
        "import json, sys; from mitsplat import load_scene, settle_layout;"
        "sys.stdout.write(json.dumps(settle_layout(load_scene(sys.argv[1]), 2, cached=False).to_json()))"
    )
    done = forks.run(program, path, folder=path.parent)
    assert done.returncode == 0, done.stderr
    there = done.stdout
    assert hashlib.sha256(there.encode()).hexdigest() == hashlib.sha256(here.encode()).hexdigest()
    assert json.dumps(settle_layout(scene, 1, cached=False).to_json()["instances"]) != json.dumps(
        json.loads(here)["instances"]
    )


def test_steppers_leave_upright_objects_at_the_same_poses(scene_data, write_scene):
    """Objects placed upright from the same draw do not tumble, so that both physics engines agree closely."""
    layouts = []
    for stepper in STEPPERS:
        scene_data["settle"] = {"arrangement": "upright", "stepper": stepper}
        layouts.append(settle_layout(load_scene(write_scene(scene_data)), 0, cached=False))
    assert [layout.certificate.attempts for layout in layouts] == [1, 1]
    for one, other in zip(layouts[0].instances, layouts[1].instances, strict=True):
        np.testing.assert_allclose(one.world_from_object[:3, 3], other.world_from_object[:3, 3], atol=1e-4)
        turn = Rotation.from_matrix(one.world_from_object[:3, :3].T @ other.world_from_object[:3, :3])
        assert np.degrees(turn.magnitude()) < 0.1


def test_simulations_are_freed(scene_data, write_scene, monkeypatch):
    """Models in Newton's reference cycles are freed, however seldom Python's garbage collector runs."""
    from mitsplat.physics import drop
    from mitsplat.physics import mujoco_world as physics
    from mitsplat.physics.settle import warp_settings

    models = []
    build = physics.build_model
    monkeypatch.setattr(physics, "build_model", lambda *args: (model := build(*args), models.append(ref(model)))[0])
    monkeypatch.setattr(drop, "_COLLECTION_INTERVAL", 2)
    gc.disable()
    try:
        with warp_settings():
            made = drop.Drop(load_scene(write_scene(scene_data)), lambda text: None)
            for number in range(4):
                made.world_of((0, 1)[: 1 + number % 2], 1.0)
        gone = [model() is None for model in models]
    finally:
        gc.enable()
    assert gone == [True, True, True, False]


def test_contact_shapes_are_made_for_the_assets_of_a_layout_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a large pool, a layout has few assets. Every mesh is checked nevertheless."""
    from mitsplat.physics import bodies

    made = []
    monkeypatch.setattr(bodies, "contact_pieces", lambda pieces: (made.append(pieces), tuple(pieces))[1])
    boxes = [box_asset(f"box_{edge}", (edge, edge, edge)) for edge in (0.02, 0.03, 0.04)]
    parts = [bodies.make_part(box, lambda text: None) for box in boxes]
    assert made == []
    assert parts[1].body.size == pytest.approx(0.03)
    assert parts[1].body is parts[1].body
    assert len(made) == 1
    flat = replace(boxes[0], mesh=trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]]))
    with pytest.raises(InputError, match="must enclose a volume"):
        bodies.make_part(flat, lambda text: None)


def test_notes_of_slow_operations_go_to_the_caller_of_the_present_call(scene_data, write_scene):
    """Pieces are computed when an asset is used for the first time, which may be in a later layout."""
    from mitsplat.physics.drop import drop_of

    scene = load_scene(write_scene(scene_data))
    scene = replace(scene, assets=tuple(replace(asset, pieces=()) for asset in scene.assets))
    first, second = [], []
    _ = drop_of(scene, first.append).objects[0].body
    _ = drop_of(scene, second.append).objects[1].body
    assert first == ["computing convex pieces of nut"]
    assert second == ["computing convex pieces of bolt"]


def test_an_interrupted_search_for_the_largest_hull_starts_again(scene_data, write_scene, monkeypatch):
    """After Ctrl-C in a notebook, the next call finds the largest hull of all pieces."""
    from mitsplat.physics import bodies
    from mitsplat.physics.drop import Drop

    drop = Drop(load_scene(write_scene(scene_data)), lambda text: None)
    ball, calls = trimesh.creation.icosphere(subdivisions=1, radius=0.01), []

    def pieces_of(pieces):
        calls.append(pieces)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return (ball,) if len(calls) == 1 else tuple(pieces)

    monkeypatch.setattr(bodies, "contact_pieces", pieces_of)
    finder = drop.static_scenes[0].contact_finder
    with pytest.raises(KeyboardInterrupt):
        _ = finder._largest
    assert len(finder._largest.vertices) == len(ball.vertices)


def test_the_first_of_several_faulty_meshes_is_named(scene_data, write_scene):
    from mitsplat.physics.drop import Drop

    scene = load_scene(write_scene(scene_data))
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]])
    flat = tuple(replace(asset, mesh=sheet.copy(), pieces=()) for asset in scene.assets)
    with pytest.raises(InputError, match="asset 'nut'"):
        Drop(replace(scene, assets=flat), lambda text: None)


@pytest.fixture
def pedestal_scene(scene_data, write_scene):
    """Return a scene with a pedestal narrower than the region, from which some objects fall."""
    scene_data["shapes"][0]["box"] = {"size": [0.12, 0.12, 0.1], "position": [0, 0, -0.05]}
    scene_data["region"] = {"min": [-0.1, -0.1, 0.01], "max": [0.1, 0.1, 0.1]}
    scene_data["settle"] = {"attempts": 30}
    return load_scene(write_scene(scene_data))


def test_objects_that_fall_off_are_dropped_again_while_the_others_stay(pedestal_scene):
    again = 0
    for index in range(3):
        layout = settle_layout(pedestal_scene, index, cached=False)
        assert layout.certificate.refused == ()
        assert layout.left_out == ()
        *moments, _ = replay_layout(pedestal_scene, layout, interval=0.008)
        places = np.array([[one.world_from_object[:3, 3] for one in moment.layout.instances] for moment in moments])
        assert places[-1, :, 2].min() > 0
        raised = np.diff(places[..., 2], axis=0) > 0.05  # from below the pedestal to above it
        ids = [one.id for one in layout.instances]
        marked = np.array([[number in moment.dropped_again for number in ids] for moment in moments[1:]])
        jumps = np.linalg.norm(np.diff(places, axis=0), axis=2) > 0.02  # at most 16 mm by falling
        np.testing.assert_array_equal(jumps, marked)
        assert not raised.all(axis=1).any()
        again += raised.sum()
    assert again > 0


def test_drops_that_fall_off_are_rejected_and_counted(pedestal_scene, monkeypatch):
    from mitsplat.physics import rest

    monkeypatch.setattr(rest, "_REDRAW_TIME", 0.0)
    scene = pedestal_scene
    certificates = [settle_layout(scene, index, cached=False).certificate for index in range(3)]
    refused = [reason for certificate in certificates for reason in certificate.refused]
    assert refused
    assert all("left the enclosure" in reason for reason in refused)
    assert all(certificate.attempts == len(certificate.refused) + 1 for certificate in certificates)


@pytest.mark.parametrize(("distance", "settles"), [(3e-4, False), (3e-3, True)])
def test_an_object_resting_against_the_enclosure_is_drawn_again(distance, settles, scene_data, write_scene):
    """A nut of 20 x 30 x 10 mm is placed flat, with its face at the given distance from the wall at x = 0.2 m."""
    scene_data["enclosure"] = {"margin": 0}
    scene_data["objects"] = [{"asset": "assets/nut", "poses": [{"position": [0.19 - distance, 0, 0.005]}]}]
    scene_data["settle"] = {"attempts": 2}
    scene = load_scene(write_scene(scene_data))
    if settles:
        assert settle_layout(scene, 0, cached=False).certificate.refused == ()
    else:
        with pytest.raises(InputError, match=r"got 2 x nut rests against the enclosure"):
            settle_layout(scene, 0, cached=False)


def test_a_layout_that_never_rests_is_an_error(scene_data, write_scene):
    scene_data["settle"] = {"max_time": 0.05, "attempts": 3}
    with pytest.raises(InputError, match=r"layout 0 must come to rest .*3 x not at rest within 0\.05 s"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


@pytest.mark.parametrize(("size", "depth", "refused"), [(0.05, 3.5e-4, True), (0.2, 3.5e-4, False), (0.2, 7e-4, True)])
def test_the_allowed_depth_grows_with_the_size_of_an_object(size, depth, refused):
    """The allowed depth is 0.3 mm, or 0.3 % of the object's size: 0.6 mm for 200 mm."""
    from mitsplat.geometry.mesh_distance import DistanceSurface, PlacedSurface
    from mitsplat.physics.certificate import RestingObject, RestingState

    item = PlacedSurface("part", DistanceSurface(trimesh.creation.box((size,) * 3)), pose_at((0, 0, size / 2 - depth)))
    table = PlacedSurface("table", DistanceSurface(trimesh.creation.box((1.0, 1.0, 0.1))), pose_at((0, 0, -0.05)))
    state = RestingState([RestingObject(item, "drop", None)], [table])
    assert state.collider_penetration == pytest.approx(depth, abs=1e-6)
    assert (state.find_defect() is not None) == refused


@pytest.mark.parametrize(
    ("places", "arrangement", "tilts", "expected"),
    [
        ([(0, 0, 0.0)], "drop", [None], None),
        ([(0, 0, 5e-4)], "drop", [None], None),
        ([(0, 0, 0.0), (0.1, 0, 2e-3)], "drop", [None, None], ("part 1 rests 2.0 mm or more from what is near", {1})),
        ([(0, 0, 0.3)], "drop", [None], ("part 0 rests 5.0 mm or more", {0})),
        ([(0, 0, 0.0), (0.0497, 0, 0.0)], "drop", [None, None], None),
        ([(0, 0, 0.0), (0.0492, 0.01, 0.0)], "drop", [None, None], ("part 0 and part 1 overlap by 0.8 mm", {0, 1})),
        ([(0, 0, 0.0), (0.0503, 0, 0.0)], "drop", [None, None], None),
        ([(0, 0, 0.0), (0.0503, 0, 0.0)], "scatter", [None, None], ("part 0 and part 1 touch", {0, 1})),
        ([(0, 0, 0.0), (0.0508, 0, 0.0)], "scatter", [None, None], None),
        ([(0, 0.1, 0.0), (0.1742, 0, 0.0)], "drop", [None, None], ("part 1 rests against the enclosure", {1})),
        ([(0.1735, 0, 0.0)], "drop", [None], None),
        ([(0, 0, 0.0), (0.1, 0, 0.0)], "upright", [4.9, 5.1], ("part 1 fell over", {1})),
        ([(0, 0, 0.0), (0.1, 0, 0.0)], "drop", [4.9, 5.1], None),
    ],
)
def test_each_defect_of_a_resting_state_is_found(places, arrangement, tilts, expected):
    """Boxes of 50 mm stand on or above a table; a wall of the enclosure is at x = 0.2 m."""
    from mitsplat.geometry.mesh_distance import DistanceSurface, PlacedSurface
    from mitsplat.physics.certificate import RestingObject, RestingState

    box = DistanceSurface(trimesh.creation.box((0.05,) * 3))
    surfaces = [
        PlacedSurface(f"part {i}", box, pose_at(np.add(place, (0, 0, 0.025)))) for i, place in enumerate(places)
    ]
    table = PlacedSurface("table", DistanceSurface(trimesh.creation.box((1.0, 1.0, 0.1))), pose_at((0, 0, -0.05)))
    wall = PlacedSurface("enclosure 1", DistanceSurface(trimesh.creation.box((0.1, 1, 1))), pose_at((0.25, 0, 0.501)))
    items = [RestingObject(surface, arrangement, tilt) for surface, tilt in zip(surfaces, tilts, strict=True)]
    state = RestingState(items, [table, wall])
    gaps = [min(place[2], 5e-3) for place in places]
    if "overlap" not in (expected or [""])[0]:
        np.testing.assert_allclose(state.support_gaps, gaps, atol=2e-6)
        assert state.pair_penetration < 4e-4
    defect = state.find_defect()
    if expected is None:
        assert defect is None
    else:
        assert defect is not None and defect.reason.startswith(expected[0]) and set(defect.causes) == expected[1]


def test_a_scene_without_colliders_is_refused(scene_data, write_scene):
    scene_data["shapes"][0]["collider"] = False
    with pytest.raises(InputError, match="must be a collider, on which objects rest"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


@pytest.mark.parametrize("divided", [True, False])
def test_an_environment_carries_objects(scene_data, write_scene, divided):
    """Its convex pieces are computed if the asset has none."""
    scene = load_scene(write_scene(scene_data))
    step = trimesh.creation.box((0.6, 0.6, 0.04)).apply_translation((0, 0, -0.005))
    pieces = (step,) if divided else ()
    environment = replace(scene.assets[0], name="cell", mesh=step, pieces=pieces, kind="environment")
    region = scene.spec.region.model_copy(update={"min": (-0.2, -0.2, 0.03)})
    spec = scene.spec.model_copy(update={"region": region, "environment_collides": True})
    raised = replace(scene, environments=(environment,), spec=spec)
    layout = settle_layout(raised, 0, cached=False)
    for instance in layout.instances:
        mesh = scene.assets[instance.asset].mesh
        assert lowest(mesh, instance.world_from_object) == pytest.approx(0.015, abs=3e-4)


def test_objects_rest_on_the_drawn_environment(scene_data, write_scene):
    """Two environments have steps of different heights; a layout settled after another equals one settled alone."""
    scene_data["shapes"] = []
    scene = load_scene(write_scene(scene_data))
    tops = (0.015, -0.03)
    cells = []
    for top in tops:
        step = trimesh.creation.box((0.6, 0.6, 0.04)).apply_translation((0, 0, top - 0.02))
        cells.append(replace(scene.assets[0], name=f"cell {top}", mesh=step, pieces=(step,), kind="environment"))
    spec = scene.spec.model_copy(update={"environment": ("a", "b"), "environment_collides": True})
    scene = replace(scene, environments=tuple(cells), spec=spec)
    numbers = [draw_surroundings(spec, 4 * index).environment for index in range(9)]
    for number in (0, 1, 0):
        index = numbers.index(number)
        layout = settle_layout(scene, index, cached=False)
        for instance in layout.instances:
            mesh = scene.assets[instance.asset].mesh
            assert lowest(mesh, instance.world_from_object) == pytest.approx(tops[number], abs=5e-4)
    alone = settle_layout(replace(scene), index, cached=False)
    assert alone.to_json() == layout.to_json()


def test_a_moved_collider_leaves_the_original_in_place():
    from mitsplat.physics.bodies import Collider
    from mitsplat.physics.friction import ContactMaterial

    piece, motion = trimesh.creation.box((0.1, 0.1, 0.1)), pose_at((0.2, 0, 0))
    original = Collider(ContactMaterial(), pieces=(piece,))
    for moved in (original.moved(motion), original.moved(motion)):  # of two layouts
        np.testing.assert_allclose(moved.pieces[0].centroid, (0.2, 0, 0), atol=1e-12)
    np.testing.assert_allclose(original.pieces[0].centroid, 0, atol=1e-12)
    moved = Collider(ContactMaterial(), box=((1, 1, 1), pose_at((0, 0.1, 0)))).moved(motion)
    assert moved.box is not None and not moved.pieces
    np.testing.assert_allclose(moved.box[1], pose_at((0.2, 0.1, 0)))


def test_objects_rest_on_the_jittered_shape(scene_data, write_scene):
    """In the scene file, a step of 4 cm is beside the place where objects fall; in some layout it is below."""
    step = {"size": [0.3, 0.3, 0.04], "position": [0.25, 0, 0.02]}
    scene_data["shapes"].append({"name": "step", "box": step, "jitter": 0.15})
    scene_data["objects"] = [{"asset": "assets/nut"}]
    scene_data["region"] = {"min": [-0.03, -0.03, 0.05], "max": [0.03, 0.03, 0.12]}
    scene_data["settle"] = {"stepper": "mujoco"}
    scene_data["output"]["layouts"] = 100
    scene = load_scene(write_scene(scene_data))
    bounds = ([placed.mesh.bounds[:, :2] for placed in placed_shapes(scene, layout)][1] for layout in range(100))
    below = next(layout for layout, (low, high) in enumerate(bounds) if (low < -0.08).all() and (high > 0.08).all())
    (one,) = settle_layout(scene, below, cached=False).instances
    assert lowest(scene.assets[one.asset].mesh, one.world_from_object) == pytest.approx(0.04, abs=5e-4)


def test_objects_rest_on_a_shape_only_in_layouts_that_have_it(scene_data, write_scene):
    step = {"size": [0.3, 0.3, 0.04], "position": [0, 0, 0.02]}
    scene_data["shapes"].append({"name": "step", "box": step, "share": 0.5})
    scene_data["objects"] = [{"asset": "assets/nut"}]
    scene_data["region"] = {"min": [-0.03, -0.03, 0.06], "max": [0.03, 0.03, 0.13]}
    scene_data["settle"] = {"stepper": "mujoco"}
    scene_data["output"]["layouts"] = 20
    scene = load_scene(write_scene(scene_data))
    counts = [len(list(placed_shapes(scene, layout))) for layout in range(20)]
    for layout, height in ((counts.index(1), 0.0), (counts.index(2), 0.04)):
        (one,) = settle_layout(scene, layout, cached=False).instances
        assert lowest(scene.assets[one.asset].mesh, one.world_from_object) == pytest.approx(height, abs=5e-4)


def test_standoff_of_a_hull_equals_its_closed_form():
    """Pieces equal to the mesh have no standoff.

    The hull of an L has half a leg, where its long face spans the notch.
    """
    from mitsplat.geometry.mesh_distance import DistanceSurface, standoff

    floor, wall = trimesh.creation.box((0.022, 0.01, 0.002)), trimesh.creation.box((0.002, 0.01, 0.022))
    floor.apply_translation((0.009, 0, -0.001))
    wall.apply_translation((-0.001, 0, 0.009))
    bracket = trimesh.boolean.union([floor, wall])
    surface = DistanceSurface(bracket)
    assert standoff(surface, [floor, wall]) < 1e-5
    # The middle of the hull's long face, from (20, 0) to (0, 20) mm, is 10 mm from both plates.
    assert standoff(surface, [bracket.convex_hull]) == pytest.approx(0.01, abs=2e-4)


def test_standoff_equals_the_largest_signed_distance_of_points():
    """Points deep inside are farther from the surface than the standoff, and must not count."""
    from mitsplat.geometry.mesh import contact_points
    from mitsplat.geometry.mesh_distance import _SAMPLES, DistanceSurface, standoff

    surface = DistanceSurface(trimesh.creation.box((0.04, 0.04, 0.04)))
    inside = trimesh.creation.icosphere(3, 0.005)
    bump = trimesh.creation.icosphere(2, 0.002).apply_translation((0.02, 0.003, 0.001))
    assert standoff(surface, [inside]) == 0
    samples, _ = trimesh.sample.sample_surface(trimesh.util.concatenate([inside, bump]), _SAMPLES, seed=0)
    points = np.concatenate([contact_points(inside), contact_points(bump), samples])
    found = standoff(surface, [inside, bump])
    assert found == pytest.approx(0.002, rel=0.05)
    assert found == surface.signed_distances(points).max()


def test_no_objects_make_an_empty_layout(scene_data, write_scene):
    scene_data["objects"] = []
    assert settle_layout(load_scene(write_scene(scene_data)), 0, cached=False).instances == ()
