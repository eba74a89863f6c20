"""Memory budget of workers: an upper bound of measured peaks that scales with the scene."""

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsplat.checks import doctor
from mitsplat.engine import pool as engine
from mitsplat.engine.resources import WorkerMemory
from mitsplat.frames import budget
from mitsplat.frames.budget import worker_memory
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import PRESETS
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.projection.clouds import Placement, merge_clouds, upload_cloud
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.renderer.splatting.tiles import bin_gaussians
from mitsplat.scene.loading.scene_loading import load_scene
from tests.conftest import BOTH, nut_and_bolt, small_scene

CHILD = """
import sys, numpy as np
from mitsplat.frames.budget import worker_memory
from mitsplat.frames.frame import render_frame
from mitsplat.renderer.layers import make_sensor
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
scene = load_scene(sys.argv[1])
poses = [np.eye(4) for _ in range(6)]
for i, pose in enumerate(poses):
    pose[:2, 3] = 0.05 * i - 0.12, 0.02 * i
objects = (Instance(i + 1, i % 2, scene.class_index(i % 2), pose) for i, pose in enumerate(poses))
layout = Layout(0, tuple(objects), NO_PHYSICS)
for index in range(2):
    render_frame(scene, index, layout=layout)
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
need = worker_memory(scene)
print(int(peak.split()[1]) * 1024, need.own + need.shared)
"""


def floor(count: int, degree: int = 3) -> Splats:
    rng = np.random.default_rng(0)
    return Splats(
        means=rng.uniform((-1, -1, -0.02), (1, 1, 0), (count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.4, 1.4, (count, 3)) / np.sqrt(count),
        opacities=rng.uniform(0.3, 1, count),
        sh=rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3)),
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("budget")
    boxes = nut_and_bolt()
    boxes = [replace(box, splats=floor(2000).transformed(np.diag([0.02, 0.02, 0.02, 1.0]))) for box in boxes]
    objects = [{**entry, "count": 3} for entry in BOTH]
    return small_scene(folder, boxes, objects, layouts=1, views=2, width=320, height=240)


@pytest.fixture(scope="module")
def room(scene):
    """Return the scene in an environment of 200,000 Gaussians."""
    return replace(scene, environments=(replace(scene.assets[0], splats=floor(200_000), kind="environment"),))


def test_the_budget_covers_the_peak_of_a_rendering_process(room):
    folder = room.path.parent
    room.environments[0].save(folder / "assets/room")
    text = room.path.read_text()
    (folder / "room.yaml").write_text(f"{text}environment: assets/room\n")
    output = subprocess.run([sys.executable, "-c", CHILD, folder / "room.yaml"], capture_output=True, check=True).stdout
    peak, need = map(float, output.split()[-2:])
    assert peak < need < 4 * peak


def test_doctor_requires_the_memory_of_the_default_scene():
    need = worker_memory(load_scene(Path(__file__).parents[2] / "scenes/workcell.yaml"))
    assert 0.5 < (need.own + need.shared) / 2**30 / doctor.NEEDED_MEMORY < 1


def test_the_budget_grows_with_the_contents_of_a_scene(scene, room):
    def changed(**output):
        spec = room.spec
        return replace(room, spec=spec.model_copy(update={"output": spec.output.model_copy(update=output)}))

    def finer(samples):
        rendering = room.spec.rendering.model_copy(update={"samples": samples})
        return replace(room, spec=room.spec.model_copy(update={"rendering": rendering}))

    need = worker_memory(room)
    size = 200_000 * 4 * (3 + 4 + 3 + 1 + 48)
    assert need.shared - worker_memory(scene).shared == size
    assert need.own - worker_memory(scene).own > budget.COPIES * size
    pixels = 320 * 240
    assert worker_memory(changed(width=640)).own - need.own > budget.PER_RAY * pixels
    assert worker_memory(finer(2)).own - need.own == pytest.approx(3 * budget.PER_RAY * pixels)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("rendering", [{}, {"samples": 2}, {"kernel": "3dgs"}])
def test_the_estimated_pairs_bound_the_true_number(preset, rendering):
    """For discs that face the camera, the estimate is at least the number of pairs in the renderer.

    For wide discs it is below 1.5 times that number.
    """
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=256, height=192, fov_x=50)
    quality = replace(PRESETS[preset], **rendering)
    view = view_of(make_sensor(camera)).sampled(quality.rays_per_axis)
    count, rng = 300, np.random.default_rng(0)
    means = np.concatenate([rng.uniform(-0.3, 0.3, (count, 2)), np.zeros((count, 1))], axis=1)
    for radius, opacity in itertools.product((0.001, 0.01, 0.05), (0.05, 0.99)):
        scales = np.tile([radius, radius, 1e-4], (count, 1))
        discs = Splats(means, np.tile([0, 0, 0, 1], (count, 1)), scales, [opacity] * count, np.zeros((count, 1, 3)))
        clouds = merge_clouds([upload_cloud(discs.means, discs.quats, discs.scales, discs.opacities, discs.sh)])
        real = bin_gaussians(clouds, [Placement(0, np.eye(4), 1)], view, quality).pairs
        need = budget._pairs(discs, camera, quality)
        assert real <= need
        assert radius == 0.001 or need < 1.5 * real
    assert budget._pairs(discs, camera, quality, position=(0, 0, -3)) == 0


def test_a_margin_of_one_counts_the_pairs_of_an_image_three_times_as_wide():
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=256, height=192, fov_x=50)
    canvas = replace(camera, width=3 * 256, height=3 * 192, cx=camera.cx + 256, cy=camera.cy + 192)
    count, rng = 500, np.random.default_rng(0)
    means, turns = rng.uniform(-3, 3, (count, 3)), np.tile([0, 0, 0, 1], (count, 1))
    splats = Splats(means, turns, np.full((count, 3), 0.02), [0.9] * count, np.zeros((count, 1, 3)))
    quality = PRESETS["fast"]
    found = budget._pairs(splats, camera, quality, margin=1)
    assert found == budget._pairs(splats, canvas, quality) > budget._pairs(splats, camera, quality) > 0


def test_the_memory_of_a_scene_with_a_fisheye_lens_is_estimated():
    """A corner of the canvas of silhouettes is beyond the largest angle of the lens."""
    assert worker_memory(load_scene(Path(__file__).parents[2] / "scenes/fisheye.yaml")).own > budget.BASE


@pytest.mark.parametrize(("own", "shared", "expected"), [(1, 0, 8), (2, 0, 5), (2, 5, 2), (20, 0, 1)])
def test_the_number_of_workers_is_bounded_by_memory(monkeypatch, own, shared, expected):
    monkeypatch.setattr(engine, "unused_memory", lambda: 10.5)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert engine.affordable_workers(WorkerMemory(own * 2**30, shared * 2**30)) == expected
