"""Datasets rendered on a GPU: identical bytes from every process, and consistent labels."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from mitsplat.audit.audit import audit_dataset
from tests.dataset.test_write import contents
from tests.gpu.cases import drawn_scene

COMMAND = "from mitsplat.cli import main; main()"


@pytest.mark.slow
@pytest.mark.parametrize("device", [pytest.param("cpu", marks=pytest.mark.extended), "cuda"])
def test_processes_sharing_a_gpu_make_the_same_bytes(
    device: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Compares one process with two processes that share the GPU."""
    if device != "cpu":
        request.getfixturevalue("gpu")
    scene = drawn_scene(tmp_path, width=160, height=120, layouts=2, views=2, formats=["yolo", "coco"])
    made = []
    for workers in (1, 2):
        out = tmp_path / f"by_{workers}"
        arguments = ["render", str(scene.path), "-o", str(out), "--device", device, "--workers", str(workers)]
        done = subprocess.run([sys.executable, "-c", COMMAND, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        made.append(contents(out))
    assert made[0] == made[1]
    audit = audit_dataset(out)
    assert (audit.frames, audit.violations) == (4, ())
    assert audit.instances > 4
    assert json.loads((out / "dataset.json").read_text())["device"] == device
