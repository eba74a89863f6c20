"""Layouts against what they promise."""

from __future__ import annotations

import ast
import gc
import hashlib
import json
import pickle
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from weakref import ref

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from mitsplat.dataset.prospects import layout_faults
from mitsplat.errors import InputError
from mitsplat.physics.placement import standing_turns
from mitsplat.physics.settle import replay_layout, settle_layout, settle_layouts, try_alone
from mitsplat.render.places import draw_place
from mitsplat.scene.contents import draw_regions
from mitsplat.scene.layout import Layout, NothingRests
from mitsplat.scene.scene import load_scene
from tests.bodies import STEPPERS, lowest, pose_at
from tests.conftest import box_asset

pytestmark = pytest.mark.usefixtures("physics")


def test_clearance_of_boxes():
    from mitsplat.mesh_distance import PlacedSurface, Surface, clearance

    box = Surface(trimesh.creation.box((0.02, 0.02, 0.02)))
    here = PlacedSurface("here", box)

    def from_here(pose):
        return clearance(here, PlacedSurface("there", box, pose), reach=0.005).distance

    assert from_here(pose_at((0.023, 0, 0))) == pytest.approx(0.003, abs=1e-6)
    assert from_here(pose_at((0.018, 0.005, 0.005))) == pytest.approx(-0.002, abs=1e-6)
    assert from_here(pose_at((0.05, 0, 0))) == 0.005
    # Edges that cross with no vertex inside: each is sqrt(2) cm from its centre, less 1 mm.
    crossed = Rotation.from_euler("xz", (45, 90), degrees=True)
    upright = PlacedSurface("edge up", box, pose_at((0, 0, 0), Rotation.from_euler("x", 45, degrees=True)))
    above = PlacedSurface("edge down", box, pose_at((0, 0, 2 * 0.01 * np.sqrt(2) - 0.001), crossed))
    assert clearance(upright, above, reach=0.005).distance == pytest.approx(-0.001 / np.sqrt(2), rel=0.1)


def test_draws_are_uniform_and_apart(scene_data, write_scene):
    from mitsplat.mesh_distance import all_clearances
    from mitsplat.physics.drop import drop_of

    drop = drop_of(load_scene(write_scene(scene_data)), lambda text: None)
    rng = np.random.default_rng(0)
    rotations = []
    for _ in range(300):
        poses = drop.draw_poses((0, 0, 1), rng)
        rotations.append(poses[:, :3, :3])
        placed = [drop._placed(asset, pose) for asset, pose in zip((0, 0, 1), poses, strict=True)]
        bounds = np.stack([item.bounds for item in placed])
        assert (bounds >= np.array(scene_data["region"]["min"]) - 1e-9).all()
        assert (bounds <= np.array(scene_data["region"]["max"]) + 1e-9).all()
        assert min(pair.distance for pair in all_clearances(placed, drop._grounds[0].obstacles, reach=0.005)) > 0.0009
    rotations = np.concatenate(rotations)
    # Haar measure: every column is uniform on the sphere, so its z is uniform (Archimedes); the angle t has
    # density (1 - cos t) / pi.
    for column in range(3):
        assert kstest(rotations[:, 2, column], "uniform", args=(-1, 2)).pvalue > 1e-3
    angles = Rotation.from_matrix(rotations).magnitude()
    assert kstest(angles, lambda t: (t - np.sin(t)) / np.pi).pvalue > 1e-3


def test_a_layout_holds_what_its_certificate_says(scene_data, write_scene):
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
    assert certificate.standoff < 1e-6  # boxes are their own pieces
    assert certificate.attempts == len(certificate.refused) + 1


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_replay_is_the_drop_that_was(stepper, scene_data, write_scene):
    """It starts high, and where it ends no object is farther than 2 mm from where the layout has it."""
    scene_data["settle"] = {"stepper": stepper}
    scene = load_scene(write_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    *moments, last = replay_layout(scene, layout, interval=0.04)
    assert last is layout
    positions = np.array([[one.world_from_object[:3, 3] for one in moment.instances] for moment in moments])
    resting = np.array([one.world_from_object[:3, 3] for one in layout.instances])
    assert len(moments) == int(layout.certificate.time_to_rest / 0.04) + 1
    assert positions[0, :, 2].min() > resting[:, 2].max()
    np.testing.assert_allclose(positions[-1], resting, atol=2e-3)


def test_layouts_survive_json(scene_data, write_scene):
    layout = settle_layout(load_scene(write_scene(scene_data)), 1, cached=False)
    again = Layout.from_json(json.loads(json.dumps(layout.to_json())))
    assert again.certificate == layout.certificate
    assert again.to_json() == layout.to_json()
    for one, other in zip(again.instances, layout.instances, strict=True):
        np.testing.assert_array_equal(one.world_from_object, other.world_from_object)


def test_a_layout_is_settled_once(scene_data, write_scene, tmp_path, monkeypatch):
    """What changes the picture only does not settle anew; seed, index and meshes do, and so does a damaged file."""
    from mitsplat.physics import drop, settle

    monkeypatch.setattr(settle, "cache_folder", lambda: tmp_path / "cache")
    settled = []
    real = drop.Drop.settle
    monkeypatch.setattr(drop.Drop, "settle", lambda self, index: settled.append(index) or real(self, index))
    scene_data["settle"] = {"stepper": "mujoco"}
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
    """Whatever mitsplat's modules of MODULES take from others of its modules is a type, or hashed as a value."""
    from mitsplat.physics import settle

    types = {
        *("arrays.BoolArray", "arrays.Float32Array", "arrays.Float64Array", "arrays.Int64Array", "progress.Note"),
        *("asset.Asset", "errors.InputError", "scene.scene.Scene"),
        *(f"scene.layout.{name}" for name in ("Instance", "Layout", "LeftOut", "NothingRests", "RestCertificate")),
        *(f"spec.objects.{name}" for name in ("Arrangement", "ObjectPose")),
        *(f"spec.shapes.{name}" for name in ("Backdrop", "Bin", "Box", "Enclosure", "Region", "Shape")),
        *("spec.spec.SceneSpec", "spec_types.Vec3"),
    }
    given = types | {"cache.cache_folder", "cache.keep_file", "scene.layout.NOTHING_TO_REST", "warp_start.quiet_warp"}
    given |= {"content_hash.ContentHash"}  # names what is kept
    given |= {"files.SPLITS"}  # names of tallies; which layout is of which split is decided in scene.contents
    given |= {"spec.spec.BACKDROP"}  # begins the names of shapes, which are hashed
    for module in settle.MODULES:
        for node in ast.walk(ast.parse((settle.PACKAGE / f"{module.replace('.', '/')}.py").read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mitsplat."):
                source = node.module.removeprefix("mitsplat.")
                taken = {f"{source}.{name.name}" for name in node.names}
                assert source in settle.MODULES or taken <= given, f"{module} takes {taken - given}"


@pytest.mark.parametrize(
    "change", [("scene/walls", "PILE_HEIGHT = 1.0", "PILE_HEIGHT = 0.9"), ("physics/friction", "sqrt", "cbrt")]
)
def test_another_rule_settles_anew(change, scene_data, write_scene, tmp_path, monkeypatch):
    """The height of piles, the walls of bins and the rule of friction are part of what a layout is kept by."""
    from mitsplat.physics import settle

    module, text, other = change
    scene = load_scene(write_scene(scene_data))
    package = tmp_path / "mitsplat"
    shutil.copytree(settle.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(settle, "PACKAGE", package)
    kept = settle._scene_hash.__wrapped__(scene)
    (package / "render/layers.py").write_text("")
    assert settle._scene_hash.__wrapped__(scene) == kept
    code = (package / f"{module}.py").read_text()
    assert text in code
    (package / f"{module}.py").write_text(code.replace(text, other))
    assert settle._scene_hash.__wrapped__(scene) != kept


@pytest.mark.slow
def test_processes_settle_what_one_process_settles(scene_data, write_scene):
    scene_data["settle"] = {"stepper": "mujoco"}
    scene = load_scene(write_scene(scene_data))
    found = {layout.index: layout.to_json() for layout in settle_layouts(scene, range(3), workers=2, cached=False)}
    assert found == {index: settle_layout(scene, index, cached=False).to_json() for index in range(3)}


@pytest.mark.parametrize("stepper", STEPPERS)
def test_seed_and_index_decide_every_byte(stepper, scene_data, write_scene):
    """A process that settles layout 2 alone, and one that has settled another before, agree."""
    scene_data["settle"] = {"stepper": stepper}
    path = write_scene(scene_data)
    scene = load_scene(path)
    settle_layout(scene, 1, cached=False)
    here = json.dumps(settle_layout(scene, 2, cached=False).to_json())
    program = (
        "import json, sys; from mitsplat import load_scene, settle_layout;"
        "sys.stdout.write(json.dumps(settle_layout(load_scene(sys.argv[1]), 2, cached=False).to_json()))"
    )
    there = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    ).stdout
    assert hashlib.sha256(there.encode()).hexdigest() == hashlib.sha256(here.encode()).hexdigest()
    assert json.dumps(settle_layout(scene, 1, cached=False).to_json()["instances"]) != json.dumps(
        json.loads(here)["instances"]
    )


def test_simulations_do_not_pile_up(scene_data, write_scene, monkeypatch):
    """Models that Newton leaves in reference cycles are let go of, however seldom Python collects."""
    from mitsplat.physics import drop
    from mitsplat.physics import worlds as physics
    from mitsplat.physics.settle import warp_settings

    models = []
    build = physics._build_model
    monkeypatch.setattr(physics, "_build_model", lambda *args: (model := build(*args), models.append(ref(model)))[0])
    monkeypatch.setattr(drop, "_GARBAGE", 2)
    gc.disable()
    try:
        with warp_settings():
            made = drop.Drop(load_scene(write_scene(scene_data)), lambda text: None)
            for number in range(4):
                made._world((0, 1)[: 1 + number % 2], (0.5, 0.5), 1.0)
        gone = [model() is None for model in models]
    finally:
        gc.enable()
    assert gone == [True, True, True, False]


def test_draws_that_fall_off_are_refused_and_counted(scene_data, write_scene):
    """On a pedestal narrower than the region some draws stay and some leave."""
    scene_data["shapes"][0]["box"] = {"size": [0.12, 0.12, 0.1], "position": [0, 0, -0.05]}
    scene_data["region"] = {"min": [-0.1, -0.1, 0.01], "max": [0.1, 0.1, 0.1]}
    scene_data["settle"] = {"attempts": 30, "stepper": "mujoco"}
    scene = load_scene(write_scene(scene_data))
    certificates = [settle_layout(scene, index, cached=False).certificate for index in range(3)]
    refused = [reason for certificate in certificates for reason in certificate.refused]
    assert refused
    assert all("left the enclosure" in reason for reason in refused)
    assert all(certificate.attempts == len(certificate.refused) + 1 for certificate in certificates)


@pytest.mark.parametrize(("distance", "settles"), [(3e-4, False), (3e-3, True)])
def test_what_rests_against_the_enclosure_is_drawn_again(distance, settles, scene_data, write_scene):
    """A nut of 20 x 30 x 10 mm is put down flat, its face as far from the wall at x = 0.2 m as said."""
    scene_data["enclosure"] = {"margin": 0}
    scene_data["objects"] = [{"asset": "assets/nut", "poses": [{"position": [0.19 - distance, 0, 0.005]}]}]
    scene_data["settle"] = {"attempts": 2, "stepper": "mujoco"}
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


@pytest.fixture
def needle_scene(scene_data, write_scene, tmp_path):
    """Nuts beside a needle on its point, its weight beside that."""
    cone = trimesh.creation.cone(0.004, 0.08, sections=16)
    cone.vertices[:, 2] = 0.08 - cone.vertices[:, 2]
    cone.vertices[:, 0] += 0.2 * cone.vertices[:, 2]
    cone.invert()
    replace(box_asset("needle"), mesh=cone, pieces=()).save(tmp_path / "assets/needle")
    scene_data["objects"] = [{"asset": "assets/needle"}, {"asset": "assets/nut", "count": 2}]
    scene_data["settle"] = {"arrangement": "upright", "attempts": 2, "stepper": "mujoco"}
    return write_scene


def test_what_cannot_stand_is_left_out_and_the_others_keep_their_numbers(needle_scene, scene_data):
    scene = load_scene(needle_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    assert [(one.id, scene.assets[one.asset].name) for one in layout.instances] == [(2, "nut"), (3, "nut")]
    (gone,) = layout.left_out
    assert (gone.id, scene.assets[gone.asset].name) == (1, "needle")
    assert gone.reason == "fell over in 2 of 2 draws"
    assert layout.certificate.refused == ("needle fell over",) * 2
    assert layout.certificate.attempts == 3
    assert Layout.from_json(json.loads(json.dumps(layout.to_json()))).left_out == layout.left_out
    *moments, _ = replay_layout(scene, layout, interval=0.04)
    start = np.array([one.world_from_object[:3, 3] for one in moments[0].instances])
    resting = np.array([one.world_from_object[:3, 3] for one in layout.instances])
    assert start.shape == (2, 3)
    assert np.abs(start - resting).max() < 2e-3  # they were put down where they lie


def test_a_layout_of_which_nothing_rests_is_an_error_that_has_the_empty_layout(needle_scene, scene_data):
    scene_data["objects"] = [{"asset": "assets/needle", "count": 2}]
    scene = load_scene(needle_scene(scene_data))
    with pytest.raises(NothingRests, match=r"layout 1 must come to rest .*[(]got 2 x needle fell over[)]") as error:
        settle_layout(scene, 1, cached=False)
    again = pickle.loads(pickle.dumps(error.value))
    assert again.layout.instances == ()
    assert {one.id for one in again.layout.left_out} == {1, 2}
    assert str(again) == str(error.value)
    (layout,) = settle_layouts(scene, [1], cached=False)
    assert layout.to_json() == again.layout.to_json()


def test_what_is_higher_than_the_region_leaves_room_for_the_others(scene_data, write_scene, tmp_path, monkeypatch):
    from mitsplat.physics import placement

    monkeypatch.setattr(placement, "_DRAWS", 2)
    box_asset("plank", (0.02, 0.02, 0.3)).save(tmp_path / "assets/plank")
    scene_data["objects"] = [{"asset": "assets/nut"}, {"asset": "assets/plank"}]
    scene_data["settle"] = {"arrangement": "upright", "attempts": 1, "stepper": "mujoco"}
    scene = load_scene(write_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    assert [one.id for one in layout.instances] == [1]
    assert [(one.id, one.reason) for one in layout.left_out] == [(2, "no room for it in 1 of 1 draws")]
    scene_data["objects"] = [{"asset": "assets/plank"}]
    with pytest.raises(NothingRests, match="region must be large enough"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_a_layout_goes_on_without_what_finds_no_room_beside_the_others(scene_data, write_scene, tmp_path):
    box_asset("tile", (0.04, 0.04, 0.01)).save(tmp_path / "assets/tile")
    scene_data["objects"] = [{"asset": "assets/tile", "count": 5}]
    scene_data["region"] = {"min": [-0.045, -0.045, 0.01], "max": [0.045, 0.045, 0.03]}
    scene_data["settle"] = {"arrangement": "packed", "stepper": "mujoco"}
    layout = settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)
    assert [one.id for one in layout.instances] == [1, 2, 3, 4]
    assert [(one.id, one.reason) for one in layout.left_out] == [(5, "no room for all in 1 of 1 draws")]
    assert layout.certificate.refused.count("no room for all") == 1
    scene_data["objects"][0]["count"] = 9
    with pytest.raises(InputError, match=r"region must be large enough .*the 9 of a layout"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_each_object_is_tried_alone(needle_scene, scene_data):
    tried = list(try_alone(load_scene(needle_scene(scene_data))))
    assert tried == [("needle", "upright", ["needle fell over"] * 3), ("nut", "upright", [])]
    scene_data["settle"]["arrangement"] = "drop"
    assert not any(refused for _, _, refused in try_alone(load_scene(needle_scene(scene_data))))


@pytest.mark.parametrize(("size", "depth", "refused"), [(0.05, 3.5e-4, True), (0.2, 3.5e-4, False), (0.2, 7e-4, True)])
def test_how_deep_an_object_may_be_grows_with_it(size, depth, refused):
    """0.3 mm, or 0.3 % of its size: 0.6 mm of 200."""
    from mitsplat.mesh_distance import Clearance, PlacedSurface, Surface
    from mitsplat.physics.drop import _fault

    item, table = (PlacedSurface(name, Surface(trimesh.creation.box((size,) * 3))) for name in ("part", "table"))
    fault = _fault([Clearance(item, table, -depth)], {item: 0.0}, [table])
    assert (fault is not None) == refused


def test_a_region_too_small_is_an_error(scene_data, write_scene):
    scene_data["objects"][0]["count"] = 60
    scene_data["region"] = {"min": [-0.05, -0.05, 0.01], "max": [0.05, 0.05, 0.08]}
    with pytest.raises(InputError, match=r"scene.yaml: region must be large enough .*the 61 of a layout"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_a_region_mostly_inside_of_a_table_is_blamed_on_it(scene_data, write_scene, monkeypatch):
    from mitsplat.physics import placement as place
    from mitsplat.physics.drop import drop_of

    monkeypatch.setattr(place, "_DRAWS", 1)
    rng = np.random.default_rng(0)
    scene_data["region"] = {"min": [-0.2, -0.2, -0.09], "max": [0.2, 0.2, 0.01]}
    with pytest.raises(InputError, match=r"in 0.4 x 0.4 x 0.1 m, (89|90|91)% of which are inside of 'table', settle"):
        drop_of(load_scene(write_scene(scene_data)), lambda text: None).draw_poses((0,), rng)


def test_a_scene_without_colliders_is_an_error(scene_data, write_scene):
    scene_data["shapes"][0]["collider"] = False
    with pytest.raises(InputError, match="something to rest on"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_an_environment_carries_objects(scene_data, write_scene):
    scene = load_scene(write_scene(scene_data))
    step = trimesh.creation.box((0.6, 0.6, 0.04)).apply_translation((0, 0, -0.005))
    environment = replace(scene.assets[0], name="cell", mesh=step, pieces=(step,), kind="environment")
    region = scene.spec.region.model_copy(update={"min": (-0.2, -0.2, 0.03)})
    spec = scene.spec.model_copy(update={"region": region, "environment_collides": True})
    raised = replace(scene, environments=(environment,), spec=spec)
    layout = settle_layout(raised, 0, cached=False)
    for instance in layout.instances:
        mesh = scene.assets[instance.asset].mesh
        assert lowest(mesh, instance.world_from_object) == pytest.approx(0.015, abs=3e-4)


def test_objects_lie_on_the_environment_that_their_layout_draws(scene_data, write_scene):
    """Steps of two heights: what is settled after another is no other than what is settled alone."""
    scene_data["shapes"] = []
    scene = load_scene(write_scene({**scene_data, "settle": {"stepper": "mujoco"}}))
    tops = (0.015, -0.03)
    cells = []
    for top in tops:
        step = trimesh.creation.box((0.6, 0.6, 0.04)).apply_translation((0, 0, top - 0.02))
        cells.append(replace(scene.assets[0], name=f"cell {top}", mesh=step, pieces=(step,), kind="environment"))
    spec = scene.spec.model_copy(update={"environment": ("a", "b"), "environment_collides": True})
    scene = replace(scene, environments=tuple(cells), spec=spec)
    numbers = [draw_place(spec, 4 * index).environment for index in range(9)]
    for number in (0, 1, 0):
        index = numbers.index(number)
        layout = settle_layout(scene, index, cached=False)
        for instance in layout.instances:
            mesh = scene.assets[instance.asset].mesh
            assert lowest(mesh, instance.world_from_object) == pytest.approx(tops[number], abs=5e-4)
    alone = settle_layout(replace(scene), index, cached=False)
    assert alone.to_json() == layout.to_json()


@pytest.fixture
def shelf(scene_data):
    """A table, a board above it and a bin beside it; objects of three entries."""
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
    return {**scene_data, "enclosure": {"margin": 0.03}, "settle": {"stepper": "mujoco"}}


def test_each_object_lies_in_its_region(shelf, write_scene):
    """On the board at 0.3 m, put upright; on the table below it; and within the walls of the bin."""
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


def test_a_region_above_nothing_is_told_before_work_begins(shelf, write_scene):
    shelf["regions"][1] |= {"min": [0.9, 0.9, 0.02], "max": [1.1, 1.1, 0.2]}
    found = [fault.text for fault in layout_faults(load_scene(write_scene(shelf)))]
    assert found == ["regions[1]: nothing that collides is below it, so that all objects fall for ever"]


def drop_layout(scene_data, write_scene, **changes):
    scene = load_scene(write_scene({**scene_data, **changes}))
    return scene, settle_layout(scene, 0, cached=False)


def placed_clearances(scene, layout):
    """Clearances of a layout's objects from one another and from the colliders."""
    from mitsplat.mesh_distance import all_clearances
    from mitsplat.physics.drop import drop_of

    drop = drop_of(scene, lambda text: None)
    placed = [drop._placed(instance.asset, instance.world_from_object) for instance in layout.instances]
    return all_clearances(placed, [], reach=0.005)


BIN = {"name": "bin", "bin": {"size": [0.12, 0.09, 0.05], "position": [0, 0, 0.004], "rotate_z": 20}, "visible": True}


def test_a_bin_is_five_boxes_around_its_inside(scene_data, write_scene):
    """Volume of the walls: outer less inner; the inside is empty and the middle of its floor where it should be."""
    from mitsplat.mesh_distance import Surface

    scene_data["shapes"].append(BIN)
    mesh = load_scene(write_scene(scene_data)).shape_meshes[1]
    assert mesh.is_watertight
    outer, inner = 0.128 * 0.098 * 0.054, 0.12 * 0.09 * 0.05
    assert mesh.volume == pytest.approx(outer - inner, rel=1e-6)
    turn, floor = Rotation.from_euler("z", 20, degrees=True), np.array([0, 0, 0.004])
    inside = turn.apply([[0, 0, 0.001], [0.059, 0.044, 0.049], [-0.059, 0.044, 0.001]]) + floor
    walls = turn.apply([[0, 0, -0.002], [0.062, 0, 0.02], [0, -0.047, 0.049]]) + floor
    assert (Surface(mesh).signed_distances(np.array([*inside, *walls])) < 0).tolist() == [False] * 3 + [True] * 3


def test_a_pile_fills_a_bin(scene_data, write_scene):
    """A dozen parts, more than the region has room for, come to rest in the bin, none beside it."""
    scene_data["shapes"].append(BIN)
    _, layout = drop_layout(
        scene_data,
        write_scene,
        objects=[{"asset": "assets/nut", "count": 7}, {"asset": "assets/bolt", "count": 5}],
        region={"min": [-0.04, -0.03, 0.02], "max": [0.04, 0.03, 0.06]},
        settle={"arrangement": "pile", "stepper": "mujoco"},
    )
    assert len(layout.instances) == 12
    positions = np.array([instance.world_from_object[:3, 3] for instance in layout.instances]) - [0, 0, 0.004]
    local = Rotation.from_euler("z", -20, degrees=True).apply(positions)
    assert (np.abs(local[:, :2]) < [0.06, 0.045]).all()
    assert layout.certificate.collider_penetration < 3e-4
    assert layout.certificate.pair_penetration < 5e-4


def test_a_pile_that_finds_no_room_is_an_error(scene_data, write_scene):
    with pytest.raises(InputError, match=r"region must be large enough .* settle\.arrangement pile"):
        drop_layout(
            scene_data,
            write_scene,
            objects=[{"asset": "assets/nut", "count": 150}],
            region={"min": [-0.02, -0.02, 0.02], "max": [0.02, 0.02, 0.06]},
            settle={"arrangement": "pile"},
        )


def test_what_is_scattered_does_not_touch(scene_data, write_scene):
    scene, layout = drop_layout(
        scene_data,
        write_scene,
        objects=[{"asset": "assets/nut", "count": 6}, {"asset": "assets/bolt", "count": 3}],
        settle={"arrangement": "scatter", "stepper": "mujoco"},
    )
    assert min(pair.distance for pair in placed_clearances(scene, layout)) > 5e-4


def test_a_stack_lies_on_its_largest_faces(scene_data, write_scene):
    """Box i of thickness h lies with its centre at (i + 1/2) h, all turned alike and in one line."""
    scene_data["objects"] = [{"asset": "assets/nut", "count": 4}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "stack"})
    poses = np.array(sorted((one.world_from_object for one in layout.instances), key=lambda pose: pose[2, 3]))
    np.testing.assert_allclose(poses[:, 2, 3], 0.01 * (np.arange(4) + 0.5), atol=3e-4)
    np.testing.assert_allclose(np.abs(poses[:, 2, 2]), 1.0, atol=1e-4)
    assert np.ptp(poses[:, :2, 3], axis=0).max() < 5e-4
    assert layout.certificate.surface_motion < 1e-4


@pytest.mark.parametrize("arrangement", ["stack", "upright", "tower", "packed"])
def test_things_are_put_down_below_the_lid_of_an_enclosure(scene_data, write_scene, arrangement):
    """They start at the region's top, where the lid is, but stand on the ground from the first moment on."""
    scene_data["objects"] = [{"asset": "assets/nut", "count": 2}]
    scene_data["enclosure"] = {"margin": 0.05}
    settle = {"arrangement": arrangement, "stepper": "mujoco", "attempts": 1}
    _, layout = drop_layout(scene_data, write_scene, settle=settle)
    assert layout.certificate.time_to_rest < 0.1


def test_what_is_upright_stands_as_the_asset_does(scene_data, write_scene):
    """Bolts of 10 x 10 x 50 mm, which lie down when dropped, stand: the vertical stays, its turn is random."""
    scene_data["objects"] = [{"asset": "assets/bolt", "count": 5}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "upright", "stepper": "mujoco"})
    poses = np.array([instance.world_from_object for instance in layout.instances])
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=1e-4)
    np.testing.assert_allclose(poses[:, 2, 3], 0.025, atol=3e-4)
    assert np.ptp(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])) > 0.5


def test_what_is_packed_stands_side_by_side_in_rows(scene_data, write_scene):
    """Bolts of 10 x 10 mm, turned by quarters up to 3 degrees off, have at most 11 mm by 11 mm and gaps of 2 to 5 mm.

    So at most five stand in a row of 60 mm, the rows are as many as they must be, and none is far from the next.
    """
    scene_data["objects"] = [{"asset": "assets/bolt", "count": 9}]
    scene_data["region"] = {"min": [-0.03, -0.03, 0.0], "max": [0.03, 0.03, 0.08]}
    scene, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "packed", "stepper": "mujoco"})
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
        drop_layout(scene_data, write_scene, settle={"arrangement": "packed", "stepper": "mujoco"})


def test_what_is_a_tower_stands_on_one_another_the_widest_below(scene_data, write_scene):
    """A bolt of 50 mm stands on three nuts of 10 mm, whatever order they are listed in; each is turned for itself."""
    scene_data["objects"] = [{"asset": "assets/bolt", "count": 1}, {"asset": "assets/nut", "count": 3}]
    _, layout = drop_layout(scene_data, write_scene, settle={"arrangement": "tower", "stepper": "mujoco"})
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
        drop_layout(scene_data, write_scene, settle={"arrangement": "tower", "stepper": "mujoco"})


@pytest.mark.parametrize("arrangement", ["upright", "tower", "packed"])
def test_fronts_look_where_yaw_says(scene_data, write_scene, arrangement):
    scene_data["objects"] = [{"asset": "assets/nut", "count": 8}]
    settle = {"arrangement": arrangement, "stepper": "mujoco", "yaw": [80, 110]}
    _, layout = drop_layout(scene_data, write_scene, settle=settle)
    poses = np.array([instance.world_from_object for instance in layout.instances])
    turns = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert turns.min() > 79.9 and turns.max() < 110.1 and np.ptp(turns) > 5


def test_yaw_is_for_what_is_put_down(scene_data, write_scene):
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
def test_what_stands_on_another_side(mesh, quarters):
    turns = [Rotation.from_matrix(turn).as_euler("YXZ", degrees=True)[0] for turn in standing_turns(mesh.vertices)]
    np.testing.assert_allclose(np.mod(turns, 360), np.multiply(quarters, 90.0), atol=1e-9)


@pytest.mark.parametrize("arrangement", ["upright", "tower", "packed"])
def test_what_is_put_down_may_stand_on_another_side(scene_data, write_scene, tmp_path, arrangement):
    box_asset("block", (0.05, 0.03, 0.04)).save(tmp_path / "assets/block")
    scene_data["objects"] = [{"asset": "assets/block", "count": 3}]
    settle = {"arrangement": arrangement, "stepper": "mujoco", "yaw": [-10, 10], "turned_over": 0.8}
    _, layout = drop_layout(scene_data, write_scene, settle=settle)
    poses = np.array([instance.world_from_object for instance in layout.instances])
    assert (poses[:, 1, 1] > np.cos(np.radians(11))).all()  # fronts stay where yaw has them
    ups = {round(np.degrees(np.arctan2(pose[0, 2], pose[2, 2])) / 90) % 4 for pose in poses}
    assert ups - {0}


def test_poses_may_be_given(scene_data, write_scene):
    """A nut put down turned by 30 degrees stays there; one above it comes down by its clearance; others keep off."""
    given = [
        {"position": [0.05, 0.02, 0.005], "rotate": [0, 0, 30]},
        {"position": [0.05, 0.02, 0.0153], "rotate": [0, 0, 30]},
    ]
    scene_data["objects"] = [{"asset": "assets/nut", "poses": given}, {"asset": "assets/bolt", "count": 2}]
    _, layout = drop_layout(scene_data, write_scene, settle={"stepper": "mujoco"})
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
    """A nut of 10 mm whose centre is 2 mm above the table, or 8 mm above that of one below."""
    given = [{"position": [0.05, 0.02, height], "rotate": [0, 0, 30]}, {"position": [0.05, 0.02, 0.005]}]
    given = given if height > 0.005 else given[:1]
    scene_data["objects"] = [{"asset": "assets/nut", "poses": given}]
    match = rf"scene.yaml: objects\[0\].poses\[0\]: must not start in {other} \(got an overlap of {overlap} mm"
    with pytest.raises(InputError, match=match):
        drop_layout(scene_data, write_scene)


def test_friction_is_drawn_anew_for_each_layout(scene_data, write_scene):
    from mitsplat.physics.drop import drop_of

    scene = load_scene(write_scene({**scene_data, "randomise": {"friction": [0.5, 1.5]}}))
    drop = drop_of(scene, lambda text: None)
    drawn = np.array([drop._draw_frictions(index) for index in range(200)])
    nominal = scene.assets[0].friction
    assert kstest(drawn.ravel(), "uniform", args=(0.5 * nominal, nominal)).pvalue > 1e-3
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.2
    bodies = drop._world((0, 0, 1), drop._draw_frictions(3), 1.0).bodies
    assert [body.friction for body in bodies] == [drawn[3, 0], drawn[3, 0], drawn[3, 1]]


def test_standoff_of_a_hull():
    """Pieces that are the mesh stand off by nothing; the hull of an L by half a leg, where its long face spans it."""
    from mitsplat.mesh_distance import Surface, standoff

    floor, wall = trimesh.creation.box((0.022, 0.01, 0.002)), trimesh.creation.box((0.002, 0.01, 0.022))
    floor.apply_translation((0.009, 0, -0.001))
    wall.apply_translation((-0.001, 0, 0.009))
    bracket = trimesh.boolean.union([floor, wall])
    surface = Surface(bracket)
    assert standoff(surface, [floor, wall]) < 1e-5
    # The middle of the hull's long face, from (20, 0) to (0, 20) mm, is 10 mm from both plates.
    assert standoff(surface, [bracket.convex_hull]) == pytest.approx(0.01, abs=2e-4)


def test_standoff_is_the_largest_signed_distance_of_all_points():
    """What is deep inside is farther from the surface than what stands off, and must not count."""
    from mitsplat.mesh import contact_points
    from mitsplat.mesh_distance import _SAMPLES, Surface, standoff

    surface = Surface(trimesh.creation.box((0.04, 0.04, 0.04)))
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
