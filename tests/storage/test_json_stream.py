"""JSON streams: the same bytes and values, for any size of the blocks read."""

from __future__ import annotations

import json
import pathlib
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mitsplat.dataset.records.manifest import Manifest, encode_line
from mitsplat.formats import bop
from mitsplat.formats.registry import Catalogue, CollectionWriter
from mitsplat.storage import json_stream
from mitsplat.storage.files import GrowingFile
from mitsplat.storage.json_stream import EntriesFile, ListsFile, read_entries

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
KEPT = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_stream, "_BLOCK", 3)


@KEPT
@given(st.lists(VALUES, max_size=4), st.lists(VALUES, max_size=4), st.dictionaries(st.text(), VALUES, max_size=2))
def test_streamed_lists_equal_those_of_json(
    tmp_path: Path, one: list[Any], other: list[Any], rest: dict[str, Any]
) -> None:
    after = {f"z{key}": value for key, value in rest.items()}
    file = ListsFile(tmp_path / "a.json", ("one", "other"), before={"first": 1}, after=after)
    for i in range(max(len(one), len(other))):  # alternating lists
        for name, values in (("one", one), ("other", other)):
            if i < len(values):
                file.append(name, values[i])
    assert (file.count("one"), file.count("other")) == (len(one), len(other))
    file.commit()
    whole = {"first": 1, "one": one, "other": other, **after}
    assert (tmp_path / "a.json").read_text() == json.dumps(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    expected = [
        (key, element) for key, value in whole.items() for element in (value if isinstance(value, list) else [value])
    ]
    assert list(read_entries(tmp_path / "a.json", split_lists=True)) == expected


@KEPT
@given(st.dictionaries(st.text(), VALUES, max_size=5), st.sampled_from([None, 1]))
def test_streamed_entries_equal_those_of_json(tmp_path: Path, entries: dict[str, Any], indent: int | None) -> None:
    file = EntriesFile(tmp_path / "a.json")
    for key, value in entries.items():
        file.append(key, value)
    file.end().rename()
    assert (tmp_path / "a.json").read_text() == json.dumps(entries)
    (tmp_path / "b.json").write_text(json.dumps(entries, indent=indent))
    assert list(read_entries(tmp_path / "b.json")) == list(entries.items())


@pytest.mark.parametrize(
    "text",
    [
        *("", "3", "[]", "{", '{"a"', '{"a": [1, 2', '{"a": [1 2]}', '{"a": 1,}', '{"a": 1} x', "{3: 1}", '{"a": NaN}'),
        *('{"a": [}', '{"a": ' + "[" * 100_000, '{"a": tru'),
    ],
)
def test_text_that_is_not_a_json_object_is_refused(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_stream, "_BLOCK", 1 << 16)
    (tmp_path / "a.json").write_text(text)
    for split_lists in (True, False):
        with pytest.raises(ValueError, match=r"."):
            list(read_entries(tmp_path / "a.json", split_lists=split_lists))


def test_a_discarded_file_leaves_the_earlier_one(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("before")
    file = ListsFile(tmp_path / "a.json", ("one", "other"))
    file.append("other", 3)
    file.discard()
    growing = GrowingFile(tmp_path / "b")
    growing.write("text")
    growing.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert (tmp_path / "a.json").read_text() == "before"


def record(index: int) -> dict[str, Any]:
    pose = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
    label = {
        **{"id": 1, "asset": 0, "class_index": 0, "class": "nut", "box": [1, 2, 11, 12], "area": 80, "marks": []},
        **{"amodal_box": [1, 2, 11, 12], "amodal_area": 90, "silhouette_box": [1, 2, 11, 12], "silhouette_area": 90},
        **{"depth_area": 90, "visible_fraction": 0.9, "truncation": 0.0, "keypoints": [], "world_from_object": pose},
        **{"rle": "0" * 100, "amodal_rle": "0" * 100},
    }
    camera = {
        **{"width": 64, "height": 48, "intrinsics": [[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]]},
        **{"distortion": [], "lens": "opencv", "aperture_radius": 0.0, "focus_distance": 1.0, "near": 0.01},
        "world_from_camera": pose,
    }
    return {
        **{"index": index, "layout": index // 10, "view": index % 10, "split": "train"},
        **{"files": {f"images/train/{index:06d}.png": "0" * 64}, "camera": camera, "depth_scale": 0.1},
        "labels": {"size": [64, 48], "instances": [label], "dropped": {}},
    }


def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opens, exports to every format and sorts a manifest with frames in the wrong order.

    Frames in memory took 5 kB each and more.
    """

    def memory(count: int) -> int:
        folder = tmp_path / str(count)
        folder.mkdir()
        with (folder / "manifest.jsonl").open("wb") as file:
            file.writelines(encode_line(record(index ^ 1)) for index in range(count))
        catalogue = Catalogue(["nut"], [()], ["nut"], [])
        tracemalloc.start()
        try:
            manifest = Manifest(folder / "manifest.jsonl")
            held = []

            def hear(found: dict[str, Any]) -> None:
                collection.add(found)
                if found["index"] == count - 1:
                    # The interpreter-wide table of path names grows in steps at arbitrary times.
                    paths = tracemalloc.Filter(inclusive=False, filename_pattern=pathlib.__file__)
                    kept = tracemalloc.take_snapshot().filter_traces([paths]).statistics("filename")
                    held.append(sum(entry.size for entry in kept))

            formats = ["yolo", "coco", "amodal", "panoptic", "poses", "bop", "colmap"]
            with CollectionWriter(folder, catalogue, formats) as collection:
                manifest.sort(hear)
                collection.commit()
        finally:  # exclude allocations of other tests
            tracemalloc.stop()
        assert [found["index"] for found in Manifest(folder / "manifest.jsonl")] == list(range(count))
        return held[0]

    monkeypatch.setattr(bop, "_BATCH_FILES", 30)
    memory(20)
    assert memory(600) - memory(150) < 50 * 1000
