"""Light on coarse planes, traced at one of four pixels: choice of tiles, no seams, and shadows as with all pixels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_light import WHITE_SKY, nothing

ensure_variant()
from mitsplat.renderer.light import light as light_stages  # noqa: E402
from mitsplat.renderer.light.light_estimate import Estimate  # noqa: E402
from mitsplat.renderer.light.light_filter import LightFilter  # noqa: E402
from mitsplat.renderer.light.light_planes import SAMPLES, CoarseLight, Planes, between_samples  # noqa: E402
from mitsplat.renderer.light.light_tiles import BLOCK  # noqa: E402
from mitsplat.renderer.light.lit_surface import LitSurface  # noqa: E402
from mitsplat.renderer.rays.camera_rays import CameraView  # noqa: E402
from mitsplat.renderer.rays.device_arrays import plain_mesh  # noqa: E402

PLAIN = 0x40000001
"""A surface code of planes."""


def view_of(width: int, height: int) -> Any:
    return SimpleNamespace(width=width, height=height)


def planes_of(codes: npt.NDArray[np.uint32], needed: npt.NDArray[np.bool_]) -> Planes:
    height, width = codes.shape
    return Planes.of(mi.UInt32(codes.ravel()), mi.Bool(needed.ravel()), view_of(width, height))


@pytest.mark.parametrize(("width", "height"), [(96, 64), (100, 52)])
def test_planes_equal_those_of_a_slow_loop(width: int, height: int) -> None:
    rng = np.random.default_rng(width)
    codes = np.full((height, width), PLAIN, np.uint32)
    codes[:, width // 2 + 3 :] = PLAIN + 1
    codes[: height // 3, : width // 4] = 0
    codes[rng.integers(0, height, 3), rng.integers(0, width, 3)] = 0
    needed = np.ones((height, width), bool)
    needed[2 * BLOCK : 4 * BLOCK, BLOCK : 3 * BLOCK] = False
    planes = planes_of(codes, needed)
    numbers, across = [], -(-width // BLOCK)
    place = np.array(planes.place)
    for y in range(-(-height // BLOCK)):
        for x in range(across):
            inside = np.s_[y * BLOCK : (y + 1) * BLOCK, x * BLOCK : (x + 1) * BLOCK]
            beyond = codes[y * BLOCK : (y + 1) * BLOCK + 1, x * BLOCK : (x + 1) * BLOCK + 1]
            whole = needed[inside].size == BLOCK**2 and needed[inside].all()
            if whole and (beyond == beyond[0, 0]).all() and beyond[0, 0]:
                numbers.append(y * across + x)
            else:
                assert place[y * across + x] == planes.count + needed[inside].any()
    assert numbers
    np.testing.assert_array_equal(np.array(planes.number), numbers)
    np.testing.assert_array_equal(place[numbers], np.arange(len(numbers)))
    pixel = np.array(planes.samples()).reshape(SAMPLES, -1)
    tile = pixel // width // BLOCK * across + pixel % width // BLOCK
    np.testing.assert_array_equal(tile, np.tile(numbers, (SAMPLES, 1)))
    assert len(np.unique(pixel)) == pixel.size
    assert not ((pixel % width | pixel // width) & 1).any()


def test_tiles_beside_a_shadow_or_another_instance_are_not_coarse() -> None:
    width, height = 10 * BLOCK, 6 * BLOCK
    codes, needed = np.full((height, width), PLAIN, np.uint32), np.ones((height, width), bool)
    codes[: BLOCK // 2, : BLOCK // 2] = 0
    planes = planes_of(codes, needed)
    tile = np.tile(np.array(planes.number), SAMPLES)
    lit = np.where(tile % 10 >= 6, 4.0, 8.0).astype(np.float32)
    ones = dr.full(mi.Float, 1, len(tile))
    estimate = Estimate(
        mi.Color3f(mi.Float(lit / 3)), mi.Color3f(8 * ones / 3), 0 * ones, 0 * ones, 8 * ones, 0 * ones, 8 * ones
    )
    coarse = np.array(planes.coarse(estimate)).reshape(height, width)
    expected = np.ones((6, 10), bool)
    expected[:2, :2] = False
    expected[:, 5:7] = False
    np.testing.assert_array_equal(coarse, expected.repeat(BLOCK, 0).repeat(BLOCK, 1))


def test_constant_light_stays_constant_and_a_ramp_has_no_step() -> None:
    width, height = 6 * BLOCK, 5 * BLOCK
    rng = np.random.default_rng(3)
    coarse = (rng.random((5, 6)) < 0.6).repeat(BLOCK, 0).repeat(BLOCK, 1)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    stood_for = coarse & ((x.astype(int) | y.astype(int)) & 1 > 0)

    def filled(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        known = np.where(stood_for, np.float32(7), image)  # ignored values
        colour = mi.Color3f(mi.Float(known.ravel()))
        dr.eval(colour)
        result = between_samples(colour, mi.Bool(coarse.ravel()), view_of(width, height))
        return np.array(result)[0].reshape(height, width)

    even = np.full((height, width), 0.3, np.float32)
    np.testing.assert_array_equal(filled(even), even)
    ramp = 0.1 + 0.01 * x - 0.003 * y
    # Interpolation at the border of the image lacks the next sample.
    np.testing.assert_allclose(filled(ramp)[:-1, :-1], ramp[:-1, :-1], atol=1e-6)


def test_pixels_beside_a_coarse_tile_see_the_same_in_every_column() -> None:
    """Light depends on the row only: samples are weighted by the four pixels that they represent."""
    make_integrator()
    size = 2 * BLOCK
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=size, height=size, fov_x=20)
    view = CameraView(size, size, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_from_camera)
    y, x = np.mgrid[:size, :size]
    coarse = y < BLOCK
    index = np.flatnonzero((~coarse | ((x | y) & 1 == 0)).ravel()).astype(np.uint32)
    fields: dict[str, Any] = dict.fromkeys(LitSurface.__dataclass_fields__, mi.Float(0))
    fields |= {"position": dr.zeros(mi.Point3f, len(index)), "normal": mi.Vector3f(0, 0, 1), "offset": mi.Float(1)}
    fields |= {"known": dr.full(mi.Bool, True, len(index))}
    light_filter = LightFilter(LitSurface(**fields), view, mi.UInt32(index), mi.Bool(coarse.ravel()))
    values = mi.Float((index // size).astype(np.float32) ** 2)
    averaged = np.zeros(size * size)
    averaged[index] = np.array(light_filter.average([values])[0])
    rows = averaged.reshape(size, size)
    np.testing.assert_allclose(rows[BLOCK:], np.broadcast_to(rows[BLOCK:, :1], (BLOCK, size)), rtol=1e-5)
    assert rows[BLOCK, 0] != BLOCK**2


def board(*, size: int = 160, error: float = 0.03, rays: int = 64, seed: int = 0, lamp: float = 0.1) -> Layers:
    """Render a plate over a large visible board, under a lamp and a sky."""
    plate = trimesh.creation.box(bounds=[[-0.1, -0.1, 0.1], [0.1, 0.1, 0.11]])
    ground = trimesh.creation.box(bounds=[[-3, -3, -0.1], [3, 3, 0]])
    pose = mi.ScalarTransform4f().look_at(origin=[0.6, 0, 1], target=[0, 0, 0], up=[0, 1, 0])
    scene = {
        "board": plain_mesh(ground),
        "plate": make_splats_shape(nothing(), proxy=plate, instance=1, capture_light="uniform"),
        "lamp": {
            "type": "rectangle",
            "to_world": pose @ mi.ScalarTransform4f().scale(lamp),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.5 / lamp**2}},
        },
        "sky": WHITE_SKY,
    }
    camera = Camera.look_at((0.2, -0.7, 1.2), (0, 0, 0), width=size, height=size, fov_x=60)
    integrator = make_integrator(shadow_error=error, shadow_samples=rays, white=2 * np.pi)
    return render_layers(integrator, mi.load_dict({"type": "scene", **scene}), camera, seed=seed)


def test_shadows_on_planes_equal_those_of_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = np.mean([board(error=0, rays=1024, seed=s).light for s in (10, 11)], axis=0).mean(axis=-1)
    chosen: list[npt.NDArray[np.bool_]] = []
    judge = Planes.coarse

    def coarse(self: Planes, estimate: Estimate) -> Any:
        result = judge(self, estimate)
        chosen.append(np.array(result).reshape(truth.shape))
        return result

    monkeypatch.setattr(Planes, "coarse", coarse)
    kept: list[CoarseLight] = []
    trace = light_stages.trace_planes

    def trace_planes(*args: Any) -> CoarseLight:
        result = trace(*args)
        assert result is not None
        kept.append(result)
        return result

    monkeypatch.setattr(light_stages, "trace_planes", trace_planes)
    runs = np.array([board(seed=s).light.mean(axis=-1) for s in range(4)])
    # Every second pixel of coarse tiles is traced, in both directions.
    y, x = np.indices(truth.shape)
    for mask, coarse_light in zip(chosen, kept, strict=True):
        traced = (mask & ((x | y) & 1 == 0)).ravel()
        np.testing.assert_array_equal(coarse_light.lattice, traced)
        np.testing.assert_array_equal(np.sort(coarse_light.pixel), np.flatnonzero(traced))
    monkeypatch.setattr(light_stages, "trace_planes", trace)
    monkeypatch.setattr(Planes, "count", 0)
    whole = np.array([board(seed=s).light.mean(axis=-1) for s in range(4)])
    common = np.logical_and.reduce(chosen)
    assert 0.2 < common.mean() < 0.95
    errors = [np.sqrt(np.mean((lights - truth)[:, common] ** 2)) for lights in (runs, whole)]
    assert errors[0] < max(1.15 * errors[1], 0.004)
    # The mean error is the same in a shadow: interpolation between samples loses no shadow.
    assert abs(np.mean((runs - whole)[:, common])) < 2e-3
    # There are no seams: steps between tiles are no larger than those within tiles.
    steps = np.abs(np.diff(runs - truth, axis=2))
    both = common[:, 1:] & common[:, :-1]
    border = both & (np.arange(1, truth.shape[1]) % BLOCK == 0)
    within = both & (np.arange(1, truth.shape[1]) % BLOCK != 0)
    assert np.sqrt(np.mean(steps[:, border] ** 2)) < 1.3 * np.sqrt(np.mean(steps[:, within] ** 2))


def test_an_open_plane_under_a_uniform_sky_is_lit_evenly() -> None:
    ground = trimesh.creation.box(bounds=[[-3, -3, -0.1], [3, 3, 0]])
    camera = Camera.look_at((0.2, -0.7, 1.2), (0, 0, 0), width=160, height=136, fov_x=60)
    scene = mi.load_dict({"type": "scene", "board": plain_mesh(ground), "sky": WHITE_SKY})
    light = render_layers(make_integrator(white=np.pi), scene, camera).light
    np.testing.assert_allclose(light, 1, atol=1e-5)
    assert len(np.unique(light)) == 1
