"""Datasets with layouts that lack objects which did not come to rest: writers and readers agree on them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.records.manifest import encode_line, parse_line
from mitsplat.dataset.rerender import rerender_frame
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import DatasetSummary, write_dataset
from mitsplat.errors import InputError
from mitsplat.report.dataset_report import write_report
from mitsplat.scene.layout import Layout, LeftOut, UnsettledLayoutError
from mitsplat.scene.scene import Scene
from tests.conftest import BOTH, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes
from tests.manifests import records_of

WORDS = "fell over in 5 of 5 draws"


def settle_most(scene: Scene, index: int, *, progress: Any) -> Layout:
    """Settle layouts. Layout 2 lacks a bolt, and no object of layout 5 comes to rest."""
    layout = scatter_boxes(scene, index, progress=progress)
    if index == 2:
        return replace(layout, instances=(layout.instances[0], *layout.instances[2:]), left_out=(LeftOut(2, 1, WORDS),))
    if index == 5:
        gone = tuple(LeftOut(one.id, one.asset, "fell") for one in layout.instances)
        raise UnsettledLayoutError("nothing rests", replace(layout, instances=(), left_out=gone))
    return layout


def write(scene: Scene, out: Path, **options: Any) -> DatasetSummary:
    return write_dataset(scene, out, **({"render": render_boxes, "settle": settle_most} | options))


def with_share(scene: Scene, share: float) -> Scene:
    settle = scene.spec.settle.model_copy(update={"incomplete": share})
    return replace(scene, spec=scene.spec.model_copy(update={"settle": settle}))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("left_out")
    small = small_scene(folder, large_boxes(), BOTH, layouts=8, views=2, formats=["yolo", "coco", "bop"])
    return with_share(small, 0.25)


@pytest.fixture(scope="module")
def whole(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> DatasetSummary:
    return write(scene, tmp_path_factory.mktemp("whole") / "out")


def files_of(root: Path) -> dict[Path, bytes]:
    names = (".lock", "timings.jsonl", "runs.jsonl", "shard.json", "report.html")
    return {
        path.relative_to(root): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file() and path.name not in names
    }


def test_the_manifest_names_omitted_objects_and_frames_keep_their_numbers(whole: DatasetSummary) -> None:
    records = records_of(whole.path)
    assert [record["index"] for record in records] == list(range(16))
    lacking = {record["index"]: record["left_out"] for record in records if "left_out" in record}
    assert list(lacking) == [4, 5, 10, 11]
    assert lacking[4] == [{"id": 2, "asset": 1, "name": "bolt", "reason": WORDS}]
    assert 2 not in {label["id"] for label in records[4]["labels"]["instances"]}
    assert records[10]["labels"]["instances"] == []
    assert (whole.incomplete, whole.left_out) == (2, {"bolt": 3, "nut": 2})
    assert audit_dataset(whole.path).violations == ()


def test_the_report_counts_omitted_objects(whole: DatasetSummary, tmp_path: Path) -> None:
    page, _, _ = write_report(whole.path, tmp_path / "report.html")
    assert (
        f"2 layouts lack objects that did not come to rest: 2 nut (fell), 2 bolt (fell), 1 bolt ({WORDS})"
        in page.read_text()
    )


@pytest.mark.extended
def test_workers_make_the_same_bytes(scene: Scene, whole: DatasetSummary, tmp_path: Path) -> None:
    """The number of workers does not divide the number of layouts."""
    assert files_of(write(scene, tmp_path / "out", workers=3).path) == files_of(whole.path)


def test_an_interrupted_run_resumes_to_the_same_bytes(scene: Scene, whole: DatasetSummary, tmp_path: Path) -> None:
    def broken(scene: Scene, index: int, *, layout: Layout) -> Any:
        if index == 11:  # second view of the layout without objects
            raise KeyboardInterrupt
        return render_boxes(scene, index, layout=layout)

    with pytest.raises(KeyboardInterrupt):
        write(scene, tmp_path / "out", render=broken)
    summary = write(scene, tmp_path / "out")
    assert 0 < summary.rendered < 16
    assert files_of(summary.path) == files_of(whole.path)


def test_shards_merge_into_the_same_bytes(scene: Scene, whole: DatasetSummary, tmp_path: Path) -> None:
    parts = [write(scene, tmp_path / f"part{number}", shard=Shard(number, 3)).path for number in (1, 2, 3)]
    merged = merge_shards(parts, tmp_path / "out")
    assert files_of(merged.path) == files_of(whole.path)
    assert (merged.incomplete, merged.left_out) == (whole.incomplete, whole.left_out)


@pytest.mark.parametrize("index", [5, 10])
def test_a_remade_frame_has_the_same_bytes(scene: Scene, whole: DatasetSummary, tmp_path: Path, index: int) -> None:
    made = rerender_frame(scene, index, tmp_path / "frame", dataset=whole.path, render=render_boxes, settle=settle_most)
    assert made.compared
    assert made.differing == ()


def test_a_label_of_an_omitted_object_is_a_violation(whole: DatasetSummary, tmp_path: Path) -> None:
    shutil.copytree(whole.path, tmp_path / "out")
    path = tmp_path / "out/manifest.jsonl"
    records = [parse_line(line) for line in path.read_bytes().splitlines()]
    records[4]["left_out"][0]["id"] = records[4]["labels"]["instances"][0]["id"]
    path.write_bytes(b"".join(map(encode_line, records)))
    found = [text for _, text in audit_dataset(tmp_path / "out").violations]
    assert len(found) == 1
    assert found[0].endswith("is labelled, although its layout lacks it")


def test_more_incomplete_layouts_than_allowed_end_the_run(scene: Scene, tmp_path: Path) -> None:
    few = with_share(scene, 0.2)  # 1.6 of 8
    words = r"settle.incomplete = 0.2 of the 8 layouts may lack .*got 2, among them 2 x nut: fell; .*mitsplat check"
    for _ in range(2):  # the second run finds both layouts settled
        with pytest.raises(InputError, match=words):
            write(few, tmp_path / "out")
    summary = write(scene, tmp_path / "out")  # the allowed share changes no byte, so the run resumes
    assert 0 < summary.rendered < 16
    assert summary.incomplete == 2
    # The limit of a shard is that of the whole dataset.
    assert write(few, tmp_path / "part", shard=Shard(2, 2)).incomplete == 1


def test_a_finished_dataset_accepts_a_request_for_fewer_images(
    scene: Scene, whole: DatasetSummary, tmp_path: Path
) -> None:
    """Of the first 3 layouts, 1 lacks objects: more than 0.25 of these, but not of the 8 that exist."""
    shutil.copytree(whole.path, tmp_path / "out")
    summary = write(scene, tmp_path / "out", frames=6)
    assert (summary.frames, summary.rendered, summary.incomplete) == (16, 0, 2)
    assert files_of(tmp_path / "out") == files_of(whole.path)
    with pytest.raises(InputError, match=r"settle.incomplete = 0.2 of the 8 layouts may lack .*got 2"):
        write(with_share(scene, 0.2), tmp_path / "out", frames=4)  # 0 of 2
    with pytest.raises(InputError, match=r"settle.incomplete = 0.25 of the 3 layouts may lack .*got 1"):
        write(scene, tmp_path / "new", frames=6)


def test_the_allowed_share_is_not_recorded_as_an_input(whole: DatasetSummary) -> None:
    assert "incomplete" not in (whole.path / "dataset.json").read_text()
