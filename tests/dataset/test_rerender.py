"""Single frames made again: the same bytes as in the dataset for any earlier frames, and reports of differences."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mitsplat.dataset.rerender import rerender_frame
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.scene import Scene
from tests.conftest import BOTH, WriteScene, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes
from tests.manifests import records_of, store_lines

DRAWN: dict[str, Any] = {"render": render_boxes, "settle": scatter_boxes}


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return small_scene(tmp_path, large_boxes(), BOTH, layouts=2, views=2, formats=["yolo", "coco", "bop"])


@pytest.fixture
def made(scene: Scene, tmp_path: Path) -> Path:
    return write_dataset(scene, tmp_path / "out", frames=3, **DRAWN).path


def test_remade_frames_have_the_same_bytes(scene_data: dict[str, Any], write_scene: WriteScene, tmp_path: Path) -> None:
    """The frame is made from the scene alone. Only the comparison reads the dataset."""
    path = write_scene(
        scene_data
        | {
            "randomise": {"exposure": [-1, 1], "iso": [400, 800]},
            "output": scene_data["output"] | {"layouts": 2, "views": 2, "formats": ["yolo", "depth"]},
        }
    )
    out = write_dataset(load_scene(path), tmp_path / "out", settle=scatter_boxes).path
    made = rerender_frame(load_scene(path), 2, tmp_path / "again", dataset=out, settle=scatter_boxes)
    assert (made.compared, made.differing, made.cause) == (3, (), "")
    for file in [*made.record["files"], "layouts/0001.json"]:
        assert (made.path / file).read_bytes() == (out / file).read_bytes()
    assert json.loads((made.path / "frame.json").read_text()) == made.record


def test_files_that_differ_are_named_with_the_cause(scene: Scene, made: Path, tmp_path: Path) -> None:
    line = (made / "manifest.jsonl").read_bytes().splitlines(keepends=True)[1]
    (made / "layouts/0000.json").write_text("{}")
    again = rerender_frame(scene, 1, tmp_path / "again", dataset=made, **DRAWN)
    assert again.differing == ("layouts/0000.json",)
    other = replace(scene, spec=scene.spec.model_copy(update={"seed": 1}))
    again = rerender_frame(other, 1, tmp_path / "again", dataset=made, **DRAWN)
    assert set(again.differing) >= {"images/train/000001.png", "manifest.jsonl"}
    assert again.cause == "scene.seed was 0 and is 1"
    (made / "manifest.jsonl").write_bytes(line.replace(b'"view":1', b'"view":2'))
    with pytest.raises(InputError, match=r"manifest\.jsonl: must hold the record of frame 1 \(its checksum"):
        rerender_frame(scene, 1, tmp_path / "again", dataset=made, **DRAWN)


@pytest.mark.parametrize(
    ("formats", "file"),
    [("coco bop", "labels/train/000001.txt"), ("yolo coco bop instances", "instances/train/000001.png")],
)
def test_files_of_other_formats_are_named(scene: Scene, made: Path, tmp_path: Path, formats: str, file: str) -> None:
    output = scene.spec.output.model_copy(update={"formats": tuple(formats.split())})
    other = replace(scene, spec=scene.spec.model_copy(update={"output": output}))
    again = rerender_frame(other, 1, tmp_path / "again", dataset=made, **DRAWN)
    stored = records_of(made)[1]["files"]
    assert file in again.differing and set(again.differing) == stored.keys() ^ again.record["files"].keys()
    assert again.compared == len(stored)


def test_a_missing_layout_is_named(scene: Scene, made: Path, tmp_path: Path) -> None:
    (made / "layouts/0000.json").unlink()
    assert rerender_frame(scene, 1, tmp_path / "again", dataset=made, **DRAWN).differing == ("layouts/0000.json",)


def test_links_to_other_folders_are_refused(scene: Scene, tmp_path: Path) -> None:
    rerender_frame(scene, 1, tmp_path / "again", **DRAWN)
    (tmp_path / "again/layouts").rename(tmp_path / "outside")
    (tmp_path / "again/layouts").symlink_to(tmp_path / "outside")
    with pytest.raises(InputError, match="link"):
        rerender_frame(scene, 2, tmp_path / "again", **DRAWN)
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["0000.json"]


def test_files_of_an_earlier_frame_are_removed(scene: Scene, tmp_path: Path) -> None:
    again = tmp_path / "again"
    for index in (1, 2):
        files = {*rerender_frame(scene, index, again, **DRAWN).record["files"], "frame.json"}
    files.add("layouts/0001.json")
    assert {str(path.relative_to(again)) for path in again.rglob("*") if path.is_file()} == files


def test_a_frame_that_the_dataset_lacks_is_not_compared(scene: Scene, made: Path, tmp_path: Path) -> None:
    for index, dataset in ((3, made), (1, tmp_path / "none"), (1, None)):
        again = rerender_frame(scene, index, tmp_path / f"again{index}", dataset=dataset, **DRAWN)
        assert again.compared == 0 and again.record["index"] == index


def test_a_folder_with_other_files_is_refused(scene: Scene, made: Path) -> None:
    with pytest.raises(InputError, match="must be absent, empty, or hold a frame of an earlier call"):
        rerender_frame(scene, 1, made, **DRAWN)
    with pytest.raises(InputError, match="must be absent, empty, or hold a frame of an earlier call"):
        rerender_frame(scene, 1, made / "dataset.json", **DRAWN)
    with pytest.raises(InputError, match="frame must be in 0 to 3"):
        rerender_frame(scene, 4, made, **DRAWN)


def test_the_last_line_of_the_frame_is_compared(scene: Scene, made: Path, tmp_path: Path) -> None:
    first, one, two = records_of(made)
    earlier = {**one, "files": dict.fromkeys(one["files"], "0" * 64)}
    store_lines(made, [first, earlier, one, {**earlier, "index": 10}, two])
    assert rerender_frame(scene, 1, tmp_path / "again", dataset=made, **DRAWN).differing == ()


def test_files_of_others_are_not_removed(scene: Scene, tmp_path: Path) -> None:
    again = tmp_path / "again"
    again.mkdir()
    (again / "notes.txt").touch()
    other = tmp_path / ".splats.ply.1.part"
    other.touch()
    (again / "frame.json").write_text(
        json.dumps({"files": dict.fromkeys([f"../{other.name}", str(other), "notes.txt"], "")})
    )
    rerender_frame(scene, 1, again, **DRAWN)
    assert other.exists() and (again / "notes.txt").exists()


def test_remaking_a_frame_does_not_change_the_dataset(scene: Scene, made: Path, tmp_path: Path) -> None:
    """Another process may be writing the dataset, so its last line may be incomplete."""
    with (made / "manifest.jsonl").open("ab") as file:
        file.write(b'{"index":1,"layout"')
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    assert rerender_frame(scene, 1, tmp_path / "again", dataset=made, **DRAWN).differing == ()
    assert before == {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
