"""Start of Warp: which of its messages reach the user."""

from __future__ import annotations

import os

import pytest
import warp as wp

from mitsplat.runtime import warp_start


def test_only_warnings_about_a_missing_gpu_are_hidden(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The second line is that of Warp 1.19 with a driver and an empty CUDA_VISIBLE_DEVICES."""
    lines = [
        "Warp UserWarning: Could not find or load the NVIDIA CUDA driver. Proceeding in CPU-only mode.",
        "Warp CUDA error 100: no CUDA-capable device is detected (in function init_cuda_driver, cuda_util.cpp:333)",
        "Warp CUDA error 2: out of memory (in function wp_alloc_device, cuda_util.cpp:1)",
    ]
    monkeypatch.setattr(warp_start, "_started", False)
    monkeypatch.setattr(wp, "init", lambda: os.write(2, "".join(f"{line}\n" for line in lines).encode()))
    with warp_start.quiet_warp():
        pass
    assert capfd.readouterr().err == f"{lines[2]}\n"
