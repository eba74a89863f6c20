"""Frozen dataclasses with fields that are computed on first access, such as device arrays copied to the host."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Self, cast

from mitsplat.runtime.variant import one_at_a_time


class LazyValue:
    """Dataclass of which some fields are computed on first access and then stored.

    Copies by ``replace`` and pickles hold the values of all fields.
    """

    @classmethod
    def later(cls, makers: Mapping[str, Callable[[], object]], **known: object) -> Self:
        """Create an object from ``known`` fields and functions that compute the other fields."""
        made = cls.__new__(cls)
        made.__dict__.update(known, _makers=dict(makers))
        return made

    if not TYPE_CHECKING:  # keeps all other names unknown to type checkers

        def __getattr__(self, name: str) -> Any:
            if name not in self.__dict__.get("_makers", ()):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            return self._make(name)

    @one_at_a_time
    def _make(self, name: str) -> object:
        if name not in self.__dict__:  # another thread may have stored it meanwhile
            self.__dict__[name] = self.__dict__["_makers"][name]()
        return self.__dict__[name]

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), tuple(getattr(self, field.name) for field in fields(cast(Any, self)))
