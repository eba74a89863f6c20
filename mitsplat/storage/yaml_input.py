"""YAML files as pydantic models, with errors of one sentence: file, line, key path, rule and received value."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path, PurePath
from typing import Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq, TaggedScalar
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.scanner import RoundTripScanner

from mitsplat.arguments import describe
from mitsplat.errors import InputError
from mitsplat.storage.file_kinds import refuse_placeholder
from mitsplat.storage.format_version import FORMAT_VERSION, check_format_version

Validated = TypeVar("Validated", bound=BaseModel)
KeyPath = tuple[str | int, ...]

MAX_DEPTH = 32
"""Maximum nesting depth. Deeper files are malicious, or contain an alias to itself."""
MAX_BYTES = 8 << 20
MAX_VALUES = 200_000
"""Maximum number of values. Files with more are malicious: nested aliases multiply values."""
MAX_NUMBER = 1e30
"""Maximum magnitude of a number; the fourth power of a larger one may overflow."""

RULES = {
    "missing": "is required",
    "greater_than": "must be > {gt:g}",
    "greater_than_equal": "must be >= {ge:g}",
    "less_than": "must be < {lt:g}",
    "less_than_equal": "must be <= {le:g}",
    "finite_number": "must be finite",
    "literal_error": "must be {expected}",
    "union_tag_invalid": "must be one of {expected_tags}",
    "union_tag_not_found": "is required",
    "model_type": "must be a mapping of keys to values",
    "model_attributes_type": "must be a mapping of keys to values",
    "dict_type": "must be a mapping of keys to values",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "too_short": "must have {min_length} or more items",
    "too_long": "must have {max_length} or fewer items",
    "string_type": "must be text",
    "string_too_short": "must have {min_length} or more characters",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "bool_type": "must be true or false",
}
"""Messages by pydantic error type; other types keep pydantic's message."""


class FieldError(ValueError):
    """Violation of a rule between several fields of one model; ``key`` is the field to report.

    Raise it in a model validator, where pydantic reports only the model.
    """

    def __init__(self, key: str | KeyPath, rule: str) -> None:
        super().__init__(rule)
        self.key: KeyPath = (key,) if isinstance(key, str) else key


class _Scanner(RoundTripScanner):
    """Scanner with a limit on nesting; its time otherwise grows with the square of the depth."""

    def fetch_flow_collection_start(self, *args: Any, **kwargs: Any) -> None:
        """Start a list or mapping in brackets."""
        if len(self.flow_context) > MAX_DEPTH:
            raise RecursionError
        super().fetch_flow_collection_start(*args, **kwargs)


class _Finding(NamedTuple):
    """One broken rule for an error message."""

    path: KeyPath
    rule: str
    line: int | None
    missing: bool


def load_yaml(
    path: str | Path,
    model: type[Validated],
    *,
    overrides: Mapping[str, object] | None = None,
    newest: int | None = None,
) -> Validated:
    """Read a YAML 1.2 file into ``model``. Types are checked strictly (no text for numbers), and no code is executed.

    Args:
        path: The file.
        model: Pydantic model with the rules.
        overrides: Values that replace those of the file, by dotted key, such as ``{"output.width": 640}``.
        newest: Newest readable version of the file's format; None for files without versions.

    Raises:
        InputError: If the file cannot be read, is not YAML, repeats a key, has a newer version or breaks a rule of
            ``model``.
    """
    path = Path(path)
    tree = _parse(path)
    overridden = _overridden(overrides or {})
    data = _plain(tree, (), tree, path, count())
    for keys, value in overridden.items():
        _set(data, keys, _to_file_values(value))
    if newest is not None:  # checked first: other errors may be valid in a newer version
        check_format_version(data, newest, _place(path, _line(tree, (FORMAT_VERSION,)), ()))
    try:
        # Strict JSON mode matches YAML: lists fill tuples, whole numbers fill floats, and nothing else is converted.
        return model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        findings = [_finding(details, model, data, tree, overridden) for details in error.errors()]
    first = min(findings, key=lambda finding: (_is_consequence(finding, findings), finding.line or 0))
    raise InputError(_sentence(path, first.line, first.path, first.rule))


def _overridden(overrides: Mapping[str, object]) -> dict[tuple[str, ...], object]:
    """Return the overrides of :func:`load_yaml` by their keys.

    Raises:
        InputError: If they are no mapping of dotted keys to values that a file can contain.
    """
    if not isinstance(overrides, Mapping) or not all(isinstance(key, str) for key in overrides):
        raise InputError(f"overrides must map dotted keys to values, as in {{'output.width': 640}} (got {overrides!r})")
    for key, value in overrides.items():
        try:
            json.dumps(_to_file_values(value))
        except (TypeError, ValueError):
            raise InputError(f"overrides[{key!r}]: must be a value of a YAML file (got {describe(value)})") from None
    return {tuple(key.split(".")): value for key, value in overrides.items()}


def model_error_sentence(error: ValidationError, model: type[BaseModel], values: Mapping[str, object]) -> str:
    """Return the error sentence for ``values`` from Python code (not from a file) that break a rule of a model."""
    data = _to_file_values(values)
    findings = [_finding(details, model, data, None, {}) for details in error.errors()]
    first = min(findings, key=lambda finding: _is_consequence(finding, findings))
    return _sentence(Path(model.__name__), None, first.path, first.rule)


def key_place(path: str | Path, keys: KeyPath) -> str:
    """Return the place of ``keys`` as errors begin: ``scene.yaml:41: objects[2].asset``.

    The line is omitted if the file does not exist.
    """
    path = Path(path)
    return _place(path, _line(_parse(path), keys) if path.exists() else None, keys)


def _to_file_values(value: object) -> Any:
    """Convert a value to mappings, lists and scalars as in a file."""
    if isinstance(value, BaseModel):
        # dict(value) would call a field named ``keys``.
        return {name: _to_file_values(getattr(value, name)) for name in type(value).model_fields}
    if isinstance(value, Mapping):
        return {str(key): _to_file_values(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_to_file_values(inner) for inner in value]
    if isinstance(value, PurePath):
        return str(value)
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _parse(path: Path) -> CommentedMap:
    """Parse the file to a mapping with line numbers."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: must be a file")
        if (size := path.stat().st_size) > MAX_BYTES:
            raise InputError(f"{path}: must have at most {MAX_BYTES >> 20} MiB (got {size} bytes)")
        text = path.read_text(encoding="utf-8")
        if text:
            refuse_placeholder(path, text[:80].encode())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be YAML in UTF-8 ({error.reason} at byte {error.start})") from None
    try:
        reader = YAML(typ="rt", pure=True)
        reader.Scanner = _Scanner
        tree = reader.load(text)
    except DuplicateKeyError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        problem = str(error.problem).partition(" with value")[0]
        raise InputError(_sentence(path, line, (), f"keys must be unique ({problem})")) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        remedy = "; use spaces in place of tabs" if "'\\t'" in str(error.problem) else ""
        raise InputError(
            _sentence(path, mark.line + 1 if mark else None, (), f"not YAML: {error.problem}{remedy}")
        ) from None
    except (YAMLError, ValueError) as error:  # ValueError: an impossible date or number
        raise InputError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
    except RecursionError:
        raise InputError(f"{path}: must not nest deeper than {MAX_DEPTH} levels") from None
    if not isinstance(tree, CommentedMap):
        raise InputError(f"{path}: must be a mapping of keys to values (got {_format_value(tree)})")
    return tree


def _plain(node: object, keys: KeyPath, tree: CommentedMap, path: Path, values: Iterator[int]) -> Any:
    """Convert a node to built-in dicts, lists and scalars; refuse values without a JSON equivalent."""
    if len(keys) > MAX_DEPTH:
        raise InputError(f"{path}: must not nest deeper than {MAX_DEPTH} levels")
    if next(values) > MAX_VALUES:
        raise InputError(f"{path}: must not hold more than {MAX_VALUES} values")
    tag = getattr(node, "tag", None)
    if isinstance(node, TaggedScalar) or (tag is not None and tag.value is not None):
        raise InputError(_sentence(path, _line(tree, keys), keys, f"must not have a YAML tag (got {tag})"))
    if isinstance(node, Mapping):
        for key in node:
            if not isinstance(key, str):
                line = _line(tree, (*keys, key))
                raise InputError(_sentence(path, line, keys, f"keys must be text (got {_format_value(key)})"))
        return {str(key): _plain(value, (*keys, key), tree, path, values) for key, value in node.items()}
    if isinstance(node, list):
        return [_plain(value, (*keys, position), tree, path, values) for position, value in enumerate(node)]
    if node is None or isinstance(node, bool):
        return node
    if isinstance(node, int | float) and MAX_NUMBER < abs(node) < float("inf"):
        got = f"{float(node):g}" if isinstance(node, float) else f"a whole number of {int(node).bit_length()} bits"
        rule = f"numbers must be from {-MAX_NUMBER:g} to {MAX_NUMBER:g} (got {got})"
        raise InputError(_sentence(path, _line(tree, keys), keys, rule))
    for scalar in (int, float, str):
        if isinstance(node, scalar):
            return scalar(node)
    return str(node)


def _set(data: dict[str, Any], keys: tuple[str, ...], value: object) -> None:
    """Replace one value of nested mappings, and create missing mappings."""
    for key in keys[:-1]:
        inner = data.get(key)
        if not isinstance(inner, dict):
            inner = data[key] = {}
        data = inner
    data[keys[-1]] = value


def _finding(
    details: ErrorDetails,
    model: type[BaseModel],
    data: dict[str, Any],
    tree: CommentedMap | None,
    overridden: Mapping[tuple[str, ...], object],
) -> _Finding:
    """Convert one error of pydantic to a finding in terms of the file, if there is one."""
    kind, context, location = details["type"], details.get("ctx", {}), details["loc"]
    keys = _file_path(location, data, keep_last=kind == "missing")
    value: object = details["input"]
    cause = context.get("error")
    if isinstance(cause, FieldError):
        keys += cause.key
    if kind.startswith("union_tag"):
        keys += (str(context["discriminator"]).strip("'"),)
        value = context.get("tag")
    rule = RULES[kind].format(**context) if kind in RULES else str(details["msg"])
    if kind == "value_error":
        rule = str(cause)
    elif kind == "extra_forbidden":
        rule = _unknown_key(str(keys[-1]), list(_schema_at(model, location[:-1]).get("properties", {})))
    elif kind == "union_tag_not_found":
        rule += f", one of {', '.join(_schema_at(model, location)['discriminator']['mapping'])}"
    elif kind == "missing" and isinstance(location[-1], int):
        rule = f"must have {_schema_at(model, location[:-1])['minItems']} items (got {location[-1]})"
    elif kind != "missing":
        if kind == "tuple_type" and "prefixItems" in (form := _schema_at(model, location)):
            rule += f" of {len(form['prefixItems'])}"
        rule = f"{rule.replace('Input should', 'must')} (got {_format_value(value)}{_hint(kind, context, value)})"
    overlaps = [min(len(keys), len(override)) for override in overridden]
    from_file = not any(n and keys[:n] == override[:n] for n, override in zip(overlaps, overridden, strict=True))
    line = _line(tree, keys) if tree is not None and from_file else None
    return _Finding(keys, rule, line, kind == "missing" and isinstance(location[-1], str))


def _is_consequence(finding: _Finding, findings: Sequence[_Finding]) -> bool:
    """Return True if the finding may result from another one, such as a misspelt key or an invalid list item."""
    return finding.missing or any(
        len(finding.path) < len(other.path) and other.path[: len(finding.path)] == finding.path for other in findings
    )


def _file_path(location: KeyPath, data: object, *, keep_last: bool) -> KeyPath:
    """Remove the names of union members from pydantic's location, because they are not in the file."""
    keys: list[str | int] = []
    for position, part in enumerate(location):
        last = position == len(location) - 1
        if isinstance(data, dict):
            if part == data.get("kind") and not last:
                continue
            if part in data:
                keys, data = [*keys, part], data[str(part)]
            elif last and keep_last:
                keys.append(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            keys, data = [*keys, part], data[part]
    return tuple(keys)


def _line(tree: Any, keys: KeyPath) -> int:
    """Return the line (from 1) of the deepest part of ``keys`` that the file contains."""
    line = int(tree.lc.line)
    for key in keys:
        try:
            if isinstance(tree, CommentedMap):
                line = tree.lc.key(key)[0]
            elif isinstance(tree, CommentedSeq):
                line = tree.lc.item(key)[0]
            tree = tree[key]
        except (KeyError, IndexError, TypeError):
            break
    return line + 1


def _schema_at(model: type[BaseModel], location: KeyPath) -> dict[str, Any]:
    """Return the part of the model's JSON Schema at pydantic's ``location``, or {}."""
    root = model.model_json_schema()

    def resolved(schema: dict[str, Any]) -> dict[str, Any]:
        while "$ref" in schema or "anyOf" in schema:
            # The options of anyOf are an optional value and null, in this order.
            schema = root["$defs"][schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema["anyOf"][0]
        return schema

    schema = resolved(root)
    for part in location:
        members = schema.get("discriminator", {}).get("mapping", {})
        if part in members:
            schema = {"$ref": members[part]}
        elif isinstance(part, int):
            items = schema.get("prefixItems", [])
            schema = items[part] if part < len(items) else schema.get("items", {})
        else:
            schema = schema.get("properties", {}).get(part, {})
        schema = resolved(schema)
    return schema


def _hint(kind: str, context: Mapping[str, Any], value: object) -> str:
    """Return the value that was probably meant, as the end of a message: a similar word, or a percentage as a share."""
    if kind in ("literal_error", "union_tag_invalid") and isinstance(value, str):
        expected = re.findall(r"'([^']*)'", str(context.get("expected", context.get("expected_tags", ""))))
        close = difflib.get_close_matches(value.lower(), expected, n=1)
        return f"; did you mean '{close[0]}'?" if close else ""
    limit = context.get("le", context.get("lt"))
    if isinstance(value, bool) or not isinstance(value, int | float) or not isinstance(limit, int | float):
        return ""
    return f"; a share of {value:g} % is {value / 100:g}" if limit <= 1 and 5 <= value <= 100 * limit else ""


def _unknown_key(key: str, known: list[str]) -> str:
    close = difflib.get_close_matches(key, known, n=1)
    hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(known)}"
    return f"is not a known key ({hint})"


def _place(path: Path, line: int | None, keys: KeyPath) -> str:
    place = str(path) if line is None else f"{path}:{line}"
    shown = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).lstrip(".")
    return f"{place}: {shown}" if shown else place


def _sentence(path: Path, line: int | None, keys: KeyPath, rule: str) -> str:
    return f"{_place(path, line, keys)}: {rule}"


def _format_value(value: object) -> str:
    """Return the value in the notation of the file, shortened."""
    text = "nothing" if value is None else json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
