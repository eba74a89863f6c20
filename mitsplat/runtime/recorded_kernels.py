"""Kernels that are recorded once and launched again, for parts of a training step that are the same in every step.

To trace a step in Python and to find its compiled kernels takes longer than a GPU takes to run them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import drjit as dr
import mitsuba as mi

REPLAY = True
"""Whether recordings are used. Without, every call is traced: to the same bytes on a CPU, and on a GPU to the same but
for rounding, because it divides by a number that is known when a kernel is compiled otherwise than by one that is not
(``tests/renderer/test_recorded.py``, ``python -m benchmarks.assets.fit --synthetic spur_gear --replay off``)."""

_KEPT = 64
"""Recordings of one function: there is one per size of a picture, number of Gaussians and degree of their colours."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def recorded(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A function of arrays on the device whose launches are recorded, and repeated when it is called again.

    What is no array must be hashable, and decides which recording is used, as the widths of arrays do, but for those in
    a :class:`Table`, in place of which the function gets the array itself. Dr.Jit can keep several recordings of a
    function too, but guesses other widths, and takes some numbers for others. The function must read nothing from the
    device, compress nothing, take evaluated arrays without gradients, and use nothing that changes but its arguments,
    which come by position. What it returns is evaluated.
    """
    recordings: OrderedDict[Any, Callable[[list[Any]], Any]] = OrderedDict()

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        arrays: list[Any] = []
        form = _form(args, arrays)

        def run(arrays: list[Any]) -> Result:
            return function(*_filled(form, iter(arrays)))  # type: ignore[call-arg]

        if not REPLAY:
            result = run(arrays)
        else:
            key = mi.variant(), form
            if key not in recordings:
                recordings[key] = dr.freeze(run)
                if len(recordings) > _KEPT:
                    recordings.popitem(last=False)
            recordings.move_to_end(key)
            result = recordings[key](arrays)
        dr.eval(result)
        return result

    return call


@dataclass(frozen=True, eq=False)
class Table:
    """An array of any width that a recorded function only gathers from, in kernels that also take a number."""

    values: Any


class _Array(NamedTuple):
    """Stands for an array; of no width if that may be any."""

    kind: type
    width: int | None


class _Keyed(NamedTuple):
    """Stands for a dictionary."""

    keys: tuple[str, ...]
    parts: tuple[Any, ...]


class _Listed(NamedTuple):
    """Stands for a list or a tuple."""

    kind: type
    parts: tuple[Any, ...]


def _form(values: Any, arrays: list[Any]) -> Any:
    """Values with what stands for their arrays, which are appended to a list."""
    if isinstance(values, dr.ArrayBase):
        arrays.append(values)
        return _Array(type(values), dr.width(values))
    if isinstance(values, Table):
        arrays.append(values.values)
        return _Array(type(values.values), None)
    if isinstance(values, dict):
        return _Keyed(tuple(values), tuple([_form(value, arrays) for value in values.values()]))
    if isinstance(values, (list, tuple)) and not hasattr(values, "_fields"):
        return _Listed(type(values), tuple([_form(value, arrays) for value in values]))
    return values


def _filled(form: Any, arrays: Iterator[Any]) -> Any:
    """The values of a form, with these arrays."""
    if isinstance(form, _Array):
        return next(arrays)
    if isinstance(form, _Keyed):
        return dict(zip(form.keys, [_filled(part, arrays) for part in form.parts], strict=True))
    if isinstance(form, _Listed):
        return form.kind(_filled(part, arrays) for part in form.parts)
    return form
