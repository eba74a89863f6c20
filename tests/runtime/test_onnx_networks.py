"""ONNX networks read no weights from outside their folder."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.scale.attack.networks import NETWORKS, external_weights
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.fit.depth_network import open_session
from mitsplat.runtime.onnx_networks import load_library


@pytest.mark.parametrize(
    ("version", "good"), [("1.23.2", False), ("0.99", False), ("nightly", False), ("1.24.0", True), ("2.0", True)]
)
def test_old_releases_are_refused(version: str, good: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", SimpleNamespace(__version__=version))
    if good:
        assert load_library("depth", "onnxruntime").__version__ == version
    else:
        with pytest.raises(MissingResourceError, match=rf"need onnxruntime 1\.24 or newer, .* \(got {version}\)"):
            load_library("depth", "onnxruntime")


def test_the_missing_library_of_mask_networks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingResourceError, match=r"masks by a model need rembg: pip install 'mitsplat\[masks\]'"):
        load_library("masks", "rembg")


@pytest.mark.parametrize("name", [name for name in NETWORKS if name.startswith("numbers from")])
def test_weights_outside_of_the_network_folder_are_not_read(tmp_path: Path, name: str) -> None:
    pytest.importorskip("onnxruntime")
    for folder in ("inside", "outside"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "numbers.bin").write_bytes(os.urandom(4))
    place = SimpleNamespace(inside=tmp_path / "inside", outside=tmp_path / "outside")
    model = tmp_path / "inside/a.onnx"
    model.write_bytes(external_weights("numbers.bin")(place))
    assert open_session(model).get_inputs()[0].name == "image"
    model.write_bytes(NETWORKS[name](place))
    with pytest.raises(InputError, match=r"a\.onnx: not a network in ONNX"):
        open_session(model)
