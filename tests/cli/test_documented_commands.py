"""Commands in README and docs, each run in a process of its own on real input without mocks.

Other tests call the same code in a process where earlier tests have set up imports, Mitsuba's variant and caches. Here
nothing is set up: the first command runs in a new process, the others in forks of :mod:`tests.forks`. ``make test``
runs :data:`QUICK` commands, and ``make test-extended`` all.
"""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import trimesh
import typer.main
from ruamel.yaml import YAML

import mitsplat as ms
from mitsplat.capture.lighting.panorama import write_radiance
from mitsplat.checks.path_checks import check_scene
from mitsplat.cli import app
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.physics.settle import settle_layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.spec import SceneSpec
from tests import rendered
from tests.capture.lighting import room
from tests.cli.typed import run as type_in
from tests.conftest import box_asset
from tests.forks import MITSPLAT, Forks

if TYPE_CHECKING:
    from mitsplat.capture.pipeline.capture_result import CaptureResult

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs/bin_picking.md"
"""Page whose commands need only the files that it makes. They run in a folder of their own."""
PAGES = (
    ROOT / "README.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts and path != TUTORIAL),
)
"""Pages with documented commands. README comes first, because it creates most files that the others name."""
SMALLER = {
    "render": ["-n", "4", "--size", "64x36"],
    "preview": ["--size", "64x36"],
    "settle": ["-n", "1", "--size", "32x18"],
    "chart": ["-n", "1", "--size", "32x18"],
    "bake": ["--gaussians", "60"],
    "capture": ["--frames", "17"],
    "fit": ["--gaussians", "200", "--iterations", "20", "--max-size", "64"],
    "mesh": ["--faces", "300", "--voxels", "48"],
    "import": ["--faces", "300", "--voxels", "48"],
    "split": ["--folds", "2"],
    "train": ["--steps", "2", "--batch", "2", "--size", "64", "--device", "cpu"],
    "evaluate": ["--size", "64", "--device", "cpu"],
    "compare": ["--size", "64"],
}
"""Options that replace or extend those of documented commands to make them fast."""


SMALLER_SETTINGS = {
    "asset": """
from mitsplat.reconstruct import reconstruct
from mitsplat.reconstruct.pipeline import asset_pipeline as module
from mitsplat.reconstruct.surface import SurfaceSettings

reconstruct.convex_pieces = lambda mesh: (mesh.convex_hull,)  # the command mesh splits such a mesh
full = module.asset_from_photos

def small(*arguments, fit, **options):
    photos, out, job = arguments
    job = replace(job, settings=replace(job.settings, surface=SurfaceSettings(voxels=48, faces=300)))
    return full(photos, out, job, fit=replace(fit, gaussians=200, iterations=20, max_size=64), **options)

module.asset_from_photos = small
""",
}
"""Code that makes commands fast by settings for which they have no options."""


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page in one language, without generated signatures, which follow a comment."""
    return re.findall(rf"(?<!-->\n\n)^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[list[str]]:
    """Return the mitsplat commands of a page, without their comments."""
    lines = (line for text in blocks(page, "sh") for line in text.splitlines())
    return [words for line in lines if (words := shlex.split(line, comments=True))[:1] == ["mitsplat"]]


def form(words: list[str]) -> tuple[str, ...]:
    """Reduce a command to its options and the file types of its arguments, without names and numbers."""
    kept = re.compile(r"-|\d+/\d+")
    return (words[1], *sorted(word if kept.match(word) else Path(word).suffix for word in smaller(words)))


def smaller(words: list[str]) -> list[str]:
    """Make a documented command fast.

    A Mitsuba scene states its own size, a single image takes no ``-n``, and photographs take no ``--frames``.
    """
    is_whole = words[2:3] == ["frame.xml"] or (words[1] == "capture" and not Path(words[2]).suffix)
    added = [] if is_whole else SMALLER.get(words[1], [])
    kept = list(words)
    for option in (word for word in added if word.startswith("-")):
        if option in kept:
            place = kept.index(option)
            del kept[place : place + 2]
    if "--real-size" in kept:  # at most 1.5 times the reduced --size
        kept[kept.index("--real-size") + 1] = "96"
    if "--only" in kept and "-n" in added:
        added = added[: added.index("-n")] + added[added.index("-n") + 2 :]
    return kept + added


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create the files that quick commands and Python examples name: a scene of two parts under each name, and splats.

    The first command settles the two layouts of the quick commands from an empty cache.
    """
    folder = tmp_path_factory.mktemp("desk")
    shipped = YAML(typ="safe", pure=True).load(ROOT / "scenes/workcell.yaml")
    parts = ("assets/hex_nut_m16", "assets/washer")
    for name in (*parts, shipped["environment"]):
        shutil.copytree(ROOT / "scenes" / name, folder / "scenes" / name)
    shipped["objects"] = [{"asset": name} for name in parts]
    shipped["output"] |= {"width": 128, "height": 72, "layouts": 12, "views": 2}
    named = {Path(word).name for words in DOCUMENTED for word in words if re.fullmatch(r"scenes/\w+\.yaml", word)}
    for name in named:
        YAML(typ="safe", pure=True).dump(shipped, folder / "scenes" / name)
    box_asset("plant").splats.save(folder / "plant.splat")
    return folder


@pytest.fixture(scope="session")
def dataset_desk(desk: Path, forks: Forks) -> Path:
    """Run the quick commands in their order, and return their folder."""
    for words in QUICK:
        obey(words, desk, forks, good=(0, 1) if words[1] == "doctor" else (0,))  # status 1: the machine is small
    return desk


def lay_inputs(folder: Path) -> None:
    """Add the files that the other commands name: a mesh in mm, splats of an object and a room, photos of light.

    The layout of a later command is settled here with the same code.
    """
    settle_layout(load_scene(folder / "scenes/workcell.yaml"), 3)
    gear = trimesh.creation.box((30, 20, 10))
    gear.visual.vertex_colors = [200, 60, 40, 255]
    gear.export(folder / "gear.glb")
    bottle, floor = trimesh.creation.cylinder(0.03, 0.2), trimesh.creation.box((1.2, 0.8, 0.02))
    for name, mesh in (("bottle", bottle), ("room", floor)):
        surfels = place_surfels(mesh, 1.0, 2500, np.random.default_rng(0))
        surfels.splats(np.zeros((len(surfels), 1, 3))).save(folder / f"{name}.ply")
    mirrored = room.render(room.room(room.ball(type="conductor", material="none")), room.SIZE, 48)
    for name in ("ball", "photos/ball"):
        (folder / name).mkdir(parents=True)
        room.photographs(folder / name, mirrored, [0.01, 0.05, 0.25, 1.2], ".jpg")
    write_radiance(folder / "hall.exr", room.true_panorama(128, 8))


PHOTOGRAPHS = ("capture", "asset", "fit", "mesh")
"""Commands that begin with photographs."""

DETECTORS = ("train", "evaluate")
"""Commands that need the extra ``train``."""

DOCUMENTED = [words for page in PAGES for words in commands(page)]

SHOWN = [words for words in {form(words): words for words in reversed(DOCUMENTED)}.values() if "--engine" not in words]
"""First command of each form. Commands that differ only in names and numbers run once. Clusters have tests of their
own.
"""
SHOWN.sort(key=DOCUMENTED.index)  # a command comes after those whose output it needs

QUICK = [
    next(words for words in SHOWN if words[1] == name)
    for name in ("render", "audit", "report", "board", "export", "schema", "doctor", "split")
]
"""One command of each kind that is quick, in an order in which they can run."""

FILMED = [words for words in SHOWN if words[1] in PHOTOGRAPHS and any(word.endswith(".mp4") for word in words)]
"""Commands that begin with a video."""


def expand(words: list[str], folder: Path) -> list[str]:
    """Replace patterns of file names as a shell does."""
    found = [sorted(folder.glob(word)) if "*" in word else [word] for word in words]
    return [str(name) for names in found for name in names]


def obey(words: list[str], desk: Path, forks: Forks, *, good: tuple[int, ...] = (0,)) -> None:
    """Run a fast version of a command and check that it ends without an error or developer messages."""
    typed = expand(smaller(words)[1:], desk)
    file = None
    if ">" in typed:
        *typed, _, file = typed
    if words == SHOWN[0]:
        command = [Path(sys.executable).with_name("mitsplat"), *typed]
        done = subprocess.run(command, cwd=desk, capture_output=True, text=True, timeout=400)
    else:
        changes = SMALLER_SETTINGS.get(typed[0], "")
        done = forks.run(f"from dataclasses import replace\n{changes}\n{MITSPLAT}", *typed, folder=desk)
    told = f"{shlex.join(words)}: status {done.returncode}\n{done.stdout[-800:]}\n{done.stderr[-2000:]}"
    assert done.returncode in good, told
    assert "Traceback" not in done.stderr and "CUDA driver" not in done.stderr, told
    if file is not None:
        (desk / file).write_text(done.stdout)


def test_every_command_is_shown_in_the_documentation() -> None:
    known = typer.main.get_command(app).commands
    assert {words[1] for words in SHOWN} == set(known)
    for words in DOCUMENTED:  # includes commands that are not run below
        given = words[2 : words.index(">") if ">" in words else None]
        assert known[words[1]].make_context(words[1], list(given)), words


@pytest.mark.slow
def test_quick_documented_commands_run_in_their_own_process(dataset_desk: Path) -> None:
    desk = dataset_desk
    made = ("out/cell/report.html", "board.pdf", "frame.xml")
    assert [name for name in made if not (desk / name).stat().st_size] == []
    assert json.loads((desk / "scene.schema.json").read_text())["properties"]["camera"]
    assert len(list((desk / "out/cell/images").rglob("*.jpg"))) == 4


@pytest.mark.extended
def test_every_documented_command_runs_in_its_own_process(dataset_desk: Path, forks: Forks) -> None:
    desk = dataset_desk
    lay_inputs(desk)
    for words in SHOWN:
        # view is tested in tests/view; compare and the detectors run below.
        if words in QUICK or words[1] in ("view", "compare", *DETECTORS):
            continue
        if words[1] not in PHOTOGRAPHS and "assets/mug" not in words:
            # Status 1 means findings, which a box of 60 Gaussians may give.
            obey(words, desk, forks, good=(0, 1) if words[1] == "check" else (0,))
    made = ("frame.png", "drop.gif", "assets/gear/asset.yaml", "frame_again.png", "out/whole/contact_sheet.jpg")
    assert [name for name in made if not (desk / name).stat().st_size] == []


def test_the_files_of_the_tutorial_of_a_bin_are_valid(forks: Forks, tmp_path: Path) -> None:
    (code,), (scene,) = blocks(TUTORIAL, "python"), blocks(TUTORIAL, "yaml")
    done = forks.run(code, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert trimesh.load_mesh(tmp_path / "bracket.stl").is_watertight
    assert len(list((tmp_path / "textures").iterdir())) == 4
    SceneSpec.model_validate(YAML(typ="safe", pure=True).load(scene))


@pytest.mark.extended
def test_the_tutorial_of_a_bin_makes_a_bop_dataset(forks: Forks, tmp_path: Path) -> None:
    """All commands run in their order, on the files that the page makes. The audit finds no violation."""
    (code,), (scene,) = blocks(TUTORIAL, "python"), blocks(TUTORIAL, "yaml")
    done = forks.run(code, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    (tmp_path / "bin.yaml").write_text(scene)
    typed = commands(TUTORIAL)
    assert [words[1] for words in typed] == ["bake", "check", "preview", "render", "audit", "report"]
    for words in typed:
        # Status 1 of check means findings, which a part of 60 Gaussians gives.
        obey(words, tmp_path, forks, good=(0, 1) if words[1] == "check" else (0,))
    truths = [json.loads(file.read_text()) for file in (tmp_path / "out/bin/bop").rglob("scene_gt.json")]
    assert sum(map(len, truths)) == 4
    assert all(instances for truth in truths for instances in truth.values())


def lay_photographs(desk: Path) -> None:
    """Make labelled photographs from images of the dataset that the commands above have written."""
    if not (desk / "photographs").is_dir():
        for name in ("images", "labels"):
            shutil.copytree(desk / "out/cell" / name, desk / "photographs" / name)
        shutil.copyfile(desk / "out/cell/data.yaml", desk / "photographs/data.yaml")


def test_the_documented_compare_commands_run(dataset_desk: Path, forks: Forks) -> None:
    lay_photographs(dataset_desk)
    for words in SHOWN:
        if words[1] == "compare":
            obey(words, dataset_desk, forks)


@pytest.mark.extended
def test_the_documented_detector_commands_run(dataset_desk: Path, forks: Forks) -> None:
    desk = dataset_desk
    if not all(map(find_spec, ("torch", "torchvision", "ultralytics"))):
        pytest.skip("Ultralytics and PyTorch are not installed")
    if subprocess.run([sys.executable, "-c", "import torchvision"], capture_output=True, check=False).returncode:
        pytest.skip("torchvision was built for another PyTorch")
    lay_photographs(desk)
    for words in SHOWN:
        if words[1] in DETECTORS:
            obey(words, desk, forks)
    assert (desk / "runs/mixed/evaluation/photographs-all/report.html").stat().st_size


LONG_EXAMPLES = ("label_formats", "scaling_out", "simulators", "train_detector")
"""Pages whose Python examples need files of commands that are not quick, or repeat the example of another page."""


ASSET_CALLS = ("ms.bake_asset(", "ms.capture_photos(")


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[pytest.mark.extended] if page.stem in LONG_EXAMPLES else [])
        for page in PAGES
        if blocks(page, "python")
    ],
)
def test_the_documented_python_examples_run(desk: Path, forks: Forks, page: Path) -> None:
    """Each page runs in one process, after the commands above, which have written the datasets of some pages."""
    # tests/frames/test_torch_dataset.py tests the loop over endless frames with a detector of the reader's.
    # tests/usd/test_simulated_frames.py runs Newton, which compiles kernels for a minute.
    # The next test checks the calls that make assets, which take minutes.
    foreign = ("import torch", "from torch", "import newton", "newton.Model", *ASSET_CALLS)
    known = [text for text in blocks(page, "python") if not any(word in text for word in foreign)]
    if not (desk / "runs").is_dir():
        known = [text for text in known if "runs/" not in text]
    code = "\n".join(known)
    done = forks.run(code, folder=desk)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_documented_calls_that_make_assets_have_valid_arguments() -> None:
    code = "\n".join(
        text for text in blocks(ROOT / "docs/api.md", "python") if any(call in text for call in ASSET_CALLS)
    )
    called = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("ms."):
            name = ast.unparse(node.func).removeprefix("ms.")
            function = ms.Capture.load if name == "Capture.load" else getattr(ms, name)
            inspect.signature(function).bind(*node.args, **{str(word.arg): word.value for word in node.keywords})
            called.add(name)
    assert called == {
        *("AssetJob", "BakeSettings", "FitSettings", "ImportSettings"),
        *("asset_from_photos", "bake_asset", "capture_photos", "fit_capture", "import_splats"),
    }


def test_the_scene_of_the_guide_is_valid(tmp_path: Path) -> None:
    (text,) = (text for text in blocks(ROOT / "docs/first_dataset.md", "yaml") if text.startswith("# Parts"))
    (tmp_path / "tray.yaml").write_text(text)
    scene_data = YAML(typ="safe", pure=True).load(text)
    for entry in scene_data["objects"]:
        shutil.copytree(ROOT / "scenes" / entry["asset"], tmp_path / entry["asset"])
    scene = load_scene(tmp_path / "tray.yaml")
    assert scene.num_frames == 20
    assert [finding.text for finding in check_scene(scene) if not finding.ok] == []


@pytest.mark.extended
def test_the_documented_photo_commands_make_an_asset(
    desk: Path, forks: Forks, captured: tuple[Path, Path, CaptureResult]
) -> None:
    """The cameras exist already, as if a first run had ended after structure from motion, which takes a minute.

    Status 4 comes from a tiny fit, which misses the quality thresholds of an asset.
    """
    given, out, _ = captured
    for name in ("mug", "cell", "nut"):
        shutil.copytree(given, desk / "photos" / name)
    for place in ("captures/mug", "assets/mug/capture", "assets/cell/capture", "assets/nut/capture"):
        shutil.copytree(out, desk / place)
    (desk / "assets/lamps.yaml").write_text("lights:\n- {kind: environment, radiance: 1.0}\n")
    for words in SHOWN:
        if "--remove" in words:  # needs a detected table; runs in tests/surroundings/test_removal.py
            continue
        if words not in FILMED and (words[1] in PHOTOGRAPHS or "assets/mug" in words):
            obey(words, desk, forks, good={"asset": (0, 4), "mesh": (0, 4), "check": (0, 1)}.get(words[1], (0,)))
    made = ("captures/mug/capture.png", "assets/mug/report.html", "assets/mug_by_stages/report.html")
    assert [name for name in made if not (desk / name).stat().st_size] == []


@pytest.mark.extended
def test_the_documented_video_commands_make_a_capture(forks: Forks, tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    rendered.render_video(tmp_path / "videos/mug.mp4")
    for words in FILMED:
        obey(words, tmp_path, forks)
        made = tmp_path / words[words.index("-o") + 1]
        assert (made / "capture.png").stat().st_size
        assert len(list((made / "images").iterdir())) >= 0.75 * len(list((made / "frames").glob("*.jpg"))) > 12
    assert FILMED


@pytest.mark.parametrize("command", ["audit", "report", "render", "check", "schema"])
def test_a_file_name_that_is_not_utf_8_is_refused(command, capsys):
    """Native libraries would end the process or reject the name as text."""
    assert type_in(command, os.fsdecode(b"bad\xff/scene.yaml")) == 2
    assert capsys.readouterr().err == (
        "mitsplat: names of files and folders must be UTF-8 (got b'bad\\xff/scene.yaml')\n"
    )


def test_a_current_folder_that_is_not_utf_8_is_refused(tmp_path, monkeypatch, capsys):
    folder = tmp_path / os.fsdecode(b"bad\xff")
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert type_in("check", "scene.yaml") == 2
    assert "must be UTF-8" in capsys.readouterr().err
