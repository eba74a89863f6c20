"""The house: every import between wings points down, nothing goes in circles, and no wing is too large to know."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

FLOORS = (
    ("cli",),
    ("detector", "report", "view"),
    ("audit", "checks", "surroundings"),
    ("dataset", "importing"),
    ("bake", "formats", "reconstruct"),
    ("fit", "frames"),
    ("labels", "physics", "render"),
    ("capture", "engine", "plugins", "scene"),
    ("boards", "isolation", "lighting", "video"),
    ("spec",),
    ("ground",),
)
"""Wings from the roof down: each imports from floors below its own. Ground is what lies in ``mitsplat`` itself."""

LARGEST = 3000
"""Lines of a wing; the plugins, one stage of the renderer a module, and the ground are no such rooms."""


def modules() -> dict[str, Path]:
    """Every module of the package by its name; ``plugins`` is installed as ``mitsplat.plugins``."""
    found = {}
    for path in [*(ROOT / "mitsplat").rglob("*.py"), *(ROOT / "plugins").glob("*.py")]:
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        found[".".join(parts if parts[0] == "mitsplat" else ("mitsplat", *parts))] = path
    return found


MODULES = modules()


def wing_of(module: str) -> str:
    names = module.split(".")
    return names[1] if len(names) > 1 and any(names[1] in floor for floor in FLOORS) else "ground"


def imports(module: str) -> Iterator[tuple[str, int]]:
    """Modules of the package that a module imports anywhere in it, but for type checkers, and the lines."""
    tree = ast.parse(MODULES[module].read_text())
    unread = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mitsplat":
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            targets = {name if name in MODULES else str(node.module) for name in names}
        elif isinstance(node, ast.Import):
            targets = {alias.name for alias in node.names if alias.name in MODULES}
        else:
            continue
        if node not in unread:
            yield from ((target, node.lineno) for target in targets)


FLOOR = {wing: height for height, wings in enumerate(reversed(FLOORS)) for wing in wings}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_down(module: str) -> None:
    if module in ("mitsplat", "mitsplat.variant"):
        return  # the front door, which hands out names of every wing, and what registers the plugins
    own = wing_of(module)
    for target, line in imports(module):
        other = wing_of(target)
        place = f"{MODULES[module].relative_to(ROOT)}:{line}: {own} imports {target}"
        assert own == other or FLOOR[other] < FLOOR[own], place


def test_nothing_goes_in_circles() -> None:
    graph = {module: {target for target, _ in imports(module)} - {module} for module in MODULES}
    doors = {module for module, path in MODULES.items() if path.name == "__init__.py"}
    for module in graph:  # a door imports its own rooms, which are entered through it
        graph[module] -= doors
    list(TopologicalSorter(graph).static_order())


def test_every_wing_has_a_floor_and_a_door_that_tells_of_it() -> None:
    wings = {path.parent.name for path in (ROOT / "mitsplat").glob("*/*.py")}
    assert wings | {"plugins", "ground"} == set(FLOOR)
    for wing in wings:
        door = ast.parse((ROOT / "mitsplat" / wing / "__init__.py").read_text())
        assert len(ast.get_docstring(door) or "") > 100, wing


def test_no_wing_is_too_large_to_know() -> None:
    lines = Counter[str]()
    for module, path in MODULES.items():
        lines[wing_of(module)] += len(path.read_text().splitlines())
    del lines["plugins"], lines["ground"]
    assert {wing: count for wing, count in lines.items() if count > LARGEST} == {}


def test_no_page_has_marks_of_an_unfinished_merge() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("scenes/*.yaml")]:
        assert not [line for line in page.read_text().splitlines() if line.startswith(("<<<<<<< ", ">>>>>>> "))], page


def test_the_design_names_every_module() -> None:
    design = (ROOT / "docs/design.md").read_text()
    for module, path in MODULES.items():
        if path.name != "__init__.py":
            assert f"`{module.split('.')[-1]}`" in design, module


def imports_inside(path: Path) -> Iterator[tuple[int, bool]]:
    """Lines of imports inside of functions, and whether each says why it is not at the top.

    The reason is a comment on the import, above it or above those right before it; or the module's docstring says that
    its functions import what they need.
    """
    lines, tree = path.read_text().splitlines(), ast.parse(path.read_text())
    for_all = "inside of their functions" in (ast.get_docstring(tree) or "")
    inner = {
        node.lineno: node
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    ends: dict[int, bool] = {}
    for first, node in sorted(inner.items()):
        last = node.end_lineno or first
        text = "\n".join(lines[first - 1 : last])
        above = lines[first - 2].strip()
        said = for_all or ends.get(first - 1, False) or above.startswith("# ") or "  # " in text.replace("# noqa", "")
        ends[last] = said
        yield first, said


def test_one_module_builds_command_lines_of_python() -> None:
    """Elsewhere a child could start without safe-path mode, and run Python files of the current folder."""
    starts = ("sys.executable", "sys._base_executable", "ProcessPoolExecutor", "set_executable", "forkserver")
    found = {f"{module}: {start}" for module, path in MODULES.items() for start in starts if start in path.read_text()}
    assert found == {"mitsplat.child_process: sys.executable"}


def test_processes_of_multiprocessing_start_safely() -> None:
    starts = [module for module, path in MODULES.items() if "import multiprocessing" in path.read_text()]
    assert starts == ["mitsplat.engine.pool"]
    source = MODULES["mitsplat.engine.pool"].read_text()
    assert "with starting_safely(), starting_on(" in source and source.count("process.start()") == 1


def test_opencv_opens_no_picture_by_itself() -> None:
    """It ends the process where a path is not UTF-8."""
    assert [module for module, path in MODULES.items() if "cv2.imread(" in path.read_text()] == []


def test_masks_are_decoded_without_the_warning_of_pycocotools() -> None:
    """It would end a run under Python's option -W error."""
    found = [module for module, path in MODULES.items() if "coco_mask.decode(" in path.read_text()]
    assert found == ["mitsplat.masks"]


def test_imports_inside_of_functions_say_why() -> None:
    silent = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in MODULES.values()
        for line, said in imports_inside(path)
        if not said
    ]
    assert silent == []
