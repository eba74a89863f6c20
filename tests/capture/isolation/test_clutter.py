"""Isolation of an object among clutter on several kinds of ground, without a hint, from path-traced photos.

Points come from the scene instead of feature matching. ``benchmarks.assets.clutter --ground KIND`` runs the complete
pipeline with matching and fits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from benchmarks.assets.clutter import GROUNDS, exposures, room, walk
from benchmarks.assets.known import solid, speckled
from benchmarks.assets.photographing import Sensors, by_name, photograph, show_where
from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.geometric_masks import object_masks
from mitsplat.capture.pipeline.picking import chosen_object
from mitsplat.images.masks import iou
from mitsplat.runtime.variant import ensure_variant

pytestmark = pytest.mark.slow

WIDTH, VIEWS, POINTS = 320, 10, 900
NEAR = 0.6
"""Distance from the centre below which there are no walls [m]."""


def shared_points(scene: dict, photos: list[Photo]) -> Capture:
    """Sample surface points of the photos with the accuracy of matched points.

    Each point is seen by the photos in which it is not occluded.
    """
    loaded, rng, sensors = mi.load_dict(scene), np.random.default_rng(3), Sensors()
    depths = mi.load_dict({"type": "aov", "aovs": "place:position"})
    buffers = [np.array(mi.render(loaded, integrator=depths, sensor=sensors.like(p.camera), spp=1)) for p in photos]
    near = [buffer[np.linalg.norm(buffer, axis=-1) < NEAR] for buffer in buffers]
    places = np.concatenate([rng.choice(one[one.any(axis=1)], POINTS) for one in near])
    seen = []
    for photo, buffer in zip(photos, buffers, strict=True):
        pixels, ahead = photo.camera.project(places)
        column, row = np.floor(np.nan_to_num(pixels, nan=-1).clip(-1, WIDTH)).astype(int).T
        inside = (ahead > 0) & (column >= 0) & (row >= 0) & (column < WIDTH) & (row < WIDTH * 3 // 4)
        shown = np.zeros(len(places), dtype=bool)
        gap = np.linalg.norm(buffer[row[inside], column[inside]] - places[inside], axis=1)
        shown[inside] = gap < 0.01 * ahead[inside]
        seen.append(np.flatnonzero(shown & (rng.random(len(places)) < 0.7)).astype(np.int32))
    places = places + rng.normal(0, 4e-4, places.shape)
    kept = tuple(Photo(p.name, p.file, p.camera, seen=s) for p, s in zip(photos, seen, strict=True))
    return Capture(kept, places, np.full(places.shape, 128, dtype=np.uint8), units="metre", up="z")


@pytest.fixture(scope="module")
def thing() -> Any:
    ensure_variant()
    return speckled(solid())


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[] if kind == "cloth" else [pytest.mark.extended]) for kind in GROUNDS]
)
def test_an_object_in_clutter_is_isolated_without_a_hint(kind: str, thing: Any, tmp_path: Path) -> None:
    scene, views = room(kind=kind) | {"solid": thing}, walk(VIEWS, WIDTH)
    photograph(scene, views, tmp_path / "photos", samples=4, noise=0.008, gains=exposures(VIEWS))
    show_where(scene, "solid", views, tmp_path / "truth")
    photos = [Photo(name, tmp_path / "photos" / name, camera) for name, camera in by_name(views).items()]
    capture = shared_points(scene, photos)
    chosen = chosen_object(capture)
    masked = object_masks(capture, chosen.points, chosen.above, tmp_path / "masks")
    assert len(masked.photos) == VIEWS
    truth = [np.array(Image.open(tmp_path / "truth" / photo.name)) > 0 for photo in masked.photos]
    shares = [iou(photo.read_mask()[0] >= 0.5, shown) for photo, shown in zip(masked.photos, truth, strict=True)]
    assert np.mean(shares) > 0.95 and min(shares) > 0.9  # an error of one pixel along the outline costs 0.04
