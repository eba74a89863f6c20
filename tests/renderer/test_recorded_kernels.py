"""Recorded kernels: replays equal traced execution."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.fit.optimizer import GaussianModel
from mitsplat.fit.refine_splats import QUALITY
from mitsplat.fit.trainer import fit_capture
from mitsplat.quality import Quality
from mitsplat.renderer.differentiation import backward
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.runtime import recorded_kernels as recorded
from mitsplat.runtime.variant import ensure_variant
from tests.fit.test_fit import SMALL, photograph, seeing
from tests.renderer.test_render import CAMERA, make_splats


def test_recordings_depend_on_counts_and_sizes_and_not_on_values() -> None:
    """Dr.Jit's own selection of recordings confuses some numbers in such calls."""
    ensure_variant()
    traced: list[tuple[int, int]] = []

    @recorded.recorded
    def scaled(
        values: dict[str, mi.Float], unit: mi.Float, quality: Quality, more: list[mi.Float]
    ) -> dict[str, mi.Float]:
        traced.append((dr.width(values["a"]), quality.sh_degree))
        return {name: value * unit * (quality.sh_degree + 1) + more[0] for name, value in values.items()}

    for turn in range(2):
        for width in (10, 20):
            for degree in (0, 1, 2, 3, 0, 1, 2):
                values = np.random.default_rng(turn).random(width).astype(np.float32)
                unit, one = dr.opaque(mi.Float, 2.0 + turn), wrapped(mi.Float, np.ones(width, np.float32))
                found = scaled(
                    {"a": wrapped(mi.Float, values), "b": one}, unit, replace(QUALITY, sh_degree=degree), [one]
                )
                np.testing.assert_allclose(np.array(found["a"]), values * (2 + turn) * (degree + 1) + 1, rtol=1e-6)
                np.testing.assert_allclose(np.array(found["b"]), (2 + turn) * (degree + 1) + 1, rtol=1e-6)
    assert traced == [(width, degree) for width in (10, 20) for degree in range(4)]


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.01, -0.01)])
def test_recorded_gradients_equal_traced_ones(distortion: tuple[float, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Views differ in their number of pairs of Gaussian and tile, down to none."""
    ensure_variant()
    model = GaussianModel(make_splats(300, 36, bands=4), 1.0)
    pairs: list[int] = []

    def gradients(shift: float) -> list[np.ndarray]:
        pose = CAMERA.world_from_camera.copy()
        pose[:3, 3] += shift * pose[:3, 0] - 0.5 * shift * pose[:3, 2]
        camera = replace(CAMERA, world_from_camera=pose, distortion=distortion)
        eye = backward.Eye(view_of(make_sensor(camera)))
        seen = model.render(eye, QUALITY, depth=True)
        assert isinstance(seen, backward.DepthRendering)
        pairs.append(seen._lists.pairs)
        weight = mi.Float(np.random.default_rng(1).normal(size=dr.width(seen.alpha)).astype(np.float32))
        found = [seen.gradient([weight, weight, weight], weight), seen.gradient_of_moment(weight)]
        model.set_gradients(eye, QUALITY, found, opacity_weight=0.1, scale_weight=0.2)
        return [np.array(dr.grad(value)) for value in model.values.values()] + [np.array(seen.moment)]

    shifts = [0.0, 0.3, 100.0, 0.7, 1.5, 0.1]
    monkeypatch.setattr(recorded, "REPLAY", True)
    replayed = [gradients(shift) for shift in (*shifts, *shifts)]
    monkeypatch.setattr(recorded, "REPLAY", False)
    traced = [gradients(shift) for shift in shifts]
    assert 0 in pairs and len(set(pairs)) > 4 and np.abs(traced[0][0]).max() > 0
    for turn, found in enumerate(replayed):
        for one, other in zip(found, traced[turn % len(shifts)], strict=True):
            # GPUs round divisions by compile-time constants differently from divisions by variables.
            rounding = 0.0 if mi.variant().startswith("llvm") else 1e-5 * np.abs(other).max(initial=0.0)
            np.testing.assert_allclose(one, other, rtol=0, atol=rounding)
    for first, second in zip(replayed[: len(shifts)], replayed[len(shifts) :], strict=True):
        for one, other in zip(first, second, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.cpu(reason="what GPUs round otherwise grows over the steps of a fit")
def test_a_fit_with_recordings_has_the_bytes_of_a_traced_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit varies everything that changes its kernels: sizes, degrees, depths and numbers of Gaussians."""
    ensure_variant()
    (tmp_path / "photos").mkdir()
    capture = seeing(photograph(tmp_path / "photos"))
    settings = replace(SMALL, sh_degree=2, coarse=0.3, iterations=50)
    monkeypatch.setattr(recorded, "REPLAY", True)
    replayed = fit_capture(capture, tmp_path / "replayed", settings)
    monkeypatch.setattr(recorded, "REPLAY", False)
    fit_capture(capture, tmp_path / "traced", settings)
    assert replayed.psnr > 10
    one, other = ((tmp_path / name / "splats.ply").read_bytes() for name in ("replayed", "traced"))
    assert one == other
