"""Lamps by the shadows on a printed table, path-traced from above under lamps that are known."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_erosion

from benchmarks.assets.photographing import paint
from benchmarks.assets.room import papered, things
from mitsplat.renderer.layers import ensure_variant
from mitsplat.renderer.rays.device_arrays import plain_mesh
from mitsplat.surroundings.shading import ShadingLight, light_of_shading

WIDE, DEEP, ACROSS = 1.3, 0.75, 104

Lamps = list[tuple[tuple[float, float, float], float, tuple[float, float, float]]]
"""Places, sizes [m] and radiances."""


def standing(solids: list[trimesh.Trimesh]) -> dict[str, Any]:
    grey = {"type": "diffuse", "reflectance": 0.4}
    shapes = {}
    for number, solid in enumerate(solids):
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(grey)
        shapes[f"thing{number}"] = plain_mesh(solid, properties)
    return shapes


def told(lamps: Lamps, sky: float, *, flat: bool = False, empty: bool = False) -> ShadingLight | None:
    """What light a table tells whose things are seen from above."""
    ensure_variant()
    place = mi.ScalarTransform4f()
    solids = []
    for solid, (x, y), turn, _ in [] if empty else things():
        solid.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        solid.apply_translation((x, y, -solid.bounds[0, 2]))
        solids.append(solid)
    plain = paint(np.full((2, 2, 3), 0.4, dtype=np.float32))
    scene = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": sky}},
        "top": {
            "type": "rectangle",
            "to_world": place.scale([WIDE / 2, DEEP / 2, 1]),
            "bsdf": plain if flat else papered(np.random.default_rng(1), (0.5, 0.44, 0.36)),
        },
        **standing(solids),
    }
    for number, (position, size, radiance) in enumerate(lamps):
        facing = place.look_at(position, [0, 0, 0], [0, 1, 0.01]).scale([size / 2, size / 2, 1])
        light = {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}
        scene[f"lamp{number}"] = {"type": "rectangle", "to_world": facing, "light": light}
    down = round(ACROSS * DEEP / WIDE)
    cell = WIDE / ACROSS
    film = {"type": "hdrfilm", "width": ACROSS, "height": down, "rfilter": {"type": "box"}}
    above = place.look_at([0, 0, 0.6], [0, 0, 0], [0, 1, 0]).scale([WIDE / 2, WIDE / 2, 1])
    sensor = mi.load_dict({"type": "orthographic", "to_world": above, "film": film})
    loaded = mi.load_dict(scene)
    path = mi.load_dict({"type": "path", "max_depth": 3})
    seen = np.array(mi.render(loaded, sensor=sensor, integrator=path, spp=64), dtype=np.float64)
    aov = mi.load_dict({"type": "aov", "aovs": "place:position"})
    places = np.array(mi.render(loaded, sensor=sensor, integrator=aov, spp=1), dtype=np.float64)
    turned = [np.ascontiguousarray(np.moveaxis(a[::-1, ::-1], 0, 1)) for a in (seen, places)]
    if turned[1][0, 0, 0] > turned[1][-1, 0, 0]:
        turned = [a[::-1] for a in turned]
    seen, places = turned
    height = np.where(places[..., 2] > 0.002, places[..., 2], 0)
    inside = (np.abs(places[..., :2]) < (WIDE / 2 - cell, DEEP / 2 - cell)).all(axis=-1) & places.any(axis=-1)
    return light_of_shading(seen, height, binary_erosion(inside & (height == 0)), cell)


def off(told_at: np.ndarray, true: tuple[float, float, float]) -> float:
    """Between two directions from the middle [degrees]."""
    cosine = told_at @ np.array(true) / np.linalg.norm(told_at) / np.linalg.norm(true)
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


def shares(lamps: Lamps, sky: float) -> np.ndarray:
    """Of the light in the middle: from all sides, and of each lamp, which faces it."""
    light = [np.pi * sky]
    for place, size, radiance in lamps:
        away = np.linalg.norm(place)
        light.append(np.mean(radiance) * size**2 * place[2] / away**3)
    return np.array(light) / np.sum(light)


@pytest.mark.slow
def test_two_lamps_are_told_apart() -> None:
    lamps: Lamps = [((-0.8, -0.6, 1.3), 0.4, (15, 14, 10)), ((1.2, 0.2, 1.2), 0.35, (15, 17, 23))]
    light = told(lamps, 0.12)
    assert light is not None and len(light.lamps) == 2
    for lamp, (place, _, radiance) in zip(light.lamps, lamps, strict=True):
        assert off(lamp.position, place) < 10
        warmth = np.log(lamp.irradiance[0] / lamp.irradiance[2])
        assert np.sign(warmth) == np.sign(radiance[0] - radiance[2]) and abs(warmth) > 0.1
    assert light.ambient_share == pytest.approx(shares(lamps, 0.12)[0], abs=0.2)


@pytest.mark.slow
def test_a_low_lamp_is_told_by_long_shadows() -> None:
    lamps: Lamps = [((0.3, -1.6, 0.7), 0.5, (14, 14, 14))]
    light = told(lamps, 0.35)
    assert light is not None and len(light.lamps) == 1
    assert off(light.lamps[0].position, lamps[0][0]) < 10
    assert light.ambient_share == pytest.approx(shares(lamps, 0.35)[0], abs=0.2)


@pytest.mark.slow
def test_a_dull_day_has_no_lamp() -> None:
    assert told([], 0.5) is None


def test_a_bare_table_tells_nothing() -> None:
    assert told([((-0.5, -0.4, 1.5), 0.4, (9, 9, 9))], 0.2, flat=True, empty=True) is None


def test_few_cells_tell_nothing() -> None:
    assert light_of_shading(np.ones((10, 10, 3)), np.zeros((10, 10)), np.ones((10, 10), dtype=bool), 0.01) is None
