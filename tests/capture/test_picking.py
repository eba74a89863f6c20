"""Picking: from a ray to a pixel of a photo, and from pixels to the object at these pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.capture.pipeline.picking import chosen_object, pick_along
from mitsplat.errors import InputError
from tests.capture.isolation.balls import THINGS, capture_of_balls, ground

EYE = np.array([0.5, -0.4, 0.5])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return capture_of_balls(tmp_path_factory.mktemp("balls"))


def top_of(thing: int) -> np.ndarray:
    x, y = THINGS[thing]
    return np.array([x, y, 0.07 + float(ground(np.array([[x, y]]))[0])])


@pytest.mark.parametrize("pixel", ["1_0,20", "٣,20", "10", "10,20,30", "10,x", ""])
def test_a_pixel_is_read_as_it_is_written(capture: Capture, pixel: str) -> None:
    name = capture.photos[0].name
    with pytest.raises(InputError) as error:
        capture.picked(f"{name}:{pixel}")
    assert str(error.value) == f"{name}:{pixel}: a pixel must be given as X,Y (got {pixel})"
    for picks in ({"picks": (f"{name}:{pixel}",)}, {"picks_not": (f"{name}:{pixel}",)}):
        with pytest.raises(InputError, match="a pixel must be given as X,Y"):
            CaptureSettings(**picks)  # before cameras are computed


@pytest.mark.parametrize("thing", [0, 1, 2])
def test_a_ray_picks_the_object_that_it_hits(capture: Capture, thing: int) -> None:
    pick = pick_along(capture, EYE, top_of(thing) - EYE)
    chosen = chosen_object(capture, [pick]).above
    away = np.linalg.norm(chosen[:, :2] - THINGS[thing], axis=1)
    assert len(chosen) > 200 and away.max() < 0.05


def test_the_photo_of_a_pick_has_about_the_direction_of_the_ray(capture: Capture) -> None:
    ahead = top_of(0) - EYE
    photo, pixel = capture.picked(pick_along(capture, EYE, ahead))
    towards = top_of(0) - photo.camera.centre
    every = [top_of(0) - one.camera.centre for one in capture.photos]
    cosines = [float(one @ ahead / np.linalg.norm(one) / np.linalg.norm(ahead)) for one in every]
    assert towards @ ahead / np.linalg.norm(towards) / np.linalg.norm(ahead) == pytest.approx(max(cosines), abs=0.02)
    shown = photo.camera.project(top_of(0)[None])[0][0]
    assert np.linalg.norm(shown - pixel) < 8  # px: half a degree from the eye, and gaps between points


def test_a_ray_picks_the_nearest_of_two_objects(capture: Capture) -> None:
    """The ray passes the second ball on its way to the first one, at the height of both."""
    start = np.array([0.5, 0.02 + 0.02 * 0.34 / 0.16, 0.05])
    middle = np.array([*THINGS[1], 0.045])
    pick = pick_along(capture, start, middle - start)
    chosen = chosen_object(capture, [pick]).above
    assert np.linalg.norm(chosen[:, :2] - THINGS[1], axis=1).max() < 0.05


@pytest.mark.parametrize("ahead", [(0, 0, 1), (1, -1, 0.3)])
def test_a_ray_that_hits_no_point_is_refused(capture: Capture, ahead: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="there is no point of the capture at this position"):
        pick_along(capture, EYE, ahead)


def test_a_pick_that_no_photo_observes_is_refused(capture: Capture) -> None:
    blind = replace(capture, photos=tuple(replace(one, seen=one.seen[:0]) for one in capture.photos))
    with pytest.raises(InputError, match="no photo of the capture observes"):
        pick_along(blind, EYE, top_of(0) - EYE)
