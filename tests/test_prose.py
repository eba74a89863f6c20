"""Style of docstrings, whose first line does not begin with a question word, their references, and the changelog."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
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


REFERENCE = re.compile(r":(?:mod|class|func|meth|attr|data|exc|obj):`~?([\w.]+)`")
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in SOURCES}
MODULES |= {f"mitsplat.{name}": path for name, path in MODULES.items() if name.startswith("plugins")}


def defined_names(node: ast.stmt) -> set[str]:
    """Return the names that a class, a function or an assignment defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}


@cache
def names_of(module: str) -> tuple[set[str], dict[str, str]]:
    """Return the names of a module with ``Class.member``, and the full names of what it imports."""
    tree = ast.parse(MODULES[module].read_text())
    names, imported = set[str](), dict[str, str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            imported |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            imported |= {alias.asname or alias.name: alias.name for alias in node.names}
    for node in tree.body:
        names |= defined_names(node)
        if isinstance(node, ast.ClassDef):
            members = {name for part in node.body for name in defined_names(part)}
            members |= {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}
            listed = re.findall(r"^ +((?:\w+, )*\w+): ", ast.get_docstring(node, clean=False) or "", re.MULTILINE)
            members |= {name for line in listed for name in line.split(", ")}
            names |= {f"{node.name}.{member}" for member in members}
    return names, imported


def exists(target: str) -> bool:
    """Return True if a full name is a module, a name of a module, or is outside of ``mitsplat``."""
    if target in MODULES or not target.startswith("mitsplat."):
        return True
    module = next(target[:i] for i in reversed(range(len(target))) if target[i] == "." and target[:i] in MODULES)
    name = target[len(module) + 1 :]
    names, imported = names_of(module)
    first, _, rest = name.partition(".")
    return name in names or (first in imported and exists(".".join(filter(None, (imported[first], rest)))))


def lost_references(module: str) -> list[str]:
    """Return the references in the docstrings of a module that lead to no name."""
    path, lost = MODULES[module], []
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names, imported = names_of(module)
    members = {name.partition(".")[2] for name in names}
    for target in REFERENCE.findall(path.read_text()):
        first = target.partition(".")[0]
        if target.startswith((".", "mitsplat.")):
            found = exists(package + target if target.startswith(".") else target)
        elif first in imported:
            found = exists(imported[first] + target.removeprefix(first))
        else:
            found = target in names | members or first in sys.stdlib_module_names
        if not found:
            lost.append(target)
    return lost


def test_every_reference_in_a_docstring_leads_to_a_name() -> None:
    assert {module: lost for module in MODULES if (lost := lost_references(module))} == {}


def test_a_reference_that_leads_nowhere_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "a.py"
    source.write_text(
        '"""See :func:`f`, :meth:`A.g`, :attr:`A.size`, :class:`mitsplat.Scene`, :meth:`mitsplat.Asset.save`.\n\n'
        'No: :func:`h`, :meth:`A.h`, :mod:`mitsplat.nothing` or :meth:`mitsplat.Layout.nothing`.\n"""\n\n'
        'def f(): ...\n\nclass A:\n    """A thing.\n\n    Attributes:\n        size: Its size.\n    """\n\n'
        "    def g(self): ...\n"
    )
    monkeypatch.setitem(MODULES, "mitsplat.a", source)
    assert lost_references("mitsplat.a") == ["h", "A.h", "mitsplat.nothing", "mitsplat.Layout.nothing"]


def test_the_changelog_describes_a_version_on_one_page() -> None:
    """Changes between unreleased revisions are in the history of the repository."""
    pages = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1:]
    assert pages
    assert max(len(page.splitlines()) for page in pages) <= 90


def test_a_docstring_with_a_question_word_is_found(tmp_path: Path) -> None:
    source = tmp_path / "a.py"
    source.write_text('"""Good."""\n\n\ndef f():\n    """Whether it rains."""\n\n\ndef _g():\n    """What it is."""\n')
    assert [line for line, text in public_docstrings(source) if QUESTION.match(text)] == [4]
