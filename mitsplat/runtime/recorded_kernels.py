"""Recorded kernel launches for parts of a training step that repeat in every step.

Tracing a step in Python and looking up its compiled kernels takes longer than the GPU needs to run them.
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
"""Use of recordings. If false, every call is traced.

On a CPU, both give the same bytes. On a GPU, both agree up to rounding, because division by a compile-time constant
differs from division by a variable (``tests/renderer/test_recorded_kernels.py``,
``python -m benchmarks.assets.fit --synthetic spur_gear --replay off``).
"""

_MAX_RECORDINGS = 64
"""Maximum number of recordings per function; one per picture size, number of Gaussians and SH degree."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def recorded(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Record the kernel launches of a function of device arrays, and replay them in later calls.

    Arguments that are not arrays must be hashable. They select the recording, as do the widths of arrays. Arrays in a
    :class:`Table` are exempt: their width is free, and the function receives the array itself. Dr.Jit can also manage
    several recordings of one function, but it guesses other widths and confuses some numbers. Requirements for the
    function: it reads nothing back from the device, compresses nothing, takes evaluated arrays without gradients as
    positional arguments, and depends on no other variable state. Its results are evaluated.
    """
    recordings: OrderedDict[Any, Callable[[list[Any]], Any]] = OrderedDict()

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        arrays: list[Any] = []
        form = _with_placeholders(args, arrays)

        def run(arrays: list[Any]) -> Result:
            return function(*_with_arrays(form, iter(arrays)))  # type: ignore[call-arg]

        if not REPLAY:
            result = run(arrays)
        else:
            key = mi.variant(), form
            if key not in recordings:
                recordings[key] = dr.freeze(run)
                if len(recordings) > _MAX_RECORDINGS:
                    recordings.popitem(last=False)
            recordings.move_to_end(key)
            result = recordings[key](arrays)
        dr.eval(result)
        return result

    return call


@dataclass(frozen=True, eq=False)
class Table:
    """An array of any width from which a recorded function only gathers, in kernels that also take a number."""

    values: Any


class _Array(NamedTuple):
    """Placeholder of an array; width None if any width is allowed."""

    kind: type
    width: int | None


class _Dict(NamedTuple):
    """Placeholder of a dictionary."""

    keys: tuple[str, ...]
    parts: tuple[Any, ...]


class _Sequence(NamedTuple):
    """Placeholder of a list or a tuple."""

    kind: type
    parts: tuple[Any, ...]


def _with_placeholders(values: Any, arrays: list[Any]) -> Any:
    """Replace arrays in the values by placeholders, and append the arrays to a list."""
    if isinstance(values, dr.ArrayBase):
        arrays.append(values)
        return _Array(type(values), dr.width(values))
    if isinstance(values, Table):
        arrays.append(values.values)
        return _Array(type(values.values), None)
    if isinstance(values, dict):
        return _Dict(tuple(values), tuple([_with_placeholders(value, arrays) for value in values.values()]))
    if isinstance(values, (list, tuple)) and not hasattr(values, "_fields"):
        return _Sequence(type(values), tuple([_with_placeholders(value, arrays) for value in values]))
    return values


def _with_arrays(form: Any, arrays: Iterator[Any]) -> Any:
    """Replace the placeholders of a form by these arrays."""
    if isinstance(form, _Array):
        return next(arrays)
    if isinstance(form, _Dict):
        return dict(zip(form.keys, [_with_arrays(part, arrays) for part in form.parts], strict=True))
    if isinstance(form, _Sequence):
        return form.kind(_with_arrays(part, arrays) for part in form.parts)
    return form
