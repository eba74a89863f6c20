"""Primitives: closed solids for physics, covered by splats, and determined by the seed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from mitsplat.asset import Asset
from mitsplat.scene.loading.primitives import make_primitives
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.streams import random_stream
from tests.conftest import WriteScene


@pytest.fixture(scope="module")
def primitives() -> tuple[Asset, ...]:
    return make_primitives(random_stream(7, "primitive", number) for number in range(10))


def test_primitives_are_solids_that_their_splats_cover(primitives: tuple[Asset, ...]) -> None:
    assert len({asset.name for asset in primitives}) == 10
    assert sorted({asset.class_name for asset in primitives}) == ["box", "capsule", "cone", "cylinder", "sphere"]
    for asset in primitives:
        assert asset.mesh is not None
        assert asset.mesh.is_watertight and asset.mesh.is_convex and asset.mesh.volume > 0
        assert 0.025 <= asset.mesh.extents.max() <= 0.06
        assert asset.check() == ()
        area = 4 * np.sqrt(asset.mesh.area / len(asset.splats))
        places = asset.mesh.sample(500, seed=0)
        distance, _ = KDTree(asset.splats.means).query(places)
        assert distance.max() < area
    colours = {tuple(np.round(asset.splats.sh[0, 0], 3)) for asset in primitives}
    assert len(colours) == 10
    assert any(len(np.unique(asset.splats.sh.round(3), axis=0)) == 2 for asset in primitives)


def test_the_seed_determines_primitives(primitives: tuple[Asset, ...]) -> None:
    """Tests one primitive of each kind."""
    again, other = (
        make_primitives(random_stream(seed, "primitive", number) for number in range(count))
        for seed, count in ((7, 5), (8, 1))
    )
    for one, same in zip(primitives[:5], again, strict=True):
        assert one.mesh is not None and same.mesh is not None
        assert (one.mesh.vertices == same.mesh.vertices).all()
        for array in ("means", "quats", "scales", "sh"):
            assert (getattr(one.splats, array) == getattr(same.splats, array)).all()
    assert primitives[0].splats.sh.tolist() != other[0].splats.sh.tolist()


def test_entries_share_primitives_and_scale_them(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    scene_data["objects"] = [
        {"asset": "assets/nut"},
        {"pool": "primitives", "label": False},
        {"pool": "primitives", "label": False, "scale": 2},
    ]
    scene = load_scene(write_scene(scene_data))
    assert scene.class_names == ("nut",)
    assert [len(pool) for pool in scene.pools] == [1, 15, 15]
    for one, larger in zip(scene.assets[1:16], scene.assets[16:], strict=True):
        assert one.mesh is not None and larger.mesh is not None
        assert larger.mesh.extents.max() == pytest.approx(2 * one.mesh.extents.max())
