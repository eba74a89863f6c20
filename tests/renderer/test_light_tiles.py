"""Estimates of tiles from one ray per pixel, and unshadowed highlights, against slow twins and closed forms."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_light import WHITE_SKY, down_camera, floor, nothing, slab

ensure_variant()
from mitsplat.renderer.light.light_tiles import BLOCK, MIN_SHADOW_HITS, ShadowTiles, block_order  # noqa: E402


@pytest.mark.parametrize(("width", "height"), [(8, 8), (100, 52), (130, 70)])
def test_tiles_equal_those_of_a_slow_loop(width: int, height: int) -> None:
    view: Any = SimpleNamespace(width=width, height=height)
    rng = np.random.default_rng(width)
    arriving = rng.random((height, width, 3)).astype(np.float32) * (rng.random((height, width, 1)) < 0.9)
    arriving[: height // 2, : width // 4] = 0
    lost = arriving * (rng.random((height, width, 1)) < 0.05)
    pixel, inside = (np.array(v) for v in block_order(view))
    assert sorted(pixel[inside]) == list(range(width * height))

    def ordered(image: np.ndarray) -> Any:
        values = np.where(inside[:, None], image.reshape(-1, 3)[pixel], 0)
        return mi.Color3f(*[mi.Float(c.astype(np.float32)) for c in values.T])

    tiles = ShadowTiles.of(ordered(arriving), ordered(lost), view)
    across, down = -(-width // BLOCK), -(-height // BLOCK)
    sums = np.zeros((2, down + 2, across + 2, 3))
    together = np.zeros((down + 2, across + 2), bool)
    for y in range(down):
        for x in range(across):
            part = np.s_[y * BLOCK : (y + 1) * BLOCK, x * BLOCK : (x + 1) * BLOCK]
            sums[:, y + 1, x + 1] = [image[part].sum(axis=(0, 1)) for image in (arriving, lost)]
            hits = np.zeros((BLOCK, BLOCK), int)
            found = lost[part].sum(axis=-1) > 0
            hits[: found.shape[0], : found.shape[1]] = found
            half = BLOCK // 2
            together[y + 1, x + 1] = hits.reshape(2, half, 2, half).sum(axis=(1, 3)).max() >= MIN_SHADOW_HITS
    kernel = (1, 2, 1)
    taken, around, uneven = np.zeros((down, across, 3)), np.zeros((down, across)), np.zeros((down, across), bool)
    for y in range(down):
        for x in range(across):
            total, away = sum(kernel[i] * kernel[j] * sums[:, y + i, x + j] for i in range(3) for j in range(3))  # type: ignore[misc]
            taken[y, x] = np.divide(away, total, out=np.zeros(3), where=total > 0)
            around[y, x] = away.sum() / total.sum() if total.sum() > 0 else 0
            uneven[y, x] = together[y : y + 3, x : x + 3].any()
    np.testing.assert_allclose(np.array(tiles.occluded).T.reshape(taken.shape), taken, atol=1e-5)
    np.testing.assert_array_equal(
        np.array(tiles.differs(0.05)).reshape(height, width),
        (uneven | (around >= np.float32(0.05))).repeat(BLOCK, 0).repeat(BLOCK, 1)[:height, :width],
    )
    known = sums[0, 1:-1, 1:-1].sum(axis=-1) > 0
    light = np.array(tiles.light()).T.reshape(height, width, 3)
    for y, x in rng.integers(0, (height, width), (50, 2)):
        u, v = (x + 0.5) / BLOCK - 0.5, (y + 0.5) / BLOCK - 0.5
        weights, total = 0.0, np.zeros(3)
        for ty in range(down):
            for tx in range(across):
                weight = max(0, 1 - abs(u - tx)) * max(0, 1 - abs(v - ty)) * known[ty, tx]
                weights, total = weights + weight, total + weight * taken[ty, tx]
        np.testing.assert_allclose(light[y, x], 1 - total / weights if weights else 1, atol=1e-5)


def light_below_plate(camera: Camera, edge: float, height: float, **others: dict[str, Any]) -> np.ndarray:
    """Render light with four seeds (4, H, W) on a floor under a uniform sky.

    A small plate and other shapes occlude it.
    """
    plate = trimesh.creation.box(bounds=[[-edge / 2, -edge / 2, height], [edge / 2, edge / 2, height + 1e-4]])
    shapes = {
        "floor": make_splats_shape(floor(2.0), proxy=slab(2.0)),
        **others,
        "plate": make_splats_shape(nothing(), proxy=plate, instance=1),
        "sky": WHITE_SKY,
    }
    scene = mi.load_dict({"type": "scene", **shapes})
    integrator = make_integrator(shadow_error=0.03)
    return np.stack([render_layers(integrator, scene, camera, seed=seed).light[..., 0] for seed in range(4)])


def test_a_faint_shadow_equals_its_form_factor() -> None:
    """One ray per pixel: a small plate removes its form factor A h^2 / (pi d^4) from the light of a uniform sky."""
    edge, height = 0.12, 0.3
    camera = down_camera(3.0, 192, 24.0)
    light = light_below_plate(camera, edge, height)
    x = (np.arange(192) + 0.5 - 96) * 3.0 / camera.fx
    distance2 = x[:, None] ** 2 + x**2 + height**2
    factor = edge**2 * height**2 / (np.pi * distance2**2)
    faint = (factor < 0.01) & (factor > 0.002)
    blocks = faint.reshape(24, 8, 24, 8).all(axis=(1, 3))
    off = (1 - light - factor).reshape(4, 24, 8, 24, 8).mean(axis=(2, 4))[:, blocks]
    assert blocks.sum() > 100
    assert abs(off.mean()) < 0.1 * factor[faint].mean()
    assert np.sqrt(np.mean(off**2)) < 0.5 * factor[faint].mean()
    assert len(np.unique(light[0, faint])) > 100  # continuous values


def test_a_faint_shadow_is_a_share_of_the_light_left_by_static_objects() -> None:
    """A roof hides the share F of the sky.

    A plate before the rest of the sky removes f / (1 - F) of the light, and a plate before the roof removes nothing.
    """
    edge, height, top = 0.12, 0.3, 1.0
    roof = trimesh.creation.box(bounds=[[0.5, -1.5, top], [3.5, 1.5, top + 0.01]])
    camera = down_camera(0.9, 192, 80.0)
    light = light_below_plate(camera, edge, height, roof=make_splats_shape(nothing(), proxy=roof))
    x = (np.arange(192) + 0.5 - 96) * 0.9 / camera.fx
    factor = edge**2 * height**2 / (np.pi * (x[:, None] ** 2 + x**2 + height**2) ** 2)
    cell = 0.05
    across, along = np.meshgrid(np.arange(0.5, 3.5, cell) + cell / 2, np.arange(-1.5, 1.5, cell) + cell / 2)
    hidden = np.zeros((192, 192))
    for u, v in zip(across.ravel(), along.ravel(), strict=True):
        hidden += cell**2 * top**2 / (np.pi * ((x[:, None] - v) ** 2 + (x - u) ** 2 + top**2) ** 2)
    share = factor / (1 - hidden)
    faint = (share < 0.012) & (share > 0.002)
    before_sky, before_roof = faint & (x > 0.15), faint & (x < -0.45) & (np.abs(x[:, None]) < 0.3)
    assert before_sky.sum() > 1000
    assert before_roof.sum() > 500
    assert hidden[before_sky].mean() > 0.2
    assert abs((1 - light - share)[:, before_sky].mean()) < 0.1 * share[before_sky].mean()
    assert abs((1 - light)[:, before_roof].mean()) < 0.1 * share[before_roof].mean()
