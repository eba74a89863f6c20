"""Small assets and scene files that several tests need."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from ruamel.yaml import YAML

from mitsplat.assets import Asset
from mitsplat.dataset import write_dataset
from mitsplat.scene import load_scene
from mitsplat.spec import FORMATS
from mitsplat.splats import Splats

WriteScene = Callable[..., Path]


def box_asset(name: str, size: tuple[float, float, float] = (0.02, 0.03, 0.01), class_name: str | None = None) -> Asset:
    """A box with a flat grey Gaussian on each face."""
    mesh = trimesh.creation.box(extents=size)
    splats = Splats(
        means=mesh.triangles_center.astype(np.float32),
        quats=np.tile(np.float32([0, 0, 0, 1]), (12, 1)),
        scales=np.full((12, 3), 0.2 * min(size), dtype=np.float32),
        opacities=np.full(12, 0.9, dtype=np.float32),
        sh=np.zeros((12, 1, 3), dtype=np.float32),
    )
    return Asset(name=name, class_name=class_name or name, splats=splats, mesh=mesh, pieces=(mesh,))


@pytest.fixture
def scene_data() -> dict[str, Any]:
    """A valid scene file's content; tests change what they are about."""
    return {
        "name": "small",
        "shapes": [{"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True}],
        "objects": [{"asset": "assets/nut", "count": [1, 2]}, {"asset": "assets/bolt"}],
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "lights": [{"kind": "area", "position": [0.5, 0, 1]}],
        "output": {"width": 64, "height": 48, "layouts": 3, "views": 4},
        "seed": 7,
    }


@pytest.fixture
def write_scene(tmp_path: Path) -> WriteScene:
    """Writes a scene file next to the assets ``nut`` and ``bolt``, and returns its path."""

    def write(data: dict[str, Any], name: str = "scene.yaml") -> Path:
        for asset in (box_asset("nut"), box_asset("bolt", (0.01, 0.01, 0.05))):
            folder = tmp_path / "assets" / asset.name
            if not folder.exists():
                asset.save(folder)
        YAML(typ="safe", pure=True).dump(data, tmp_path / name)
        return tmp_path / name

    return write


@pytest.fixture(scope="session")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset of drawn frames in every format, to be left as it is."""
    from test_dataset import render, settle

    folder = tmp_path_factory.mktemp("clean")
    for asset in (box_asset("nut"), box_asset("bolt", (0.01, 0.01, 0.05))):
        replace(asset, keypoints={"top": (0, 0, 0.005)}).save(folder / "assets" / asset.name)
    data = {
        "name": "small",
        "objects": [{"asset": "assets/nut"}, {"asset": "assets/bolt"}],
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "output": {"width": 64, "height": 48, "layouts": 3, "views": 2, "formats": list(FORMATS)},
    }
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    return write_dataset(load_scene(folder / "scene.yaml"), folder / "out", render=render, settle=settle).path


@pytest.fixture
def dataset(clean: Path, tmp_path: Path) -> Path:
    """A copy of the clean dataset, to be damaged."""
    return Path(shutil.copytree(clean, tmp_path / "out"))
