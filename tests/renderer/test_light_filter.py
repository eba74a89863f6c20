"""Filter of traced light: penumbrae without saw-teeth, hard edges, and points that are not known."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.renderer.layers import make_integrator
from mitsplat.renderer.light.light_estimate import Estimate
from mitsplat.renderer.light.light_filter import GUESS_WEIGHT, LightFilter
from mitsplat.renderer.light.light_tiles import STRIDE
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.light.shadow_rays import SURROUNDINGS_RECURRENCE, _bayer, sequence_point
from mitsplat.renderer.rays.camera_rays import CameraView
from tests.renderer.test_light import down_camera

SIZE, RAYS = 96, 10


def filtered(share: Float64Array, across: float) -> Float64Array:
    """Return the filtered light of a plane where a straight edge hides all but ``share`` (H, W) of a lamp.

    Rays go to the points of the lamp that their pixels take of the sequence. ``across`` is the direction of the edge.
    """
    make_integrator()
    camera = down_camera(size=SIZE)
    view = CameraView(SIZE, SIZE, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_from_camera)
    count = SIZE * SIZE
    pixel = dr.arange(mi.UInt32, count)
    start = np.array(_bayer(pixel % SIZE, pixel // SIZE))
    number = (start[:, None] + STRIDE * np.arange(RAYS)).ravel().astype(np.uint32)
    u, v = np.array(sequence_point(mi.UInt32(number), SURROUNDINGS_RECURRENCE))
    along = np.cos(across) * (u - 0.5) + np.sin(across) * (v - 0.5)
    # The edge lies where it leaves the wanted share of the points of the unit square.
    points = np.stack(np.meshgrid(*[(np.arange(256) + 0.5) / 256 - 0.5] * 2), axis=-1).reshape(-1, 2)
    place = np.quantile(points @ [np.cos(across), np.sin(across)], share.ravel())
    place = np.where(share.ravel() <= 0, -np.inf, np.where(share.ravel() >= 1, np.inf, place))
    lit = (along.reshape(count, RAYS) < place[:, None]).sum(axis=1)
    fields: dict[str, Any] = dict.fromkeys(LitSurface.__dataclass_fields__, mi.Float(0))
    fields |= {"position": dr.zeros(mi.Point3f, count), "normal": mi.Vector3f(0, 0, 1), "offset": mi.Float(1)}
    fields |= {"known": dr.full(mi.Bool, True, count)}
    rays = dr.full(mi.Float, RAYS, count)
    dark, base = dr.zeros(mi.Color3f, count), mi.Color3f(rays)
    estimate = Estimate(mi.Color3f(mi.Float(lit)), base, dark, dark, 9 * rays, dr.zeros(mi.Float, count), rays)
    means = LightFilter(LitSurface(**fields), view, pixel).smooth(estimate)
    return np.asarray(np.array(means.lit[0]).reshape(SIZE, SIZE), dtype=np.float64)


def test_penumbrae_have_no_saw_teeth() -> None:
    """Along a penumbra 16 to 48 px wide, adjacent pixels differ by 0.0017 (RMS).

    They differ by 0.012 if neighbours count fully up to a limit of the difference, and not at all beyond it.
    """
    row = np.arange(SIZE)[:, None] + 0.5
    teeth = []
    for width in (16, 24, 48):
        share = np.clip((row - SIZE / 2) / width + 0.5, 0, 1) * np.ones(SIZE)
        for across in np.radians([10, 35, 60, 80]):
            for turned in (False, True):
                light = filtered(share.T if turned else share, across)
                light = light.T if turned else light
                off = light - share
                assert abs(off[8:-8, 8:-8].mean()) < 0.006
                teeth.append(np.diff(light, axis=1)[8:-8, 8:-8][(share[8:-8, 8:-9] % 1) > 0])
    assert np.sqrt(np.mean(np.concatenate(teeth) ** 2)) < 0.003


def test_hard_edges_stay_sharp() -> None:
    """No light leaks across the edge of a shadow without a penumbra."""
    share = np.where(np.arange(SIZE) < SIZE // 2, 0.0, 1.0) * np.ones((SIZE, 1))
    for turned in (False, True):
        light = filtered(share.T if turned else share, 0.6)
        light = light.T if turned else light
        assert np.abs(light - share).max() < 1e-6


def test_unknown_points_take_the_light_of_the_nearest_known_ones() -> None:
    """Weights fall with the fourth power of the distance, and the outermost pixel has half of its weight."""
    make_integrator()
    width, unknown = 12, 8
    camera = down_camera(size=width)
    view = CameraView(width, 1, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_from_camera)
    x = np.arange(width, dtype=np.float32)
    fields: dict[str, Any] = dict.fromkeys(LitSurface.__dataclass_fields__, mi.Float(0))
    fields |= {"position": dr.zeros(mi.Point3f, width), "normal": mi.Vector3f(0, 0, 1), "offset": mi.Float(1)}
    fields |= {"known": mi.Bool(x != unknown), "trait": mi.Float(np.float32(x > unknown))}
    light = np.where(x == unknown, 100, x * x)
    light_filter = LightFilter(LitSurface(**fields), view, dr.arange(mi.UInt32, width))
    (mean,) = light_filter.average([mi.Float(np.float32(light))])
    weight = np.array([GUESS_WEIGHT, 1, 1 / 16, 1 / 81, 0.5 / 256])
    np.testing.assert_allclose(np.array(mean)[unknown], weight @ light[8:3:-1] / weight.sum(), rtol=1e-5)
