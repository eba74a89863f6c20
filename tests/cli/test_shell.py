"""What README and docs tell users to type, each command in a process of its own, on real input and without stand-ins.

Other tests call the same code in a process where imports, Mitsuba's variant and caches are set up by whatever ran
before; here nothing is.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import trimesh
import typer.main
from ruamel.yaml import YAML

from mitsplat.cli import app
from tests.conftest import box_asset

if TYPE_CHECKING:
    from mitsplat.capture.pipeline import CaptureResult

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
MITSPLAT = Path(sys.executable).with_name("mitsplat")

SMALLER = {
    "render": ["-n", "2", "--size", "64x36"],
    "preview": ["--size", "64x36"],
    "settle": ["-n", "1", "--size", "32x18"],
    "merge": ["-o", "out/merged"],
    "bake": ["--gaussians", "60", "--sh-degree", "0"],
    "asset": ["--gaussians", "300", "--iterations", "20", "--edge", "64", "--faces", "300"],
}
"""Options that are added to README's commands, in place of their own, so that they are quick."""


def run(command: list[str] | str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command as a user's shell would, with the caches of this session."""
    environment = {**os.environ, "PATH": f"{MITSPLAT.parent}{os.pathsep}{os.environ['PATH']}", **variables}
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        shell=isinstance(command, str),
        capture_output=True,
        text=True,
        timeout=400,
    )


def block(after: str, language: str) -> str:
    """README's first block in a language after some words."""
    return re.search(rf"```{language}\n(.*?)```", README[README.index(after) :], re.DOTALL)[1]


def commands(text: str) -> list[list[str]]:
    """The commands of a block for the shell, without their comments."""
    return [words for line in text.splitlines() if (words := shlex.split(line, comments=True))]


def smaller(words: list[str]) -> list[str]:
    """A command of README, made quick; a Mitsuba scene says its size itself."""
    added = [] if words[2:3] == ["frame.xml"] else SMALLER.get(words[1], [])
    kept = list(words)
    for option in (word for word in added if word.startswith("-")):
        if option in kept:
            place = kept.index(option)
            del kept[place : place + 2]
    return kept + added


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what README's commands name: its own scene with two kinds of parts, a mesh in mm, splats."""
    folder = tmp_path_factory.mktemp("desk")
    shipped = YAML(typ="safe", pure=True).load(ROOT / "scenes/workcell.yaml")
    parts = ("assets/hex_nut_m16", "assets/washer")
    for name in (*parts, shipped["environment"]):
        shutil.copytree(ROOT / "scenes" / name, folder / "scenes" / name)
    shipped["objects"] = [{"asset": name} for name in parts]
    shipped["settle"] = {"stepper": "mujoco"}
    shipped["output"] |= {"width": 128, "height": 72}
    YAML(typ="safe", pure=True).dump(shipped, folder / "scenes/workcell.yaml")
    gear = trimesh.creation.box((30, 20, 10))
    gear.visual.vertex_colors = [200, 60, 40, 255]
    gear.export(folder / "gear.glb")
    box_asset("plant").splats.save(folder / "plant.splat")
    return folder


QUICK_START = commands(block("## Quick start", "sh"))
SHARDS = [words for words in commands(block("goes on where it stopped", "sh")) if "--engine" not in words]

# Those that need what another one has made come after it.
FURTHER = [
    "mitsplat check scenes/workcell.yaml",
    "mitsplat check assets/gear",
    "mitsplat render frame.xml -o frame_again.png",
    "mitsplat fit captures/mug -o fits/mug --gaussians 200 --iterations 20 --edge 64",
    "mitsplat mesh captures/mug fits/mug -o assets/mug_again --faces 300 --voxels 48",
    "mitsplat chart plant.splat -n 1 --size 32x18",
    "mitsplat doctor",
]
"""Commands of README's table that its blocks do not show."""

PHOTOGRAPHS = ("capture", "asset", "fit", "mesh")
"""Commands that begin with photographs."""

SHOWN = [*QUICK_START, *SHARDS, *map(shlex.split, FURTHER)]


def obey(words: list[str], desk: Path, *, good: tuple[int, ...] = (0,)) -> None:
    """Type a command, made quick; it must end well and say nothing that is for developers."""
    typed = shlex.join(smaller(words)).replace("'>'", ">")
    done = run(typed, desk)
    told = f"{typed}: status {done.returncode}\n{done.stdout[-800:]}\n{done.stderr[-2000:]}"
    assert done.returncode in good, told
    assert "Traceback" not in done.stderr and "CUDA driver" not in done.stderr, told


def test_every_command_is_shown() -> None:
    assert {words[1] for words in SHOWN} == set(typer.main.get_command(app).commands)
    assert [words for words in QUICK_START + SHARDS if words[0] != "mitsplat"] == []


@pytest.mark.slow
def test_every_command_runs_by_itself_as_readme_shows_it(desk: Path) -> None:
    for words in SHOWN:
        if words[1] not in PHOTOGRAPHS:
            # 1 is that of findings, which a box of sixty Gaussians and small machines may give.
            obey(words, desk, good=(0, 1) if words[1] in ("check", "doctor") else (0,))
    made = ("out/cell/report.html", "frame.png", "drop.gif", "assets/gear/asset.yaml", "board.pdf", "frame.xml")
    assert [name for name in (*made, "frame_again.png") if not (desk / name).stat().st_size] == []
    assert json.loads((desk / "scene.schema.json").read_text())["properties"]["camera"]
    assert len(list((desk / "out/cell/images").rglob("*.jpg"))) == 2


@pytest.mark.slow
def test_the_python_example_runs_as_it_stands(desk: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", block("In a notebook", "python")], cwd=desk, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_photographs_become_assets_as_readme_shows_it(desk: Path, captured: tuple[Path, Path, CaptureResult]) -> None:
    """Their cameras are there, as if a first run had ended after structure from motion, which takes a minute.

    Status 4 is that of a tiny fit, which misses the thresholds of an asset.
    """
    given, out, _ = captured
    shutil.copytree(given, desk / "photos/mug")
    for place in ("captures/mug", "assets/mug/capture"):
        shutil.copytree(out, desk / place)
    for words in SHOWN:
        if words[1] in PHOTOGRAPHS:
            obey(words, desk, good=(0, 4) if words[1] in ("asset", "mesh") else (0,))
    made = ("captures/mug/capture.png", "assets/mug/report.html", "assets/mug_again/report.html")
    assert [name for name in made if not (desk / name).stat().st_size] == []
