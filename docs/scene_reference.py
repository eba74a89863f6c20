"""Reference of scene files in Markdown: a table for each mapping, from the JSON Schema and the pictures of the keys."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any

from pictures import Picture, read_pictures

Schema = dict[str, Any]

LONG_DEFAULT = 40
"""Longer defaults are stated below the description [characters]."""

COLUMNS = 3
"""Maximum number of pictures in a row."""


def scene_reference(schema: Schema) -> str:
    """Return a section for each mapping of the schema, in the order in which scene files are written."""
    pictures = {key: list(group) for key, group in groupby(read_pictures(), key=lambda picture: picture.key)}
    unknown = set(pictures) - set(scene_keys(schema))
    if unknown:
        raise ValueError(f"docs/pictures.yaml shows what is no key of a scene file: {', '.join(sorted(unknown))}")
    return "\n\n".join(_section(schema, path, model, pictures) for path, model in _sections(schema, schema, ""))


def scene_keys(schema: Schema) -> list[str]:
    """Return every key by its path, such as ``objects[].count``; keys of cameras and lights without their kinds."""
    return [
        _joined(_without_kind(path), name)
        for path, model in _sections(schema, schema, "")
        for name in model.get("properties", {})
    ]


def _sections(root: Schema, model: Schema, path: str) -> Iterator[tuple[str, Schema]]:
    """Yield mappings by their paths, each before those that it contains.

    A key with several kinds of mappings yields itself, then each kind, and then the mappings that these contain.
    """
    yield path, model
    seen = set()
    for name, key in model.get("properties", {}).items():
        key = _present(key)
        inside = _joined(_without_kind(path), name) + ("[]" if _item(key) is not key else "")
        if "oneOf" in _item(key):
            if _described_at(root, _item(key), inside) != inside:
                continue
            yield inside, _item(key) | {"description": key.get("description", "")}
            kinds = [
                list(_sections(root, kind, f"{inside} of kind {kind['properties']['kind']['const']}"))
                for kind in _kinds(root, _item(key))
            ]
            yield from (first for first, *_ in kinds)
            for place, found in (nested for _, *others in kinds for nested in others):
                if place not in seen:
                    yield place, found
                seen.add(place)
            continue
        one = _resolved(root, _item(key))
        if "properties" in one:
            yield from _sections(root, one, inside)


def _kinds(root: Schema, key: Schema) -> list[Schema]:
    return [_resolved(root, kind) for kind in key["oneOf"]]


def _described_at(root: Schema, key: Schema, path: str) -> str:
    """Return the path of the first key with the same kinds of mappings as another; they are described there."""
    return next((place for place, other in _unions(root, root, "") if other["oneOf"] == key["oneOf"]), path)


def _unions(root: Schema, model: Schema, path: str) -> Iterator[tuple[str, Schema]]:
    for name, key in model.get("properties", {}).items():
        present = _present(key)
        item = _item(present)
        inside = _joined(path, name) + ("[]" if item is not present else "")
        if "oneOf" in item:
            yield inside, item
        elif "properties" in (one := _resolved(root, item)):
            yield from _unions(root, one, inside)


def _section(root: Schema, path: str, model: Schema, pictures: dict[str, list[Picture]]) -> str:
    where, _, kind = path.partition(" of kind ")
    title = _title(path)
    level = "##" if not kind and "." not in path else "###"
    parts = [f"{level} {title}", to_markdown(model.get("description", ""))]
    if "oneOf" in model:
        rows = [
            (f"[`{one['properties']['kind']['const']}`](#{_anchor(root, path, one)})", in_a_row(one["description"]))
            for one in _kinds(root, model)
        ]
        return "\n\n".join([*parts, markdown_table(("kind", "meaning"), rows)])
    rows, shown = [], []
    for name, key in sorted(model["properties"].items(), key=lambda item: item[0] != "kind"):
        key = _present(key)
        full = _joined(where, name)
        rows.append(_row(root, name, full, key, required=name in model.get("required", ())))
        # Pictures of a key that several kinds share are shown once.
        shown += _gallery(full, pictures.pop(full, []))
    return "\n\n".join([*parts, markdown_table(("key", "value", "default", "meaning"), rows), *shown])


def _row(root: Schema, name: str, full: str, key: Schema, *, required: bool) -> tuple[str, ...]:
    value = _type_of(root, _item(key), full + ("[]" if _item(key) is not key else ""))
    if _item(key) is not key:
        value = f"list of {_plural(value)}"
    text = in_a_row(key.get("description") or _resolved(root, _item(key)).get("description", ""))
    # A unit that is stated once belongs to the value.
    if len(units := re.findall(r" \[([a-zA-Z/^0-9]+)\]", text)) == 1 and "number" in value and not value.endswith("`"):
        value, text = f"{value} [{units[0]}]", text.replace(f" [{units[0]}]", "")
    default = _default_of(key)
    if len(default) > LONG_DEFAULT:
        text, default = f"{text}<br>Default: {default}", ""
    if required or "const" in key:  # a kind decides which mapping it is
        default = "**required**"
    return f"`{name}`", value, default, text


def markdown_table(titles: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown."""
    titles = tuple(titles)
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _gallery(key: str, pictures: list[Picture]) -> list[str]:
    """Return tables of the pictures of a key, each picture above its lines of the scene file."""
    if not pictures:
        return []
    entries = [_entries(picture) for picture in pictures]
    shared = [entry for entry in entries[0] if all(entry in others for others in entries)]
    parts = [f"Pictures of `{key}`{', all with:' if shared else ':'}"]
    if shared:
        parts.append("\n".join(["```yaml", *shared, "```"]))
    for start in range(0, len(pictures), COLUMNS):
        row = range(start, min(start + COLUMNS, len(pictures)))
        images = [f"![{key}, example {i + 1}](pictures/scene/{pictures[i].file.name})" for i in row]
        parts.append(markdown_table(images, [[_code([one for one in entries[i] if one not in shared]) for i in row]]))
    return parts


def _entries(picture: Picture) -> list[str]:
    """Return the keys that a picture adds to its base scene, each with its value in YAML."""
    return re.findall(r"^\S.*(?:\n .*)*", "" if picture.fragment == "{}" else picture.fragment, re.MULTILINE)


def _code(entries: list[str]) -> str:
    lines = [line.strip() for entry in entries for line in entry.splitlines()]
    return "<br>".join(f"`{line}`" for line in lines) or "without"


def _present(key: Schema) -> Schema:
    """Return an optional key with several kinds of mappings as one that is present."""
    kinds = [choice for choice in key.get("anyOf", ()) if "oneOf" in choice]
    return {**{name: value for name, value in key.items() if name != "anyOf"}, **kinds[0]} if kinds else key


def _item(key: Schema) -> Schema:
    """Return the schema of the entries of a list of mappings, or the key itself."""
    items: Schema = key.get("items", {})
    return items if "$ref" in items or "oneOf" in items else key


def _resolved(root: Schema, key: Schema) -> Schema:
    for choice in (key, *key.get("anyOf", ())):
        if "$ref" in choice:
            found: Schema = root["$defs"][choice["$ref"].rsplit("/", 1)[1]]
            return found
    return key


def _type_of(root: Schema, key: Schema, path: str) -> str:
    """Describe the allowed values of a key and their bounds in words."""
    if "anyOf" in key:
        choices = [choice for choice in key["anyOf"] if choice.get("type") != "null"]
        return " or ".join(
            "list of these"
            if choice.get("items") in choices[:1] and "enum" in choices[0]
            else _type_of(root, choice, path)
            for choice in choices
        )
    if "oneOf" in key:
        return f"[mapping](#{_slug(_title(_described_at(root, key, path)))})"
    if "$ref" in key:
        return f"[mapping](#{_slug(_title(path))})"
    if "enum" in key or "const" in key:
        return _listed(f"`{choice}`" for choice in key.get("enum", [key.get("const")]))
    if "prefixItems" in key:
        each = {_type_of(root, item, path) for item in key["prefixItems"]}
        if len(each) > 1:
            return f"[{', '.join(sorted(each))}]"
        (item,) = each
        return f"{len(key['prefixItems'])} {f'lists of {item}' if item[0].isdigit() else _plural(item)}"
    if key.get("type") == "array":
        return f"list of {_plural(_type_of(root, key['items'], path))}"
    names = {"string": "text", "boolean": "`true` or `false`", "integer": "whole number"}
    low, high = key.get("minimum", key.get("exclusiveMinimum")), key.get("maximum", key.get("exclusiveMaximum"))
    if "minimum" in key and "maximum" in key:
        bounds = f"from {low:g} to {high:g}"
    else:
        signs = (">" if "exclusiveMinimum" in key else "≥", "<" if "exclusiveMaximum" in key else "≤")
        bounds = ", ".join(
            f"{sign} {value:g}" for sign, value in zip(signs, (low, high), strict=True) if value is not None
        )
    return f"{names.get(key.get('type', ''), key.get('type', 'anything'))} {bounds}".strip()


def _plural(text: str) -> str:
    return re.sub(r"(number|mapping)(?!s)(\])?", r"\1s\2", text, count=1)


def _default_of(key: Schema) -> str:
    default = key.get("default")
    if isinstance(default, dict) or default in (None, []):
        return ""
    return f"`{json.dumps(default)}`".replace('"', "").replace(".0]", "]").replace(".0,", ",").replace(".0`", "`")


def _listed(names: Iterable[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else str(last)


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _without_kind(path: str) -> str:
    return path.partition(" of kind ")[0]


def _title(path: str) -> str:
    where, _, kind = path.partition(" of kind ")
    return f"`{where}` of kind `{kind}`" if kind else f"`{where}`" if where else "Top level"


def _anchor(root: Schema, path: str, kind: Schema) -> str:
    return _slug(_title(f"{path} of kind {kind['properties']['kind']['const']}"))


def _slug(title: str) -> str:
    """Return the anchor of a heading, on the site and where repositories are hosted."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def to_markdown(text: str) -> str:
    """Convert the reStructuredText of a docstring to Markdown; references with ``~`` keep only their last name."""
    text = re.sub(r":\w+:`~[^`]*?(\w+)`", r"`\1`", text)
    return re.sub(r":\w+:`\.?([^`]+)`", r"`\1`", text).replace("``", "`")


def in_a_row(text: str) -> str:
    """Convert a docstring to one line of Markdown: its first paragraph."""
    return " ".join(to_markdown(text).split("\n\n", 1)[0].split()).replace("|", "\\|")
