"""Reference of the Python interface in Markdown: public names by task, packages, and manuals of the plugins."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

from scene_reference import in_a_row, markdown_table, to_markdown

import mitsplat

ROOT = Path(__file__).parents[1]
TASKS = {
    "Make assets": (
        *("asset_from_photos", "AssetJob", "capture_photos", "CaptureSettings", "Capture", "fit_capture"),
        *("FitSettings", "bake_asset", "BakeSettings", "import_splats", "ImportSettings", "Asset"),
    ),
    "Load and make scenes": ("load_scene", "make_scene", "SceneSpec", "Scene"),
    "Place objects": ("settle_layout", "Layout", "layout_from_mujoco", "layout_from_newton", "camera_from_mujoco"),
    "Render frames": ("Renderer", "render_frame", "render_frames", "Frame", "Labels", "Camera"),
    "Write and check datasets": ("write_dataset", "write_frames", "audit_dataset", "rerender_frame", "write_report"),
    "Render splats": ("render_splats", "Splats", "Layers", "Quality"),
    "Choose the device": ("use_device",),
    "Handle errors": ("InputError", "MissingResourceError", "LateDeviceError", "PartialResultError"),
}
"""The names of ``mitsplat``, in the order of their tasks."""
PACKAGES = tuple(
    ".".join(path.parent.relative_to(ROOT / "mitsplat").parts)
    for path in sorted((ROOT / "mitsplat").glob("*/**/__init__.py"))
    if "__all__ = " in path.read_text()
)
"""The packages that export names, without the leading ``mitsplat``."""
PLUGINS = ("splats", "splat_proxy", "opencv_camera")


def api_reference() -> str:
    """Return the names of each task, and a section with their signatures; the site shows their docstrings instead."""
    rows = [
        (f"[{task}](#{task.lower().replace(' ', '-')})", ", ".join(f"`{name}`" for name in names))
        for task, names in TASKS.items()
    ]
    sections = [markdown_table(("task", "names"), rows)]
    for task, names in TASKS.items():
        stubs = "\n\n".join(_stub(getattr(mitsplat, name)) for name in names)
        sections.append(f"### {task}\n\n<!-- generated: api {task} -->\n\n```python\n{stubs}\n```")
    return "\n\n".join(sections)


def package_reference() -> str:
    """Return a section for each package with its docstring and names; the site adds the docstrings of the names."""
    sections = []
    for package in PACKAGES:
        module = importlib.import_module(f"mitsplat.{package}")
        rows = [(f"`{name}`", in_a_row(inspect.getdoc(getattr(module, name)) or "")) for name in module.__all__]
        parts = [f"## `mitsplat.{package}`", f"<!-- generated: package {package} -->"]
        parts += [to_markdown(inspect.cleandoc(module.__doc__ or "")), markdown_table(("name", "meaning"), rows)]
        sections.append("\n\n".join(parts))
    return "\n\n".join(sections)


def plugin_reference() -> str:
    """Return the manual of each plugin: the docstring of its class, with the parameters as a table."""
    sections = []
    for name in PLUGINS:
        classes = (
            node for node in ast.parse((ROOT / f"plugins/{name}.py").read_text()).body if isinstance(node, ast.ClassDef)
        )
        manual = next(text for node in classes if ":monosp:" in (text := ast.get_docstring(node) or ""))
        title, _, rest = manual.partition("\n\n.. pluginparameters::\n\n")
        table, text = re.split(r"\n\n(?=\S)", rest, maxsplit=1)
        rows = [_parameter_row(entry) for entry in re.split(r"^ \* - ", table, flags=re.MULTILINE)[1:]]
        text = to_markdown(re.sub(r"^\.\. tabs::\n\n", "", text, flags=re.MULTILINE))
        text = re.sub(r" *\.\. code-tab:: (\w+)\n\n((?: .*\n?|\n)+)", _fenced, text)
        parts = [f"## `{name}`", re.sub(r" \(:monosp:.*\)", "", title)]
        parts += [markdown_table(("parameter", "type", "default", "meaning"), rows), text]
        sections.append("\n\n".join(parts))
    return "\n\n".join(sections)


def _stub(value: Any) -> str:
    """Return the signature and summary of a function, or of a class with its fields and public methods.

    The keys of a pydantic model are on a page of their own.
    """
    source = textwrap.dedent(inspect.getsource(value))
    node = ast.parse(source).body[0]
    parts = [_head(source.splitlines(), node)]
    if isinstance(node, ast.ClassDef) and not hasattr(value, "model_fields"):
        fields = [part for part in node.body if isinstance(part, ast.AnnAssign)]
        if fields:
            parts.append("\n".join(f"    {ast.get_source_segment(source, field)}" for field in fields))
        methods = [part for part in node.body if isinstance(part, ast.FunctionDef)]
        parts += [_head(source.splitlines(), part) for part in methods if re.match(r"(?!_)|__init__$", part.name)]
    return "\n\n".join(parts)


def _head(lines: list[str], node: ast.ClassDef | ast.FunctionDef) -> str:
    """Return decorators, signature and first paragraph of the docstring of a class or function."""
    indent = " " * node.col_offset
    names = [ast.unparse(decorator) for decorator in node.decorator_list]
    decorators = [f"{indent}@{name}" for name in names if re.match(r"dataclass|\w*property|(class|static)method", name)]
    summary = to_markdown((ast.get_docstring(node) or "").partition("\n\n")[0])
    body = textwrap.indent(f'"""{summary}"""' if summary else "...", f"{indent}    ")
    return "\n".join([*decorators, *lines[node.lineno - 1 : node.body[0].lineno - 1], body])


def _parameter_row(entry: str) -> tuple[str, ...]:
    """Return the cells of an entry of ``pluginparameters``: names, type, default and meaning."""
    parts = re.split(r"\n   - ", re.sub(r"\|(\w+)\|", r"\1", entry))
    names, kind, text = (" ".join(part.split()) for part in parts)
    meaning, _, default = text.removesuffix(")").partition(" (Default: ") if "(Default: " in text else (text, "", "")
    return f"`{names}`".replace(", ", "`, `"), kind, in_a_row(default), in_a_row(meaning)


def _fenced(match: re.Match[str]) -> str:
    return f"```{match[1]}\n{textwrap.dedent(match[2]).strip()}\n```"
