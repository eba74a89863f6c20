"""Visibility of keypoints in rendered frames, against rays cast at the meshes in float64."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from mitsplat.asset import Asset
from mitsplat.frames.frame import Renderer
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.labels.keypoint_visibility import _keypoint_rays
from mitsplat.labels.labels import HIDDEN, UNLABELLED, VISIBLE
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene

CERTAIN = 5e-4
"""Lateral distance to the edge of an occluder from which the reference decides [m]."""


def solid_asset(name: str, mesh: trimesh.Trimesh, points: np.ndarray) -> Asset:
    """Build an opaque asset with Gaussians all over a mesh and the given keypoints [m]."""
    surfels = place_surfels(mesh, 1.0, 600, np.random.default_rng(0))
    splats = Splats(
        surfels.points, surfels.quats, surfels.scales, np.full(len(surfels), 0.98), np.zeros((len(surfels), 1, 3))
    )
    named = {f"p{i}": tuple(point) for i, point in enumerate(points.tolist())}
    return Asset(name=name, class_name=name, splats=splats, mesh=mesh, pieces=(mesh,), keypoints=named)


def pierced_plate() -> trimesh.Trimesh:
    """Build a plate of 1 mm with a hole of 20 mm."""
    return trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.001, sections=24)


def assets() -> list[Asset]:
    """Build a box, a thin pierced plate, an L that hides its own parts, and a rod, with keypoints at all places."""
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    plate = pierced_plate()
    standing = trimesh.creation.box((0.02, 0.05, 0.07))
    standing.apply_translation((-0.02, 0, 0.035))
    lying = trimesh.creation.box((0.07, 0.05, 0.015))
    bracket = trimesh.boolean.union([standing, lying], engine="manifold")
    rod = trimesh.creation.cylinder(0.0015, 0.1, sections=12)
    middle = np.zeros((1, 3))
    above = np.array([[0, 0, 0.03], [0.028, 0.018, 0.0148]])  # off the surface, and 0.2 mm inside of it
    return [
        solid_asset("box", box, np.concatenate([box.vertices, middle, above])),
        solid_asset("plate", plate, np.concatenate([plate.vertices[::5], middle])),
        solid_asset("bracket", bracket, bracket.vertices),
        solid_asset("rod", rod, np.array([[0, 0, -0.05], [0, 0, 0.05], [0.0015, 0, 0], [-0.0015, 0, 0]])),
    ]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("keypoints")
    built = assets()
    for asset in built:
        asset.save(folder / "assets" / asset.name)
    data = {
        "name": "keypoints",
        "shapes": [
            {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True},
            {"name": "post", "box": {"size": [0.02, 0.02, 0.2], "position": [0.1, -0.1, 0.1]}, "visible": True},
        ],
        "objects": [{"asset": f"assets/{asset.name}"} for asset in built],
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "labels": {"min_pixels": 1, "min_fragment": 1, "min_visible": 0, "min_agreement": 0},
        "output": {"width": 96, "height": 72, "layouts": 1, "views": 8},
    }
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    return load_scene(folder / "scene.yaml")


LENSES = {
    "pinhole": {},
    "distorted": {"distortion": (-0.2, 0.05, 0.001, -0.001)},
}


def first_hits(triangles: np.ndarray, start: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance to the first triangle along each ray, infinite for a miss (Möller and Trumbore 1997)."""
    a, one, two = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    nearest = np.full(len(directions), np.inf)
    for i, direction in enumerate(directions):
        across = np.cross(direction, two)
        det = (one * across).sum(axis=1)
        with np.errstate(all="ignore"):
            u = ((start - a) * across).sum(axis=1) / det
            q = np.cross(start - a, one)
            v, t = (q * direction).sum(axis=1) / det, (q * two).sum(axis=1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & np.isfinite(t)
        nearest[i] = t[hit].min(initial=np.inf)
    return nearest


def reference(scene: Any, layout: Layout, camera: Camera, point: np.ndarray) -> int | None:
    """Return the visibility of a point by a ray to it; None if rays around it differ, because it is at an edge.

    A ray that ends within 0.3 mm of the point reaches it.
    """
    triangles = [
        scene.assets[one.asset].mesh.triangles @ one.world_from_object[:3, :3].T + one.world_from_object[:3, 3]
        for one in layout.instances
    ]
    triangles = np.concatenate([*triangles, *(mesh.triangles for mesh in scene.shape_meshes)])
    way = point - camera.centre
    right, down = camera.world_from_camera[:3, :2].T
    angles = np.arange(16) * np.pi / 8
    ring = CERTAIN * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * down)
    ways = np.concatenate([way[None], way + ring])
    lengths = np.linalg.norm(ways, axis=1)
    hits = first_hits(triangles, camera.centre, ways / lengths[:, None])
    reached = hits >= lengths - 3e-4
    if reached[0]:
        return VISIBLE if reached[1:].any() else None
    return HIDDEN if reached.sum() < 5 else None


def scattered(scene: Any, seed: int) -> Layout:
    """Place two objects of each asset in random poses above the table."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (4, 2, 1, 1))
    for pose in poses.reshape(-1, 4, 4):
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform((-0.12, -0.12, 0.05), (0.12, 0.12, 0.15))
    return Layout.from_poses(scene, dict(enumerate(poses)))


@pytest.mark.parametrize("lens", LENSES)
def test_a_keypoint_is_hidden_only_by_what_is_in_front_of_it(scene: Any, lens: str) -> None:
    counts = {VISIBLE: 0, HIDDEN: 0, None: 0}
    with Renderer(scene, quality="fast") as renderer:
        for seed in range(2):
            layout = scattered(scene, seed)
            eye = Rotation.from_euler("z", 40 * seed, degrees=True).apply((0.3, 0, 0.35))
            camera = Camera.look_at(eye, (0, 0, 0.05), width=96, height=72, fov_x=60)
            camera = replace(camera, **LENSES[lens])
            frame = renderer.render(0, layout=layout, camera=camera)
            placed = {one.id: one for one in layout.instances}
            for label in frame.labels.instances:
                pose = placed[label.id].world_from_object
                points = scene.assets[label.asset].keypoint_array @ pose[:3, :3].T + pose[:3, 3]
                for point, (_, _, visibility) in zip(points, label.keypoints, strict=True):
                    if visibility == UNLABELLED:
                        continue
                    expected = reference(scene, layout, camera, point)
                    counts[expected] += 1
                    assert expected in (None, visibility), (scene.assets[label.asset].name, point, visibility)
    assert counts[VISIBLE] > 50 and counts[HIDDEN] > 50 and counts[None] < 0.15 * sum(counts.values())


def keypoints_of(scene: Any, name: str, pose: np.ndarray, eye: tuple[float, float, float], **camera: Any) -> list[int]:
    layout = Layout.from_poses(scene, {name: [pose]})
    seen = Camera.look_at(eye, pose[:3, 3], width=96, height=72, fov_x=40, **camera)
    with Renderer(scene, quality="fast") as renderer:
        (label,) = renderer.render(0, layout=layout, camera=seen).labels.instances
    return label.keypoints[:, 2].astype(int).tolist()


def test_seven_corners_of_a_box_are_visible_from_a_diagonal(scene: Any) -> None:
    pose = np.eye(4)
    pose[2, 3] = 0.2
    *corners, middle, above, inside = keypoints_of(scene, "box", pose, (0.25, 0.22, 0.4))
    assert sorted(corners) == [HIDDEN, *[VISIBLE] * 7]
    assert (middle, above, inside) == (HIDDEN, VISIBLE, VISIBLE)


def test_a_thin_plate_hides_its_far_side_but_not_the_centre_of_its_hole(scene: Any) -> None:
    pose = np.eye(4)
    pose[2, 3] = 0.2
    *rim, centre = keypoints_of(scene, "plate", pose, (0.0, 0.02, 0.6))
    upper = pierced_plate().vertices[::5, 2] > 0
    outer = np.linalg.norm(pierced_plate().vertices[::5, :2], axis=1) > 0.02
    # From above, perspective hides the lower corners at the outer rim and shows those in the hole on the far side.
    assert [rim[i] for i in np.flatnonzero(upper)] == [VISIBLE] * upper.sum()
    assert [rim[i] for i in np.flatnonzero(~upper & outer)] == [HIDDEN] * (~upper & outer).sum()
    assert centre == VISIBLE


def test_rays_to_keypoints_beside_the_camera_are_finite() -> None:
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), width=96, height=72, fov_x=60)
    rays = _keypoint_rays(np.array([(0.2, 0.1, 1.0), (0.2, 0.1, 1.5)]), camera)
    assert np.isfinite(rays).all()
