"""Writes the generated parts of pages: ``python docs/reference.py [--check]``.

These are the scene keys, the commands, the Python names, the gallery and the example scripts. The part of a page is
below its comment.
``--check`` writes nothing, and exits with status 1 if a page differs from the code.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from pathlib import Path

from cli_reference import cli_reference
from pictures import GALLERY, SCENES, SHEETS
from python_reference import api_reference, package_reference, plugin_reference
from scene_reference import scene_reference

from mitsplat.scene import scene_json_schema

DOCS = Path(__file__).parent
_BEGIN = "<!-- Written by python docs/reference.py from here on -->\n\n"


def gallery() -> str:
    """Return a section for each scene of the gallery, with its pictures; the site adds the files."""
    sections = []
    for name in (*GALLERY, "real.yaml", "mirror_ball.xml"):
        stem = Path(name).stem
        comment = re.match(r"(?:# .*\n)+|<!-- .* -->", (SCENES / name).read_text())
        text = re.sub(r"^# |^<!-- | -->$", "", comment[0] if comment else "", flags=re.MULTILINE).strip()
        parts = [f"## {stem.replace('_', ' ').capitalize()}", text]
        parts.append(f"File: [`scenes/{name}`](../scenes/{name})")
        if name != "real.yaml":
            parts.append(f"![A frame of {name}](pictures/scene/gallery-{stem}.jpg)")
        if name in SHEETS:
            parts.append(f"![Frames of {name}](pictures/scene/sheet-{stem}.jpg)")
        sections.append("\n\n".join([*parts, f"<!-- included: scenes/{name} -->"]))
    return "\n\n".join(sections)


def scripts() -> str:
    """Return a section for each script of the examples, with its docstring; the site adds the files."""
    sections = []
    for path in sorted((SCENES.parent / "examples").glob("*.py")):
        text = inspect.cleandoc(ast.get_docstring(ast.parse(path.read_text())) or "").replace("``", "`")
        link = f"File: [`examples/{path.name}`](../examples/{path.name})"
        sections.append(f"### `{path.name}`\n\n{text}\n\n{link}\n\n<!-- included: examples/{path.name} -->")
    return "\n\n".join(sections)


def reference_pages() -> dict[Path, str]:
    """Return the expected text of each page."""
    parts = {
        "scene.md": scene_reference(scene_json_schema()),
        "cli.md": cli_reference(),
        "api.md": api_reference(),
        "packages.md": package_reference(),
        "plugins.md": plugin_reference(),
        "gallery.md": gallery(),
        "examples.md": scripts(),
    }
    heads = {name: (DOCS / name).read_text().partition(_BEGIN)[0] for name in parts}
    return {DOCS / name: f"{heads[name]}{_BEGIN}{part}\n" for name, part in parts.items()}


def stale_pages() -> list[str]:
    """Return the names of the pages that differ from the code."""
    return [page.name for page, text in reference_pages().items() if page.read_text() != text]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit with status 1 if a page is not current"
    )
    if parser.parse_args().check:
        if stale := stale_pages():
            sys.exit(f"docs/{', docs/'.join(stale)} differ from the code: run python docs/reference.py")
    else:
        for path, text in reference_pages().items():
            path.write_text(text)
