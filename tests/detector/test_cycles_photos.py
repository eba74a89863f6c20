"""Photographs by Blender Cycles: the things on benches, the cameras, and labels against projected meshes."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pycocotools.mask as coco_mask
import pytest
from PIL import Image

from benchmarks import record
from benchmarks.detector import clutter, cycles_photos, experiment
from benchmarks.detector.interiors import BENCHES, Interior
from benchmarks.light.shadow_scenes import nearest_object, placed, shipped
from mitsplat.geometry.camera import Camera
from mitsplat.runtime.variant import ensure_variant
from scenes.build.parts import PARTS, build_part

BLENDER = os.environ.get("BLENDER_PYTHON", "/tmp/blender/bin/python")
MAKERS = (*clutter.TOOLS, *clutter.GOODS, *clutter.SMALL, *clutter.SOFT)


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_clutter_stands_on_the_bench_and_is_as_large_as_on_a_workbench(make):
    few = {"cells": 20, "steps": 60} if make is clutter.cloth else {}
    thing = make(np.random.default_rng(3), **few)
    low = np.min([mesh.bounds[0] for mesh, _ in thing], axis=0)
    high = np.max([mesh.bounds[1] for mesh, _ in thing], axis=0)
    assert abs(low[2]) < 0.002
    assert 0.01 < (high - low)[:2].max() < 0.4 and high[2] < 0.25
    assert np.isfinite(np.concatenate([mesh.vertices for mesh, _ in thing])).all()
    assert all({"colour", "roughness", "metallic", "pattern"} <= set(material) for _, material in thing)


def test_clutter_covers_neither_parts_nor_other_clutter():
    room, rng = Interior(), np.random.default_rng(0)
    part = np.random.default_rng(1).uniform(-0.03, 0.03, (20, 2))
    room.taken = [cycles_photos.MultiPoint(part).convex_hull]
    for _ in range(12):
        room.strew(clutter.spanner(rng), rng, (0.02, 0.3), np.array([0.6, 0.4]))
    assert len(room.taken) > 4
    assert not any(a.intersects(b) for k, a in enumerate(room.taken) for b in room.taken[:k])


def test_every_component_of_every_part_has_a_material():
    assert set(cycles_photos.FINISHES) == set(PARTS)
    for name in ("relay_box", "bearing_6204", "washer"):
        assert set(cycles_photos.FINISHES[name]) == set(build_part(name, 0)[0].geometry)
    assert len(BENCHES) == 12  # each of the twelve workshops has its own bench


def test_parts_that_are_laid_out_stay_at_their_height_and_apart():
    rng, up = np.random.default_rng(0), np.eye(4)
    up[2, 3] = 0.02
    lying = cycles_photos.laid_out([(name, up) for name in ("relay_box", "bearing_6204", "washer")], rng)
    corners = [np.concatenate([p.mesh.vertices for p in placed(shipped(*one))])[:, :2] for one in lying]
    hulls = [cycles_photos.MultiPoint(points).convex_hull for points in corners]
    assert all(pose[2, 3] == pytest.approx(0.02) for _, pose in lying)
    assert min(a.distance(b) for k, a in enumerate(hulls) for b in hulls[:k]) > 0.005


def test_cameras_see_several_parts_from_arm_length():
    rng, centres = np.random.default_rng(5), np.random.default_rng(0).uniform(-0.1, 0.1, (8, 3)) * (1, 1, 0.1)
    for _ in range(12):
        view = cycles_photos.view_of(rng, Interior(), centres, 480, 22)
        camera = camera_of(view)
        pixels, depth = camera.project(centres)
        assert ((pixels > 0) & (pixels < (480, 320))).all(axis=1).sum() >= 4
        assert 0.2 < depth.min() < depth.max() < 1.2
        assert view["shake"] is None or np.allclose(
            np.mean(view["shake"], axis=0), view["world_from_camera"], atol=1e-3
        )


def camera_of(view: dict) -> Camera:
    size = view["width"], view["height"]
    pose = np.array(view["world_from_camera"])
    return Camera(*size, view["fx"], view["fx"], size[0] / 2, size[1] / 2, pose)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Write a scene of two parts of which the sensor stands before the relay, and one view of it with all blur."""
    ensure_variant()
    poses = [np.eye(4), np.eye(4)]
    poses[0][:3, 3], poses[1][:3, 3] = (0.0, 0.0, 0.0321), (0.012, -0.05, 0.0375)
    view = cycles_photos.view_of(
        np.random.default_rng(2), Interior(), np.array([pose[:3, 3] for pose in poses]), 240, 22
    )
    camera = Camera.look_at((0.1, -0.5, 0.3), (0, 0, 0.03), width=240, height=160, fov_x=30)
    shaken = [camera.world_from_camera.copy() for _ in range(2)]
    shaken[0][0, 3] -= 0.004
    shaken[1][0, 3] += 0.004
    view |= {
        "width": 240, "height": 160, "fx": camera.fx, "world_from_camera": camera.world_from_camera.tolist(),
        "shake": [pose.tolist() for pose in shaken], "fstop": 1.4, "sensor": 23.5, "focus": 0.45,
    }  # fmt: skip
    names = ("relay_box", "proximity_sensor")
    cycles_photos.write_parts(tmp_path, names)
    objects = [
        {"mesh": f"{name}-{part}.npz", "material": clutter.matt((0.4, 0.4, 0.4)), "pose": pose.tolist(), "index": k}
        for k, (name, pose) in enumerate(zip(names, poses, strict=True), 1)
        for part in cycles_photos.FINISHES[name]
    ]
    parts = [{"name": name, "pose": pose.tolist()} for name, pose in zip(names, poses, strict=True)]
    path = tmp_path / "scene_0000.json"
    path.write_text(json.dumps({"objects": objects, "parts": parts, "world": 1.0, "samples": 2, "views": [view]}))
    return path


def things_of(path: Path) -> list:
    return [placed(shipped(one["name"], np.array(one["pose"]))) for one in json.loads(path.read_text())["parts"]]


def test_labels_are_visible_pixels_and_misplaced_masks_are_refused(scene):
    camera, things = camera_of(json.loads(scene.read_text())["views"][0]), things_of(scene)
    index = nearest_object(camera, (), things)
    Image.new("RGB", (240, 160)).save(scene.with_name("scene_0000_0000.jpg"))
    np.savez(scene.with_name(".scene_0000_0000.npz"), index=index.astype(np.uint8))
    (shot,) = cycles_photos.label_scene(scene, scene.parent)
    relay, sensor = shot["objects"]
    assert [sorted(PARTS)[one["category_id"] - 1] for one in (relay, sensor)] == ["relay_box", "proximity_sensor"]
    assert sensor["visible_fraction"] == 1 and 0.5 < relay["visible_fraction"] < 0.97
    assert (coco_mask.decode(relay["segmentation"]) == (index == 1)).all()
    np.savez(scene.with_name(".scene_0000_0000.npz"), index=np.roll(index, 4, axis=1).astype(np.uint8))
    with pytest.raises(ValueError, match="lies outside of its silhouette"):
        cycles_photos.label_scene(scene, scene.parent)


@pytest.mark.skipif(not Path(BLENDER).exists(), reason="needs a Python with bpy (variable BLENDER_PYTHON)")
def test_masks_of_cycles_are_the_projected_meshes_without_blur(scene):
    """Blender's camera moves and is out of focus, but its masks agree with the silhouettes of mitsplat's camera."""
    command = [BLENDER, "-P", "-W", "ignore", cycles_photos.SCRIPT, scene.parent, scene.parent, "1", "2", "0"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    camera, things = camera_of(json.loads(scene.read_text())["views"][0]), things_of(scene)
    index = np.load(scene.with_name(".scene_0000_0000.npz"))["index"]
    assert (index != nearest_object(camera, (), things)).mean() < 0.001
    rows, columns = np.nonzero(index == 2)  # the sensor is not hidden
    pixels, _ = camera.project(np.concatenate([part.mesh.vertices for part in things[1]]))
    assert np.abs(pixels.min(axis=0) - (columns.min(), rows.min())).max() < 1.5
    assert np.abs(pixels.max(axis=0) - (columns.max() + 1, rows.max() + 1)).max() < 1.5
    photograph = np.asarray(Image.open(scene.with_name("scene_0000_0000.jpg")).convert("L"), float)
    assert photograph.shape == (160, 240) and 30 < photograph.mean() < 225


def test_the_plan_of_cycles_judges_the_arms_of_the_workshop_on_other_photographs(tmp_path):
    plan, base = experiment.read_arms(Path("cycles.yaml")), experiment.read_arms(Path("workshop.yaml"))
    assert plan["arms"] == base["arms"] and plan["scene"] == base["scene"]
    assert sorted(scene for fold in plan["folds"] for scene in fold) == list(range(12))
    for folder, names in (
        ("photos", ("scene_0000_0000.jpg",)),
        ("cycles", ("scene_0000_0001.jpg", "scene_0011_0000.jpg")),
    ):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).write_bytes(b"")
        images = [{"id": k, "file_name": name} for k, name in enumerate(names)]
        (tmp_path / folder / "labels.json").write_text(json.dumps({"images": images, "annotations": []}))
    found = experiment.photographs(tmp_path, set(range(12)), "all", experiment.photos_of(plan))
    assert sorted(path.name for path in found.glob("*.jpg")) == ["scene_0000_0001.jpg", "scene_0011_0000.jpg"]
    assert found != experiment.photographs(tmp_path, set(range(12)), "all")


@pytest.mark.extended
def test_benches_are_written_for_blender(tmp_path, physics, monkeypatch):
    monkeypatch.setattr(record, "_open", [{}])
    options = argparse.Namespace(work=tmp_path, blender=None, scenes=1, views=2, width=96, samples=1, processes=1)
    cycles_photos.photograph_benches(options)
    scene = json.loads((tmp_path / "cycles_inputs/scene_0000.json").read_text())
    assert len(scene["views"]) == 2 and 9 <= len(scene["parts"]) <= 15
    assert {one["index"] for one in scene["objects"]} == set(range(len(scene["parts"]) + 1))
    assert all((tmp_path / "cycles_inputs" / one["mesh"]).exists() for one in scene["objects"])
    assert any("emission" in one["material"] for one in scene["objects"])
    assert json.loads((tmp_path / "cycles/labels.json").read_text())["images"] == []
