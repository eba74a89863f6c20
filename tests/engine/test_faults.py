"""Faults while a dataset is written: kills, a full disk, files that vanish. The finished dataset has the same bytes.

Frames are synthetic; ``python -m benchmarks.scale.faults`` kills real renderings many times.
"""

import os
import random
import resource
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from mitsplat.dataset.records.manifest import Manifest
from mitsplat.errors import InputError, MissingResourceError, PartialResultError
from tests.conftest import box_asset, small_scene
from tests.dataset.test_write import contents, render, settle, write
from tests.engine.faults import KilledOnce, TooLarge, lines, slow

CHILD = """
import sys
sys.path.insert(0, {tests!r})
from functools import partial
from mitsplat.dataset import write as dataset
from mitsplat.cli import main
from tests.engine.faults import slow
from tests.synthetic import settle

if __name__ == "__main__":
    dataset.render_frame = partial(slow, {seconds}, {stop})
    dataset.settle_layout = settle
    main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    objects = [{"asset": "assets/nut", "count": 2}]
    return small_scene(folder, [box_asset("nut")], objects, layouts=4, views=5, formats=["yolo", "coco", "exr"])


@pytest.fixture(scope="module")
def undisturbed(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    write(scene, folder)
    return contents(folder)


def command(tmp_path, *args, seconds=0.05, stop=None):
    script = tmp_path / "child.py"
    script.write_text(CHILD.format(tests=str(Path(__file__).parents[2]), seconds=seconds, stop=stop))
    return [sys.executable, str(script), "render", *map(str, args)]


def start(tmp_path, scene, out, *options, frames):
    """Start the command line on ``frames`` synthetic frames, in a session of its own as from a terminal."""
    stop = str(out), lines(out) + frames
    with (tmp_path / "log").open("w") as log:
        return subprocess.Popen(
            command(tmp_path, scene.path, "-o", out, *options, stop=stop),
            stdout=log,
            stderr=log,
            start_new_session=True,
            # Children of a background shell job ignore Ctrl-C, and so would this process without the default handler.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )


def wait_for_frames(process, out, count):
    end = time.monotonic() + 300
    while lines(out) < count:
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.002)


def test_a_run_killed_at_random_moments_resumes_to_the_same_bytes(scene, tmp_path, undisturbed):
    """Two runs are killed while they write. The lock error names the running process, and the lock ends with that
    process.
    """
    out, rng = tmp_path / "out", random.Random(8)
    for options in (["--workers", "1"], ["--workers", "2"]):
        process = start(tmp_path, scene, out, *options, frames=4)
        wait_for_frames(process, out, lines(out) + 2)
        with pytest.raises(InputError, match=rf"by another run \(process {process.pid} on {socket.gethostname()}\)"):
            write(scene, out)
        time.sleep(rng.uniform(0, 0.1))
        process.kill()
        process.wait()
    kept = lines(out)
    assert 4 <= kept < 20
    assert write(scene, out).rendered <= 20 - kept + 1
    assert contents(out) == undisturbed


@pytest.mark.extended
def test_an_interrupted_run_ends_with_130_and_resumes_to_the_same_bytes(scene, tmp_path, undisturbed):
    """Ctrl-C, sent to all processes of a terminal, ends the run at once with status 130 and no partial files."""
    out = tmp_path / "out"
    process = start(tmp_path, scene, out, "--workers", 2, frames=4)
    wait_for_frames(process, out, 3)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert "Traceback" not in (tmp_path / "log").read_text()
    assert not list(out.rglob(".*.part"))
    kept = lines(out)
    assert write(scene, out).rendered == 20 - kept
    assert contents(out) == undisturbed


@pytest.mark.extended
def test_a_killed_worker_loses_no_frame(scene, tmp_path, undisturbed):
    told = []
    summary = write(
        scene,
        tmp_path / "out",
        render=KilledOnce(tmp_path, 7),
        workers=2,
        progress=lambda *event: told.append(event[2]),
    )
    assert summary.rendered == 20
    assert "the worker of frame 7 was killed by SIGKILL: the frame is repeated" in told
    assert contents(tmp_path / "out") == undisturbed


@pytest.mark.parametrize("workers", [1, pytest.param(3, marks=pytest.mark.extended)])
def test_a_worker_without_memory_loses_no_frame(scene, tmp_path, undisturbed, workers):
    out = tmp_path / "out"
    with pytest.raises(
        MissingResourceError, match=r"^frame 7 cannot be made: memory is exhausted \(jit_malloc.*are kept$"
    ):
        write(scene, out, render=TooLarge(7), workers=workers)
    kept = lines(out)
    assert kept >= 7
    assert write(scene, out).rendered == 20 - kept
    assert contents(out) == undisturbed


def test_a_file_size_limit_ends_with_one_sentence_and_resumes(scene, tmp_path, undisturbed):
    """A limit on the size of files ends the run like a full disk, also within a line of the manifest."""
    out = tmp_path / "out"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (3000, 20000, 40000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            with pytest.raises(MissingResourceError, match="File too large: raise the limit of file sizes"):
                write(scene, out)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert not list(out.rglob(".*.part"))
    write(scene, out)
    assert contents(out) == undisturbed


def mounted(tmp_path, options):
    """Return a mount point for a new file system, and the start of a shell script that mounts it."""
    folder = tmp_path / "mounted"
    folder.mkdir()
    begin = f"mount -t tmpfs -o {options} tmpfs {folder} || exit 99\n"
    if subprocess.run(["unshare", "-m", "sh", "-c", begin], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount (root, or a container that may)")
    return folder, begin


def run_script(script):
    return subprocess.run(["unshare", "-m", "sh", "-c", script], capture_output=True, text=True, check=False)


def test_a_full_disk_ends_with_status_3_and_resumes(scene, tmp_path, undisturbed):
    """With 300 KiB the run ends with status 3 and one sentence. With more space it resumes from the finished frames."""
    folder, begin = mounted(tmp_path, "size=300k")
    first, again = (
        " ".join(command(tmp_path, scene.path, "-o", folder / "out", "--workers", workers, seconds=0))
        for workers in (2, 1)
    )
    done = run_script(
        f"{begin}{first}\n[ $? = 3 ] || exit 98\nwc -l < {folder}/out/manifest.jsonl\n"
        f"mount -o remount,size=20m {folder}\n{again} > /dev/null || exit 97\ncp -r {folder}/out {tmp_path}/out"
    )
    assert done.returncode == 0, done.stderr
    sentence = next(line for line in done.stderr.splitlines() if line.startswith("mitsplat: "))
    assert sentence.endswith("No space left on device: free disk space and run again; finished files are kept")
    assert "Traceback" not in done.stderr
    assert 0 < int(done.stdout) < 20
    assert contents(tmp_path / "out") == undisturbed


def test_a_read_only_disk_ends_with_status_2(scene, tmp_path):
    folder, begin = mounted(tmp_path, "ro")
    done = run_script(begin + " ".join(command(tmp_path, scene.path, "-o", folder / "out")))
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == f"mitsplat: {folder / 'out'}: cannot be written (Read-only file system)"


@dataclass(frozen=True)
class Remove:
    """Renderer that removes a file of the dataset at frame 8."""

    path: Path

    def __call__(self, scene, index, *, layout):
        if index == 8:
            self.path.unlink()
        return render(scene, index, layout=layout)


@pytest.mark.parametrize(
    ("file", "error"),
    [
        ("images/train/000002.png", PartialResultError),
        ("labels/train/000002.txt", PartialResultError),
        ("dataset.json", PartialResultError),
        ("manifest.jsonl", InputError),
    ],
)
def test_a_file_removed_while_running_is_reported_and_made_again(scene, tmp_path, undisturbed, file, error):
    out = tmp_path / "out"
    with pytest.raises(error, match=rf"{file}: must not be (changed or )?removed while"):
        write(scene, out, render=Remove(out / file))
    if file == "dataset.json":  # without it the folder is not a dataset and is not changed
        with pytest.raises(InputError, match="must be empty or a dataset"):
            write(scene, out)
        return
    write(scene, out)
    assert contents(out) == undisturbed


def test_a_layout_removed_while_running_is_reported_and_made_again(scene, tmp_path, undisturbed):
    out = tmp_path / "out"
    write(scene, out, render=Remove(out / "layouts/0001.json"))
    assert len(Manifest(out / "manifest.jsonl")) == 20
    write(scene, out, render=partial(slow, 0), settle=settle)
    assert {key: value for key, value in contents(out).items() if key != "layouts/0001.json"} == {
        key: value for key, value in undisturbed.items() if key != "layouts/0001.json"
    }
