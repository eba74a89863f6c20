"""Untrusted datasets: links, pipes, deep JSON and records of other types are handled without changing other files."""

import copy
import hashlib
import json
import os
import random
import shutil
import signal
from contextlib import suppress
from pathlib import Path

import pytest

from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.dataset_files import is_written
from mitsplat.dataset.folds import write_folds
from mitsplat.dataset.records.manifest import Manifest, encode_line
from mitsplat.dataset.shards import merge_shards
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.training import write_data
from mitsplat.errors import InputError, PartialResultError
from mitsplat.report.dataset_report import write_report
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.storage.files import MAX_JSON_DEPTH, open_in_place, parse_json, read_json, write_file
from mitsplat.view.dataset_index import DatasetIndex
from tests.conftest import BOTH, nut_and_bolt, small_scene
from tests.dataset.test_write import contents, write
from tests.manifests import records_of

FORMATS = ["yolo", "yolo-detect", "coco", "depth", "exr"]
PRECIOUS = "years of work\n"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("scene"), nut_and_bolt(), BOTH, layouts=3, views=2, formats=FORMATS)


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "out"
    write(scene, folder)
    return folder


@pytest.fixture
def out(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "out"))


@pytest.fixture
def outside(tmp_path):
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "thesis.txt").write_text(PRECIOUS)
    return folder


def write_again(scene, out):
    for layer in out.glob("layers/*/000003.exr"):
        layer.unlink()
    write(scene, out)


WRITERS = {
    "render": write_again,
    "render --overwrite": lambda scene, out: write(scene, out, overwrite=True),
    "split": lambda scene, out: write_folds(out, 2),
    "merge": lambda scene, out: merge_shards([out.parent / "shard"], out),
}


class TestLinks:
    @pytest.mark.parametrize("command", WRITERS)
    @pytest.mark.parametrize("name", ["manifest.jsonl", "timings.jsonl", "runs.jsonl", ".lock", "dataset.json"])
    def test_a_file_that_is_a_link_is_not_written_through(self, scene, out, outside, name, command):
        shutil.copytree(out, out.parent / "shard")
        target = outside / name
        (out / name).rename(target)
        with target.open("ab") as file:
            file.write(b"torn")
        if name == "dataset.json":
            target.write_bytes(target.read_bytes()[:-4])
        (out / name).symlink_to(target)
        before = target.read_bytes()
        with pytest.raises(InputError, match=rf"{name}: must not be a link"):
            WRITERS[command](scene, out)
        assert target.read_bytes() == before
        assert (out / name).is_symlink()

    @pytest.mark.parametrize("command", WRITERS)
    @pytest.mark.parametrize("name", ["images", "images/train", "labels", "layouts", "yolo-detect", "folds"])
    def test_a_folder_that_is_a_link_is_not_written_into(self, scene, out, outside, name, command):
        shutil.copytree(out, out.parent / "shard")
        target = outside / "folder"
        if (out / name).exists():
            (out / name).rename(target)
        else:
            target.mkdir()
        (target / "fold1_train.txt").write_text(PRECIOUS)
        (out / name).symlink_to(target)
        before = contents(outside, without=())
        with pytest.raises(InputError, match=rf"{name}: must not be a link"):
            WRITERS[command](scene, out)
        assert contents(outside, without=()) == before

    @pytest.mark.parametrize("command", WRITERS)
    def test_a_folder_that_is_reached_through_a_link_is_written(self, scene, out, command):
        shutil.copytree(out, out.parent / "shard")
        (out.parent / "reached").symlink_to(out)
        WRITERS[command](scene, out.parent / "reached")
        assert (out.parent / "reached").is_symlink()
        assert len(Manifest(out / "manifest.jsonl")) == 6

    def test_a_link_in_the_place_of_a_page_or_picture_is_replaced(self, scene, out, outside):
        for name in ("report.html", "labels/train/000000.txt"):
            target = outside / Path(name).name
            target.write_text(PRECIOUS)
            (out / name).unlink(missing_ok=True)
            (out / name).symlink_to(target)
        write_report(out)
        assert not (out / "report.html").is_symlink()
        assert {path.read_text() for path in outside.iterdir()} == {PRECIOUS}

    def test_links_with_the_names_of_partial_files_are_not_followed(self, tmp_path, outside):
        path = tmp_path / "picture.png"
        (tmp_path / f".picture.png.{os.getpid()}.part").symlink_to(outside / "thesis.txt")
        write_file(path, lambda part: part.write_bytes(b"picture"))
        assert path.read_bytes() == b"picture"
        assert (outside / "thesis.txt").read_text() == PRECIOUS

    def test_resuming_a_copy_by_hard_links_does_not_change_the_original(self, scene, tmp_path):
        write(scene, tmp_path / "one", frames=3)
        before = contents(tmp_path / "one", without=())
        shutil.copytree(tmp_path / "one", tmp_path / "two", copy_function=os.link)
        (tmp_path / "two/.lock").unlink()
        (tmp_path / "two/layouts/.lock").unlink()
        write(scene, tmp_path / "two")
        assert contents(tmp_path / "one", without=()) == before

    @pytest.mark.parametrize("link", [os.symlink, os.link])
    def test_a_file_with_a_second_name_is_not_opened_for_writing(self, outside, tmp_path, link):
        link(outside / "thesis.txt", tmp_path / "name")
        for mode in ("w", "a", "r+b"):
            with pytest.raises(OSError, match="must not"):
                open_in_place(tmp_path / "name", mode)
        assert (outside / "thesis.txt").read_text() == PRECIOUS

    def test_a_link_in_place_of_a_training_folder_is_not_followed(self, scene, out, outside):
        found = read_set(out, "train")
        (out.parent / "data").symlink_to(outside)
        write_data([found], out.parent / "data")
        assert [path.name for path in outside.iterdir()] == ["thesis.txt"]


def test_merging_does_not_change_its_inputs(scene, out):
    with (out / "manifest.jsonl").open("ab") as file:
        file.write(b'{"index":6,"torn')
    (out / ".lock").unlink()
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.rglob("*") if path.is_file()}
    assert merge_shards([out], out.parent / "merged").frames == 6
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.rglob("*") if path.is_file()} == before
    assert len(Manifest(out.parent / "merged/manifest.jsonl")) == 6


def test_merging_reads_no_files_outside_of_the_shards(scene, out, outside):
    for name in ("layouts/0000.json", "scene/scene.yaml"):
        kept = (out / name).read_bytes()
        (out / name).unlink()
        (out / name).symlink_to(outside / "thesis.txt")
        with pytest.raises(InputError, match="must be a file inside"):
            merge_shards([out], out.parent / "merged")
        (out / name).unlink()
        (out / name).write_bytes(kept)


class TestOverwriting:
    def test_overwriting_keeps_files_of_other_programs(self, scene, out):
        own = ["labels/notes.txt", "labels/train/corrected.txt", "images/train/photo.jpg", "notes.md", "scene/why.md"]
        for name in own:
            (out / name).write_text(PRECIOUS)
        assert write(load_scene(scene.path, overrides={"output.formats": ["exr"]}), out, frames=2, overwrite=True)
        for name in own:
            assert (out / name).read_text() == PRECIOUS
        assert sorted(path.name for path in (out / "labels").rglob("*.txt")) == ["corrected.txt", "notes.txt"]
        assert len(list((out / "images").rglob("*.png"))) == 2

    def test_every_file_of_every_format_is_recognised(self, clean):
        files = [path.relative_to(clean).as_posix() for path in clean.rglob("*") if path.is_file()]
        inner = [name for name in files if "/" in name]
        assert len(inner) > 100
        assert [name for name in inner if not is_written(name)] == []


DEEP = "[" * 100_000 + "]" * 100_000
READERS = {
    "audit": audit_dataset,
    "report": write_report,
    "merge": lambda out: merge_shards([out], out.parent / "merged"),
    "split": lambda out: write_folds(out, 2),
    "view": DatasetIndex,
    "train": lambda out: read_set(out, "train"),
}


class TestJson:
    @pytest.mark.parametrize("command", ["audit", "report", "merge", "split", "view"])
    @pytest.mark.parametrize("text", [DEEP, f'{{"mitsplat": {DEEP}}}', '{"a":' * 900 + "0" + "}" * 900, "[]", "0"])
    def test_a_description_nested_too_deep_is_refused(self, out, command, text):
        (out / "dataset.json").write_text(text)
        with pytest.raises(InputError, match=r"dataset\.json"):
            READERS[command](out)

    def test_a_manifest_line_nested_too_deep_is_refused(self, scene, out):
        for depth in (150, 900, 100_000):
            line = b'{"index":12,"deep":' + b"[" * depth + b"]" * depth + b"}"
            record = encode_line({"index": 12, "deep": 0})
            assert record.startswith(line[:19])
            with (out / "manifest.jsonl").open("rb") as file:
                kept = file.read()
            (out / "manifest.jsonl").write_bytes(_checked(line) + kept)
            with pytest.raises(InputError, match=r"manifest\.jsonl:1: must be the record of a frame"):
                write_folds(out, 2)
            assert any("line 1 is not the record" in text for _, text in audit_dataset(out).violations)
            (out / "manifest.jsonl").write_bytes(kept)

    def test_brackets_in_strings_do_not_count_as_nesting(self):
        text = json.dumps(["[" * 1000, '\\"[[' * 100, '"' + "{" * 500])
        assert parse_json(text.encode()) == json.loads(text)
        levels = "[" * MAX_JSON_DEPTH + "]" * MAX_JSON_DEPTH
        assert parse_json(levels.encode()) == json.loads(levels)
        with pytest.raises(ValueError, match="nested deeper"):
            parse_json(f"[{levels}]".encode())

    @pytest.mark.parametrize("command", READERS)
    @pytest.mark.parametrize("name", ["dataset.json", "manifest.jsonl", "runs.jsonl", "layouts/0000.json"])
    def test_a_named_pipe_is_refused_without_waiting(self, out, name, command):
        (out / name).unlink(missing_ok=True)
        os.mkfifo(out / name)
        signal.alarm(60)  # ends the process if opening a pipe blocks
        try:
            with suppress(InputError, OSError):
                READERS[command](out)
        finally:
            assert signal.alarm(0) > 0

    def test_a_report_shows_no_image_from_outside(self, out, outside):
        image = next((out / "images").rglob("*.*"))
        shutil.move(image, outside)
        image.symlink_to(outside / image.name)
        READERS["report"](out)
        assert f"Frame {int(image.stem)}: its image cannot be read" in (out / "report.html").read_text()

    def test_a_report_shows_names_of_strays_that_are_not_utf_8(self, out):
        (out / "images/train" / os.fsdecode(b"caf\xe9.png")).write_bytes(b"")
        READERS["report"](out)
        assert r"images/train/caf\udce9.png" in (out / "report.html").read_text()


def _checked(text):
    """Encode a manifest line with a valid checksum, from JSON text that Python's encoder does not produce."""
    return text[:-1] + f',"check":"{hashlib.sha256(text).hexdigest()[:16]}"}}\n'.encode()


def _places(value, at=()):
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*at, key)
        yield from _places(value[key], (*at, key))


def _changed(value, at, new):
    value = copy.deepcopy(value)
    inner = value
    for key in at[:-1]:
        inner = inner[key]
    if new is KeyError:
        del inner[at[-1]]
    else:
        inner[at[-1]] = new
    return value


class TestTypes:
    """Keys that are missing or have another type, in lines with a valid checksum."""

    @pytest.mark.parametrize("key", ["index", "files", "split", "labels", "camera", "layout"])
    @pytest.mark.parametrize("new", [KeyError, -1], ids=repr)
    def test_a_line_with_any_key_missing_or_of_another_type_is_refused(self, scene, out, key, new):
        lines = records_of(out)
        for line in lines:
            del line["check"]
        lines[1] = _changed(lines[1], (key,), new)
        (out / "manifest.jsonl").write_bytes(b"".join(map(encode_line, lines)))
        for command in (lambda: write_folds(out, 2), lambda: READERS["merge"](out), lambda: write(scene, out)):
            with pytest.raises(InputError, match=r"manifest\.jsonl:2: must be the record of a frame") as caught:
                command()
            assert "\n" not in str(caught.value)
        assert any("line 2 is not the record" in text for _, text in audit_dataset(out).violations)
        assert DatasetIndex(out).unreadable == 1

    @pytest.mark.filterwarnings("ignore::RuntimeWarning")  # from values that overflow
    def test_random_changes_of_values_never_end_in_a_crash(self, scene, out):
        """Random changes of random values are refused in one sentence, reported by the audit, or accepted."""
        rng = random.Random(1)
        values = [KeyError, None, "x", -1, {}, [], 1e308, 10**30, True, "\u2028", [[[]]], float("nan")]
        tried = 0
        for name in [*["manifest.jsonl"] * 8, *["dataset.json"] * 8, *["runs.jsonl", "timings.jsonl"] * 2]:
            before = (out / name).read_bytes()
            lines = [before] if name == "dataset.json" else before.splitlines()
            found = [json.loads(line) for line in lines]
            number = rng.randrange(len(found))
            found[number].pop("check", None)
            found[number] = _changed(found[number], rng.choice(list(_places(found[number]))), rng.choice(values))
            if name == "manifest.jsonl":
                changed = [encode_line({key: value for key, value in one.items() if key != "check"}) for one in found]
            else:
                changed = [json.dumps(one).encode() + b"\n" for one in found]
            (out / name).write_bytes(b"".join(changed))
            for command in rng.sample(sorted(READERS), 3):
                tried += 1
                shutil.rmtree(out.parent / "merged", ignore_errors=True)
                try:
                    READERS[command](out)
                except (InputError, PartialResultError) as error:
                    assert "\n" not in str(error)
            (out / name).write_bytes(before)
        assert tried == 60


@pytest.mark.parametrize("character", ["\n", "\r\n", "\0", "\x1b", "\u2028", "\uffff"], ids=ascii)
def test_class_names_with_line_breaks_or_control_characters_are_refused(scene_data, write_scene, character):
    scene_data["objects"][0]["class_name"] = f"nut{character}"
    with pytest.raises(InputError, match=r"class.*must have no control characters or line breaks"):
        load_scene(write_scene(scene_data))


@pytest.mark.parametrize("key", ["name", "class"])
def test_asset_names_with_line_breaks_are_refused(scene_data, write_scene, key):
    path = write_scene(scene_data).parent / "assets/nut/asset.yaml"
    kept = "".join(line for line in path.read_text().splitlines(keepends=True) if not line.startswith(f"{key}:"))
    path.write_text(f'{kept}{key}: "nut\\r\\nbolt"\n')
    with pytest.raises(InputError, match=rf"{key}.*must have no control characters or line breaks"):
        load_scene(path.parents[2] / "scene.yaml")


def test_dataset_classes_with_line_breaks_are_refused(out):
    content = read_json(out / "dataset.json")
    content["classes"][0] = "nut\u2028bolt"
    (out / "dataset.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"classes\.0.*must have no control characters"):
        audit_dataset(out)
