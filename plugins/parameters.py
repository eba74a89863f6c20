"""Typed parameters of plugins; Mitsuba alone accepts a string as a number."""

from __future__ import annotations

from typing import Any, NoReturn

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.errors import InputError


class Parameters:
    """Parameters of one plugin in a scene.

    Every method takes the name of a parameter and its default value. It raises :class:`~mitsplat.errors.InputError` if
    the value has another type or is out of range.

    Args:
        props: Properties from Mitsuba.
        plugin: Name of the plugin in errors, such as ``shape 'splats'``.
    """

    def __init__(self, props: mi.Properties, plugin: str) -> None:
        self._props, self._plugin = props, plugin

    def string(self, name: str, default: str) -> str:
        """Return a string."""
        return str(self._typed(name, default, (str,), "text"))

    def choice(self, name: str, default: str, *others: str) -> str:
        """Return one of several words."""
        value, words = self.string(name, default), (default, *others)
        if value not in words:
            self.refuse(name, f"be {' or '.join(map(repr, words))}", value)
        return value

    def boolean(self, name: str, default: bool) -> bool:
        """Return a boolean."""
        return bool(self._typed(name, default, (bool,), "true or false"))

    def number(self, name: str, default: float | None) -> float:
        """Return a number; it is required if the default is None."""
        value = self._typed(name, default, (int, float), "a number")
        if value is None:
            raise InputError(f"{self._plugin}: {name!r} is missing")
        return float(value)

    def positive(self, name: str, default: float | None) -> float:
        """Return a number above 0."""
        value = self.number(name, default)
        if not value > 0:
            self.refuse(name, "be > 0", value)
        return value

    def colour(self, name: str, default: float) -> tuple[float, float, float]:
        """Return three finite numbers above 0, from a number for all channels or from an RGB value."""
        value = self._typed(name, default, (int, float, mi.ScalarColor3d), "a number or an RGB value")
        red, green, blue = (float(v) for v in np.broadcast_to(np.ravel(value), 3))
        if not (min(red, green, blue) > 0 and max(red, green, blue) < np.inf):
            self.refuse(name, "be > 0", value)
        return red, green, blue

    def point(self, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return three finite numbers."""
        x, y, z = (float(v) for v in self._typed(name, default, (dr.scalar.Array3f64,), "a point"))
        if not np.isfinite([x, y, z]).all():
            self.refuse(name, "be finite", [x, y, z])
        return x, y, z

    def integer(self, name: str, default: int, least: int, most: int) -> int:
        """Return an integer from ``least`` to ``most``."""
        value = self._typed(name, default, (int,), f"an integer from {least} to {most}")
        if not least <= value <= most:
            self.refuse(name, f"be from {least} to {most}", value)
        return int(value)

    def refuse(self, name: str, rule: str, value: object) -> NoReturn:
        """Raise an error that a parameter violates a rule."""
        raise InputError(f"{self._plugin}: {name!r} must {rule} (got {value!r})")

    def _typed(self, name: str, default: Any, kinds: tuple[type, ...], what: str) -> Any:
        if name not in self._props:
            return default
        value = self._props[name]
        if type(value) not in kinds:
            self.refuse(name, f"be {what}", value)
        return value
