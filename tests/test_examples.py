"""Notebooks and scripts in ``examples``: complete runs, each with its own checks at the end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.forks import Forks

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
QUICK = ("robot_poses", "speed_and_accuracy", "xml_authoring")


def runs(paths: list[Path]) -> list[Any]:
    """Return the parameters of tests that run examples, of which most take long."""
    return [
        pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.extended) for path in paths
    ]


def code_of(path: Path) -> list[str]:
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_the_four_notebooks_exist() -> None:
    assert {path.stem for path in NOTEBOOKS} == {"first_dataset", "own_scene", "speed_and_accuracy", "xml_authoring"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_outputs_and_ends_in_checks(path: Path) -> None:
    cells = json.loads(path.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
    assert cells[0]["cell_type"] == "markdown"
    assert code_of(path)[-1].startswith("assert ")


@pytest.mark.slow
@pytest.mark.parametrize("path", runs(NOTEBOOKS))
def test_each_notebook_runs(forks: Forks, path: Path) -> None:
    """Each notebook runs in a process of its own, because it chooses Mitsuba's variant and imports as a user would."""
    done = forks.run("\n\n".join(code_of(path)), folder=EXAMPLES)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.slow
@pytest.mark.parametrize("path", runs(SCRIPTS))
def test_each_example_script_runs(forks: Forks, path: Path, tmp_path: Path) -> None:
    assert "\nassert " in path.read_text()
    given = [] if path.stem == "read_labels" else [tmp_path]
    code = "import runpy, sys\nrunpy.run_path(sys.argv.pop(1), run_name='__main__')"
    done = forks.run(code, path, *given, folder=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert any(tmp_path.iterdir()) == bool(given)
