"""Style of docstrings, whose first line does not begin with a question word, and length of the changelog."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted([*(ROOT / "mitsplat").rglob("*.py"), *(ROOT / "plugins").glob("*.py")])

QUESTION = re.compile(r"(What|Whether|How|Which|Where|Who|When|Why)\b")
Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def public_docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and docstring of a module and of its public classes, methods and functions."""

    def visit(node: Documented, line: int) -> Iterator[tuple[int, str]]:
        if text := ast.get_docstring(node):
            yield line, text
        for child in node.body:
            if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and child.name[0] != "_":
                yield from visit(child, child.lineno)

    yield from visit(ast.parse(path.read_text()), 1)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_public_docstrings_do_not_open_with_a_question_word(path: Path) -> None:
    found = [f"{line}: {text.splitlines()[0]}" for line, text in public_docstrings(path) if QUESTION.match(text)]
    assert found == []


def test_the_changelog_describes_a_version_on_one_page() -> None:
    """Changes between unreleased revisions are in the history of the repository."""
    pages = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1:]
    assert pages
    assert max(len(page.splitlines()) for page in pages) <= 90


def test_a_docstring_with_a_question_word_is_found(tmp_path: Path) -> None:
    source = tmp_path / "a.py"
    source.write_text('"""Good."""\n\n\ndef f():\n    """Whether it rains."""\n\n\ndef _g():\n    """What it is."""\n')
    assert [line for line, text in public_docstrings(source) if QUESTION.match(text)] == [4]
