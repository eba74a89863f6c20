"""Fields of frozen dataclasses that are made when they are first looked at: what a GPU holds, brought to the host."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Self, cast

from mitsplat.runtime.variant import one_at_a_time


class LazyValue:
    """A dataclass of which some fields are made when they are first looked at, and kept from then on.

    Copies by ``replace`` and pickles hold the values of all fields.
    """

    @classmethod
    def later(cls, makers: Mapping[str, Callable[[], Any]], **known: Any) -> Self:
        """An object of the fields that are ``known``, and those that ``makers`` make."""
        made = cls.__new__(cls)
        made.__dict__.update(known, _makers=dict(makers))
        return made

    if not TYPE_CHECKING:  # all other names stay unknown to type checkers

        def __getattr__(self, name: str) -> Any:
            if name not in self.__dict__.get("_makers", ()):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            return self._make(name)

    @one_at_a_time
    def _make(self, name: str) -> Any:
        if name not in self.__dict__:  # another thread may have been first
            self.__dict__[name] = self.__dict__["_makers"][name]()
        return self.__dict__[name]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), tuple(getattr(self, field.name) for field in fields(cast(Any, self)))
