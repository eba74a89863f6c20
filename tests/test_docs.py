"""Documentation checks: examples exist, load, and are complete. ``make docs`` builds the site."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from mitsplat.asset import Asset
from mitsplat.checks import check_path
from mitsplat.findings import Finding
from mitsplat.frames.untrusted_xml import check_xml
from mitsplat.scene import scene_json_schema
from mitsplat.scene.spec import SceneSpec

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module", autouse=True)
def _docs_on_path() -> Iterator[None]:
    folders = [str(DOCS), str(DOCS / "_ext")]
    sys.path[:0] = folders
    yield
    for folder in folders:
        sys.path.remove(folder)


def test_pictures_show_existing_scene_keys() -> None:
    from pictures import read_pictures
    from scene_reference import scene_keys

    keys = scene_keys(scene_json_schema())
    assert {"objects[].count", "camera.intrinsics.fov_x", "lights[].path[].position"} <= set(keys)
    assert {picture.key for picture in read_pictures()} <= set(keys)


def test_every_referenced_picture_exists_and_no_other() -> None:
    from pictures import FOLDER, GALLERY, SHEETS, read_pictures

    asked = {picture.file.name for picture in read_pictures()}
    asked |= {f"gallery-{Path(name).stem}.jpg" for name in (*GALLERY, "mirror_ball.xml")}
    asked |= {f"sheet-{Path(name).stem}.jpg" for name in SHEETS}
    assert {path.name for path in FOLDER.iterdir()} == asked
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 2_400_000


def test_every_fragment_below_a_picture_is_valid() -> None:
    """The pydantic models check the fragments. ``python docs/pictures.py`` renders all of them."""
    from pictures import read_pictures

    for picture in read_pictures():
        SceneSpec.model_validate_json(json.dumps(picture.scene))


def test_scenes_of_the_gallery_are_valid() -> None:
    from pictures import GALLERY, SCENES

    check_xml(SCENES / "mirror_ball.xml")
    for name in GALLERY:
        spec = SceneSpec.model_validate(YAML(typ="safe", pure=True).load(SCENES / name))
        assert spec.objects, name


@pytest.mark.extended
def test_scenes_of_the_gallery_get_no_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scenes share their parts. Each part is dropped alone once per arrangement, and checked once per size."""
    from pictures import GALLERY, SCENES

    from mitsplat.checks import path_checks
    from mitsplat.physics.drop import Drop
    from mitsplat.scene.spec.object_spec import Arrangement

    checked: dict[tuple[str, bytes], list[Finding]] = {}
    check_asset = path_checks.check_asset

    def check_once(asset: Asset) -> list[Finding]:
        key = asset.name, asset.splats.means.tobytes()
        if key not in checked:
            checked[key] = list(check_asset(asset))
        return checked[key]

    monkeypatch.setattr(path_checks, "check_asset", check_once)
    dropped: set[tuple[str, str]] = set()
    try_alone = Drop.try_alone

    def try_once(drop: Drop, asset: int, region: int, arrangement: Arrangement, tries: int) -> list[str]:
        drops = drop.scene.assets[asset].name, arrangement
        if drops in dropped:
            return []
        dropped.add(drops)
        return try_alone(drop, asset, region, arrangement, tries)

    monkeypatch.setattr(Drop, "try_alone", try_once)
    for name in GALLERY:
        findings = list(check_path(SCENES / name))
        assert len(findings) > 5
        assert [finding for finding in findings if not finding.ok] == [], name
    assert len(dropped) > 20


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[a](other.md)", None),
        ("[a](other.md#a-title)", None),
        ("[a](other.md#no-title)", "leads to no such place"),
        ("[a](missing.md)", "leads to no file"),
        ("![a](missing.jpg)", "leads to no file"),
        ("[a](#here)", None),
        ("[a](#elsewhere)", "leads to no such place"),
        ("[a](https://example.org/b#c)", None),
        ("[a](http://example.org)", "must be https and name a host"),
        ("[a](https:/example.org)", "must be https and name a host"),
        ("    [a](missing.md)", None),  # code block
    ],
)
def test_links_to_missing_files_and_places_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, fault: str | None
) -> None:
    import links

    monkeypatch.setattr(links, "ROOT", tmp_path)
    (tmp_path / "page.md").write_text(f"# Here\n\n{text}\n")
    (tmp_path / "other.md").write_text("# A `title`!\n")
    assert [line.split(": ", 1)[1].split(" ", 1)[1] for line in links.faults([tmp_path / "page.md"])] == (
        [fault] if fault else []
    )


def test_the_reference_pages_equal_those_written_from_the_code() -> None:
    from reference import stale_pages

    assert stale_pages() == [], "run python docs/reference.py"


def test_every_command_option_and_scene_key_is_in_a_row_of_the_reference_pages() -> None:
    import typer
    from scene_reference import scene_keys

    from mitsplat.cli import app

    text = (DOCS / "cli.md").read_text()
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert len(commands) > 20
    for name, command in commands.items():
        section = text.partition(f"\n### `mitsplat {name}`\n")[2].partition("\n###")[0]
        rows = [line.partition(" | ")[0] for line in section.splitlines()]
        for param in command.params:
            shown = param.opts if param.opts[0].startswith("-") else [param.metavar.replace("|", r"\|")]
            assert any(all(one in row for one in shown) for row in rows), f"{name}: {shown}"
    text = (DOCS / "scene.md").read_text()
    for key in scene_keys(scene_json_schema()):
        where, _, name = key.rpartition(".")
        title = f"`{where}`" if where else "Top level"
        sections = [part for part in text.split("\n##")[1:] if part.partition("\n")[0].lstrip("# ").startswith(title)]
        assert any(f"\n| `{name}` | " in part for part in sections), key


def test_every_public_name_is_in_one_task_with_its_signature() -> None:
    from python_reference import TASKS

    import mitsplat

    names = [name for task in TASKS.values() for name in task]
    assert sorted(names) == mitsplat.__all__
    sections = (DOCS / "api.md").read_text().split("\n### ")
    for task, listed in TASKS.items():
        (section,) = (part for part in sections if part.partition("\n")[0] == task)
        assert re.findall(r"^(?:def|class) (\w+)", section, re.MULTILINE) == list(listed)


def test_every_package_that_exports_names_has_a_section_with_them() -> None:
    sections = (DOCS / "packages.md").read_text().split("\n## ")[1:]
    rows = {
        part.partition("\n")[0].strip("`"): re.findall(r"^\| `(\w+)` \| \S", part, re.MULTILINE) for part in sections
    }
    assert {"mitsplat.scene", "mitsplat.renderer", "mitsplat.importing"} <= set(rows)
    for package in sorted((DOCS.parent / "mitsplat").glob("*/**/__init__.py")):
        name = ".".join(package.parent.relative_to(DOCS.parent).parts)
        exported = getattr(importlib.import_module(name), "__all__", None)
        assert rows.get(name) == exported, name


@pytest.mark.parametrize("plugin", ["splats", "splat_proxy", "opencv_camera"])
def test_every_plugin_parameter_is_in_a_row_of_its_manual(plugin: str) -> None:
    source = (DOCS.parent / f"plugins/{plugin}.py").read_text()
    read = set(re.findall(r"^     \* - (.*)$", source, re.MULTILINE))
    section = (DOCS / "plugins.md").read_text().partition(f"## `{plugin}`")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(.*?)` \| (\w[\w ]*) \| (.*) \| (\S.*) \|$", section, re.MULTILINE)
    assert {row[0].replace("`", "") for row in rows} == read
    assert "::" not in section and "(Default" not in section


def test_a_page_that_differs_from_the_code_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import reference

    pages = list(reference.reference_pages())
    for page in pages:
        (tmp_path / page.name).write_text(page.read_text())
    monkeypatch.setattr(reference, "DOCS", tmp_path)
    assert reference.stale_pages() == []
    for page in pages:
        (tmp_path / page.name).write_text(page.read_text() + "one line more\n")
    assert reference.stale_pages() == [page.name for page in pages]
    for page in pages:
        (tmp_path / page.name).write_text(page.read_text())
    page = tmp_path / "cli.md"
    page.write_text(page.read_text().replace("| `--spz` |", "| `--spzz` |"))
    assert reference.stale_pages() == ["cli.md"]
    page.write_text("# Commands\n")  # the comment is missing
    assert reference.stale_pages() == ["cli.md"]
