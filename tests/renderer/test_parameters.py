"""Plugin parameters of the wrong type or out of range raise an error of one sentence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import pytest

from mitsplat.errors import InputError
from mitsplat.plugins.parameters import Parameters
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import make_integrator
from mitsplat.runtime.variant import ensure_variant


def given(**values: Any) -> Parameters:
    ensure_variant()
    props = mi.Properties("splats")
    for name, value in values.items():
        props[name] = value
    return Parameters(props, "shape 'splats'")


def test_missing_parameters_have_their_defaults() -> None:
    none = given()
    assert (none.string("a", "b"), none.boolean("a", True), none.number("a", 2), none.integer("a", 3, 0, 9)) == (
        "b",
        True,
        2.0,
        3,
    )
    assert none.choice("a", "one", "two") == "one"
    assert none.point("a", (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    with pytest.raises(InputError, match=r"^shape 'splats': 'a' is missing$"):
        none.positive("a", None)


def test_given_parameters_are_read() -> None:
    some = given(text="b", truth=False, whole=3, number=0.5, point=[1, 2.5, 3])
    assert (some.string("text", ""), some.boolean("truth", True), some.integer("whole", 0, 0, 3)) == ("b", False, 3)
    assert some.point("point", (0.0, 0.0, 0.0)) == (1.0, 2.5, 3.0)
    assert (some.number("number", 1), some.number("whole", 1), some.choice("text", "a", "b")) == (0.5, 3.0, "b")


@pytest.mark.parametrize(
    ("value", "method", "limits", "sentence"),
    [
        ("1", "number", (0.0,), "'x' must be a number (got '1')"),
        (True, "number", (0.0,), "'x' must be a number (got True)"),
        (0, "positive", (1.0,), "'x' must be > 0 (got 0.0)"),
        (float("nan"), "positive", (1.0,), "'x' must be > 0 (got nan)"),
        (1.0, "integer", (0, 0, 9), "'x' must be an integer from 0 to 9 (got 1.0)"),
        (10, "integer", (0, 0, 9), "'x' must be from 0 to 9 (got 10)"),
        (1, "boolean", (True,), "'x' must be true or false (got 1)"),
        (1, "string", ("",), "'x' must be text (got 1)"),
        ("c", "choice", ("a", "b"), "'x' must be 'a' or 'b' (got 'c')"),
        (1.0, "point", ((0, 0, 0),), "'x' must be a point (got 1.0)"),
        ("1 2 3", "point", ((0, 0, 0),), "'x' must be a point (got '1 2 3')"),
        ([0.0, float("nan"), 1.0], "point", ((0, 0, 0),), "'x' must be finite (got [0.0, nan, 1.0])"),
    ],
)
def test_parameters_of_another_type_or_range_are_refused(
    value: Any, method: str, limits: tuple[Any, ...], sentence: str
) -> None:
    with pytest.raises(InputError) as caught:
        getattr(given(x=value), method)("x", *limits)
    assert str(caught.value) == f"shape 'splats': {sentence}"


def test_the_integrator_in_python_refines_a_preset_as_in_xml() -> None:
    refined = {"response": "ewa", "kernel": "mip", "samples": 4, "lens_rings": 3}
    assert make_integrator(quality="fast", **refined).renderer.quality == replace(PRESETS["fast"], **refined)
    assert make_integrator(quality=Quality(kernel="gsplat")).renderer.quality == Quality(kernel="gsplat")


def test_parameters_of_a_complete_quality_are_refused() -> None:
    with pytest.raises(InputError, match=r"^make_integrator: 'kernel' must not be given together with a Quality, .*$"):
        make_integrator(quality=Quality(), kernel="mip")
