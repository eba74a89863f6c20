"""The reference of scene files, in Markdown, from the JSON Schema of their models and the pictures of their keys."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any

from pictures import Picture, read_pictures

Schema = dict[str, Any]


def scene_reference(schema: Schema) -> str:
    """Every key of a scene file: a section for each mapping, in the order in which files are written."""
    pictures = {key: list(group) for key, group in groupby(read_pictures(), key=lambda picture: picture.key)}
    sections = list(_sections(schema, schema, ""))
    unknown = set(pictures) - set(scene_keys(schema))
    if unknown:
        raise ValueError(f"docs/pictures.yaml shows what is no key of a scene file: {', '.join(sorted(unknown))}")
    return "\n\n".join(_section(schema, path, model, pictures) for path, model in sections)


def scene_keys(schema: Schema) -> list[str]:
    """Every key by its path, such as ``objects[].count``; keys of cameras and lights without their kinds."""
    return [
        _joined(re.sub(r" .*", "", path), name)
        for path, model in _sections(schema, schema, "")
        for name in model.get("properties", {})
    ]


def _sections(root: Schema, model: Schema, path: str) -> Iterator[tuple[str, Schema]]:
    """Mappings by their paths, each before those that it holds; each kind of a union is a section."""
    yield path, model
    seen = set()
    for name, key in model.get("properties", {}).items():
        key = _present(key)
        inside = _joined(re.sub(r" .*", "", path), name) + ("[]" if _item(key) is not key else "")
        kinds = [_resolved(root, kind) for kind in _item(key).get("oneOf", ())]
        if kinds and _shown_at(root, _item(key), inside) != inside:
            continue
        for kind in kinds:
            for where, found in _sections(root, kind, f"{inside} of kind {kind['properties']['kind']['const']}"):
                if where not in seen:
                    yield where, found
                seen.add(where)
        one = _resolved(root, _item(key))
        if "properties" in one:
            yield from _sections(root, one, inside)


def _shown_at(root: Schema, key: Schema, path: str) -> str:
    """The first key of the file that holds the same kinds of mappings as another, where they are described."""
    for name, other in root["properties"].items():
        if _item(_present(other)).get("oneOf") == key["oneOf"]:
            return name + ("[]" if _item(other) is not other else "")
    return path


def _section(root: Schema, path: str, model: Schema, pictures: dict[str, list[Picture]]) -> str:
    where, _, kind = path.partition(" of kind ")
    title = f"`{where}` of kind `{kind}`" if kind else f"`{where}`" if where else "The file"
    keys = []
    for name, key in sorted(model["properties"].items(), key=lambda item: item[0] != "kind"):
        key = _present(key)
        full = _joined(where, name)
        anchor = _anchor(_joined(f"{where}.{kind}" if kind else where, name))
        shown = [_type_of(root, _item(key), full + ("[]" if _item(key) is not key else ""))]
        if _item(key) is not key:
            shown[0] = f"list of {_plural(shown[0])}"
        required = name in model.get("required", ()) or "const" in key  # a kind is what decides which mapping it is
        shown.append("**required**" if required else _default_of(key))
        text = _markdown(key.get("description") or _resolved(root, _item(key)).get("description", ""))
        # What is a mapping has a section, whose anchor it is.
        place = ".key" if f"](#{anchor})" in shown[0] else f"#{anchor} .key"
        entry = f"`{name}`{{{place}}} {' · '.join(filter(None, shown))}\n: {_indented(text)}"
        # The keys that several kinds share are shown once.
        keys.append(entry + _gallery(pictures.pop(full, [])))
    label = f"({_anchor(path)})=\n" if path else ""
    level = "##" if kind or "." not in path else "###"
    return f"{label}{level} {title}\n\n{_markdown(model.get('description', ''))}\n\n" + "\n\n".join(keys)


def _gallery(pictures: list[Picture]) -> str:
    if not pictures:
        return ""
    lines = ["", "", ":::::{container} pictures"]
    for picture in pictures:
        fragment = picture.fragment if picture.scene and picture.fragment != "{}" else "# without"
        lines += ["::::{container} picture", f"![A frame rendered with {picture.key} as in the lines below it]"]
        lines[-1] += f"(pictures/scene/{picture.file.name})"
        lines += ["", "```yaml", *fragment.splitlines(), "```", "::::"]
    return _indented("\n".join([*lines, ":::::"]))


def _present(key: Schema) -> Schema:
    """A key that may be absent as one that is there, where it holds mappings of several kinds."""
    kinds = [choice for choice in key.get("anyOf", ()) if "oneOf" in choice]
    return {**{name: value for name, value in key.items() if name != "anyOf"}, **kinds[0]} if kinds else key


def _item(key: Schema) -> Schema:
    """What a list of mappings holds, or the key itself."""
    items: Schema = key.get("items", {})
    return items if "$ref" in items or "oneOf" in items else key


def _resolved(root: Schema, key: Schema) -> Schema:
    for choice in (key, *key.get("anyOf", ())):
        if "$ref" in choice:
            found: Schema = root["$defs"][choice["$ref"].rsplit("/", 1)[1]]
            return found
    return key


def _type_of(root: Schema, key: Schema, path: str) -> str:
    """What may be written, with its bounds, in words."""
    if "anyOf" in key:
        choices = [choice for choice in key["anyOf"] if choice.get("type") != "null"]
        return " or ".join(
            "list of these"
            if choice.get("items") in choices[:1] and "enum" in choices[0]
            else _type_of(root, choice, path)
            for choice in choices
        )
    if "oneOf" in key:
        kinds = [_resolved(root, kind)["properties"]["kind"]["const"] for kind in key["oneOf"]]
        path = _shown_at(root, key, path)
        return "mapping of kind " + _listed(f"[`{kind}`](#{_anchor(f'{path} of kind {kind}')})" for kind in kinds)
    if "$ref" in key:
        return f"[mapping](#{_anchor(path)})"
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
    return re.sub(r"(number|mapping)(?!s)", r"\1s", text, count=1)


def _default_of(key: Schema) -> str:
    default = key.get("default")
    if isinstance(default, dict) or default in (None, []):
        return ""
    return (
        f"default `{json.dumps(default)}`".replace('"', "").replace(".0]", "]").replace(".0,", ",").replace(".0`", "`")
    )


def _listed(names: Any) -> str:
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else str(last)


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _anchor(path: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", path.lower().replace(" of kind ", " ")).strip("-")


def _markdown(text: str) -> str:
    """A docstring's reStructuredText as Markdown."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")


def _indented(text: str) -> str:
    return text.replace("\n", "\n  ")
