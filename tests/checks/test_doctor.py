"""``mitsplat doctor``: every failed check states a remedy."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsplat.checks import doctor
from mitsplat.checks.doctor import examine
from mitsplat.checks.trial import KNOWN_MEANS, TOLERANCE, render_trial, trial_faults, trial_means
from mitsplat.engine import resources
from mitsplat.engine.resources import unused_memory
from mitsplat.renderer.occluders.proxies import Proxies
from mitsplat.runtime.device import Gpu, MissingPrerequisite


def found():
    return {finding.name: finding for finding in examine()}


def test_a_healthy_machine_passes_every_check(monkeypatch):
    first = found()
    names = ["Python", "mitsuba", "drjit", "newton", "processor", "LLVM", "GPU", "cache", "warp", "memory", "disk"]
    assert list(first) == names
    assert all(finding.ok for finding in first.values())
    assert all(finding.remedy or finding.name in ("mitsuba", "drjit", "newton", "warp", "cache", "LLVM")
               for finding in first.values())  # fmt: skip
    assert re.match(r"\d+\.\d+\.\d+ from .* renders the trial scene correctly", first["LLVM"].text)


@pytest.mark.parametrize(
    ("name", "change", "remedy"),
    [
        (
            "GPU",
            lambda patch: patch.setattr(doctor, "visible_gpus", lambda: MissingPrerequisite("no OptiX", "fetch it")),
            "fetch",
        ),
        ("disk", lambda patch: patch.setattr(doctor, "NEEDED_DISK", 1e9), "free at least"),
        ("memory", lambda patch: patch.setattr(doctor, "NEEDED_MEMORY", 1e9), "fewer workers"),
        ("cache", lambda patch: patch.setenv("XDG_CACHE_HOME", "/dev/null/cache"), "XDG_CACHE_HOME"),
        ("newton", lambda patch: patch.setattr(doctor, "version", missing), "pip install newton"),
    ],
)
def test_each_fault_is_reported_with_a_remedy(monkeypatch, name, change, remedy):
    monkeypatch.setattr(doctor, "_render_trial_on", lambda device, environment: ("23", ""))
    change(monkeypatch)
    finding = found()[name]
    assert not finding.ok and remedy in finding.remedy


@pytest.fixture(scope="module")
def trial():
    return render_trial()


class TestTrial:
    def test_the_trial_scene_has_its_known_means(self, trial):
        """Differences are below an eighth of the tolerance. CPUs of two manufacturers differ by 0.0014.

        A larger difference would mean that the means come from another renderer.
        """
        means = trial_means(trial)
        assert max(np.abs(means[name] - known).max() for name, known in KNOWN_MEANS.items()) < TOLERANCE / 8
        assert trial_faults(trial) == []

    @pytest.mark.parametrize("lost", ["static", "dynamic"])
    def test_missing_shadows_of_either_kind_are_faults(self, monkeypatch, lost):
        """A GPU that omits rays to captured (static) or to added (dynamic) objects gives such images."""
        build = Proxies.__init__

        def without(self, *args):
            build(self, *args)
            if lost == "static":
                self.static = None
            else:
                self.shadow_casters = ()

        monkeypatch.setattr(Proxies, "__init__", without)
        assert any(fault.startswith("light") for fault in trial_faults(render_trial()))

    def test_missing_splats_are_a_fault(self, trial):
        assert [fault.split()[0] for fault in trial_faults(replace(trial, instance=0 * trial.instance))] == ["instance"]

    def test_nan_is_a_fault(self, trial):
        assert trial_faults(replace(trial, light=np.nan * trial.light)) == ["light is off by nan"]


@pytest.mark.parametrize("fault", ["", "renders the trial scene incorrectly (light is off by 0.52)"])
def test_every_gpu_renders_the_trial_scene(monkeypatch, fault):
    tried = []

    def attempt(device, environment):
        tried.append((device, environment))
        return "23", fault if environment.get("CUDA_VISIBLE_DEVICES") == "GPU-b" else ""

    gpus = Gpu("NVIDIA A", 1, 0, "01", "GPU-a"), Gpu("NVIDIA B", 1, 1, "02", "GPU-b")
    monkeypatch.setattr(doctor, "visible_gpus", lambda: gpus)
    monkeypatch.setattr(doctor, "_render_trial_on", attempt)
    finding = doctor._cuda()
    assert tried == [("cuda", {"CUDA_VISIBLE_DEVICES": "GPU-a"}), ("cuda", {"CUDA_VISIBLE_DEVICES": "GPU-b"})]
    assert finding.ok == (not fault)
    assert f"NVIDIA B {fault or 'renders the trial scene as the CPU does'}" in finding.text
    assert "driver" in finding.text and "CPU" in finding.remedy


@pytest.mark.parametrize("libraries", ["/nonexistent/libLLVM.so"])
def test_an_llvm_that_does_not_load_is_a_fault(monkeypatch, libraries):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", libraries)
    finding = doctor._llvm()
    assert not finding.ok and "karellen-llvm-core" in finding.remedy
    assert finding.text.startswith(f"{libraries} does not render (Dr.Jit has found no LLVM")


def missing(name):
    if name == "newton":
        raise doctor.PackageNotFoundError(name)
    return "1"


def test_memory_is_bounded_by_the_limit_of_the_container(monkeypatch, tmp_path):
    """The machine's memory is mocked, because other programs allocate and free memory at any time."""
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
