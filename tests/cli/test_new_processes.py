"""Behaviour of a process that has just imported mitsplat: entry points, threads, variants, errors."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mitsplat
from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene
from tests.conftest import WriteScene, box_asset
from tests.forks import PACKAGES

ROOT = Path(__file__).parents[2]

BEGIN = """
import sys
import numpy as np
import mitsplat as ms

def ball(k=0):
    return ms.Splats(
        means=np.float32([[0.02 * k, 0, 0]]), quats=np.float32([[0, 0, 0, 1]]), scales=np.full((1, 3), 0.1, np.float32),
        opacities=np.float32([0.9]), sh=np.zeros((1, 1, 3), np.float32),
    )

camera = ms.Camera.look_at((0, 0, -1), (0, 0, 0), up=(0, -1, 0), width=32, height=24, fov_x=50)
"""


def fresh(
    code: str, *arguments: object, folder: Path | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run code in a new process. Dr.Jit finds its LLVM even if Mitsuba is imported before mitsplat."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    environment = {**os.environ, **variables}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=400, check=False
    )


CALLS = {
    "LateDeviceError": "assert issubclass(ms.LateDeviceError, ms.InputError)",
    "MissingResourceError": "ms.MissingResourceError('x')",
    "PartialResultError": "ms.PartialResultError('x')",
    "asset_from_photos": "refused(lambda: ms.asset_from_photos('no_photos', 'asset', ms.AssetJob(name='part')))",
    "camera_from_mujoco": "refused(lambda: ms.camera_from_mujoco(None, None, 'camera'))",
    "capture_photos": "refused(lambda: ms.capture_photos(Path('no_photos'), Path('capture')))",
    "fit_capture": "refused(lambda: ms.fit_capture(empty_capture(), 'fit'))",
    "import_splats": "refused(lambda: ms.import_splats('no.ply', name='part'))",
    "Asset": "ms.Asset.load('assets/nut')",
    "AssetJob": "ms.AssetJob(name='part')",
    "BakeSettings": "ms.BakeSettings(gaussians=30)",
    "Capture": "assert len(empty_capture().photos) == 0",
    "CaptureSettings": "ms.CaptureSettings()",
    "FitSettings": "ms.FitSettings()",
    "ImportSettings": "ms.ImportSettings()",
    "audit_dataset": "refused(lambda: ms.audit_dataset(Path('no_dataset')))",
    "write_report": "refused(lambda: ms.write_report(Path('no_dataset')))",
    "Camera": "camera.project(np.zeros((1, 3)))",
    "Frame": "ms.Frame",
    "InputError": "ms.InputError('x')",
    "Labels": "ms.Labels",
    "Layers": "ms.Layers",
    "Layout": "ms.Layout",
    "Quality": "ms.Quality()",
    "Scene": "ms.Scene",
    "SceneSpec": "ms.SceneSpec.model_json_schema()",
    "Splats": "ms.Splats.load('assets/nut/splats.ply')",
    "bake_asset": "assert len(bake('part.stl').asset.splats)",
    "Renderer": "assert ms.Renderer(ms.load_scene('scene.yaml')).render(0).image.any()",
    "layout_from_mujoco": "refused(lambda: ms.layout_from_mujoco(ms.load_scene('scene.yaml'), None, None))",
    "layout_from_newton": "refused(lambda: ms.layout_from_newton(ms.load_scene('scene.yaml'), None, None))",
    "load_scene": "ms.load_scene('scene.yaml')",
    "make_scene": "ms.make_scene(ms.load_scene('scene.yaml').spec)",
    "rerender_frame": "assert ms.rerender_frame(ms.load_scene('scene.yaml'), 0, 'again').record",
    "render_frames": "assert all(f.image.any() for f in ms.render_frames(ms.load_scene('scene.yaml'), 1))",
    "render_frame": "assert ms.render_frame(ms.load_scene('scene.yaml'), 0).image.any()",
    "render_splats": "assert ms.render_splats(ball(), camera).alpha.any()",
    "settle_layout": "assert ms.settle_layout(ms.load_scene('scene.yaml'), 0).certificate.rested",
    "use_device": "assert ms.use_device('cpu').kind == 'cpu' and mitsuba.variant() == 'llvm_ad_rgb'",
    "write_dataset": "assert ms.write_dataset(ms.load_scene('scene.yaml'), 'out', frames=1, workers=1).frames == 1",
    "write_frames": "scene = ms.load_scene('scene.yaml'); ms.write_frames(scene, 'own', ms.render_frames(scene, 1))",
}
"""First use of each public name in a process."""

FURTHER = {
    **{f"bake {kind}": f"assert len(bake('part.{kind}').asset.splats)" for kind in ("obj", "glb", "ply")},
    "bake lights": "from mitsplat.scene.spec.light_spec import EnvironmentLight; "
    "bake('part.stl', lights=[EnvironmentLight()])",
    "modules": "import importlib; [importlib.import_module(name) for name in modules]",
}

FORKS = (
    BEGIN
    + PACKAGES
    + """
import json, os, traceback
import mitsuba, pkgutil
assert mitsuba.variant() is None
modules = [f"mitsplat.{m.name}" for m in pkgutil.iter_modules(ms.__path__) if m.name not in ("sfm_child", "plugins")]

def bake(file, **options):
    few = ms.BakeSettings(gaussians=30, fit_steps=0, verify_views=0)
    return ms.bake_asset(file, name="part", kind="environment", settings=few, **options)

from pathlib import Path

def empty_capture():
    return ms.Capture(photos=(), points=np.zeros((0, 3)), colours=np.zeros((0, 3)))

def refused(call):
    from mitsplat.errors import MissingResourceError

    try:
        call()
    except (ms.InputError, MissingResourceError):  # the extra may be missing
        return
    raise AssertionError("nothing was refused")

failed = {}
for name, call in json.loads(sys.argv[1]).items():
    end, begin = os.pipe()
    child = os.fork()
    if not child:
        try:
            exec(call)
            status = 0
        except BaseException:
            os.write(begin, traceback.format_exc()[-1500:].encode())
            status = 1
        os._exit(status)
    os.close(begin)
    output = os.fdopen(end).read()
    status = os.waitpid(child, 0)[1]
    if status:
        failed[name] = f"{status}: {output}"
print(json.dumps(failed))
"""
)
"""Code that runs every call in a fork of a process that has imported mitsplat without choosing a variant.

A fork is equivalent to a new process here.
"""


def small(scene: dict[str, object]) -> dict[str, object]:
    return scene | {"output": {"width": 32, "height": 24, "layouts": 3, "views": 1}}


@pytest.fixture
def desk(scene_data: dict[str, object], write_scene: WriteScene, tmp_path: Path) -> Path:
    write_scene(small(scene_data))
    for kind in ("stl", "obj", "glb", "ply"):
        box_asset("part").mesh.export(tmp_path / f"part.{kind}")
    return tmp_path


@pytest.mark.parametrize("calls", [CALLS, pytest.param(FURTHER, marks=pytest.mark.extended)], ids=["names", "further"])
def test_every_public_name_works_in_a_new_process(desk: Path, calls: dict[str, str]) -> None:
    assert sorted(CALLS) == mitsplat.__all__
    done = fresh(FORKS, json.dumps(calls), folder=desk)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1]) == {}


# Threads


def test_the_first_renders_of_a_process_may_run_in_several_threads(desk: Path) -> None:
    """Each thread gets the result of a serial run: plugin registration and device state must be complete before use."""
    code = """
import threading
scene = ms.load_scene("scene.yaml")
jobs = [lambda k=k: ms.render_splats(ball(k), camera).alpha for k in range(2)]
jobs += [lambda k=k: ms.render_frame(scene, k).instance for k in range(2)]
found, start = {}, threading.Barrier(len(jobs))

def work(k):
    start.wait()
    try:
        found[k] = jobs[k]()
    except Exception as error:
        found[k] = repr(error)

threads = [threading.Thread(target=work, args=(k,)) for k in range(len(jobs))]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
for k, job in enumerate(jobs):
    assert not isinstance(found[k], str), found[k]
    assert np.array_equal(found[k], job()), k
"""
    done = fresh(BEGIN + code, folder=desk)
    assert done.returncode == 0, done.stderr[-2000:]


# Variants


@pytest.mark.parametrize("before", [True, False])
def test_a_mitsuba_variant_without_the_plugins_is_refused_and_kept(before: bool) -> None:
    chosen = "import mitsuba as mi; mi.set_variant('scalar_rgb')\n"
    code = """
try:
    ms.render_splats(ball(), camera)
except ms.InputError as error:
    print(error)
print(mi.variant())
with mi.scoped_set_variant("llvm_ad_rgb"):
    alone = ms.render_splats(ball(), camera).alpha
assert mi.variant() == "scalar_rgb"
with mi.scoped_set_variant("llvm_ad_rgb"):
    assert alone.any() and np.array_equal(alone, ms.render_splats(ball(), camera).alpha)
try:
    mi.load_dict({"type": "splat_proxy"})
except RuntimeError as error:
    print(str(error).splitlines()[-1])
"""
    done = fresh(chosen + BEGIN + code if before else BEGIN + chosen + code)
    assert done.returncode == 0, done.stderr[-2000:]
    refused, variant, plugin = done.stdout.splitlines()
    assert refused.startswith("Mitsuba's variant must be llvm_ad_rgb or cuda_ad_rgb for mitsplat (got scalar_rgb)")
    assert variant == "scalar_rgb"
    assert "plugin 'splat_proxy' needs the variant llvm_ad_rgb or cuda_ad_rgb (got scalar_rgb)" in plugin


def test_plugins_refuse_an_llvm_that_would_abort_the_process() -> None:
    """A script that imports Mitsuba first gets the LLVM of the distribution."""
    code = """
import drjit as dr, mitsuba as mi
dr.detail.llvm_version = lambda: (15, 0, 6)
mi.set_variant("llvm_ad_rgb")
import mitsplat
for kind in ("splat_proxy", "splats", "opencv_camera"):
    try:
        mi.load_dict({"type": kind})
    except RuntimeError as error:
        print(str(error).splitlines()[-1])
"""
    done = fresh(code)
    assert done.returncode == 0, done.stderr[-2000:]
    sentences = done.stdout.splitlines()
    assert len(sentences) == 3
    for sentence in sentences:
        assert (
            "cannot be used: Dr.Jit has loaded LLVM 15.0.6, but needs 16 or newer: import mitsplat before" in sentence
        )


# Errors

FAULT = """
from mitsplat.cli import main
from mitsplat.capture.boards import targets as board

def write_pdf(*args):
    raise ZeroDivisionError("on purpose\\nat length")

board.Board.write_pdf = write_pdf
main(["board", "-o", "board.pdf"])
"""


def test_a_crash_is_one_sentence_and_a_log(tmp_path: Path) -> None:
    done = fresh(FAULT, folder=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"), MITSPLAT_TRACEBACK="")
    assert done.returncode == 70
    assert done.stderr.count("\n") == 1 and "Traceback" not in done.stderr
    log = re.search(r"ZeroDivisionError: on purpose \(the log is (.+)\)$", done.stderr.strip())[1]
    assert Path(log).is_relative_to(tmp_path / "cache")
    assert "in write_pdf" in Path(log).read_text() and f"mitsplat {mitsplat.__version__}" in Path(log).read_text()


def test_the_log_is_written_to_a_writable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    places = {"XDG_CACHE_HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path), "MITSPLAT_TRACEBACK": "1"}
    done = fresh(FAULT, folder=tmp_path, **places)
    assert done.returncode == 70
    assert "in write_pdf" in done.stderr  # traceback for developers
    assert Path(re.search(r"the log is (.+)\)$", done.stderr.strip())[1]).parent == tmp_path


WORKER = """
import sys
from mitsplat.dataset import write as dataset
from mitsplat.cli import main

class Broken:
    def __call__(self, index, note, /):
        raise KeyError("on purpose")

def broken(*args, **kwargs):
    from mitsplat.engine.pool import run_in_process
    run_in_process(Broken())

if __name__ == "__main__":
    dataset.write_dataset = broken
    main(["render", "scene.yaml", *sys.argv[1:]])
"""


def test_a_crash_of_a_worker_process_is_one_sentence_and_a_log(desk: Path) -> None:
    (desk / "broken.py").write_text(WORKER)
    done = subprocess.run(
        [sys.executable, "broken.py", "--json"], cwd=desk, capture_output=True, text=True, timeout=400, check=False
    )
    assert done.returncode == 70
    assert "Traceback" not in done.stderr
    told = json.loads(done.stderr.splitlines()[-1])["message"]
    assert "FrameError: frame 0 failed: KeyError: 'on purpose'" in told
    log = Path(re.search(r"the log is (.+)\)$", told)[1]).read_text()
    assert 'raise KeyError("on purpose")' in log


def test_a_closed_pipe_ends_the_command_without_an_error() -> None:
    code = "from mitsplat.cli import main; main(['schema'])"
    command = f'{sys.executable} -c "{code}" | true; true'
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=100, check=False)
    assert done.stderr == ""


# Sentences


def test_the_error_in_the_guide_is_the_one_of_a_wrong_scene(
    scene_data: dict[str, object], write_scene: WriteScene
) -> None:
    shown = re.search(
        r"^    (scenes/cell\.yaml:\d+: objects\[2\]\.count: .*)$", (ROOT / "docs/first_dataset.md").read_text(), re.M
    )[1]
    wrong = [{"asset": "assets/nut"}, {"asset": "assets/bolt"}, {"asset": "assets/nut", "count": -3}]
    path = write_scene(scene_data | {"objects": wrong})
    line = next(n for n, text in enumerate(path.read_text().splitlines(), 1) if "count: -3" in text)
    with pytest.raises(InputError) as told:
        load_scene(path)
    assert str(told.value) == shown.replace("scenes/cell.yaml:17:", f"{path}:{line}:")
