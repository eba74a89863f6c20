"""Arrays shared by worker processes: equal to the originals, one copy in memory, read-only, removed at the end."""

import os
import signal
from contextlib import closing
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mitsplat.engine import shared_arrays
from mitsplat.engine.pool import run_frames
from mitsplat.gaussians.splat_cloud import Splats
from tests.conftest import box_asset
from tests.engine.array_jobs import Describe, arrays_of, total_of

MIB = 2**20


def splats_of(count: int) -> Splats:
    rng = np.random.default_rng(0)
    return Splats(
        means=rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.1, 1, (count, 3)),
        opacities=rng.uniform(0, 1, count),
        sh=rng.normal(size=(count, 16, 3)),
    )


def test_workers_map_one_copy_of_the_arrays_and_leave_no_file(tmp_path, monkeypatch):
    """No file is left, not even by a killed worker."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    splats = splats_of(50_000)
    size = sum(array.nbytes for array in arrays_of(splats)) / MIB
    make = Describe(splats, box_asset("nut"))
    with closing(run_frames(make, {i: [i] for i in range(4)}, workers=2, note=print)) as results:
        found = list(islice(results, 2))
        os.kill(found[0][0], signal.SIGKILL)
        found += list(results)
    assert len({process for process, *_ in found}) == 2
    for _, total, refusal, mapped, resident, rest in found:
        assert total == total_of(splats)
        assert refusal == "cannot set WRITEABLE flag to True of this array"
        assert mapped == ["r--s"]
        assert size <= resident <= size + 1
        assert rest == ((0, 3), "as it was")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("reason", ["read-only", "full"])
def test_an_unusable_cache_folder_falls_back_to_shared_memory(tmp_path, monkeypatch, caplog, reason):
    if reason == "full":
        monkeypatch.setattr(shared_arrays.tempfile, "TemporaryFile", lambda dir: Path("/dev/full").open("wb"))  # noqa: SIM115
    else:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    splats = splats_of(10)
    packed = shared_arrays.SharedArrays(Describe(splats, box_asset("nut")))
    handed = SimpleNamespace(detach=lambda: os.dup(packed._file.fileno()))
    copy = shared_arrays._open(handed, packed.size)
    packed.close()
    assert "workers share memory instead" in caplog.text
    assert total_of(copy.splats) == total_of(splats)
    assert "/memfd:mitsplat" in Path("/proc/self/maps").read_text()


def test_the_start_message_of_a_process_is_small():
    """Its size is constant for any number of arrays. A message larger than a pipe's buffer would block."""
    value = [np.arange(3) for _ in range(20_000)], "text" * 100_000
    with closing(shared_arrays.SharedArrays(value)) as packed:
        assert packed.size > 20_000 * 64
        assert packed.__reduce__()[1][1:] == (packed.size,)
        arrays, text = shared_arrays._open(SimpleNamespace(detach=lambda: os.dup(packed._file.fileno())), packed.size)
    assert len(arrays) == 20_000 and arrays[-1].tolist() == [0, 1, 2] and text == value[1]
