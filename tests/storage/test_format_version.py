"""Format versions of files: files without a version are of version 1, and newer versions are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsplat.asset import Asset
from mitsplat.audit.audit import audit_dataset
from mitsplat.capture.capture import Capture
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.fit.fit_folder import FitFolder, FitResult
from mitsplat.fit.training_view import HeldOut
from mitsplat.reconstruct.pipeline.asset_pipeline import read_fit
from mitsplat.scene.scene import Scene
from mitsplat.storage.format_version import FORMAT_VERSION, FORMAT_VERSIONS, check_format_version
from mitsplat.version import __version__
from tests.conftest import BOTH, box_asset, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes

NEWER = (
    rf"format_version must be at most 1, the newest that mitsplat {__version__} reads \(got 2\): "
    r"update mitsplat, or create the file again with this version"
)
NO_VERSIONS = ["two", True, 1.5, 0, None]


def state(file: Path, version: Any) -> None:
    """Write this version, or none, into a JSON file."""
    stored = json.loads(file.read_text())
    assert stored.pop(FORMAT_VERSION) == 1
    file.write_text(json.dumps(stored if version is ... else {FORMAT_VERSION: version, "future": 3, **stored}))


@pytest.mark.parametrize("version", NO_VERSIONS)
def test_invalid_versions_are_refused(version: Any) -> None:
    with pytest.raises(InputError, match=r"^a\.json: format_version must be a whole number of at least 1 \(got "):
        check_format_version({FORMAT_VERSION: version}, 3, "a.json")


def test_versions_up_to_the_newest_are_accepted() -> None:
    for stored in ({}, {FORMAT_VERSION: 1}, {FORMAT_VERSION: 3}, []):
        check_format_version(stored, 3, "a.json")
    with pytest.raises(InputError, match=r"must be at most 3"):
        check_format_version({FORMAT_VERSION: 4}, 3, "a.json")


class TestAssets:
    def test_an_asset_file_starts_with_its_version(self, tmp_path: Path) -> None:
        box_asset("nut").save(tmp_path)
        assert (tmp_path / "asset.yaml").read_text().startswith("format_version: 2\nname: nut\n")

    def test_an_asset_without_a_version_counts_as_version_1(self, tmp_path: Path) -> None:
        box_asset("nut").save(tmp_path)
        manual = tmp_path / "asset.yaml"
        manual.write_text(manual.read_text().replace("format_version: 2\n", ""))
        assert Asset.load(tmp_path).name == "nut"

    def test_a_newer_asset_is_refused_before_its_unknown_keys(self, tmp_path: Path) -> None:
        box_asset("nut").save(tmp_path)
        manual = tmp_path / "asset.yaml"
        manual.write_text("hardness: 3\n" + manual.read_text().replace("version: 2", "version: 3"))
        newer = NEWER.replace("most 1", "most 2").replace("got 2", "got 3")
        with pytest.raises(InputError, match=rf"asset\.yaml:2: {newer}$"):
            Asset.load(tmp_path)

    def test_an_invalid_asset_version_is_refused_with_its_line(self, tmp_path: Path) -> None:
        (tmp_path / "asset.yaml").write_text("name: a\nformat_version: one\nsplats: a.ply\nmesh: hull\n")
        with pytest.raises(InputError, match=r'asset\.yaml:2: format_version must be a whole number .* \(got "one"\)$'):
            Asset.load(tmp_path)


def test_captures_have_a_version_and_newer_ones_are_refused(tmp_path: Path) -> None:
    Capture((), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)).save(tmp_path)
    state(tmp_path / "capture.json", ...)
    assert Capture.load(tmp_path).photos == ()
    Capture.load(tmp_path).save(tmp_path)
    state(tmp_path / "capture.json", 2)
    with pytest.raises(InputError, match=rf"capture\.json:1: {NEWER}$"):
        Capture.load(tmp_path)


def test_fits_have_a_version_and_newer_ones_are_refused(tmp_path: Path) -> None:
    folder, held_out = FitFolder(tmp_path, "abc"), (HeldOut("a.png", 31.5, 0.9, 31.5),)
    result = FitResult(box_asset("nut").splats, 5, 1.0, held_out, "abc")
    folder.save(result, {})
    state(tmp_path / "fit.json", ...)
    assert read_fit(tmp_path) == (tmp_path / "splats.ply", 31.5)
    found = folder.finished(overwrite=False)
    assert found is not None and found.held_out == held_out
    folder.save(result, {})
    state(tmp_path / "fit.json", 2)
    with pytest.raises(InputError, match=rf"fit\.json: {NEWER}$"):
        read_fit(tmp_path)
    with pytest.raises(InputError, match=rf"fit\.json: {NEWER}; --overwrite replaces it$"):
        folder.finished(overwrite=False)
    assert folder.finished(overwrite=True) is None


def test_fits_with_fields_of_older_versions_are_read(tmp_path: Path) -> None:
    folder, held_out = FitFolder(tmp_path, "abc"), (HeldOut("a.png", 31.5, 0.9, 31.5),)
    folder.save(FitResult(box_asset("nut").splats, 5, 1.0, held_out, "abc"), {})
    record = json.loads((tmp_path / "fit.json").read_text())
    record["held_out"][0]["psnr_corrected"] = 32.0
    (tmp_path / "fit.json").write_text(json.dumps(record))
    found = folder.finished(overwrite=False)
    assert found is not None and found.held_out == held_out


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return small_scene(tmp_path, large_boxes(), BOTH, layouts=1, views=2)


class TestDatasets:
    def write(self, scene: Scene, out: Path, **options: Any) -> Path:
        return write_dataset(scene, out, render=render_boxes, settle=scatter_boxes, **options).path

    def test_a_dataset_without_a_version_counts_as_version_1(self, scene: Scene, tmp_path: Path) -> None:
        out = self.write(scene, tmp_path / "out", frames=1)
        state(out / "dataset.json", ...)
        assert audit_dataset(out).violations == ()
        self.write(scene, out, frames=2)
        merge_shards([out], tmp_path / "whole")
        assert json.loads((tmp_path / "whole/dataset.json").read_text())[FORMAT_VERSION] == 1

    @pytest.mark.parametrize("overwrite", [False, True])
    def test_a_newer_dataset_is_refused_and_unchanged(self, scene: Scene, tmp_path: Path, overwrite: bool) -> None:
        out = self.write(scene, tmp_path / "out", frames=1)
        state(out / "dataset.json", 2)
        before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
        for read in (
            lambda: audit_dataset(out),
            lambda: merge_shards([out], tmp_path / "whole"),
            lambda: self.write(scene, out, overwrite=overwrite),
        ):
            with pytest.raises(InputError, match=rf"dataset\.json: {NEWER}$"):
                read()
        assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_the_compatibility_page_states_every_version() -> None:
    page = (Path(__file__).parents[2] / "docs/compatibility.md").read_text()
    for file, version in FORMAT_VERSIONS.items():
        assert f"| `{file}` | {version} |" in page, file
