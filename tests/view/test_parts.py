"""Shown parts of a scene, and the parts sent again after a change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsplat.asset import Asset
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, PointLight, SpotLight
from mitsplat.view.scene_parts import (
    Frustum,
    Lines,
    ShownMesh,
    ShownPart,
    ShownSplats,
    asset_parts,
    base_colours,
    bounds_of,
    camera_parts,
    changes,
    light_parts,
    scene_parts,
    share_gaussians,
)
from tests.bodies import pose_at
from tests.conftest import box_asset


@pytest.fixture
def scene(scene_data, write_scene) -> Scene:
    return load_scene(write_scene({**scene_data, "enclosure": {"margin": 0.1}}))


def layout_at(scene: Scene, *heights: float) -> Layout:
    return Layout.from_poses(scene, {"nut": [pose_at((0.1 * i, 0, z)) for i, z in enumerate(heights)]})


def named(parts) -> dict[str, ShownPart]:
    return {part.name: part for part in parts}


def test_a_scene_shows_everything_once(scene):
    lights = plan_frame(scene, 0).lights
    parts = [*scene_parts(scene, 0, layout_at(scene, 0.1, 0.2), lights), *camera_parts(scene, 0, None)]
    found = named(parts)
    assert len(found) == len(parts)
    groups = {part.group for part in parts}
    assert groups == {
        *("splats", "meshes", "pieces", "shapes", "enclosure", "regions", "lights", "cameras", "other cameras"),
    }
    assert sum(part.group == "splats" for part in parts) == 2
    frusta = [part.drawable for part in parts if isinstance(part.drawable, Frustum)]
    assert sorted(frustum.index for frustum in frusta) == list(range(scene.num_frames))
    assert found["/cameras/3"].drawable.index == 3
    assert found["/other cameras/4"].drawable.index == 4
    assert sum(part.group == "enclosure" for part in parts) == 5
    box = found["/regions/main"].drawable.segments
    assert box.min(axis=(0, 1)) == pytest.approx(scene.spec.region.min)
    assert box.max(axis=(0, 1)) == pytest.approx(scene.spec.region.max)
    assert len(np.unique(np.sort(box.reshape(12, 6)), axis=0)) > 1
    assert np.count_nonzero(box[:, 1] - box[:, 0], axis=1).tolist() == [1] * 12  # each edge is along one axis


def test_a_scene_without_a_layout_shows_no_objects(scene):
    assert {part.group for part in scene_parts(scene, 0)} == {"shapes", "enclosure", "regions"}


def test_another_layout_sends_changed_poses_only(scene):
    before, after = (named(scene_parts(scene, 0, layout_at(scene, *heights))) for heights in ((0.1, 0.2), (0.0, 0.2)))
    removed, added, moved = changes(before, after)
    assert (removed, added) == ([], [])
    assert {part.name.split("/")[2] for part in moved} == {"0-nut-0"}
    fewer = named(scene_parts(scene, 0, layout_at(scene, 0.1)))
    removed, added, moved = changes(before, fewer)
    assert sorted(removed) == ["/meshes/0-nut-1", "/pieces/0-nut-1/0", "/splats/0-nut-1"]
    assert (added, moved) == ([], [])


def test_a_reloaded_scene_sends_changed_parts_only(scene_data, write_scene):
    path = write_scene(scene_data)
    before = load_scene(path)
    scene_data["shapes"][0]["box"]["size"] = [1, 1, 0.2]
    after = load_scene(write_scene(scene_data))
    one, other = (named(scene_parts(scene, 0, layout_at(scene, 0.1))) for scene in (before, after))
    removed, added, moved = changes(one, other)
    assert removed == [part.name for part in added] == ["/shapes/table"]
    assert moved == []


def test_lights_are_shown_at_their_positions(scene):
    lights = (
        AreaLight(position=(0, 0, 1), target=(0, 0, 0), size=(0.4, 0.2)),
        SpotLight(position=(1, 0, 1), target=(0, 0, 0), cone=20),
        PointLight(position=(0, 1, 1)),
        EnvironmentLight(),
    )
    found = named(light_parts(lights))
    assert sorted(found) == ["/lights/0", "/lights/0-aim", "/lights/1", "/lights/1-aim", "/lights/2"]
    area = found["/lights/0"]
    corners = area.drawable.mesh.vertices @ area.pose[:3, :3].T + area.pose[:3, 3]
    assert np.ptp(corners, axis=0) == pytest.approx([0.4, 0.2, 0])
    spot = found["/lights/1"].drawable.segments[:24].reshape(-1, 3)
    assert np.degrees(np.arctan2(np.hypot(spot[:, 0], spot[:, 1]), spot[:, 2])) == pytest.approx(20)
    assert np.linalg.norm(spot, axis=1) == pytest.approx(0.15)
    assert found["/lights/2"].pose[:3, 3] == pytest.approx([0, 1, 1])


def test_the_path_of_a_light_is_shown_as_a_line(scene_data, write_scene):
    scene_data["lights"][0]["temperature"] = 3000
    scene_data["lights"][0]["path"] = [{"position": [0, 0, 1]}, {"temperature": 3000}, {"position": [0, 1, 1]}]
    found = named(scene_parts(load_scene(write_scene(scene_data)), 0))
    assert found["/lights/path-0"].drawable.segments.tolist() == [[[0, 0, 1], [0.5, 0, 1]], [[0.5, 0, 1], [0, 1, 1]]]


def test_a_thinned_cloud_keeps_its_coverage():
    count = 100
    splats = Splats(
        means=np.arange(3 * count).reshape(count, 3),
        quats=np.tile([0, 0, 0, 1], (count, 1)),
        scales=np.full((count, 3), 0.01),
        opacities=np.full(count, 0.5),
        sh=np.zeros((count, 1, 3)),
    )
    kept = ShownSplats(splats, 0.25).thinned()
    assert len(kept) == 25
    assert np.diff(kept.means[:, 0] / 3) == pytest.approx(np.full(24, 4), abs=1.01)  # evenly spaced
    area, whole = (float(np.prod(some.scales[:, :2], axis=1).sum()) for some in (kept, splats))
    assert area == pytest.approx(whole)
    assert ShownSplats(splats).thinned() is splats


def test_the_gaussians_of_all_clouds_are_limited_together():
    splats = [box_asset("nut").splats for _ in range(5)]
    parts = [ShownPart(f"/splats/{i}", ShownSplats(one)) for i, one in enumerate(splats)]
    for most in (60, 59, 30, 20, 7):
        shared, count = share_gaussians(parts, most)
        drawn = [len(part.drawable.thinned()) for part in shared]
        assert count == 60 and sum(drawn) <= max(most, 5) and len(set(drawn)) == 1
        assert min(drawn) >= max(1, int(most / 60 / 2**0.5 * 12))
    assert share_gaussians(parts, 60)[0] == parts
    fewer, more = (share_gaussians(parts[:n], 22)[0] for n in (4, 5))
    assert changes({p.name: p for p in fewer}, {p.name: p for p in more[:4]}) == ([], [], [])


def test_shown_colours_are_averages_over_directions():
    splats = box_asset("nut").splats
    sh = np.zeros((12, 4, 3), dtype=np.float32)
    sh[:, 0], sh[:, 1:] = 0.25 / 0.28209479, 7.0
    assert base_colours(replace(splats, sh=sh)) == pytest.approx(0.75)


def test_an_asset_shows_its_splats_mesh_pieces_and_keypoints():
    asset: Asset = replace(box_asset("nut"), keypoints={"top": (0, 0, 0.005)})
    found = named(asset_parts(asset))
    assert sorted(found) == ["/keypoints/all", "/meshes/nut", "/pieces/nut/0", "/splats/nut"]
    low, high = bounds_of(found.values())
    assert (high - low <= asset.mesh.extents + 1e-6).all()


def test_parts_of_the_same_look_are_not_sent_again():
    pose = look_at_pose((1, 0, 1), (0, 0, 0))
    line = np.zeros((1, 2, 3))
    one = {
        "a": ShownPart("/a/a", Lines(line, (1, 2, 3)), pose),
        "b": ShownPart("/b/b", ShownMesh(box_asset("x").mesh, (1, 1, 1))),
    }
    other = {
        "a": ShownPart("/a/a", Lines(line.copy(), (1, 2, 3)), pose.copy()),
        "b": ShownPart("/b/b", ShownMesh(box_asset("x").mesh, (1, 1, 1))),
    }
    assert changes(one, other) == ([], [], [])
    other["b"] = replace(other["b"], drawable=ShownMesh(box_asset("x", (0.1, 0.1, 0.1)).mesh, (1, 1, 1)))
    assert changes(one, other)[0] == ["b"]
