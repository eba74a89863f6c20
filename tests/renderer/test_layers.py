"""Transfer of layers from the device to the host: content, time and type."""

from __future__ import annotations

import copy
import pickle
from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.renderer.layers import Layers
from mitsplat.runtime.variant import ensure_variant

COLOURS = ("rgb", "captured", "normal", "light", "highlight")
IDS = ("instance", "proxy_instance")


def channels(shape: tuple[int, int], *, even: bool = False) -> dict[str, Any]:
    """Return device arrays with distinct values per pixel, or with uniform colours and ids."""
    ensure_variant()
    count, made = shape[0] * shape[1], {}
    for number, field in enumerate(fields(Layers)):
        place = mi.Float(number) if even else dr.arange(mi.Float, count) + 1000 * number
        if field.name in COLOURS:
            made[field.name] = mi.Color3f(place, 0.25, -place)
        elif field.name in IDS:
            made[field.name] = mi.UInt32(place) % 65536
        else:
            made[field.name] = place
    dr.eval(made)
    return made


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (8, 6)])
def test_layers_equal_the_arrays_on_the_device(shape: tuple[int, int], even: bool) -> None:
    device = channels(shape, even=even)
    layers = Layers.on_device(device, shape)
    assert layers.shape == shape
    for field in fields(Layers):
        got, held = getattr(layers, field.name), device[field.name]
        colour = field.name in COLOURS
        rows = [np.broadcast_to(np.array(c), shape[0] * shape[1]) for c in (held if colour else [held])]
        expected = np.stack(rows, axis=-1).reshape(*shape, len(rows))
        np.testing.assert_array_equal(got, expected if colour else expected[..., 0])
        assert got.dtype == (np.uint16 if field.name in IDS else np.float32)
        assert got.flags.c_contiguous and got.flags.writeable == (colour or field.name in IDS)


def test_layers_are_transferred_when_they_are_read() -> None:
    layers = Layers.on_device(channels((4, 6)), (4, 6))
    assert not {field.name for field in fields(Layers)} & vars(layers).keys()
    assert layers.depth is layers.depth
    assert {field.name for field in fields(Layers)} & vars(layers).keys() == {"depth"}
    layers.rgb[0, 0] = 7  # the cached host copy
    assert (layers.rgb[0, 0] == 7).all()
    assert dr.all(layers.device_array("rgb").y == 0.25)
    with pytest.raises(AttributeError, match="'Layers' object has no attribute 'colour'"):
        layers.colour  # type: ignore[attr-defined]  # noqa: B018


def test_copies_have_the_same_values() -> None:
    layers = Layers.on_device(channels((4, 6)), (4, 6))
    for other in (pickle.loads(pickle.dumps(layers)), copy.copy(layers), replace(layers)):
        for field in fields(Layers):
            np.testing.assert_array_equal(getattr(other, field.name), getattr(layers, field.name))
    changed = replace(layers, captured=np.full((4, 6, 3), 0.5, np.float32))
    assert changed.shape == (4, 6)
    assert dr.all(changed.device_array("captured") == 0.5, axis=None)
    assert dr.all(changed.device_array("rgb") == layers.device_array("rgb"), axis=None)
    assert dr.all(changed.device_array("alpha") == layers.device_array("alpha"))
