"""Writes the tables of ``scene.md`` and ``cli.md`` from the code: ``python docs/reference.py [--check]``.

The tables are between two comments of each page. ``--check`` writes nothing, and exits with status 1 if a page differs
from the code.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from cli_reference import cli_reference
from scene_reference import scene_reference

from mitsplat.scene import scene_json_schema

DOCS = Path(__file__).parent
_BEGIN = "<!-- Written by python docs/reference.py from here on -->\n\n"
_PART = re.compile(f"(?<={re.escape(_BEGIN)}).*", re.DOTALL)


def reference_pages() -> dict[Path, str]:
    """Return the expected text of each page."""
    parts = {DOCS / "scene.md": scene_reference(scene_json_schema()), DOCS / "cli.md": cli_reference()}
    return {page: _PART.sub(lambda _, part=part: f"{part}\n", page.read_text()) for page, part in parts.items()}


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
