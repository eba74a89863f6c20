"""Tests of the minimum number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import os, sys
from pathlib import Path
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import numpy as np
import mitsplat
import drjit as dr
from mitsplat.capture.lighting.panorama import read_radiance, write_radiance
from mitsplat.runtime.variant import ensure_variant
ensure_variant()
dr.set_thread_count(1)
path, radiance = Path(sys.argv[1]), np.arange(24, dtype=np.float32).reshape(2, 4, 3)
write_radiance(path, radiance)
assert np.array_equal(read_radiance(path), radiance)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores of a process cannot be chosen here")
def test_one_core_writes_and_reads_openexr(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-c", CODE, str(tmp_path / "sky.exr")]
    done = subprocess.run(command, timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
