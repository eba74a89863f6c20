"""Choice of the object among points of a cluttered scene: by viewing directions or by a hint, on uneven ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.capture.isolation import PhotoView, Pick, choose_object
from mitsplat.capture.isolation.object_choice import focus_of
from mitsplat.capture.isolation.support import find_support
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from tests.capture.isolation.balls import THINGS, ground, three_balls


@pytest.fixture(scope="module")
def place() -> tuple[Float64Array, Int64Array, list[PhotoView]]:
    """Return points on the ground (label 0) and on the visible part of the balls (1, 2, 3), and cameras around."""
    return three_balls()


def ball_of(points: Float64Array, place: tuple[Float64Array, Int64Array, list[PhotoView]]) -> set[int]:
    """Return the labels of the chosen points."""
    every, labels, _ = place
    row = {tuple(point): int(label) for point, label in zip(every.tolist(), labels, strict=True)}
    return {row[tuple(point)] for point in points.tolist()}


def pick(place: tuple[Float64Array, Int64Array, list[PhotoView]], thing: int) -> Pick:
    """Pick the top of a ball by a pixel of the first photo."""
    view = place[2][0]
    x, y = THINGS[thing - 1]
    top = np.array([[x, y, 0.08 + float(ground(np.array([[x, y]]))[0])]])
    u, v = view.camera.project(top)[0][0]
    return Pick("one.jpg:1,2", view, (float(u), float(v)))


def test_uneven_ground_under_objects_is_found_within_2_mm(
    place: tuple[Float64Array, Int64Array, list[PhotoView]],
) -> None:
    points, labels, views = place
    support = find_support(points, focus_of([view.camera for view in views])[0], 0.28)
    near = (labels == 0) & (np.abs(points[:, :2]) < 0.2).all(axis=1)
    gap = support.under(points[near]) - ground(points[near])
    assert np.sqrt(np.mean(gap**2)) < 0.002
    assert support.roughness < 0.002


def test_the_object_in_the_focus_of_the_cameras_is_chosen(
    place: tuple[Float64Array, Int64Array, list[PhotoView]],
) -> None:
    points, labels, views = place
    found = choose_object(points, views)
    assert sorted(sorted(ball_of(other, place)) for other in found.others) == [[2], [3]]
    assert ball_of(found.above, place) == {1}
    assert len(found.above) > 0.85 * np.count_nonzero(labels == 1)
    feet = found.points[len(found.above) :]
    assert np.abs(feet[:, 2] - ground(feet)).max() < 0.006
    assert 10 < len(feet) < 0.3 * len(found.above)  # the lowest 15 % of a ball


def test_the_focus_is_the_point_at_which_most_cameras_are_directed() -> None:
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    targets = [(0.5, 0.5, 0.0) if number % 4 == 0 else (0.1, 0.0, 0.03) for number in range(12)]
    eyes = np.column_stack([np.cos(turns), np.sin(turns), np.full(12, 0.5)])
    cameras = [Camera.look_at(e, aim, width=320, height=240, fov_x=60) for e, aim in zip(eyes, targets, strict=True)]
    focus, distance = focus_of(cameras)
    np.testing.assert_allclose(focus, (0.1, 0.0, 0.03), atol=0.01)
    assert distance == pytest.approx(np.median(np.linalg.norm(eyes - (0.1, 0.0, 0.03), axis=1)), abs=0.01)


def test_an_object_with_a_point_behind_a_camera_gets_no_preference(
    place: tuple[Float64Array, Int64Array, list[PhotoView]],
) -> None:
    """Models of other programs state observations of points that their cameras cannot show."""
    points, labels, views = place
    inwards = views[0].camera
    outwards = replace(inwards, world_from_camera=inwards.world_from_camera @ np.diag([-1.0, 1, -1, 1]))
    wrong = PhotoView(outwards, np.flatnonzero(labels == 2)[:1].astype(np.int32))
    views = [*views, wrong]
    assert ball_of(choose_object(points, views).above, place) == {1}


def test_picks_and_a_box_choose_another_object(place: tuple[Float64Array, Int64Array, list[PhotoView]]) -> None:
    points, _, views = place
    assert ball_of(choose_object(points, views, picks=[pick(place, 3)]).above, place) == {3}
    picks = [pick(place, 1), pick(place, 2)]
    both = choose_object(points, views, picks=picks)
    assert ball_of(both.above, place) == {1, 2}
    assert ball_of(choose_object(points, views, picks=picks, picks_not=[pick(place, 2)]).above, place) == {1}
    assert ball_of(choose_object(points, views, picks_not=[pick(place, 1)]).above, place) <= {2, 3}
    for low, high in ((-0.02, 0.15), (-1.0, 1.0)):
        boxed = choose_object(points, views, box=(0.1, -0.05, low, 0.25, 0.1, high))
        assert ball_of(boxed.above, place) == {2}


def test_points_that_few_photos_observe_are_no_object(
    place: tuple[Float64Array, Int64Array, list[PhotoView]],
) -> None:
    """Wrong matches of two photos can lie between the cameras."""
    points, _, views = place
    wrong = np.array([0, 0, 0.12]) + np.random.default_rng(1).normal(0, 0.005, (200, 3))
    more = np.arange(len(points), len(points) + len(wrong), dtype=np.int32)
    seen = [replace(view, seen=np.append(view.seen, more)) if k < 2 else view for k, view in enumerate(views)]
    found = choose_object(np.concatenate([points, wrong]), seen)
    assert ball_of(found.above, place) == {1} and len(found.others) == 2


def test_hints_without_a_matching_object_are_refused(place: tuple[Float64Array, Int64Array, list[PhotoView]]) -> None:
    points, labels, views = place
    one = pick(place, 1)
    with pytest.raises(InputError, match=r"selected by both --pick and --pick-not \(one.jpg:1,2\)"):
        choose_object(points, views, picks=[one], picks_not=[one])
    with pytest.raises(InputError, match=r"selected by both --pick and --pick-not \(one.jpg:1,2\)"):
        choose_object(points, views, picks=[one], picks_not=[replace(pick(place, 2), name="two.jpg:1,2"), one])
    only = (0.1, -0.05, -0.02, 0.25, 0.1, 0.15)
    with pytest.raises(InputError, match=r"^no object remains: --pick-not \(one.jpg:1,2\) excludes all"):
        choose_object(points, views, picks_not=[pick(place, 2)], box=only)
    with pytest.raises(InputError, match="no point of an object within 32 px"):
        choose_object(points, views, picks=[Pick("one.jpg:0,0", views[0], (0.0, 0.0))])
    blind = replace(views[0], seen=views[0].seen[labels[views[0].seen] != 1])
    with pytest.raises(InputError, match="no point of an object within 32 px"):
        choose_object(points, views, picks=[replace(one, view=blind)])
    bare = np.flatnonzero(labels == 0)
    place_of = {int(old): new for new, old in enumerate(bare)}
    fewer = [
        PhotoView(v.camera, np.array([place_of[i] for i in v.seen.tolist() if i in place_of], np.int32)) for v in views
    ]
    with pytest.raises(InputError, match="no object was found above its support"):
        choose_object(points[bare], fewer)
