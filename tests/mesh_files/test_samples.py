"""Sample assets of Khronos and others, where a copy of them is present."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.assets.sample_meshes import EXPECTED, difference

FOLDER = Path(os.environ.get("MITSPLAT_SAMPLES", Path(__file__).parents[3] / "shared/samples"))


@pytest.mark.parametrize("name", EXPECTED)
def test_a_sample_is_read_as_known(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not (FOLDER / name).is_file():
        pytest.skip("sample absent: copy assimp, glTF-Transform and 3mf-samples to the folder MITSPLAT_SAMPLES")
    if name.lower().endswith(".dae"):
        pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")
    monkeypatch.setattr("mitsplat.mesh_files.mesh_reading.check_mesh", lambda path, read: None)
    assert difference(FOLDER / name, EXPECTED[name]) is None
