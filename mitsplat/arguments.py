"""Checks of the arguments of public functions, methods and settings, and words for their messages."""

from __future__ import annotations

import functools
import inspect
import os
import types
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from mitsplat.errors import InputError

_Class = TypeVar("_Class")
_Number = TypeVar("_Number", int, float)


def check_type(value: object, kind: type, place: str, remedy: str) -> None:
    """Check that an argument of the Python API has a type.

    Raises:
        InputError: If it has another type.
    """
    if not isinstance(value, kind):
        raise InputError(f"{place} must be a {kind.__name__} (got {describe(value)}): {remedy}")


def describe(value: object) -> str:
    """Return the type of a value and the value, if it is short."""
    text = repr(value)
    return type(value).__name__ if len(text) > 60 or "\n" in text else f"{type(value).__name__} {text}"


def list_in_words(words: Sequence[str], last: Literal["and", "or"]) -> str:
    """Return one or more words as a list: "a", "a or b", "a, b or c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def list_first(words: Sequence[str], most: int) -> str:
    """Return the first words as a list, and the number of the others: "a, b and 5 more"."""
    others = f" and {len(words) - most} more" if len(words) > most else ""
    return f"{', '.join(words[:most])}{others}"


def number_from(text: str, kind: type[_Number]) -> _Number:
    """Return ``kind(text)``, but refuse the digits of other scripts and the separators that Python permits.

    Raises:
        ValueError: If the text is no such number.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"must be a number (got {text})")
    return kind(text)


def path_of(value: object, place: str) -> Path:
    """Return an argument of the Python API as a path.

    Raises:
        InputError: If it is no path.
    """
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{place} must be a path (got {describe(value)})")
    return Path(value)


def check_number(value: object, place: str) -> None:
    """Check that an argument of the Python API is a number; truth values are not.

    Raises:
        InputError: If it is none.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise InputError(f"{place} must be a number (got {describe(value)})")


def check_whole_number(value: object, place: str) -> None:
    """Check that an argument of the Python API is a whole number; truth values are not.

    Raises:
        InputError: If it is none.
    """
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise InputError(f"{place} must be a whole number (got {describe(value)})")


def check_text(value: object, place: str) -> None:
    """Check that an argument of the Python API is text that is not empty.

    Raises:
        InputError: If it is not.
    """
    if not isinstance(value, str) or not value:
        raise InputError(f"{place} must be text that is not empty (got {describe(value)})")


def check_list(value: object, kind: type, place: str) -> None:
    """Check that an argument of the Python API is a list or a tuple of values of a type.

    Raises:
        InputError: If it is none.
    """
    if not isinstance(value, list | tuple):
        raise InputError(f"{place} must be a list of {kind.__name__} objects (got {describe(value)})")
    for number, one in enumerate(value):
        if not isinstance(one, kind):
            raise InputError(f"{place}[{number}] must be a {kind.__name__} (got {describe(one)})")


def real_array(value: npt.ArrayLike, kind: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Return an argument of the Python API as a new array of real numbers, of any shape.

    Raises:
        TypeError, ValueError: If it has other values, such as text or complex numbers, or masked ones, which NumPy
            replaces by those below the mask.
    """
    given = np.asarray(value)
    if np.ma.is_masked(value) or given.dtype.kind in "cmM":
        raise TypeError("not real numbers, or masked ones")
    return np.array(given, dtype=kind, order="C")


_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}


def check_fields(settings: object) -> None:
    """Check the types of the fields of a frozen dataclass of settings, and convert text to paths.

    Raises:
        InputError: If a field has another type than its annotation states.
    """
    for name, hint in get_type_hints(type(settings)).items():
        kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        value = getattr(settings, name)
        if Path in kinds and isinstance(value, str):
            object.__setattr__(settings, name, Path(value))
        elif not any(_has_kind(value, kind) for kind in kinds):
            words = [word for kind in kinds for word in _describe_kind(kind)]
            raise InputError(f"{name} must be {list_in_words(words, 'or')} (got {describe(value)})")


def check_least(settings: object, **least: float) -> None:
    """Check that fields of a dataclass of settings, if they are not None, have at least the given values.

    Raises:
        InputError: If a field has a smaller value.
    """
    for name, minimum in least.items():
        value = getattr(settings, name)
        if value is not None and value < minimum:
            raise InputError(f"{name} must be at least {minimum} (got {value})")


def _has_kind(value: object, kind: Any) -> bool:
    """Return True if a value has the type of an annotation; the items of lists and mappings are not checked."""
    if get_origin(kind) is Literal:
        return any(isinstance(value, type(one)) and value == one for one in get_args(kind))
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    if get_origin(kind) is tuple:
        items = get_args(kind)
        return isinstance(value, list | tuple) and (Ellipsis in items or len(value) == len(items))
    return isinstance(value, get_origin(kind) or kind)


def _describe_kind(kind: Any) -> list[str]:
    """Return the words for the alternatives of an annotation."""
    if get_origin(kind) is Literal:
        return list(map(str, get_args(kind)))
    if get_origin(kind) is tuple:
        return ["a list" if Ellipsis in get_args(kind) else f"a list of {len(get_args(kind))}"]
    if get_origin(kind) is os.PathLike or kind is os.PathLike:
        return ["a path"]
    if get_origin(kind) is np.ndarray:
        return ["an array"]
    if get_origin(kind) is Sequence:
        return ["a list"]
    kind = get_origin(kind) or kind
    return ["None" if kind is type(None) else _WORDS.get(kind, f"a {getattr(kind, '__name__', kind)}")]


def checks_arguments(kind: type[_Class]) -> type[_Class]:
    """Class decorator: check the arguments of all public methods by their annotations.

    Numbers, text, paths, lists, dictionaries, arrays and objects are checked, and alternatives of them, such as
    ``int | None``. An argument that becomes an array (``ArrayLike``) must consist of numbers. Not checked are values of
    protocols, ``Mapping`` and ``Any``, and alternatives that include one of these or ``ArrayLike``. ``from_json`` also
    names missing keys.
    """
    for name, member in list(vars(kind).items()):
        function = getattr(member, "__func__", member)
        if not name.startswith("_") and isinstance(function, types.FunctionType):
            if name == "from_json":
                function = _with_missing_keys(function, f"{kind.__name__}.{name}")
            checked = _checked(function)
            setattr(kind, name, type(member)(checked) if isinstance(member, classmethod | staticmethod) else checked)
    return kind


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that checks its arguments."""
    signature = inspect.signature(function)
    hints = functools.cache(lambda: get_type_hints(function))  # classes of later modules are known at the first call

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            given = {}  # Python's own message names the argument
        for name, value in given.items():
            if name in hints():
                _check_argument(value, hints()[name], name)
        return function(*args, **kwargs)

    return call


def _with_missing_keys(function: Callable[..., Any], place: str) -> Callable[..., Any]:
    """Return a method ``from_json`` that refuses values that ``to_json`` has not made in one sentence."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except KeyError as error:
            raise InputError(f"{place} needs the values of to_json: the key {error} is missing") from error
        except (TypeError, IndexError, AttributeError) as error:
            raise InputError(f"{place} needs the values of to_json ({error})") from error

    return call


def _check_argument(value: Any, hint: Any, place: str) -> None:
    """Check an argument by its annotation, if it is of a type that needs no conversion.

    Raises:
        InputError: If it has another type.
    """
    if hint == npt.ArrayLike:
        try:
            is_numeric = np.asarray(value).dtype.kind in "biuf" and not np.ma.is_masked(value)
        except ValueError:
            is_numeric = False
        if not is_numeric:
            raise InputError(f"{place} must be an array of numbers (got {describe(value)})")
        return
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    if not all(_is_checked(kind) for kind in kinds):
        return
    if not any(_has_kind(value, kind) and not _is_wrong_text(value, kind) for kind in kinds):
        words = list(dict.fromkeys(word for kind in kinds for word in _describe_kind(kind)))
        if "a path" in words:
            words = [word for word in words if word != "text"]
        raise InputError(f"{place} must be {list_in_words(words, 'or')} (got {describe(value)})")
    for kind in kinds:
        if get_origin(kind) is Sequence and isinstance(value, list | tuple):
            for number, one in enumerate(value):
                _check_argument(one, get_args(kind)[0], f"{place}[{number}]")


def _is_checked(kind: Any) -> bool:
    """Return True for an annotation whose values are checked; values of protocols are converted by the method."""
    base = get_origin(kind) or kind
    if base in (object, Any, Mapping):  # methods describe the mappings that they need
        return False
    return base is Literal or (isinstance(base, type) and not getattr(base, "_is_protocol", False))


def _is_wrong_text(value: Any, kind: Any) -> bool:
    """Return True for text in place of a list, which Python takes for a list of letters."""
    return isinstance(value, str | bytes) and get_origin(kind) is Sequence
