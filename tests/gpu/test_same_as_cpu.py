"""Equality of GPU and CPU renderings; each runs in its own process, because a process has one Mitsuba variant."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import made_once
from tests.gpu.cases import CASES

SHARE = 5e-4
"""Share of pixels whose ids, depth and normals may differ: float32 rounds either way at edges."""

DECIBEL = {"path-traced": 45.0}
"""Minimum PSNR of cases with a limit other than 60 dB: rounding changes one light path in thousands."""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, gpu: None) -> dict[str, dict[str, np.ndarray]]:
    """Render every array of every case, by variant."""
    variants, root = ("llvm_ad_rgb", "cuda_ad_rgb"), Path(__file__).resolve().parents[2]

    def make(folder: Path) -> None:
        processes = []
        for variant in variants:
            command = [sys.executable, "-m", "tests.gpu.cases", variant, str(folder / f"{variant}.npz")]
            processes.append(subprocess.Popen(command, cwd=root, env=os.environ, stderr=subprocess.PIPE, text=True))
        for process in processes:
            _, errors = process.communicate()
            assert process.returncode == 0, errors

    folder = made_once(tmp_path_factory, "gpu_cases", make)
    return {variant: dict(np.load(folder / f"{variant}.npz")) for variant in variants}


@pytest.mark.parametrize("case", CASES)
def test_gpu_and_cpu_arrays_of_a_case_agree(case: str, rendered: dict[str, dict[str, np.ndarray]]) -> None:
    cpu, gpu = (
        {name.partition("/")[2]: value for name, value in arrays.items() if name.startswith(f"{case}/")}
        for arrays in rendered.values()
    )
    assert cpu and list(cpu) == list(gpu)
    faults = [f"{name}: {text}" for name in cpu if (text := fault(name, cpu[name], gpu[name], case))]
    assert not faults


def fault(name: str, cpu: np.ndarray, gpu: np.ndarray, case: str = "") -> str:
    """Describe how two arrays differ by more than the tolerance; return an empty text if they do not.

    Ids and masks: equal but for :data:`SHARE` of the pixels. Depth [m], normals and boxes [px] likewise, where equal
    means within 1e-4 of the depth, 1e-3, and one pixel. Colours and light: a PSNR of 60 dB with white = 1. Gradients:
    within a thousandth of the largest.
    """
    if cpu.shape != gpu.shape or cpu.dtype != gpu.dtype:
        return f"{cpu.dtype}{cpu.shape} and {gpu.dtype}{gpu.shape}"
    cpu, gpu = np.float64(cpu), np.float64(gpu)
    if not np.isfinite(gpu).all():
        return "not finite"
    apart = np.abs(cpu - gpu)
    if name.startswith("gradient"):
        limit = 1e-3 * np.abs(cpu).max()
        return "" if apart.max() <= limit else f"{apart.max():.3g} > {limit:.3g}"
    if name == "boxes":
        return "" if apart.max(initial=0) <= 1 else f"{apart.max():g} px"
    if name in ("rgb", "captured", "alpha", "light", "highlight", "image"):
        error = np.mean(np.square(apart / (255 if name == "image" else 1)))
        least = next((value for start, value in DECIBEL.items() if case.startswith(start)), 60.0)
        decibel = -10 * np.log10(error) if error else np.inf
        return "" if decibel >= least else f"{decibel:.1f} dB < {least:g} dB"
    allowed = {"depth": 1e-4 * cpu, "proxy_depth": 1e-4 * cpu, "normal": 1e-3}.get(name, 0)
    differ = apart > allowed
    share = float(np.mean(differ.any(axis=-1) if differ.ndim == 3 else differ))
    return "" if share <= SHARE else f"{100 * share:.2f} % of the pixels differ"
