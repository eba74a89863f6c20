"""The doctor: every line says what to do when it fails."""

from pathlib import Path

import pytest

from mitsplat.checks import doctor
from mitsplat.checks.doctor import examine
from mitsplat.engine import resources
from mitsplat.engine.resources import unused_memory


def found():
    return {finding.name: finding for finding in examine()}


def test_a_healthy_machine(monkeypatch):
    """The picture is the same every time, so its hash is."""
    first, second = found(), found()
    names = ["Python", "mitsuba", "drjit", "newton", "processor", "LLVM", "GPU", "warp", "memory", "disk", "cache"]
    assert list(first) == names
    assert all(finding.ok for finding in first.values())
    assert all(finding.remedy or finding.name in ("mitsuba", "drjit", "newton", "warp", "cache", "LLVM")
               for finding in first.values())  # fmt: skip
    assert "renders a picture with the SHA-256" in first["LLVM"].text
    assert first["LLVM"].text == second["LLVM"].text


@pytest.mark.parametrize(
    ("name", "change", "remedy"),
    [
        ("GPU", lambda patch: patch.setattr(doctor, "_loads", lambda library: "cuda" in library), "libnvoptix"),
        ("disk", lambda patch: patch.setattr(doctor, "NEEDED_DISK", 1e9), "make room"),
        ("memory", lambda patch: patch.setattr(doctor, "NEEDED_MEMORY", 1e9), "fewer workers"),
        ("cache", lambda patch: patch.setenv("XDG_CACHE_HOME", "/dev/null/cache"), "XDG_CACHE_HOME"),
        ("newton", lambda patch: patch.setattr(doctor, "version", missing), "pip install newton"),
    ],
)
def test_a_fault_has_a_remedy(monkeypatch, name, change, remedy):
    monkeypatch.setattr(doctor, "_llvm", lambda: doctor.Finding("LLVM", True, ""))
    change(monkeypatch)
    finding = found()[name]
    assert not finding.ok and remedy in finding.remedy


def missing(name):
    if name == "newton":
        raise doctor.PackageNotFoundError(name)
    return "1"


def test_memory_within_a_containers_limit(monkeypatch, tmp_path):
    """Other programs take and give back memory at any time, so what the machine has is said here."""
    monkeypatch.setattr(resources, "_CGROUP", tmp_path)
    read, machine = Path.read_text, "MemAvailable: 6291456 kB\n"
    monkeypatch.setattr(Path, "read_text", lambda path: machine if path == Path("/proc/meminfo") else read(path))
    whole = unused_memory()
    assert whole == 6
    (tmp_path / "memory.max").write_text(str(3 << 29))
    (tmp_path / "memory.current").write_text(str(1 << 29))
    assert unused_memory() == pytest.approx(1.0)
    (tmp_path / "memory.max").write_text("max")
    assert unused_memory() == whole
