"""Unusable caches only cost time, and are reported once."""

import errno
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mitsplat.checks.doctor import _cache
from mitsplat.errors import exit_status, sentence_of
from mitsplat.runtime.warp_start import quiet_warp
from mitsplat.storage import cache
from mitsplat.storage.cache import (
    cache_folder,
    drjit_folder,
    prepare_caches,
    unusable_reason,
    warp_folder,
    write_cache_file,
)

KEEP = """
from pathlib import Path

import warp as wp
from mitsplat.storage.cache import cache_folder, write_cache_file
from mitsplat.runtime.warp_start import quiet_warp

with quiet_warp():
    (Path(wp.config.kernel_cache_dir) / "kernel").write_bytes(bytes(1 << 20))
for name in "ab":
    write_cache_file(cache_folder() / "layouts" / name, lambda file: file.write(bytes(1 << 20)))
"""
"""Starts Warp, writes a kernel as its compiler does, and writes two cache files."""


@pytest.fixture
def fresh(monkeypatch):
    """Reset the caches that this process has prepared and reported."""
    with quiet_warp():  # Warp keeps the folder of the session
        prepare_caches.cache_clear()
    monkeypatch.setattr(cache, "_reported", set())
    monkeypatch.setenv("WARP_CACHE_PATH", "")
    yield monkeypatch
    prepare_caches.cache_clear()


def warnings_of(environment, *before):
    """Run :data:`KEEP` as a process and return the lines of its standard error, without those of Dr.Jit."""
    kept = {name: value for name, value in os.environ.items() if name not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    command = [*before, sys.executable, "-P", "-c", KEEP]
    done = subprocess.run(command, env=kept | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stderr.splitlines() if not line.startswith("jit_init()")]


@pytest.mark.parametrize("environment", [{"HOME": "/dev/null"}, {"XDG_CACHE_HOME": "/dev/null/cache"}])
def test_an_unwritable_cache_gives_one_warning(environment):
    (line,) = warnings_of(environment)
    assert "a cache folder cannot be written" in line and "Not a directory" in line


@pytest.mark.skipif(os.geteuid() != 0, reason="needs the right to be another user")
def test_users_without_a_home_folder_work_without_a_cache(tmp_path):
    """The root folder as home is not writable for others; one remaining privilege allows reading the environment."""
    kept = "-all,+dac_read_search"
    nobody = ["setpriv", "--reuid=54321", "--regid=54321", "--clear-groups"]
    nobody += [f"--inh-caps={kept}", f"--ambient-caps={kept}", f"--bounding-set={kept}"]
    if subprocess.run([*nobody, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to give privileges up")
    (line,) = warnings_of({"HOME": "/"}, *nobody)
    assert "/.cache" in line and "Permission denied" in line
    (line,) = warnings_of({}, *nobody, "env", "-u", "HOME")
    assert "/nonexistent/.cache" in line


@pytest.mark.parametrize("options", ["size=100k", "ro"])
def test_a_full_or_read_only_cache_disk_gives_one_warning(tmp_path, options):
    mount = f'mount -t tmpfs -o {options} tmpfs {tmp_path} || exit 99; exec "$@"'
    inside = ["unshare", "-m", "sh", "-c", mount, "sh"]
    if subprocess.run([*inside, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount (root, or a container that may)")
    (line,) = warnings_of({"HOME": str(tmp_path)}, *inside)
    assert str(tmp_path) in line


def test_kernels_of_a_read_only_cache_are_read(fresh, tmp_path, monkeypatch):
    """Kernels cached in a read-only image are not compiled again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "warp" / "1.0").mkdir(parents=True)
    (tmp_path / "warp" / "1.0" / "kernel.o").write_bytes(b"code")
    monkeypatch.setattr(cache, "unusable_reason", lambda folder: "Read-only file system")
    prepare_caches()
    assert warp_folder() != tmp_path / "warp"
    assert (warp_folder() / "1.0" / "kernel.o").read_bytes() == b"code"


def test_a_usable_cache_is_not_replaced(fresh, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    prepare_caches()
    write_cache_file(cache_folder() / "layouts" / "a", lambda file: file.write(b"a"))
    assert warp_folder() == tmp_path / "warp"
    assert "WARP_CACHE_PATH" not in os.environ  # Warp would take an empty value for the working folder
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["a"]
    assert caplog.records == []


def test_cache_files_without_room_are_removed_and_reported_once(fresh, tmp_path, caplog):
    def fill(file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with caplog.at_level(logging.WARNING):
        write_cache_file(tmp_path / "a", fill)
        write_cache_file(tmp_path / "b", fill)
    assert list(tmp_path.iterdir()) == []
    assert [record.message.count("No space left on device") for record in caplog.records] == [1]


def test_a_cache_that_fills_up_while_compiling_is_named(fresh):
    """Otherwise the caller would name its own output folder."""
    import warp as wp

    with pytest.raises(OSError) as raised, quiet_warp():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert raised.value.filename == wp.config.kernel_cache_dir
    assert exit_status(raised.value) == 3
    assert sentence_of(raised.value).startswith(wp.config.kernel_cache_dir)


def test_the_doctor_names_every_cache_folder(fresh, tmp_path, monkeypatch):
    for name in ("XDG_CACHE_HOME", "DRJIT_CACHE_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    finding = _cache()
    assert finding.ok
    assert all(str(folder) in finding.text for folder in (cache_folder(), warp_folder(), drjit_folder()))
    monkeypatch.setenv("DRJIT_CACHE_DIR", "/dev/null/kernels")
    finding = _cache()
    assert not finding.ok and finding.text == "/dev/null/kernels: Not a directory"


def test_free_space_is_tested_by_writing(tmp_path, monkeypatch):
    def refuse(file, start, length):
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))

    assert unusable_reason(tmp_path) == ""
    monkeypatch.setattr(os, "posix_fallocate", refuse)
    assert unusable_reason(Path(tmp_path)) == os.strerror(errno.EDQUOT)
