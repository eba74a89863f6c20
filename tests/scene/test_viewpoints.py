"""Views that are drawn, accepted and chosen by what lies in a layout, against brute force over triangles and pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import layout_of, plan_frame
from mitsplat.scene.planning.visibility_prediction import VisibilityPredictor
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
    """Plans of all frames with their layouts."""
    there = layouts(scene)
    for index in range(scene.num_frames):
        layout = there[layout_of(scene, index)]
        yield plan_frame(scene, index, layout), layout


def placed(scene: Scene, layout: Layout) -> list[trimesh.Trimesh]:
    return [scene.assets[one.asset].mesh.copy().apply_transform(one.world_from_object) for one in layout.instances]


def hit_depths(camera: Camera, mesh: trimesh.Trimesh) -> np.ndarray:
    """Depth [m] at which each pixel's ray first meets a mesh, infinite where it does not; triangle by triangle."""
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
    """Visible fraction of each mesh, and its share beyond the border, counted ray by ray."""
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
        pixel, depth = plan.camera.project(one.world_from_object[:3, 3])  # the middle of a box
        np.testing.assert_allclose(pixel, [[plan.camera.cx, plan.camera.cy]], atol=1e-9)
        assert 0.5 <= depth[0] <= 1.0
        looked_at.add((layout.index, one.id))
    assert len(looked_at) > 8  # of 3 layouts of 4 objects, in 24 views


def test_a_cluster_is_an_object_and_its_two_neighbours(scene: Scene) -> None:
    for plan, layout in views(seen_by(scene, look_at="clusters")):
        places = np.array([one.world_from_object[:3, 3] for one in layout.instances])
        drawn = places[[one.id for one in layout.instances].index(plan.viewpoint["object"])]
        cluster = places[np.argsort(np.linalg.norm(places - drawn, axis=1))[:3]]
        np.testing.assert_allclose(plan.viewpoint["target"], cluster.mean(axis=0), atol=1e-12)


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
        plan = plan_frame(again, index, there[layout_of(again, index)])
        assert plan.camera.world_from_camera.tolist() == forwards[index]
        if plan.next_camera is not None:
            assert plan.next_camera.world_from_camera.tolist() == forwards[index + 1]


def test_the_first_try_is_the_view_without_selection(scene: Scene) -> None:
    """So that a view which is accepted at once is the same with and without the rule."""
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
    rules = {"in_view": 0.75, "extent": 9.0, "clearance": 0.32}
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
            assert not inside.any() or np.ptp(pixel[inside], axis=0).max() >= 9.0
        assert whole >= 3
    assert len(set(attempts)) > 1  # some were refused


def test_views_from_inside_of_an_object_are_rejected(scene: Scene) -> None:
    inside = seen_by(scene, accept={}, look_at="objects", radius=[0.001, 0.01], tries=3)
    with pytest.raises(InputError, match=r"none of 3 candidate views of frame 0 .* \(the best one is inside ob"):
        plan_frame(inside, 0, layouts(inside)[0])


def test_rules_that_no_view_satisfies_are_refused_with_the_best_view(scene: Scene) -> None:
    far = seen_by(scene, accept={"extent": 500}, tries=5)
    sentence = (
        r"camera\.accept: none of 5 candidate views of frame 2 .* "
        r"\(the best one shows an object of [\d.]+ px, but extent is 500"
    )
    with pytest.raises(InputError, match=sentence):
        plan_frame(far, 2, layouts(far)[0])
    assert plan_frame(far, 2).camera.width == 64  # before there is a layout nothing is known to be refused


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


# Several cameras, pairs, hands and walks

ABOVE = {"kind": "path", "keys": [{"eye": [0, -0.1, 0.9], "target": [0, 0, 0]}], "intrinsics": {"fov_x": 40}}


def moving(scene: Scene, camera: dict[str, Any], *others: dict[str, Any], **output: Any) -> Scene:
    size = {f"output.{key}": value for key, value in output.items()}
    return load_scene(scene.path, overrides={"camera": camera, "cameras": list(others), **size})


def test_cameras_take_views_in_turn(scene: Scene) -> None:
    keys = [{"eye": [x, -0.8, 0.5], "target": [0, 0, 0]} for x in (-0.3, 0, 0.3)]
    drawn = moving(scene, HEMISPHERE, ABOVE, ABOVE | {"keys": keys}, views=8)
    plans = [plan_frame(drawn, index) for index in range(16)]
    assert [plan.viewpoint["camera"] for plan in plans] == [0, 1, 2, 0, 1, 2, 0, 1] * 2
    for index in (1, 4, 7, 9):
        np.testing.assert_allclose(plans[index].camera.centre, (0, -0.1, 0.9), atol=1e-12)
    np.testing.assert_allclose([plans[2].camera.centre, plans[5].camera.centre], [keys[0]["eye"], keys[2]["eye"]])


@pytest.mark.parametrize("camera", [HEMISPHERE | {"look_at": "objects", "occlusion": {"share": 0.4}}, ABOVE])
def test_stereo_pairs_are_rectified(scene: Scene, camera: dict[str, Any]) -> None:
    """A point has the same row in both images, and a disparity of focal length times baseline over depth."""
    drawn = moving(scene, camera | {"stereo": {"baseline": 0.06}, "zoom": [0.8, 1.4]}, views=4)
    layout = layouts(drawn)[0]
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    for index in (0, 2):
        left, right = plan_frame(drawn, index, layout), plan_frame(drawn, index + 1, layout)
        assert (left.viewpoint["side"], right.viewpoint["side"]) == ("left", "right")
        (here, depth), (there, other) = left.camera.project(points), right.camera.project(points)
        np.testing.assert_allclose(depth, other, atol=1e-12)
        np.testing.assert_allclose(
            here - there, np.stack([left.camera.fx * 0.06 / depth, 0 * depth], axis=1), atol=1e-9
        )


def test_an_incomplete_stereo_pair_is_refused(scene: Scene) -> None:
    with pytest.raises(
        InputError, match=r"output\.views: must be a multiple of 3, so that stereo pairs are complete \(got 8\)"
    ):
        moving(scene, HEMISPHERE | {"stereo": {"baseline": 0.06}}, ABOVE, views=8)


def test_zoom_multiplies_focal_lengths(scene: Scene) -> None:
    plans = [plan_frame(seen_by(scene, zoom=[0.5, 2.0]), index) for index in range(24)]
    ratios = np.array([plan.camera.fx for plan in plans]) / plan_frame(seen_by(scene), 0).camera.fx
    np.testing.assert_allclose(ratios, [plan.viewpoint["zoom"] for plan in plans])
    assert 0.5 <= ratios.min() < 0.8 < 1.7 < ratios.max() <= 2.0


def test_a_zoom_beyond_the_field_of_a_fisheye_is_refused(scene: Scene) -> None:
    lens = {"lens": "fisheye", "fx": 24.0, "distortion": [0, 0, 0, 0]}  # corners at 40 px, 96 degrees
    with pytest.raises(InputError, match=r"camera\.intrinsics: a fisheye must show at most 85 degrees"):
        seen_by(scene, intrinsics=lens | {"fx": 30.0}, zoom=[0.8, 1.2])
    seen_by(scene, intrinsics=lens | {"fx": 30.0}, zoom=[1.0, 1.2])


def test_handheld_motion_is_smooth_with_its_stated_deviation(scene: Scene) -> None:
    drawn = moving(scene, ABOVE | {"handheld": {"position": 0.01, "rotation": 2.0}}, layouts=40, views=16)
    still = plan_frame(moving(scene, ABOVE), 0).camera.camera_from_world
    motions = []
    for index in range(drawn.num_frames):
        plan = plan_frame(drawn, index)
        motions.append(plan.viewpoint["handheld"])
        relative = still @ plan.camera.world_from_camera
        np.testing.assert_allclose(relative[:3, 3], motions[-1][:3], atol=1e-12)
        turned = Rotation.from_matrix(relative[:3, :3]).as_rotvec(degrees=True)
        np.testing.assert_allclose(turned, motions[-1][3:], atol=1e-9)
    sway = np.reshape(motions, (40, 16, 6)) / ([0.01] * 3 + [2.0] * 3)
    # 40 layouts of three axes, correlated in time: relative standard error about 1 / sqrt(2 * 120) = 6 %.
    assert np.std(sway[..., :3]) == pytest.approx(1, rel=0.15)
    assert np.std(sway[..., 3:]) == pytest.approx(1, rel=0.15)
    # Of cosines at rates uniform in [0, r], the mean square of a step is 2 (1 - sin(2 pi r) / (2 pi r)) variances.
    expected = 2 * (1 - np.sinc(2 * 0.15))
    assert np.mean(np.diff(sway, axis=1) ** 2) == pytest.approx(expected, rel=0.2)


def test_a_random_walk_is_smooth_and_within_its_ranges(scene: Scene) -> None:
    ranges = {name: HEMISPHERE[name] for name in ("target", "radius", "elevation", "intrinsics")}
    drawn = moving(scene, {"kind": "walk", "azimuth": [-60, 60], "places": 5, **ranges}, layouts=4, views=100)
    eyes = np.array([plan_frame(drawn, index).camera.centre for index in range(400)]).reshape(4, 100, 3)
    radius = np.linalg.norm(eyes, axis=2)
    assert (radius >= 0.5 - 1e-9).all()
    assert (radius <= 1.0 + 1e-9).all()
    elevation, azimuth = (
        np.degrees(np.arcsin(eyes[..., 2] / radius)),
        np.degrees(np.arctan2(eyes[..., 1], eyes[..., 0])),
    )
    assert (elevation >= 10 - 1e-9).all()
    assert (elevation <= 70 + 1e-9).all()
    assert (np.abs(azimuth) <= 60 + 1e-9).all()
    assert len(np.unique(eyes[:, 0].round(6), axis=0)) == 4  # each layout has its own
    step = np.diff(eyes, axis=1)
    # C1: from one step to the next, the velocity changes by a step's share of what it is at most.
    assert np.linalg.norm(np.diff(step, axis=1), axis=2).max() < 0.2 * np.linalg.norm(step, axis=2).max()


def test_datasets_of_rigs_have_no_violations(scene: Scene, tmp_path: Path) -> None:
    hand = HEMISPHERE | {
        "stereo": {"baseline": 0.05},
        "handheld": {"position": 0.01, "rotation": 3},
        "zoom": [0.8, 1.2],
        "defocus": {"aperture": [0, 0.004], "focus": [0.3, 0.9]},
        "motion": {"exposure": [0.002, 0.01], "speed": [0, 0.5], "rotation": [10, 30]},
    }
    walk = {"kind": "walk", **{name: HEMISPHERE[name] for name in ("target", "radius", "elevation", "intrinsics")}}
    drawn = moving(scene, hand, ABOVE, walk, views=8, layouts=2, formats=["poses", "flow"])
    out = write_dataset(drawn, tmp_path / "out", render=render_boxes, settle=scatter_boxes).path
    assert audit_dataset(out).violations == ()

    def wrong(change: dict[str, Any]) -> set[str]:
        def render(scene: Scene, index: int, *, layout: Layout) -> Any:
            frame = render_boxes(scene, index, layout=layout)
            viewpoint = frame.plan.viewpoint | {
                key: value for key, value in change.items() if key in frame.plan.viewpoint
            }
            return replace(frame, plan=replace(frame.plan, viewpoint=viewpoint))

        name = "-".join(change)
        made = write_dataset(drawn, tmp_path / name, render=render, settle=scatter_boxes, frames=4).path
        return {text for _, text in audit_dataset(made).violations}

    assert any("is not the scene's camera for this view" in text for text in wrong({"camera": 1}))
    assert any("is not the scene's camera for this view" in text for text in wrong({"side": "left"}))
    assert any("its intrinsics are not" in text for text in wrong({"zoom": 1.0}))
    assert any("looks past" in text for text in wrong({"handheld": [0.0] * 6}))


def test_lenses_and_motions_are_drawn_within_their_ranges(scene: Scene) -> None:
    ranges = {"aperture": [0.001, 0.004], "focus": [0.3, 0.9]}
    moved = {"exposure": [0.002, 0.01], "speed": [0.1, 0.5], "rotation": [10, 30]}
    drawn = moving(scene, HEMISPHERE | {"defocus": ranges, "motion": moved}, layouts=40, views=2)
    plans = [plan_frame(drawn, index) for index in range(80)]
    lenses = np.array([(plan.camera.aperture_radius, plan.camera.focus_distance) for plan in plans])
    assert [(plan.viewpoint["aperture"], plan.viewpoint["focus"]) for plan in plans] == list(map(tuple, lenses))
    motions = [plan.viewpoint["motion"] for plan in plans]
    rates = np.array([[np.linalg.norm(one[key]) for key in ("velocity", "rotation")] for one in motions])
    found = np.column_stack([lenses, [one["exposure"] for one in motions], rates])
    low, high = np.array([*ranges.values(), *moved.values()]).T
    assert (found >= low).all() and (found <= high).all()
    assert (np.ptp(found, axis=0) > 0.8 * (high - low)).all()
    directions = np.array([one["velocity"] for one in motions]) / rates[:, :1]
    assert np.abs(directions.mean(axis=0)).max() < 0.3  # 1 / sqrt(3 * 80) = 0.065 is one sigma
    same = moving(scene, HEMISPHERE, layouts=40, views=2)
    assert all(
        (plan_frame(same, i).camera.world_from_camera == plans[i].camera.world_from_camera).all() for i in (0, 9)
    )
    assert not plan_frame(same, 0).viewpoint
    assert not same.spec.camera.model_dump(mode="json").keys() & {"defocus", "motion"}


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        (
            {"defocus": {"aperture": [0, 0.01], "focus": [0.01, 1]}},
            "defocus.focus: must be beyond near, 0.01 (got 0.01)",
        ),
        (
            {"defocus": {"aperture": [0.1, 0], "focus": [1, 1]}},
            "defocus.aperture: must be [low, high] with low <= high",
        ),
        ({"defocus": {"focus": [1, 1]}}, "defocus.aperture: is required"),
        ({"motion": {"exposure": [0.01, 0.02]}}, "motion: must have a speed or a rotation"),
        ({"motion": {"exposure": [0, 0.02], "speed": [1, 1]}}, "motion.exposure[0]: must be > 0 (got 0)"),
        (
            {"defocus": {"aperture": [0, 0.01], "focus": [1, 1]}, "intrinsics": {"fov_x": 50, "aperture": 0.01}},
            "defocus: must not be given together with an aperture of the intrinsics",
        ),
    ],
)
def test_invalid_lenses_and_motions_are_refused_in_one_sentence(
    scene: Scene, camera: dict[str, Any], text: str
) -> None:
    with pytest.raises(InputError) as error:
        moving(scene, HEMISPHERE | camera)
    assert f"camera.{text}" in str(error.value)
