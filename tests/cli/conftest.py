"""Fixtures shared by tests of several commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mitsplat.capture.capture import Capture
from mitsplat.dataset import write as dataset
from mitsplat.dataset.write import DatasetSummary
from mitsplat.fit import trainer as fit
from mitsplat.fit.fit_folder import FitResult
from mitsplat.fit.training_view import HeldOut
from tests.cli.typed import Calls
from tests.conftest import WriteScene, box_asset


@pytest.fixture
def scene_path(scene_data: dict[str, Any], write_scene: WriteScene) -> Path:
    return write_scene(scene_data)


@pytest.fixture
def write_dataset(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calls:
    summary = DatasetSummary(
        path=tmp_path / "out",
        frames=3,
        rendered=3,
        images={"train": 2, "val": 1},
        instances={"nut": 4, "bolt": 5},
        dropped={"small": 2, "hidden": 0},
        marked={"occluded": 1},
        contact_sheet=tmp_path / "out/contact_sheet.jpg",
    )
    calls = Calls(summary)
    monkeypatch.setattr(dataset, "write_dataset", calls)
    return calls


@pytest.fixture
def fit_capture(monkeypatch: pytest.MonkeyPatch) -> Calls:
    seen = HeldOut(name="a.jpg", psnr=28.0, ssim=0.9, psnr_object=25.0)
    calls = Calls(
        FitResult(box_asset("nut").splats, 70, 3.5, (seen,), "inputs", validation=(replace(seen, psnr=29.0),))
    )
    monkeypatch.setattr(fit, "fit_capture", calls)
    monkeypatch.setattr(Capture, "load", lambda folder: folder)
    return calls
