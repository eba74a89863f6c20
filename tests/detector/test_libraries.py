"""Loading of detector weights without a loader that executes code."""

import os
import sys
from types import ModuleType, SimpleNamespace

import pytest

from mitsplat.detector import libraries
from mitsplat.errors import MissingResourceError


@pytest.fixture
def stand_ins(monkeypatch):
    """Mock the parts of PyTorch and Ultralytics that are read while they are loaded."""
    monkeypatch.setattr(libraries, "find_spec", lambda name: name)
    monkeypatch.setenv("YOLO_CONFIG_DIR", "/nonexistent")
    for name in ("YOLO_OFFLINE", "YOLO_AUTOINSTALL", "YOLO_VERBOSE", "ULTRALYTICS_SAFE_LOAD"):
        monkeypatch.setenv(name, "false")
    serialization = SimpleNamespace(get_unsafe_globals_in_checkpoint=None)
    modules = {
        "torch": {"__version__": "2.6.0", "serialization": serialization},
        "ultralytics": {},
        "ultralytics.nn": {"tasks": SimpleNamespace(SAFE_LOAD=False)},
        "ultralytics.utils": {},
        "ultralytics.utils.events": {"events": SimpleNamespace(enabled=True)},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return sys.modules


def test_the_safe_loader_cannot_be_turned_off(stand_ins):
    libraries.load_libraries()
    assert os.environ["ULTRALYTICS_SAFE_LOAD"] == "true"
    assert stand_ins["ultralytics.nn"].tasks.SAFE_LOAD is True


def test_a_pytorch_without_the_safe_loader_is_refused(stand_ins):
    stand_ins["torch"].__version__ = "2.5.1"
    del stand_ins["torch"].serialization.get_unsafe_globals_in_checkpoint
    with pytest.raises(MissingResourceError, match=r"need PyTorch 2\.6 or newer, .* \(got 2\.5\.1\)"):
        libraries.load_libraries()


def test_a_file_of_weights_runs_no_code(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch", reason="needs the extra train")
    pytest.importorskip("ultralytics", reason="needs the extra train")

    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    torch.save({"model": Hostile()}, tmp_path / "weights.pt")
    monkeypatch.setenv("ULTRALYTICS_SAFE_LOAD", "false")
    libraries.load_libraries()
    with pytest.raises(ValueError, match="cannot be read as weights"):
        libraries.load_weights(tmp_path / "weights.pt")
    assert not (tmp_path / "made").exists()
