"""Child processes started in a folder with Python files, none of which is run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

NAMES = """
    argparse ast base64 cgitb codecs collections contextlib copy copyreg csv ctypes dataclasses datetime
    drjit enum functools gaussforge importlib inspect io json logging math mitsuba multiprocessing newton
    numpy os pathlib pickle platform pycolmap queue random re resource scipy select selectors shutil signal
    site sitecustomize socket ssl string struct subprocess tempfile threading traceback trimesh types typing
    usercustomize uuid warnings warp weakref yaml zipfile zlib
"""


PARENT = """
import os, sys, shutil
from contextlib import closing, suppress
from pathlib import Path


def worker():
    import operator
    from mitsplat.engine.pool import run_frames
    print(list(run_frames(operator.is_, {0: [0], 1: [1]}, workers=2, note=print)))


def image():
    from mitsplat.images.untrusted_images import check_images
    Path("picture.png").write_bytes(b"no picture")
    print(check_images([Path("picture.png")]))


def splats():
    from mitsplat.gaussians import splat_converter
    print(splat_converter.convert_apart(b"nothing", "ksplat", "ply"))


def doctor():
    from mitsplat.checks.doctor import _render_trial_on
    print(_render_trial_on("cpu", {}))


def colmap():
    from mitsplat.audit.colmap_check import ColmapCheck
    Path("colmap").mkdir()
    for name in ("cameras", "images", "points3D"):
        Path("colmap", f"{name}.txt").write_text("")
    print(list(ColmapCheck(Path.cwd())._read_images()))


def cameras():
    from mitsplat.capture import structure_from_motion
    structure_from_motion._run({"images": "none", "groups": [["a.jpg"]]}, Path("sfm"), None)


def video():
    from mitsplat.capture.video.extraction import choose_frames
    Path("video.mp4").write_bytes(b"no video")
    choose_frames(Path("video.mp4"), Path("frames"), most=10, least=3)


def service():
    from mitsplat.engine import mps
    Path("bin").mkdir()
    control = Path("bin", mps.CONTROL)
    control.write_text('#!/bin/sh\\n[ "$1" = -d ]\\n')
    control.chmod(0o700)
    os.environ["PATH"] = f"{control.parent.resolve()}:{os.environ['PATH']}"
    with closing(mps.SharedGpu()) as shared:
        print(shared.problem)


def presets():
    from mitsplat.frames.accuracy.speed_accuracy import measure_steps
    measure_steps(Path("missing.ply"), [])


def cluster():
    from mitsplat.engine.ray import Cluster, run_on_ray
    print(list(run_on_ray(Job(), {0: [7]}, Cluster(resources={"CPU": 1}), note=print)))


class Job:
    def known(self, layout):
        return None

    def settle(self, layout):
        return ""

    def make(self, index, layout):
        import random
        return index, random.__name__


def nothing():
    import subprocess
    subprocess.run([sys.executable, "-c", "import random"])


if __name__ == "__main__":
    from mitsplat.errors import InputError, MissingResourceError
    try:
        globals()[sys.argv[1]]()
    except (InputError, MissingResourceError) as error:
        print(error)
"""

KINDS = {
    "worker": "[False, False]",
    "image": "not a readable image",
    "splats": "not a valid ksplat file",
    "doctor": "('",
    "colmap": "[]",
    "cameras": "'task'",
    "video": "video.mp4: ",
    "service": "does not work",
    "presets": "missing.ply: ",
    "cluster": "[(7, 'random')]",
}


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Run a part of the parent script in a folder with hostile modules, and return its output and the modules run."""
    folder, run = tmp_path / "downloaded", tmp_path / "run"
    folder.mkdir(), run.mkdir()
    for name in NAMES.split():
        (folder / f"{name}.py").write_text(f"open({str(run / name)!r}, 'w').close()\n")
    (tmp_path / "script").mkdir()
    (tmp_path / "script/parent.py").write_text(PARENT)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)

    def start(*command):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
        return done.stdout + done.stderr, sorted(path.name for path in run.iterdir())

    return start


def test_a_child_without_safe_path_mode_runs_files_of_the_folder(start, tmp_path):
    assert "random" in start(sys.executable, tmp_path / "script/parent.py", "nothing")[1]


QUICK = ("worker", "image", "splats", "service", "cluster")
"""Children that need few imports."""


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=() if kind in QUICK else pytest.mark.extended) for kind in KINDS]
)
def test_no_child_runs_python_files_of_the_current_folder(start, tmp_path, kind):
    if kind == "cluster":
        pytest.importorskip("ray", reason="Ray is not installed: pip install 'mitsplat[cluster]'")
    output, run = start(sys.executable, tmp_path / "script/parent.py", kind)
    assert run == []
    assert KINDS[kind] in output


@pytest.mark.parametrize("command", [pytest.param(["doctor"], marks=pytest.mark.extended), ["check", "scene.yaml"]])
def test_no_command_runs_python_files_of_the_current_folder(start, command):
    program = Path(sys.executable).with_name("mitsplat")
    if not program.exists():
        pytest.skip("mitsplat is not installed as a command")
    output, run = start(program, *command)
    assert run == []
    assert "scene.yaml" in output or "LLVM" in output
