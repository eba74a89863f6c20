"""Gradients of the renderer against finite differences of the float64 twin."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import Quality
from mitsplat.renderer.differentiation import backward, record_gradients
from mitsplat.renderer.layers import make_sensor
from mitsplat.runtime.variant import ensure_variant
from tests.reference import render_reference
from tests.renderer.test_render import CAMERA, make_splats

QUALITY = Quality(alpha_min=1e-7, transmittance_min=0)
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def separated(count: int, bands: int) -> Splats:
    """Return Gaussians whose order along every ray equals the order of their centres, so that twin and tiles agree."""
    splats = make_splats(count, 31, bands=bands, scales=(0.05, 0.15))
    means = splats.means.copy()
    means[:, 2] = np.linspace(-1.0, 4.0, count)
    return replace(
        splats, means=means, scales=splats.scales * (0.4 + 0.6 * np.ones(3)), opacities=0.9 * splats.opacities
    )


def weights() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.normal(size=(24, 32, 3)), rng.normal(size=(24, 32))


def loss_of_twin(splats: Splats) -> float:
    twin = render_reference(splats, CAMERA)
    colour, alpha = weights()
    return float((twin.rgb * colour).sum() + (twin.alpha * alpha).sum())


def gradients(splats: Splats, camera: Camera = CAMERA) -> dict[str, np.ndarray]:
    ensure_variant()
    from mitsplat.renderer.rays.sensors import view_of

    inputs: dict[str, Any] = {name: mi.Float(np.asarray(getattr(splats, name)).ravel()) for name in FIELDS}
    for value in inputs.values():
        dr.enable_grad(value)
    cloud = backward.pack_cloud(*inputs.values(), splats.sh.shape[1])
    rgb, alpha = backward.render_differentiable(cloud, view_of(make_sensor(camera)), QUALITY)
    colour_weight, alpha_weight = weights()
    loss = dr.sum(alpha * mi.Float(alpha_weight.ravel()))
    for i in range(3):
        loss += dr.sum(rgb[i] * mi.Float(colour_weight[..., i].ravel()))
    dr.backward(loss)
    return {name: np.array(dr.grad(v)).reshape(getattr(splats, name).shape) for name, v in inputs.items()}


@pytest.mark.parametrize("bands", [1, 4, 16])
def test_gradients_equal_finite_differences_of_the_twin(bands: int) -> None:
    splats = separated(8, bands)
    found = gradients(splats)
    rng = np.random.default_rng(2)
    for name in FIELDS:
        direction = rng.normal(size=getattr(splats, name).shape)
        if name == "scales":
            direction *= splats.scales
        step = 1e-3 if name == "sh" else 2e-4
        moved = []
        for sign in (1, -1):
            values = np.asarray(getattr(splats, name), dtype=np.float64) + sign * step * direction
            moved.append((loss_of_twin(replace(splats, **{name: values})), values))
        expected = (moved[0][0] - moved[1][0]) / (2 * step)
        got = float((found[name] * direction).sum())
        if name == "quats":  # both losses use normalised quaternions
            assert got == pytest.approx(expected, rel=2e-2, abs=2e-2)
        else:
            assert got == pytest.approx(expected, rel=1e-2, abs=1e-2), name


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.01, -0.01)])
@pytest.mark.parametrize("at_once", [1, 1500])
def test_gradients_computed_in_parts_equal_those_of_the_whole(
    at_once: int, distortion: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views whose pairs exceed the memory are processed tile by tile, or in parts of many tiles."""
    splats, camera = make_splats(300, 36, bands=4), replace(CAMERA, distortion=distortion)
    whole = gradients(splats, camera)
    parts: list[int] = []
    gradient = record_gradients.tile_gradient
    monkeypatch.setattr(
        record_gradients, "tile_gradient", lambda lists, *rest: parts.append(lists.pairs) or gradient(lists, *rest)
    )
    for module in (backward, record_gradients):
        monkeypatch.setattr(module, "PAIRS_AT_ONCE", at_once)
    found = gradients(splats, camera)
    assert len(parts) > 1 and max(parts) <= max(at_once, len(splats))  # a tile has at most all Gaussians
    for name, values in whole.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-4, atol=1e-5 * np.abs(values).max())


def test_needles_thinner_than_rounding_have_finite_gradients() -> None:
    """A single needle would otherwise make the gradients of a whole fit NaN."""
    rng = np.random.default_rng(3)
    splats = make_splats(200, 34)
    scales = 10 ** np.column_stack([rng.uniform(-10, -8, (200, 2)), rng.uniform(-10, -0.5, 200)])
    for name, values in gradients(replace(splats, scales=scales)).items():
        assert np.isfinite(values).all(), name


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.01, -0.01)])
def test_the_differentiable_image_equals_the_plain_march(distortion: tuple[float, ...]) -> None:
    ensure_variant()
    from mitsplat.renderer.layers import render_splats
    from mitsplat.renderer.rays.sensors import view_of

    splats, camera = make_splats(40, 33), replace(CAMERA, distortion=distortion)
    inputs = [mi.Float(np.asarray(getattr(splats, name)).ravel()) for name in FIELDS]
    rgb, alpha = backward.render_differentiable(backward.pack_cloud(*inputs, 16), view_of(make_sensor(camera)), QUALITY)
    plain = render_splats(splats, camera, quality=QUALITY)
    np.testing.assert_allclose(np.array(alpha).reshape(24, 32), plain.alpha, atol=2e-5)
    assert np.array(rgb[0]).max() > 0.1


@pytest.mark.parametrize("switch", ["normalise_ended_rays", "correct_late_gaussians"])
def test_corrected_colours_are_refused_for_gradients(switch: str) -> None:
    ensure_variant()
    from mitsplat.renderer.rays.sensors import view_of

    splats = make_splats(1, 3)
    cloud = backward.pack_cloud(*[mi.Float(np.asarray(getattr(splats, name)).ravel()) for name in FIELDS], 16)
    with pytest.raises(ValueError, match=switch):
        backward.render_differentiable(cloud, view_of(make_sensor(CAMERA)), replace(QUALITY, **{switch: True}))


def test_depth_of_an_opaque_gaussian_has_unit_gradient() -> None:
    """Moving the camera's only Gaussian away by dz changes depth by dz, for any alpha."""
    ensure_variant()
    from mitsplat.renderer.rays.sensors import view_of

    splats = make_splats(1, 3, spread=0.05, scales=(0.2, 0.3))
    inputs: dict[str, Any] = {name: mi.Float(np.asarray(getattr(splats, name)).ravel()) for name in FIELDS}
    cloud = backward.pack_cloud(*inputs.values(), 16)
    eye = backward.Eye(view_of(make_sensor(CAMERA)))
    camera = eye.view.kind, eye.numbers, QUALITY
    records, least, box, _ = backward.project_cloud(cloud, *camera)
    dr.eval(records, least, box)
    seen = backward.render_records(records, least, box, eye.view, QUALITY, depth=True)
    assert isinstance(seen, backward.DepthRendering)
    plain, _ = backward.render_differentiable(cloud, eye.view, QUALITY)
    np.testing.assert_array_equal(np.array(seen.rgb[0]), np.array(plain[0]))
    _, depth = CAMERA.project(splats.means)
    middle = int(np.argmax(np.array(seen.alpha)))
    alpha, moment = mi.Float(seen.alpha), mi.Float(seen.moment)
    dr.enable_grad(alpha, moment)
    mean_depth = dr.gather(mi.Float, moment / alpha, mi.UInt32([middle]))
    assert mean_depth.numpy()[0] == pytest.approx(depth[0], rel=1e-5)
    dr.backward(mean_depth)
    towards = dr.grad(alpha), dr.grad(moment)
    dr.eval(towards)
    nothing = [dr.zeros(mi.Float, dr.width(alpha)) for _ in range(3)]
    found = seen.gradient(nothing, towards[0]) + seen.gradient_of_moment(towards[1])
    dr.enable_grad(inputs["means"])
    backward.gather_gradients(backward.pack_cloud(*inputs.values(), 16), *camera, found)
    np.testing.assert_allclose(np.array(dr.grad(inputs["means"])), CAMERA.world_from_camera[:3, 2], atol=1e-4)
