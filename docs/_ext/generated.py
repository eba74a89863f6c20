"""Replaces summaries of code by docstrings, and comments by files, while Sphinx reads the pages.

The comment ``<!-- generated: api TASK -->`` or ``<!-- generated: package NAME -->`` precedes a summary, which ends at
the next heading. The pages are readable where nothing is built.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path

from docutils import nodes
from python_reference import TASKS
from sphinx.application import Sphinx
from sphinx.domains.python import PyObject

import mitsplat


def _included(path: str) -> str:
    """Return the code block of a file, given by its path in the repository."""
    language = {".py": "python", ".xml": "xml"}.get(Path(path).suffix, "yaml")
    return f"```{{literalinclude}} ../{path}\n:language: {language}\n```"


def _api(task: str) -> str:
    """Return the docstrings of the public names of a task."""
    return "\n\n".join(_documented("mitsplat", name) for name in TASKS[task])


def _package(package: str) -> str:
    """Return the docstrings of a package and of its names; those of ``mitsplat`` itself are linked."""
    module = importlib.import_module(f"mitsplat.{package}")
    parts = [f"```{{eval-rst}}\n.. automodule:: mitsplat.{package}\n   :no-members:\n```"]
    public = [name for name in module.__all__ if name in mitsplat.__all__]
    if public:
        parts.append("Also exports " + ", ".join(f"{{py:obj}}`mitsplat.{name}`" for name in public) + ".")
    return "\n\n".join(
        [*parts, *(_documented(f"mitsplat.{package}", name) for name in module.__all__ if name not in public)]
    )


def _documented(module: str, name: str) -> str:
    value = getattr(importlib.import_module(module), name)
    kind = "class" if inspect.isclass(value) else "function"
    # The page of the scene keys describes the fields of pydantic models.
    members = "   :members:\n" if kind == "class" and not hasattr(value, "model_fields") else ""
    return f"```{{eval-rst}}\n.. auto{kind}:: {module}.{name}\n{members}```"


GENERATED: dict[str, Callable[[str], str]] = {"api": _api, "package": _package}


def _fill_in(app: Sphinx, docname: str, source: list[str]) -> None:
    if docname.startswith("examples/"):
        return
    pattern = r"<!-- generated: (\w+) (.+?) -->.*?(?=\n###? |\Z)"
    source[0] = re.sub(pattern, lambda match: GENERATED[match[1]](match[2]), source[0], flags=re.DOTALL)
    source[0] = re.sub(r"<!-- included: (\S+) -->", lambda match: _included(match[1]), source[0])


def _undocumented(
    _app: Sphinx, _env: object, node: nodes.Element, shown: nodes.TextElement
) -> nodes.TextElement | None:
    """What the code has but no page tells of is shown without a link; what it has not is left to be complained of."""
    target: str = node.get("reftarget", "")
    if target.startswith("."):
        target = f"{node.get('py:module')}{target}"
    if not target.startswith("mitsplat."):
        return None
    try:
        if importlib.util.find_spec(target):
            return shown
    except ModuleNotFoundError:
        pass
    try:
        pkgutil.resolve_name(target)
    except (ImportError, AttributeError):
        return None
    return shown


def _tidy_signature(_app: Sphinx, *told: object) -> tuple[str | None, str | None]:
    """Defaults that only a factory knows, as dots, since what is no Python is not laid out; aliases by their names."""
    signature, returns = (part and re.sub(r"TypeAliasForwardRef\('([\w.]+)'\)", r"\1", str(part)) for part in told[-2:])
    return signature and signature.replace("<factory>", "..."), returns


def _part_attributes(_app: Sphinx, *told: object) -> None:
    """``a, b: text`` among the attributes as one entry each, after Napoleon."""
    lines = told[-1]
    for position in reversed(range(len(lines))):
        if match := re.match(r":ivar (\w+(?:, \w+)+):(.*)", lines[position]):
            end = position + 1
            while end < len(lines) and lines[end].startswith(" "):
                end += 1
            text = lines[position + 1 : end]
            lines[position:end] = [
                line for name in match[1].split(", ") for line in (f":ivar {name}:{match[2]}", *text)
            ]


def setup(app: Sphinx) -> dict[str, bool]:
    """Sphinx's entry."""
    app.connect("source-read", _fill_in)
    app.connect("missing-reference", _undocumented)
    app.connect("autodoc-process-signature", _tidy_signature)
    app.connect("autodoc-process-docstring", _part_attributes, priority=900)
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
