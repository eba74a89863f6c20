"""Tests of :func:`tests.gpu.test_same_as_cpu.fault`, without a GPU."""

from __future__ import annotations

import numpy as np
import pytest

from tests.gpu.test_same_as_cpu import fault

PICTURE = np.random.default_rng(0).random((100, 100, 3)).astype(np.float32)


@pytest.mark.parametrize("name", ["rgb", "instance", "depth", "normal", "mask_1", "gradient_means", "boxes"])
def test_equal_arrays_pass(name: str) -> None:
    assert not fault(name, PICTURE, PICTURE.copy())


def test_one_different_id_in_a_thousand_is_a_fault() -> None:
    ids = np.zeros((100, 100), np.uint16)
    other = ids.copy()
    other[0, :5] = 1
    assert not fault("instance", ids, other)
    other[0, :10] = 1
    assert fault("instance", ids, other) == "0.10 % of the pixels differ"


def test_a_missing_shadow_is_a_fault() -> None:
    light = np.ones((100, 100, 3), np.float32)
    light[:10, :20] = 0.4
    assert "dB < 60" in fault("light", light, np.ones_like(light))
    assert not fault("rgb", PICTURE, PICTURE + np.float32(9e-4))
    assert fault("rgb", PICTURE, PICTURE + np.float32(2e-3)) == "54.0 dB < 60 dB"
    assert not fault("rgb", PICTURE, PICTURE + np.float32(2e-3), "path-traced glass")
    assert fault("rgb", PICTURE, PICTURE * np.float32(np.nan)) == "not finite"


def test_depth_and_gradients_are_relative() -> None:
    depth = PICTURE[..., 0] + 1
    assert not fault("depth", depth, depth * np.float32(1.00005))
    assert fault("depth", depth, depth * np.float32(1.0005)) == "100.00 % of the pixels differ"
    assert not fault("gradient_means", PICTURE, PICTURE + np.float32(9e-4))
    assert fault("gradient_means", PICTURE, PICTURE + np.float32(2e-3))


def test_shapes_and_types_are_compared() -> None:
    assert fault("rgb", PICTURE, PICTURE[1:]) == "float32(100, 100, 3) and float32(99, 100, 3)"
    assert fault("rgb", PICTURE, np.float64(PICTURE))
