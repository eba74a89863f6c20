"""Ctrl-C during the imports of a command ends it, whichever library catches exceptions there."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import WriteScene

# Sends SIGINT while a module is imported, as Ctrl-C in the first second of a command does.
INTERRUPT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
sys.argv = ["mitsplat", *sys.argv[1:]]
signal.signal(signal.SIGINT, signal.{handler})  # of a foreground job, or of one in the background
from mitsplat.cli import main
main()
"""


def run_interrupted(module: str, handler: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    code = INTERRUPT.format(module=module, handler=handler)
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.parametrize("module", ["networkx", "mitsuba.mitsuba_ext"])
def test_ctrl_c_during_an_import_ends_the_command(scene_data, write_scene: WriteScene, module: str) -> None:
    """trimesh catches the interrupt while it imports networkx and continues; extension modules abort."""
    done = run_interrupted(module, "default_int_handler", "check", write_scene(scene_data))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_a_background_job_keeps_ignoring_ctrl_c(scene_data, write_scene: WriteScene) -> None:
    done = run_interrupted("networkx", "SIG_IGN", "check", write_scene(scene_data))
    assert "room" in done.stdout
    assert not done.stderr


def test_ctrl_c_outside_of_imports_raises(tmp_path: Path) -> None:
    """Commands then close what they have opened."""
    code = (
        "import os, signal\n"
        "from mitsplat.cli.interrupt import handle_interrupts\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # which a background job does not inherit\n"
        "handle_interrupts()\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "except KeyboardInterrupt:\n    print('raised')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, "raised\n")
