"""Layouts against what they promise."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from mitsplat.errors import InputError
from mitsplat.scene import load_scene
from mitsplat.settle import Layout, settle_layout, warp_settings

STEPPERS = ("warp", "mujoco")


@pytest.fixture(scope="module", autouse=True)
def physics():
    """Every world of a module is made under the settings that layouts are settled with."""
    with warp_settings():
        yield


def pose_at(position, rotation=None):
    pose = np.eye(4)
    pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation.as_matrix()
    return pose


def lowest(mesh, pose):
    return float((mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min())


def test_clearance_of_boxes():
    from mitsplat.clearance import PlacedSurface, Surface, clearance

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
    from mitsplat.clearance import all_clearances
    from mitsplat.drop import drop_of

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
        assert min(pair.distance for pair in all_clearances(placed, drop._obstacles, reach=0.005)) > 0.0009
    rotations = np.concatenate(rotations)
    # Haar measure: every column is uniform on the sphere, so its z is uniform (Archimedes); the angle t has
    # density (1 - cos t) / pi.
    for column in range(3):
        assert kstest(rotations[:, 2, column], "uniform", args=(-1, 2)).pvalue > 1e-3
    angles = Rotation.from_matrix(rotations).magnitude()
    assert kstest(angles, lambda t: (t - np.sin(t)) / np.pi).pvalue > 1e-3


def test_a_layout_holds_what_its_certificate_says(scene_data, write_scene):
    scene = load_scene(write_scene(scene_data))
    said = []
    layout = settle_layout(scene, 0, progress=said.append)
    names = [scene.class_names[instance.class_index] for instance in layout.instances]
    assert [instance.id for instance in layout.instances] == list(range(1, len(names) + 1))
    assert names.count("bolt") == 1
    assert 1 <= names.count("nut") <= 2
    for instance in layout.instances:
        mesh = scene.assets[instance.asset].mesh
        assert lowest(mesh, instance.world_from_object) == pytest.approx(0.0, abs=3e-4)
    certificate = layout.certificate
    assert certificate.rested
    assert certificate.max_speed < 1e-3
    assert certificate.surface_motion < 5e-4
    assert certificate.deepest_penetration < 3e-4
    assert certificate.support_gap < 1e-3
    assert certificate.attempts == len(certificate.refused) + 1


def test_layouts_survive_json(scene_data, write_scene):
    layout = settle_layout(load_scene(write_scene(scene_data)), 1)
    again = Layout.from_json(json.loads(json.dumps(layout.to_json())))
    assert again.certificate == layout.certificate
    assert again.to_json() == layout.to_json()
    for one, other in zip(again.instances, layout.instances, strict=True):
        np.testing.assert_array_equal(one.world_from_object, other.world_from_object)


@pytest.mark.parametrize("stepper", STEPPERS)
def test_seed_and_index_decide_every_byte(stepper, scene_data, write_scene):
    """A process that settles layout 2 alone, and one that has settled another before, agree."""
    scene_data["settle"] = {"stepper": stepper}
    path = write_scene(scene_data)
    scene = load_scene(path)
    settle_layout(scene, 1)
    here = json.dumps(settle_layout(scene, 2).to_json())
    program = (
        "import json, sys; from mitsplat.scene import load_scene; from mitsplat.settle import settle_layout;"
        "sys.stdout.write(json.dumps(settle_layout(load_scene(sys.argv[1]), 2).to_json()))"
    )
    there = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
    ).stdout
    assert hashlib.sha256(there.encode()).hexdigest() == hashlib.sha256(here.encode()).hexdigest()
    assert json.dumps(settle_layout(scene, 1).to_json()["instances"]) != json.dumps(json.loads(here)["instances"])


def test_draws_that_fall_off_are_refused_and_counted(scene_data, write_scene):
    """On a pedestal narrower than the region some draws stay and some leave."""
    scene_data["shapes"][0]["box"] = {"size": [0.12, 0.12, 0.1], "position": [0, 0, -0.05]}
    scene_data["region"] = {"min": [-0.1, -0.1, 0.01], "max": [0.1, 0.1, 0.1]}
    scene_data["settle"] = {"attempts": 30, "stepper": "mujoco"}
    scene = load_scene(write_scene(scene_data))
    certificates = [settle_layout(scene, index).certificate for index in range(3)]
    refused = [reason for certificate in certificates for reason in certificate.refused]
    assert refused
    assert all("left the enclosure" in reason for reason in refused)
    assert all(certificate.attempts == len(certificate.refused) + 1 for certificate in certificates)


def test_a_layout_that_never_rests_is_an_error(scene_data, write_scene):
    scene_data["settle"] = {"max_time": 0.05, "attempts": 3}
    with pytest.raises(InputError, match=r"layout 0 must come to rest .*3 x not at rest within 0\.05 s"):
        settle_layout(load_scene(write_scene(scene_data)), 0)


def test_a_region_too_small_is_an_error(scene_data, write_scene):
    scene_data["objects"][0]["count"] = 60
    scene_data["region"] = {"min": [-0.05, -0.05, 0.01], "max": [0.05, 0.05, 0.08]}
    with pytest.raises(InputError, match=r"scene.yaml: region must be large enough .*the 61 of a layout"):
        settle_layout(load_scene(write_scene(scene_data)), 0)


def test_a_scene_without_colliders_is_an_error(scene_data, write_scene):
    scene_data["shapes"][0]["collider"] = False
    with pytest.raises(InputError, match="something to rest on"):
        settle_layout(load_scene(write_scene(scene_data)), 0)


def test_an_environment_carries_objects(scene_data, write_scene):
    scene = load_scene(write_scene(scene_data))
    step = trimesh.creation.box((0.6, 0.6, 0.04)).apply_translation((0, 0, -0.005))
    environment = replace(scene.assets[0], name="cell", mesh=step, pieces=(step,), kind="environment")
    region = scene.spec.region.model_copy(update={"min": (-0.2, -0.2, 0.03)})
    spec = scene.spec.model_copy(update={"region": region, "environment_collides": True})
    raised = replace(scene, environment=environment, spec=spec)
    layout = settle_layout(raised, 0)
    for instance in layout.instances:
        mesh = scene.assets[instance.asset].mesh
        assert lowest(mesh, instance.world_from_object) == pytest.approx(0.015, abs=3e-4)


def test_no_objects_make_an_empty_layout(scene_data, write_scene):
    scene_data["objects"] = []
    assert settle_layout(load_scene(write_scene(scene_data)), 0).instances == ()
