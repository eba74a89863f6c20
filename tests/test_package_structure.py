"""Package structure: layers, import cycles, package sizes and unique module names."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

LAYERS = (
    ("cli",),
    ("reconstruct.pipeline", "report"),
    ("checks", "surroundings", "view"),
    ("dataset", "importing"),
    ("bake", "formats", "frames.accuracy", "gltf_splats", "reconstruct", "usd"),
    ("fit", "frames", "reconstruct.materials"),
    ("renderer",),
    ("plugins",),
    ("renderer.composition",),
    ("detector", "renderer.instances"),
    ("detector.labelled_sets", "physics", "renderer.meshes"),
    ("capture.pipeline", "labels", "renderer.differentiation", "renderer.light", "scene.loading"),
    ("capture.alignment", "renderer.interreflection"),
    ("capture", "renderer.emitters", "renderer.occluders", "renderer.splatting", "scene.planning"),
    ("audit", "renderer.materials", "scene"),
    ("asset", "dataset.records", "renderer.projection"),
    (
        *("capture.boards", "capture.isolation", "capture.lighting", "gaussians", "mesh_files", "pages"),
        *("renderer.rays", "scene.spec"),
    ),
    ("capture.video", "engine", "geometry", "images"),
    ("quality", "runtime"),
    ("storage",),
    ("arguments",),
    ("arrays", "errors", "findings", "progress", "version"),
)
"""Packages, and modules directly in ``mitsplat``, from top to bottom. Each imports only from layers below its own.

A package is one folder. A subpackage has a layer of its own.
"""

MAX_LINES = 3000
"""Maximum number of lines of a package, without its subpackages."""

MAX_TOP_MODULES = 10
MAX_PLUGIN_FILES = 8


def find_modules() -> dict[str, Path]:
    """Return every module by its name. The folder ``plugins`` is installed as ``mitsplat.plugins``."""
    found = {}
    for path in [*(ROOT / "mitsplat").rglob("*.py"), *(ROOT / "plugins").glob("*.py")]:
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        found[".".join(parts if parts[0] == "mitsplat" else ("mitsplat", *parts))] = path
    return found


MODULES = find_modules()


@cache
def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(path.read_text())


def unit_of(module: str) -> str:
    """Return the package of a module without the prefix ``mitsplat.``.

    A module directly in ``mitsplat`` is returned itself.
    """
    if MODULES[module].name == "__init__.py" or module.count(".") == 1:
        return module.removeprefix("mitsplat.")
    return module.rpartition(".")[0].removeprefix("mitsplat.")


def imports(module: str) -> Iterator[tuple[str, int]]:
    """Return the package's modules that a module imports at any place, with the lines."""
    tree = tree_of(MODULES[module])
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mitsplat":
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            targets = {name if name in MODULES else str(node.module) for name in names}
        elif isinstance(node, ast.Import):
            targets = {alias.name for alias in node.names if alias.name in MODULES}
        else:
            continue
        yield from ((target, node.lineno) for target in targets)


def is_own_part(module: str, target: str) -> bool:
    """Return True if ``target`` lies in the package whose ``__init__.py`` is ``module``."""
    return MODULES[module].name == "__init__.py" and target.startswith(f"{module}.")


LAYER = {unit: height for height, units in enumerate(reversed(LAYERS)) for unit in units}


@pytest.mark.parametrize("module", sorted(set(MODULES) - {"mitsplat"}))
def test_imports_point_to_lower_layers(module: str) -> None:
    own = unit_of(module)
    for target, line in imports(module):
        other = unit_of(target)
        place = f"{MODULES[module].relative_to(ROOT)}:{line}: {own} imports {target}"
        assert own == other or is_own_part(module, target) or LAYER[other] < LAYER[own], place


def test_imports_form_no_cycle() -> None:
    graph = {module: {target for target, _ in imports(module)} - {module} for module in MODULES}
    for module, path in MODULES.items():
        if path.name == "__init__.py":  # a package's public names come from its own modules
            graph[module] = {target for target in graph[module] if not is_own_part(module, target)}
    del graph["mitsplat"]
    list(TopologicalSorter(graph).static_order())


def test_every_package_has_a_layer_and_a_docstring() -> None:
    units = {unit_of(module) for module in MODULES} - {"mitsplat"}
    assert units == set(LAYER)
    for module, path in MODULES.items():
        if path.name == "__init__.py":
            assert len(ast.get_docstring(tree_of(path)) or "") > 100, module


def test_packages_keep_their_limit_of_lines() -> None:
    lines = Counter[str]()
    for module, path in MODULES.items():
        lines[unit_of(module)] += len(path.read_text().splitlines())
    assert {unit: count for unit, count in lines.items() if count > MAX_LINES} == {}


def test_few_modules_are_outside_of_packages() -> None:
    assert len(list((ROOT / "mitsplat").glob("*.py"))) <= MAX_TOP_MODULES
    assert len(list((ROOT / "plugins").glob("*.py"))) <= MAX_PLUGIN_FILES


def test_no_two_modules_share_a_name() -> None:
    names = Counter(path.stem for path in MODULES.values() if path.name != "__init__.py")
    assert [name for name, count in names.items() if count > 1] == []


def test_no_two_classes_share_a_name() -> None:
    nodes = (node for path in MODULES.values() for node in ast.walk(ast.parse(path.read_text())))
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


def test_no_page_has_merge_conflict_markers() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("scenes/*.yaml")]:
        assert not [line for line in page.read_text().splitlines() if line.startswith(("<<<<<<< ", ">>>>>>> "))], page


def test_the_design_page_names_every_module() -> None:
    design = (ROOT / "docs/design.md").read_text()
    for module, path in MODULES.items():
        if path.name != "__init__.py":
            assert f"`{module.split('.')[-1]}`" in design, module


def test_the_design_page_names_existing_modules() -> None:
    files = {path.relative_to(ROOT).as_posix() for path in MODULES.values()}
    files |= {
        path.relative_to(ROOT).as_posix()
        for folder in ("tests", "benchmarks", "docs")
        for path in ROOT.glob(f"{folder}/**/*.py")
    }
    for name in re.findall(r"`([\w/]+\.py)`", (ROOT / "docs/design.md").read_text()):
        assert any(f"/{file}".endswith(f"/{name}") for file in files), name


def imports_inside(path: Path) -> Iterator[tuple[int, bool]]:
    """Return the lines of imports inside functions, and True for each import with a stated reason.

    The reason is a comment on the import, above the import, or above the imports right before. Alternatively the
    module's
    docstring states that its functions import what they need.
    """
    lines, tree = path.read_text().splitlines(), tree_of(path)
    for_all = re.search(r"\binside (of )?(the |their |its )?functions?\b", ast.get_docstring(tree) or "") is not None
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
        has_reason = (
            for_all or ends.get(first - 1, False) or above.startswith("# ") or "  # " in text.replace("# noqa", "")
        )
        ends[last] = has_reason
        yield first, has_reason


def test_one_module_builds_command_lines_of_python() -> None:
    """A child started by other code could lack safe-path mode, and run Python files of the current folder."""
    starts = ("sys.executable", "sys._base_executable", "ProcessPoolExecutor", "set_executable", "forkserver")
    found = {f"{module}: {start}" for module, path in MODULES.items() for start in starts if start in path.read_text()}
    assert found == {"mitsplat.runtime.child_process: sys.executable"}


def test_multiprocessing_starts_in_safe_path_mode() -> None:
    starts = [module for module, path in MODULES.items() if "import multiprocessing" in path.read_text()]
    assert starts == ["mitsplat.engine.worker_processes"]
    source = MODULES["mitsplat.engine.worker_processes"].read_text()
    assert "with safe_path_children(), _short_arguments():" in source
    assert source.count("process.start()") == 1


def test_opencv_does_not_open_image_files() -> None:
    """``cv2.imread`` ends the process if a path is not UTF-8."""
    assert [module for module, path in MODULES.items() if "cv2.imread(" in path.read_text()] == []


def test_masks_are_decoded_in_one_module() -> None:
    """A warning of pycocotools would end a run under Python's option ``-W error``."""
    found = [module for module, path in MODULES.items() if "coco_mask.decode(" in path.read_text()]
    assert found == ["mitsplat.images.masks"]


def test_imports_inside_of_functions_have_a_reason() -> None:
    silent = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in MODULES.values()
        for line, has_reason in imports_inside(path)
        if not has_reason
    ]
    assert silent == []


def test_no_public_name_hides_a_module() -> None:
    """``from package import name`` must not return a function if a module has the same name."""
    for module, path in MODULES.items():
        if path.name == "__init__.py" and module != "mitsplat":
            exports = (node for node in tree_of(path).body if isinstance(node, ast.Assign))
            names = {
                name
                for node in exports
                if ast.unparse(node.targets[0]) == "__all__"
                for name in ast.literal_eval(node.value)
            }
            assert names.isdisjoint(file.stem for file in path.parent.glob("*.py")), module
