"""Audit of objects that fill the image and extend beyond the range in which silhouettes are counted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import mitsplat as ms
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.write import write_dataset
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.frame_plan import plan_frame
from tests.conftest import small_scene

SIDE, DISTANCE = 0.36, 0.0225
LENSES = {"pinhole": (), "distorted": (-0.2, 0.03, 0.0, 0.0)}


def board() -> ms.Asset:
    """Build a board of 0.36 m with Gaussians on its upper face."""
    across = (np.arange(40) + 0.5) / 40 * SIDE - SIDE / 2
    means = np.stack([*np.meshgrid(across, across, [0.0005])], axis=-1).reshape(-1, 3).astype(np.float32)
    splats = ms.Splats(
        means,
        np.tile(np.float32([0, 0, 0, 1]), (len(means), 1)),
        np.tile(np.float32([0.007, 0.007, 0.0002]), (len(means), 1)),
        np.full(len(means), 0.95, dtype=np.float32),
        np.random.default_rng(0).normal(0, 0.5, (len(means), 1, 3)).astype(np.float32),
    )
    mesh = trimesh.creation.box((SIDE, SIDE, 0.001))
    return ms.Asset(name="board", class_name="board", splats=splats, mesh=mesh, pieces=(mesh,))


@pytest.mark.parametrize("lens", LENSES)
def test_a_board_close_to_the_camera_has_no_violation(tmp_path: Path, lens: str) -> None:
    """The board has f s / d pixels on each side, 22 images of 64 px."""
    formats = ["yolo", "coco", *(["bop"] if lens == "pinhole" else [])]
    scene = small_scene(tmp_path, [board()], [{"asset": "assets/board"}], layouts=3, views=1, formats=formats)
    camera = scene.spec.camera.model_copy(update={"distortion": LENSES[lens]})
    scene = replace(scene, spec=scene.spec.model_copy(update={"camera": camera}))

    def settle(scene: ms.Scene, index: int, *, progress: Any) -> Layout:
        camera = plan_frame(scene, index).camera
        pose = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] += (DISTANCE + 0.0005) * camera.world_from_camera[:3, 2] + 0.01 * (index + 1) * pose[:3, 0]
        return Layout.from_poses(scene, {"board": [pose]}, index=index)

    def render(scene: ms.Scene, index: int, *, layout: Layout) -> Any:
        return ms.render_frame(scene, index, layout=layout, quality="fast")

    out = write_dataset(scene, tmp_path / "out", render=render, settle=settle).path
    found = audit_dataset(out)
    assert found.violations == ()
    camera = plan_frame(scene, 0).camera
    for line in (out / "manifest.jsonl").read_text().splitlines():
        (label,) = json.loads(line)["labels"]["instances"]
        assert label["area"] == 64 * 48
        if lens == "pinhole":
            expected = 1 - 64 * 48 / (camera.fx * SIDE / DISTANCE) ** 2
            assert label["truncation"] == pytest.approx(expected, abs=2e-4)
            assert label["silhouette_area"] == 9 * 64 * 48  # as the BOP toolkit counts
        else:
            assert label["truncation"] > 0.99
