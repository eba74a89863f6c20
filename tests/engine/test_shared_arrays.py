"""Arrays shared by worker processes: equal to the originals, one copy in memory, read-only, removed at the end."""

import os
import signal
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mitsplat.asset import Asset
from mitsplat.engine import shared_arrays
from mitsplat.engine.pool import run_frames
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import SplatArrays
from mitsplat.storage.cache import cache_folder
from tests.conftest import box_asset

MIB = 2**20


@dataclass(frozen=True)
class Describe:
    """Job that describes its arrays from within a worker."""

    splats: Splats
    asset: Asset
    empty: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    text: str = "as it was"

    def __call__(self, index, note, /):
        total = total_of(self.splats)
        try:
            self.splats.means.flags.writeable = True
        except ValueError as error:
            refusal = str(error)
        self.asset.mesh.copy().apply_scale(2.0)
        rows = Path("/proc/self/smaps").read_text().split("\n")
        starts = [i for i, row in enumerate(rows) if str(cache_folder()) in row]
        mapped = [rows[i].split()[1] for i in starts]
        resident = sum(int(row.split()[1]) for i in starts for row in rows[i : i + 5] if row.startswith("Rss:")) / 1024
        return os.getpid(), total, refusal, mapped, resident, (self.empty.shape, self.text)


def splats_of(count: int) -> Splats:
    rng = np.random.default_rng(0)
    return Splats(
        means=rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.1, 1, (count, 3)),
        opacities=rng.uniform(0, 1, count),
        sh=rng.normal(size=(count, 16, 3)),
    )


def arrays_of(splats: Splats) -> list[np.ndarray]:
    return [getattr(splats, name) for name in SplatArrays._fields]


def total_of(splats: Splats) -> float:
    return float(sum(array.sum(dtype=np.float64) for array in arrays_of(splats)))


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
