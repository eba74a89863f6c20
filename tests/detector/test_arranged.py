"""Training data for comparison: objects placed without physics, and meshes instead of splats."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks.detector import arranged, meshes
from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.mesh_file import Texture
from mitsplat.scene.layout import Instance
from mitsplat.scene.planning.object_appearance import ObjectAppearance

BOX = trimesh.creation.box((0.06, 0.08, 0.12))


def place(*, in_bin: bool) -> Any:
    region = SimpleNamespace(min=(-0.2, -0.2, 0.1), max=(0.2, 0.2, 0.6))
    return SimpleNamespace(
        spec=SimpleNamespace(all_regions=[(region, "drop")], shapes=[SimpleNamespace(bin=in_bin or None)])
    )


@pytest.mark.parametrize("in_bin", [False, True])
def test_objects_placed_without_physics_do_not_overlap(in_bin: bool) -> None:
    taken: list[Any] = []
    rng = np.random.default_rng(1)
    poses = [arranged._stand(place(in_bin=in_bin), BOX, 0, taken, rng) for _ in range(6)]
    standing = [BOX.copy().apply_transform(pose) for pose in poses if pose is not None]
    assert len(standing) == 6
    assert [one.bounds[0, 2] for one in standing] == pytest.approx([0] * 6, abs=1e-9)
    assert not any(one.intersects(other) for one in taken for other in taken if one is not other)
    reach = max(np.abs(pose[:2, 3]).max() for pose in poses if pose is not None)
    assert reach < 0.2 if in_bin else 0.2 < reach < 0.3


def test_floating_objects_do_not_overlap_and_are_above_the_floor() -> None:
    taken: list[Any] = []
    rng = np.random.default_rng(2)
    found = [arranged._float(place(in_bin=False), BOX, 0, taken, rng) for _ in range(200)]
    poses = [pose for pose in found if pose is not None]
    assert 8 < len(poses) < 200  # no room for all
    solids = [BOX.copy().apply_transform(pose) for pose in poses]
    assert min(one.bounds[0, 2] for one in solids) > 0
    centres, radius = np.array([pose[:3, 3] for pose in poses]), np.linalg.norm(BOX.extents) / 2
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + np.eye(len(poses))
    assert apart.min() > 2 * radius


def test_a_mesh_gets_the_appearance_of_its_instance() -> None:
    """The instance is twice as bright, has half of the red, is moved, and is rough. Values above white are clipped to
    white.
    """
    texture = np.rint(255 * encode_srgb(np.array([[[0.4, 0.3, 0.8]]]))).astype(np.uint8)
    part = MeshPart("box", BOX, None, Texture(texture, np.zeros((12, 3, 2))), 0.0, 0.9, True)
    look = ObjectAppearance(1, 0, 0.0, 1.0, 2.0, (0.5, 1.0, 1.0), 0.3, 0.02, 0.0, 0)
    pose = np.eye(4)
    pose[2, 3] = 1.0
    found = meshes._placed(part, Instance(1, 0, 0, pose), look)
    assert found.texture is not None
    assert found.texture.pixels[0, 0] == pytest.approx(255 * encode_srgb(np.array([0.4, 0.6, 1.0])), abs=1.5)
    assert (found.roughness, found.reflectance) == (0.3, 0.02)
    assert found.mesh.bounds[:, 2] == pytest.approx([0.94, 1.06]) and BOX.bounds[1, 2] == pytest.approx(0.06)
