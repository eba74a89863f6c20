"""View selection: drawn, accepted and chosen views, against brute force over triangles and pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.stats import qmc

from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import layout_index_of, plan_frame
from mitsplat.scene.planning.visibility_prediction import VisibilityPredictor, _occluded, _Occluders
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.camera_spec import Occlusion, Truncation
from mitsplat.storage.field_types import StrictModel
from tests.conftest import BOTH, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes

HEMISPHERE = {
    "kind": "hemisphere",
    "target": [0, 0, 0],
    "radius": [0.5, 1.0],
    "elevation": [10, 70],
    "intrinsics": {"fov_x": 50},
}


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return small_scene(tmp_path, large_boxes(), BOTH, layouts=3, views=8)


def seen_by(scene: Scene, **camera: Any) -> Scene:
    return load_scene(scene.path, overrides={"camera": HEMISPHERE | camera})


def layouts(scene: Scene) -> list[Layout]:
    return [scatter_boxes(scene, index, progress=None) for index in range(scene.spec.output.layouts)]


def views(scene: Scene) -> Iterator[tuple[Any, Layout]]:
    """Return the plans of all frames with their layouts."""
    there = layouts(scene)
    for index in range(scene.num_frames):
        layout = there[layout_index_of(scene, index)]
        yield plan_frame(scene, index, layout), layout


def placed(scene: Scene, layout: Layout) -> list[trimesh.Trimesh]:
    return [scene.assets[one.asset].mesh.copy().apply_transform(one.world_from_object) for one in layout.instances]


def hit_depths(camera: Camera, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the depth [m] of each pixel ray's first hit on a mesh, infinite for a miss, triangle by triangle."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slopes = camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ camera.world_from_camera[:3, :3].T
    nearest = np.full(len(rays), np.inf)
    for a, b, c in mesh.triangles:
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = normal @ (a - camera.centre) / (rays @ normal)
        points = camera.centre + depth[:, None] * rays
        sides = [np.cross(q - p, points - p) @ normal >= 0 for p, q in ((a, b), (b, c), (c, a))]
        inside = np.logical_and.reduce([depth > camera.near, *sides])
        nearest[inside] = np.minimum(nearest[inside], depth[inside])
    return nearest


def twin(camera: Camera, meshes: list[trimesh.Trimesh], shapes: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray]:
    """Return the visible fraction of each mesh, and its share beyond the border, counted ray by ray."""
    wide = replace(
        camera, width=3 * camera.width, height=3 * camera.height, cx=camera.cx + camera.width,
        cy=camera.cy + camera.height,
    )  # fmt: skip
    shape = wide.height, wide.width
    depths = np.array([hit_depths(wide, mesh).reshape(shape) for mesh in (*meshes, *shapes)])
    image = np.zeros(shape, dtype=bool)
    image[camera.height : 2 * camera.height, camera.width : 2 * camera.width] = True
    visible, beyond = [], []
    for depth in depths[: len(meshes)]:
        alone = np.isfinite(depth)
        visible.append((alone & image & (depth <= depths.min(axis=0))).sum() / max(1, (alone & image).sum()))
        beyond.append((alone & ~image).sum() / max(1, alone.sum()))
    return np.array(visible), np.array(beyond)


# Drawing


def test_even_coverage_has_half_the_discrepancy_of_random_views(scene: Scene) -> None:
    def discrepancy(seed: int, coverage: str) -> float:
        camera = HEMISPHERE | {"coverage": coverage}
        drawn = load_scene(scene.path, overrides={"camera": camera, "output.layouts": 16, "seed": seed})
        eyes = np.array([plan_frame(drawn, index).camera.centre for index in range(128)])
        radius = np.linalg.norm(eyes, axis=1)
        azimuth = np.mod(np.arctan2(eyes[:, 1], eyes[:, 0]) / (2 * np.pi), 1)
        low, high = np.sin(np.radians(HEMISPHERE["elevation"]))
        unit = np.stack([azimuth, (eyes[:, 2] / radius - low) / (high - low), (radius - 0.5) / 0.5], axis=1)
        return float(qmc.discrepancy(np.clip(unit, 0, 1)))

    even, random = ([discrepancy(seed, how) for seed in range(4)] for how in ("even", "random"))
    assert max(even) < 0.5 * min(random)


@pytest.mark.parametrize("coverage", ["random", "even"])
def test_views_look_at_existing_objects(scene: Scene, coverage: str) -> None:
    drawn = seen_by(scene, look_at="objects", coverage=coverage)
    looked_at = set()
    for plan, layout in views(drawn):
        one = next(one for one in layout.instances if one.id == plan.viewpoint["object"])
        pixel, depth = plan.camera.project(one.world_from_object[:3, 3])  # the centre of a box
        np.testing.assert_allclose(pixel, [[plan.camera.cx, plan.camera.cy]], atol=1e-9)
        assert 0.5 <= depth[0] <= 1.0
        looked_at.add((layout.index, one.id))
    assert len(looked_at) > 8  # 3 layouts of 4 objects, in 24 views


def test_layouts_without_labelled_objects_are_seen_at_the_target(scene: Scene) -> None:
    drawn = seen_by(scene, look_at="objects", occlusion={"share": 0.5}, accept={"in_view": 1.0})
    layout = layouts(drawn)[0]
    unlabelled = replace(layout, instances=tuple(replace(one, class_index=None) for one in layout.instances))
    for nothing in (unlabelled, replace(layout, instances=())):
        plan = plan_frame(drawn, 1, nothing)
        assert plan.viewpoint["target"] == [0, 0, 0]
        assert plan.viewpoint["object"] is None


def test_frames_are_planned_in_any_order(scene: Scene) -> None:
    drawn = seen_by(scene, look_at="objects", coverage="even", occlusion={"share": 0.4}, truncation={"share": 0.2})
    forwards = [plan.camera.world_from_camera.tolist() for plan, _ in views(drawn)]
    again = load_scene(scene.path, overrides={"camera": drawn.spec.camera.model_dump(mode="json")})
    there = layouts(again)
    for index in (17, 3, 8, 0):
        plan = plan_frame(again, index, there[layout_index_of(again, index)])
        assert plan.camera.world_from_camera.tolist() == forwards[index]
        if plan.next_camera is not None:
            assert plan.next_camera.world_from_camera.tolist() == forwards[index + 1]


def test_the_first_try_is_the_view_without_selection(scene: Scene) -> None:
    """A view that is accepted at once is therefore the same with and without the rule."""
    plain, chosen = seen_by(scene), seen_by(scene, accept={"in_view": 0.0})
    for index, (plan, _) in enumerate(views(chosen)):
        assert plan.viewpoint["attempt"] == 0
        assert plan_frame(plain, index).camera.to_json() == plan.camera.to_json()
        assert not plan_frame(plain, index).viewpoint


def test_tries_without_a_selection_rule_are_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"camera\.tries: needs accept, occlusion or truncation"):
        seen_by(scene, tries=4)


# Prediction


@pytest.mark.parametrize("wall", [False, True])
def test_prediction_agrees_with_rays_through_every_pixel(scene: Scene, wall: bool) -> None:
    if wall:
        box = {"size": [0.3, 0.01, 0.2], "position": [0, -0.25, 0.05]}
        scene = load_scene(scene.path, overrides={"shapes": [{"name": "wall", "box": box, "visible": True}]})
    errors = []
    for index, layout in enumerate(layouts(scene)):
        for azimuth in (250, 285):
            across = np.radians(azimuth)
            eye = 0.75 * np.array([np.cos(across), np.sin(across), 0.3])
            camera = Camera.look_at(eye, (0.05, 0, 0.02 * index), width=64, height=48, fov_x=32)
            sight = VisibilityPredictor.of(scene, layout)
            found = sight.predict(sight.project(camera), None, None, 1)
            visible, beyond = twin(camera, placed(scene, layout), list(scene.shape_meshes))
            errors += [*np.abs(found.visible - visible)[beyond < 1], *np.abs(found.beyond - beyond)]
            assert (visible < 0.9).any()
    assert np.mean(errors) < 0.02
    assert max(errors) < 0.12


def test_possible_occluders_contain_every_triangle_that_hides_a_point() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (40, 3))
    triangles = rng.uniform(-0.5, 0.5, (200, 1, 3)) + rng.uniform(-0.2, 0.2, (200, 3, 3))
    occluders, count = _Occluders(triangles, points), 0
    for eye in rng.uniform(-1, 1, (20, 3)):
        possible = occluders.towards(eye)
        count += len(possible)
        assert _occluded(eye, points, possible).tolist() == _occluded(eye, points, triangles).tolist()
    assert 0 < count < 0.6 * 20 * len(triangles)
    assert len(_Occluders(triangles, points[:0]).towards(np.zeros(3))) == 0
    assert len(_Occluders(triangles[:0], points).towards(np.zeros(3))) == 0


def test_prediction_counts_occlusion_and_truncation(scene: Scene) -> None:
    layout = layouts(scene)[0]
    camera = Camera.look_at((0.1, -0.7, 0.2), (0.1, 0, 0), width=64, height=48, fov_x=25)
    sight = VisibilityPredictor.of(scene, layout)
    found = sight.predict(sight.project(camera), Occlusion(share=1), Truncation(share=1), 1)
    visible, beyond = twin(camera, placed(scene, layout), [])
    shown = (visible > 0) & (beyond < 1)
    assert found.in_view == np.count_nonzero(shown)
    assert found.hidden == np.count_nonzero(shown & (visible >= 0.2) & (visible <= 0.9)) > 0
    assert found.cut == np.count_nonzero(shown & (beyond >= 0.05) & (beyond <= 0.8)) > 0


# Acceptance


def test_accepted_views_satisfy_their_rules(scene: Scene) -> None:
    rules = {"in_view": 0.75, "clearance": 0.32}
    drawn = seen_by(scene, accept=rules, tries=200, radius=[0.2, 1.0])
    attempts = []
    for plan, layout in views(drawn):
        camera, meshes = plan.camera, placed(drawn, layout)
        attempts.append(plan.viewpoint["attempt"])
        samples = [trimesh.sample.sample_surface(mesh, 4000, seed=1)[0] for mesh in meshes]
        assert min(np.linalg.norm(points - camera.centre, axis=1).min() for points in samples) >= 0.32
        whole = 0
        for points in samples:
            pixel, depth = camera.project(points)
            inside = (depth > camera.near) & ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(axis=1)
            whole += inside.mean() > 0.49
        assert whole >= 3
    assert len(set(attempts)) > 1  # some views were rejected


def test_views_from_inside_of_an_object_are_rejected(scene: Scene) -> None:
    inside = seen_by(scene, accept={}, look_at="objects", radius=[0.001, 0.01], tries=3)
    with pytest.raises(InputError, match=r"none of 3 candidate views of frame 0 .* \(the best one is inside ob"):
        plan_frame(inside, 0, layouts(inside)[0])


def test_rules_that_no_view_satisfies_are_refused_with_the_best_view(scene: Scene) -> None:
    far = seen_by(scene, accept={"clearance": 500}, tries=5)
    sentence = (
        r"camera\.accept: none of 5 candidate views of frame 2 .* "
        r"\(the best one is [\d.]+ m from the nearest surface, but clearance is 500"
    )
    with pytest.raises(InputError, match=sentence):
        plan_frame(far, 2, layouts(far)[0])
    assert plan_frame(far, 2).camera.width == 64  # without a layout, no view is rejected


# Shares


def test_shares_of_hidden_and_cut_objects_are_reached(scene: Scene) -> None:
    def shares(**asked: Any) -> tuple[float, float]:
        there = load_scene(scene.path, overrides={"camera": HEMISPHERE | asked, "output.layouts": 8})
        seen = hidden = cut = 0.0
        for plan, layout in views(there):
            sight = VisibilityPredictor.of(there, layout)
            found = sight.predict(sight.project(plan.camera), Occlusion(share=1), Truncation(share=1), 16)
            seen, hidden, cut = seen + found.in_view, hidden + found.hidden, cut + found.cut
        return hidden / seen, cut / seen

    drawn, few, many = shares(), shares(occlusion={"share": 0.3}), shares(occlusion={"share": 0.55})
    assert few[0] < drawn[0] - 0.08 < drawn[0] + 0.08 < many[0]
    assert (few[0], many[0]) == pytest.approx((0.3, 0.55), abs=0.04)
    assert shares(truncation={"share": 0.25}, occlusion={"share": 0.3}, tries=32) == pytest.approx(
        (0.3, 0.25), abs=0.05
    )


# Datasets


def test_chosen_views_are_recorded_and_audited(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {"accept": {"clearance": 0.2}, "occlusion": {"share": 0.3}, "truncation": {"share": 0.2}}
    output = {"output.formats": ["flow", "poses"], "output.views": 2}
    drawn = load_scene(scene.path, overrides={"camera": HEMISPHERE | {"look_at": "objects"} | asked, **output})
    out = write_dataset(drawn, tmp_path / "out", render=render_boxes, settle=scatter_boxes).path
    assert audit_dataset(out).violations == ()
    text = (out / "manifest.jsonl").read_text()
    assert text.count('"predicted":{"in_view"') == drawn.num_frames

    def aside(scene: Scene, index: int, *, layout: Layout) -> Any:
        frame = render_boxes(scene, index, layout=layout)
        target = [*frame.plan.viewpoint["target"][:2], 0.3]
        return replace(frame, plan=replace(frame.plan, viewpoint={**frame.plan.viewpoint, "target": target}))

    wrong = write_dataset(drawn, tmp_path / "wrong", render=aside, settle=scatter_boxes).path
    assert any("looks past the scene's target" in text for _, text in audit_dataset(wrong).violations)


def test_unused_view_rules_are_not_stored(scene: Scene) -> None:
    stored = seen_by(scene).spec.camera.model_dump(mode="json")
    assert isinstance(scene.spec.camera, StrictModel)
    assert not stored.keys() & {"look_at", "coverage", "accept", "occlusion", "truncation", "tries"}


def surrounding(scene: Scene, eye: Any) -> Layout:
    """Place the box of 12 x 16 x 8 cm around a point."""
    pose = np.eye(4)
    pose[:3, 3] = eye
    return Layout.from_poses(scene, {"nut": [pose], "bolt": [None]})


@pytest.mark.parametrize("kind", ["orbit", "path", "given"])
def test_a_given_camera_inside_of_an_object_is_refused(scene: Scene, kind: str) -> None:
    if kind == "path":
        keys = [{"eye": [0.5, 0, 0.4], "target": [0, 0, 0]}]
        scene = load_scene(scene.path, overrides={"camera": {"kind": "path", "keys": keys}})
    eye = plan_frame(scene, 0).camera.centre
    given = {"camera": plan_frame(scene, 0).camera} if kind == "given" else {}
    with pytest.raises(InputError, match=r"frame 0 must not be in a solid \(it is in object 1 \(nut\)\)"):
        plan_frame(scene, 0, surrounding(scene, eye), **given)
    beside = surrounding(scene, np.add(eye, (0.07, 0, 0)))
    np.testing.assert_array_equal(plan_frame(scene, 0, beside, **given).camera.centre, eye)


def test_a_given_camera_in_a_visible_shape_is_refused(scene: Scene) -> None:
    shape = {"name": "block", "box": {"size": [0.1, 0.1, 0.1], "position": [0.5, 0, 0.4]}, "visible": True}
    scene = load_scene(scene.path, overrides={"shapes": [shape]})
    with pytest.raises(InputError, match=r"frame 0 must not be in a solid \(it is in shape 'block'\)"):
        plan_frame(scene, 0, surrounding(scene, (0, 0, 0)))
    assert plan_frame(scene, 1, surrounding(scene, (0, 0, 0)))


@pytest.mark.parametrize(
    "camera",
    [
        {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4, "jitter": 0.06},
        HEMISPHERE,
        HEMISPHERE | {"look_at": "objects"},
        HEMISPHERE | {"occlusion": {"share": 0.3}},
    ],
    ids=["jitter", "hemisphere", "objects", "selected"],
)
def test_a_drawn_camera_inside_of_an_object_is_drawn_again(scene: Scene, camera: dict[str, Any]) -> None:
    scene = load_scene(scene.path, overrides={"camera": camera})
    first = plan_frame(scene, 0, surrounding(scene, (0, 0, -1))).camera.centre
    around = surrounding(scene, np.add(first, (0.05, 0.05, 0.03)))
    seen = plan_frame(scene, 0, around).camera
    again = plan_frame(scene, 0, around).camera
    np.testing.assert_array_equal(seen.centre, again.centre)
    box = placed(scene, around)[0].bounds
    assert not ((seen.centre > box[0]) & (seen.centre < box[1])).all()
    assert np.linalg.norm(seen.centre - first) > 0
