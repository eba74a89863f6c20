"""Exports, import cost, and contents of the wheel."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import mitsplat
from mitsplat.runtime.variant import ensure_variant

ROOT = Path(__file__).parents[1]


def test_public_names_are_sorted_and_importable() -> None:
    assert list(mitsplat.__all__) == sorted(set(mitsplat.__all__))
    for name in mitsplat.__all__:
        assert getattr(mitsplat, name) is not None
    assert set(mitsplat.__all__) <= set(dir(mitsplat))
    with pytest.raises(AttributeError, match="no_such_name"):
        mitsplat.no_such_name  # noqa: B018


def test_the_compatibility_page_names_every_layer() -> None:
    ensure_variant()
    from mitsplat.plugins.splat_proxy import AOVS

    page = (ROOT / "docs/compatibility.md").read_text()
    rows = page.partition("### Layers")[2].partition("## Deprecation")[0]
    cells = re.findall(r"^\| (`[^|]*`) \|", rows, re.MULTILINE)
    assert re.findall(r"`([\w.]+)`", " ".join(cells)) == list(AOVS)


def test_importing_the_package_loads_no_heavy_library() -> None:
    heavy = ["mitsuba", "drjit", "warp", "newton", "mujoco", "pycolmap", "torch", "cv2", "skimage", "colour", "coacd"]
    code = f"import mitsplat, mitsplat.cli, sys; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_version_is_the_same_in_all_files() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert mitsplat.__version__ == project["version"]
    assert f"version: {project['version']}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {project['version']}" in (ROOT / "CHANGELOG.md").read_text()


def test_constraints_pin_every_dependency() -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [Requirement(line) for line in project["dependencies"] + extras["test"] + extras["dev"] + extras["docs"]]
    lines = (line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#"))
    pinned = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    for requirement in needed:
        version = pinned[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version, prereleases=True), requirement


def test_wheel_ships_package_and_plugins(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir"]
    source = tmp_path / "source"
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip("not a git checkout")
    for name in filter(None, tracked.stdout.split("\0")):
        if name.split("/")[0] in ("mitsplat", "plugins", "pyproject.toml", "README.md", "LICENSE"):
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    subprocess.run([*command, str(tmp_path), str(source)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("mitsplat-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    expected = {str(file.relative_to(source)) for file in (source / "mitsplat").rglob("*.py")}
    expected |= {f"mitsplat/plugins/{file.name}" for file in (source / "plugins").glob("*.py")}
    assert expected <= names
    assert {"mitsplat/plugins/splats.py", "mitsplat/plugins/splat_proxy.py", "mitsplat/cli/__init__.py"} <= expected
    assert not any(name.startswith(("tests/", "plugins/", "scenes/", "benchmarks/")) for name in names)


@pytest.mark.parametrize("first", ["mitsplat", "mitsuba"])
def test_plugins_are_registered_in_any_order_of_imports(first: str) -> None:
    """``import mitsplat`` registers plugins after Mitsuba's import. The variant may be chosen before or after."""
    chosen = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')"
    lines = {"mitsplat": f"import mitsplat\n{chosen}", "mitsuba": f"{chosen}\nimport mitsplat"}[first]
    code = f"{lines}\nprint(type(mi.load_dict({{'type': 'splat_proxy'}})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.startswith("<class 'mitsplat.plugins.splat_proxy."), done.stderr
