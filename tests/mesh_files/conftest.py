from __future__ import annotations

import pytest


@pytest.fixture
def without_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files in this process alone; tests/test_security.py checks the trial read."""
    monkeypatch.setattr("mitsplat.mesh_files.mesh_reading.check_mesh", lambda path, read: None)
