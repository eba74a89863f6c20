"""Device names: validation, the choice of ``auto``, and the GPU of a process."""

import os
import subprocess
import sys
import uuid

import mitsuba as mi
import pytest

import mitsplat as ms
from mitsplat.errors import InputError, LateDeviceError, MissingResourceError
from mitsplat.runtime import device as devices
from mitsplat.runtime import gpu_memory
from mitsplat.runtime.device import CPU, Device, current_device, find_device, gpu_environment, use_device


class FakeDriver:
    """The queries of libcuda about GPUs, given by (name, memory in GiB, bus)."""

    def __init__(self, *gpus, status=0):
        self.gpus, self.status = gpus, status

    def cuInit(self, flags):
        return self.status

    def cuDeviceGetCount(self, count):
        count._obj.value = len(self.gpus)
        return 0

    def cuDeviceGet(self, handle, ordinal):
        handle._obj.value = ordinal

    def cuDeviceGetName(self, name, size, handle):
        name.value = self.gpus[handle.value][0].encode()

    def cuDeviceGetPCIBusId(self, bus, size, handle):
        bus.value = self.gpus[handle.value][2].encode()

    def cuDeviceGetUuid(self, number, handle):
        number.raw = uuid.UUID(int=handle.value).bytes

    def cuDeviceTotalMem_v2(self, memory, handle):
        memory._obj.value = int(self.gpus[handle.value][1] * 2**30)


class FakeManagement:
    """The queries of NVML about free memory, given in GiB, in bus order."""

    def __init__(self, *unused, models=None):
        self.unused, self.users = unused, 0
        self.models = models or ["One"] * len(unused)

    def nvmlInit_v2(self):
        self.users += 1
        return 0

    def nvmlShutdown(self):
        self.users -= 1

    def nvmlDeviceGetCount_v2(self, count):
        count._obj.value = len(self.unused)

    def nvmlDeviceGetHandleByIndex_v2(self, index, handle):
        handle._obj.value = 1 + index
        return 0

    def nvmlDeviceGetUUID(self, handle, name, size):
        name.value = id_of(len(self.unused) - handle.value).encode()
        return 0

    def nvmlDeviceGetName(self, handle, name, size):
        name.value = self.models[handle.value - 1].encode()
        return 0

    def nvmlDeviceGetMemoryInfo(self, handle, memory):
        memory._obj.total, memory._obj.unused = 99 * 2**30, int(self.unused[handle.value - 1] * 2**30)
        return 0


def id_of(ordinal):
    return f"GPU-{uuid.UUID(int=ordinal)}"


@pytest.fixture
def machine(monkeypatch):
    """Install a fake driver, with or without OptiX."""
    monkeypatch.delenv(gpu_memory.VISIBLE_GPUS, raising=False)
    monkeypatch.delenv(gpu_memory.GPU_ORDER, raising=False)
    monkeypatch.delenv(devices.GPU_NUMBER, raising=False)

    def have(*gpus, optix=True, status=0, unused=None, models=None):
        libraries = {"libcuda.so.1": FakeDriver(*gpus, status=status)} if gpus or status else {}
        libraries |= {} if unused is None else {"libnvidia-ml.so.1": FakeManagement(*unused, models=models)}
        libraries |= {"libnvoptix.so.1": object()} if optix else {}

        def load(name):
            if name not in libraries:
                raise OSError(name)
            return libraries[name]

        monkeypatch.setattr(devices.ctypes, "CDLL", load)

    return have


ONE = ("One", 24, "0000:3B:00.0")
TWO = ("Two", 80, "0000:1A:00.0")
"""CUDA lists the faster GPU first, `nvidia-smi` the other."""


@pytest.mark.parametrize("text", ["gpu", "cuda:", "cuda:-1", "cuda:one", "cuda:0,1", "CPU", "", "cuda: 1", "cuda\n"])
def test_invalid_device_names_are_refused(text):
    with pytest.raises(InputError, match=r"^device must be cpu, cuda, cuda:N, cuda:all or auto \(got "):
        use_device(text)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({}, r"NVIDIA's driver is missing \(libcuda.so.1\): install it"),
        (
            {"gpus": [ONE], "optix": False},
            r"lacks OptiX, which traces rays \(libnvoptix.so.1\): install the complete driver",
        ),
        ({"status": 100}, r"finds no GPU \(status 100\): check `nvidia-smi` and CUDA_VISIBLE_DEVICES"),
        (
            {"status": 100, "unused": [0.25]},
            r"the GPU has only 0.2 GiB of unused memory: end a program on it \(`nvidia-smi` lists them\)",
        ),
    ],
)
def test_a_missing_gpu_is_reported_and_auto_selects_the_cpu(machine, parts, words):
    """A missing GPU that was requested is an error of one sentence; ``auto`` selects the CPU and states why."""
    machine(*parts.get("gpus", ()), **{key: value for key, value in parts.items() if key != "gpus"})
    for text in ("cuda", "cuda:1", "cuda:all"):
        with pytest.raises(
            MissingResourceError, match=rf"^{text} cannot be used, because .*{words}.*, or use the device cpu$"
        ):
            use_device(text)
    found = find_device("auto")
    assert (found.kind, found.gpus) == ("cpu", ())
    assert found.reason and "install" not in found.reason
    assert find_device("cpu") == CPU


@pytest.mark.parametrize(
    ("visible", "unused", "left"),
    [
        (None, (0.5, 20), id_of(0)),
        (None, (20, 0.5), id_of(1)),
        (None, (0.5,), ""),
        ("1,0", (0.5, 20), "1"),
        (id_of(1), (0.5, 20), ""),
        (f"{id_of(1)},{id_of(0)}", (0.5, 20), id_of(0)),
        ("0", (3, 20), "0"),
        (None, (3, 20), None),
        (None, (), None),
        ("", (0.5,), ""),
    ],
)
def test_a_full_gpu_is_hidden(machine, monkeypatch, visible, unused, left):
    """Dr.Jit starts CUDA on all visible GPUs and would end the process on a full one."""
    machine(unused=unused)
    if visible is not None:
        monkeypatch.setenv(gpu_memory.VISIBLE_GPUS, visible)
    else:
        monkeypatch.setenv(gpu_memory.VISIBLE_GPUS, "to be put back")
        monkeypatch.delenv(gpu_memory.VISIBLE_GPUS)
    gpu_memory.hide_full_gpus()
    assert os.environ.get(gpu_memory.VISIBLE_GPUS) == left


@pytest.mark.parametrize(("order", "left"), [(None, "0,1"), ("FASTEST_FIRST", "0,1"), ("PCI_BUS_ID", "1")])
def test_numbers_of_different_gpus_are_read_in_the_order_of_cuda(machine, monkeypatch, order, left):
    """The first GPU on the bus is full; without PCI order its number is unknown, and no GPU is hidden."""
    machine(unused=(0.5, 20), models=["Two", "One"])
    monkeypatch.setenv(gpu_memory.VISIBLE_GPUS, "0,1")
    if order is not None:
        monkeypatch.setenv(gpu_memory.GPU_ORDER, order)
    gpu_memory.hide_full_gpus()
    assert os.environ[gpu_memory.VISIBLE_GPUS] == left


def test_the_memory_of_gpus_excludes_that_of_other_processes(machine):
    machine(ONE, TWO, unused=(60, 5))
    assert [gpu.memory / 2**30 for gpu in find_device("cuda:all").gpus] == [60, 5]


def test_devices_select_gpus_by_number_and_all(machine):
    machine(ONE, TWO)
    assert find_device("auto") == Device("cuda", find_device("cuda").gpus, "NVIDIA's driver and OptiX are complete")
    assert str(find_device("cuda")) == "cuda (One)"  # first in CUDA order, which Dr.Jit uses
    assert str(find_device("cuda:all")) == "cuda (Two, One)"
    assert [find_device(f"cuda:{i}").gpus[0].name for i in range(2)] == ["Two", "One"]
    assert [gpu.memory / 2**30 for gpu in find_device("cuda:all").gpus] == [80, 24]
    assert gpu_environment(find_device("cuda:0").gpus[0]) == {"CUDA_VISIBLE_DEVICES": id_of(1)}
    with pytest.raises(InputError, match=r"^device must be one of the visible GPUs, cuda:0 to cuda:1 \(got cuda:2\)$"):
        find_device("cuda:2")


def test_gpus_are_numbered_in_the_order_of_visible_devices(machine, monkeypatch):
    machine(ONE, TWO)
    monkeypatch.setenv(gpu_memory.VISIBLE_GPUS, "3,1")
    assert [find_device(f"cuda:{i}").gpus[0].name for i in range(2)] == ["One", "Two"]


def test_a_process_uses_the_first_visible_gpu(machine, monkeypatch):
    machine(ONE, TWO)
    taken = []
    monkeypatch.setattr(devices, "choose_variant", taken.append)
    assert use_device("cuda:1").gpus[0].name == "One"
    assert use_device("cuda:all").is_usable_here
    with pytest.raises(
        LateDeviceError, match=rf"^cuda:0 must be the first .* set CUDA_VISIBLE_DEVICES={id_of(1)} before"
    ) as late:
        use_device("cuda:0")
    assert taken == ["cuda_ad_rgb"] * 2
    for name, value in late.value.environment.items():
        monkeypatch.setenv(name, value)
    machine(TWO)  # the driver in the new process
    assert use_device("cuda:0").gpus[0].name == "Two"
    assert gpu_environment(find_device("cuda").gpus[0]) == {}  # the only visible GPU
    machine(TWO)
    with pytest.raises(InputError, match=r"^device must be one of the visible GPUs, cuda:0 \(got cuda:1\)$"):
        find_device("cuda:1")


def test_the_device_determines_the_mitsuba_variant(monkeypatch):
    chosen = mi.variant()
    assert ms.use_device("cpu") == CPU == current_device()
    assert mi.variant() == "llvm_ad_rgb"
    if chosen is not None:
        mi.set_variant(chosen)
    monkeypatch.setattr(devices.mi, "variant", lambda: "cuda_ad_rgb")
    monkeypatch.setattr(devices, "visible_gpus", lambda: (devices.Gpu("One", 1, 0, "", ""),))
    assert str(current_device()) == "cuda (One)"


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="nothing to restrict processes by")
def test_cores_are_those_of_the_processor_affinity() -> None:
    restrict = "import os\nos.sched_setaffinity(0, [min(os.sched_getaffinity(0))])\n"
    script = f"{restrict}from mitsplat.runtime.cores import usable_cores\nprint(usable_cores())"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "1\n"
