"""Content of a dataset's folder after a refusal, a rewrite or a new split."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mitsplat.dataset.folds import write_folds
from mitsplat.dataset.rerender import rerender_frame
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import write_dataset
from mitsplat.engine.ray import Cluster
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.frames.mitsuba_xml import render_xml
from mitsplat.scene.loading.scene_loading import make_scene
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import FORMATS
from tests.cli.typed import run
from tests.conftest import BOTH, contents, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return small_scene(tmp_path, large_boxes(), BOTH, layouts=3, views=2, formats=["yolo", "yolo-detect", "bop"])


def write(scene: Scene, out: Path, **options: Any) -> Path:
    return write_dataset(scene, out, render=render_boxes, settle=scatter_boxes, **options).path


def with_wide_shape(scene: Scene) -> Scene:
    """Return the scene with a table of 40 m, a size that results from wrong units."""
    table = {"name": "table", "box": {"size": [40, 40, 0.02], "position": [0, 0, -0.01]}}
    spec = type(scene.spec)(**{**scene.spec.model_dump(), "shapes": (table,)})
    return replace(make_scene(spec, scene.path.parent), path=scene.path)


def test_invalid_arguments_are_refused_before_anything_is_overwritten(scene: Scene, tmp_path: Path) -> None:
    out = write(scene, tmp_path / "out")
    before = contents(out)
    with pytest.raises(InputError, match=r"workers must be at least 1 \(got 0\)"):
        write(scene, out, overwrite=True, workers=0)
    with pytest.raises(InputError, match=r"scene.yaml: shapes\[0\]: the mesh must be .* \(got 40"):
        write_dataset(with_wide_shape(scene), out, overwrite=True)
    assert contents(out) == before


def test_missing_ray_is_refused_before_anything_is_overwritten(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = write(scene, tmp_path / "out")
    before = contents(out)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingResourceError, match="the engine ray needs Ray"):
        write(scene, out, overwrite=True, cluster=Cluster(None))
    assert contents(out) == before


def test_a_damaged_shard_keeps_the_earlier_merged_dataset(scene: Scene, tmp_path: Path) -> None:
    shards = [write(scene, tmp_path / f"part{i}", shard=Shard(i, 2)) for i in (1, 2)]
    whole = merge_shards(shards, tmp_path / "whole").path
    before = contents(whole)
    damaged = shards[1] / "labels/train/000004.txt"
    damaged.unlink()  # a hard link to the file of the merged dataset
    damaged.write_text("0 0 0\n")
    with pytest.raises(InputError, match=f"{damaged}: must have the SHA-256"):
        merge_shards(shards, whole, overwrite=True)
    assert contents(whole) == before


def test_a_shard_without_images_is_not_merged(scene: Scene, tmp_path: Path) -> None:
    out = write(scene, tmp_path / "out", frames=1)
    (out / "manifest.jsonl").write_bytes(b"")
    with pytest.raises(InputError, match=f"{out}: must have at least one image; finish this shard first"):
        merge_shards([out], tmp_path / "whole")
    assert not (tmp_path / "whole").exists()


def test_overwriting_keeps_files_of_other_programs(scene: Scene, tmp_path: Path) -> None:
    """The kept files are in folders of unused formats, or have the name of a partially written file."""
    out = write(scene, tmp_path / "out", frames=2)
    for name in ("colmap/database.db", "depth/a.png", "annotations/mine.json", "notes/.mine.part"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).touch()
    torn = out / "images/.000003.png.4711.part"
    torn.touch()
    write(scene, out)
    assert not torn.exists()
    write(scene, out, overwrite=True)
    for name in ("colmap/database.db", "depth/a.png", "annotations/mine.json", "notes/.mine.part"):
        assert (out / name).exists()


def test_overwriting_removes_the_files_of_all_formats(tmp_path: Path) -> None:
    """Labels that remained would be read with those of the new dataset."""
    formats = [name for name in FORMATS if name != "colmap"]
    out = write(small_scene(tmp_path, large_boxes(), BOTH, layouts=2, views=2, formats=formats), tmp_path / "out")
    assert {"yolo-obb", "bop", "flow"} <= {path.name for path in out.iterdir()}
    scene = small_scene(tmp_path, large_boxes(), BOTH, layouts=1, views=1, formats=["yolo"])
    write(scene, out, overwrite=True)
    assert contents(out).keys() == contents(write(scene, tmp_path / "fresh")).keys()


@pytest.mark.parametrize("text", ["\n", "{}", "[]", '{"index": 1, "instances": 3}'])
def test_a_damaged_layout_is_named(scene: Scene, tmp_path: Path, text: str) -> None:
    out = write(scene, tmp_path / "out")
    layout = out / "layouts/0001.json"
    layout.write_text(text)
    with pytest.raises(InputError, match=f"{layout}: must be a valid layout .*; remove it and run again"):
        write(scene, out)


def test_folds_are_removed_when_images_are_added(
    scene: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = write(scene, tmp_path / "out", frames=4)
    write_folds(out, 2)
    assert len(list(out.rglob("fold*_train.txt"))) == 4  # two tasks
    write(scene, out)
    assert not list(out.rglob("fold*_*")) and not list(out.rglob("folds"))
    assert [message for message in caplog.messages if "no light" not in message] == [
        f"{out}: the lists of folds do not contain the new images and are removed: run `mitsplat split` again"
    ]
    write_folds(out, 3)
    write_folds(out, 2)
    assert not list(out.rglob("fold3*")) and len(list(out.rglob("fold2*.*"))) == 6
    write(scene, out)  # adds no image
    assert len(list(out.rglob("fold2*.*"))) == 6


def test_a_remade_frame_replaces_files_of_an_earlier_one(scene: Scene, tmp_path: Path) -> None:
    def make(out: Path, of: Scene) -> dict[str, bytes]:
        rerender_frame(of, 3, out, render=render_boxes, settle=scatter_boxes)
        return contents(out)

    output = scene.spec.output.model_copy(update={"formats": ("yolo", "depth")})
    make(tmp_path / "again", replace(scene, spec=scene.spec.model_copy(update={"seed": 8, "output": output})))
    assert list((tmp_path / "again/depth").rglob("*.*"))
    (tmp_path / "again/notes.txt").touch()
    found = make(tmp_path / "again", scene)
    assert found.pop("notes.txt") == b""
    assert found == make(tmp_path / "fresh", scene)


def test_reports_with_a_wrong_file_ending_are_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.yaml").write_text("mine")
    for words, kind in ((("report", dataset), ".html"), (("compare", dataset, dataset), ".json")):
        assert run(*words, "-o", tmp_path / "scene.yaml") == 2
        assert capsys.readouterr().err == f"mitsplat: --out must end in {kind} (got {tmp_path / 'scene.yaml'})\n"
    assert (tmp_path / "scene.yaml").read_text() == "mine"


def test_an_export_keeps_meshes_of_other_programs(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "y_files").mkdir()
    (tmp_path / "y_files/object_0.ply").write_text("mine")
    assert run("export", scene.path, "-o", tmp_path / "y.xml") == 2
    assert f"the folder {tmp_path / 'y_files'} must not exist yet" in capsys.readouterr().err
    assert (tmp_path / "y_files/object_0.ply").read_text() == "mine"


def test_a_full_disk_keeps_the_earlier_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = '<scene version="3.0.0"><integrator type="splat_proxy"/><sensor type="perspective">'
    text += '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
    (tmp_path / "scene.xml").write_text(text + '</sensor><emitter type="constant"/></scene>')
    picture = render_xml(tmp_path / "scene.xml", tmp_path / "out.png")
    before = contents(tmp_path)

    def full(path: Path, write: Callable[[Path], object]) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mitsplat.frames.mitsuba_xml.write_file", full)
    with pytest.raises(MissingResourceError, match=f"{picture}: No space left on device"):
        render_xml(tmp_path / "scene.xml", picture)
    assert contents(tmp_path) == before
