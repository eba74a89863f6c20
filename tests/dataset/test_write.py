"""Dataset folders: content, resumption, interruption and refusals, with a synthetic renderer."""

import fcntl
import hashlib
import json
import os
import shutil
import socket
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from pycocotools.coco import COCO
from ruamel.yaml import YAML

from mitsplat.dataset import dataset_folder as folder
from mitsplat.dataset.frame_job import FrameJob
from mitsplat.dataset.records import manifest
from mitsplat.dataset.records.manifest import Manifest
from mitsplat.dataset.records.record_schema import read_content
from mitsplat.dataset.write import write_dataset
from mitsplat.engine import pool
from mitsplat.engine.answers import FrameError
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.formats.format import Catalogue
from mitsplat.formats.yolo import data_yaml
from mitsplat.frames.layer_sheet import layer_sheet
from mitsplat.labels.labels import Labels
from mitsplat.labels.overlay import OPACITY, class_colour, draw_labels
from mitsplat.runtime import device as devices
from mitsplat.runtime.device import Device, Gpu
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.storage.files import SPLITS
from tests.manifests import records_of
from tests.synthetic import render, settle

PARSE_LINE = manifest.parse_line


@dataclass(frozen=True)
class RenderUntil:
    """Renderer that acts as :func:`render` but raises an exception at one frame."""

    index: int
    error: type[BaseException]

    def __call__(self, scene, index, *, layout):
        if index == self.index:
            raise self.error("stopped")
        return render(scene, index, layout=layout)


@pytest.fixture
def scene(scene_data, write_scene):
    scene_data["output"]["formats"] = ["yolo", "coco", "exr"]
    return load_scene(write_scene(scene_data))


def write(scene, out, **options):
    return write_dataset(scene, out, **{"render": render, "settle": settle, **options})


def contents(root, *, without=("timings.jsonl", "runs.jsonl", ".lock")):
    """Return the SHA-256 of every file that must not depend on how the dataset was made."""
    files = (path for path in sorted(root.rglob("*")) if path.is_file() and path.name not in without)
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def undisturbed(scene, tmp_path):
    write(scene, tmp_path / "undisturbed")
    return contents(tmp_path / "undisturbed")


class TestContent:
    def test_a_seed_may_have_any_number_of_bits(self, scene, tmp_path):
        out = write(load_scene(scene.path, overrides={"seed": 2**70}), tmp_path / "out", frames=1).path
        assert read_content(out)["scene"]["seed"] == 2**70

    def test_every_frame_has_its_files_and_a_line(self, scene, tmp_path):
        told = []
        summary = write(scene, tmp_path / "out", progress=lambda *event: told.append(event))
        assert (summary.frames, summary.rendered) == (12, 12)
        assert summary.images == {"train": 8, "val": 4}
        assert summary.contact_sheet.is_file()
        assert told[0] == (0, 12, "starting")
        assert told[-1] == (12, 12, "frame 11")
        assert sum("settling layout" in text for *_, text in told) == 3
        records = records_of(tmp_path / "out")
        assert [record["index"] for record in records] == list(range(12))
        for record in records:
            assert len(record["files"]) == 3
            assert record["rest"]["refused"] == ["too deep"]
            for file, digest in record["files"].items():
                assert hashlib.sha256((tmp_path / "out" / file).read_bytes()).hexdigest() == digest
        timings = [json.loads(line) for line in (tmp_path / "out/timings.jsonl").read_text().splitlines()]
        assert all(set(line) == {"index", "march", "settle", "write"} for line in timings)

    def test_the_manifest_is_read_once_to_open_and_once_to_end(self, scene, tmp_path, monkeypatch):
        """The number of formats does not matter. Reading and hashing take most of the time at the end of a run."""
        read = []
        monkeypatch.setattr(manifest, "parse_line", lambda line: read.append(1) or PARSE_LINE(line))
        write(scene, tmp_path / "out")
        assert len(read) == 12
        next((tmp_path / "out/images").rglob("000005.png")).unlink()
        read.clear()
        write(scene, tmp_path / "out")
        assert len(read) == 24

    def test_views_of_a_layout_share_their_split(self, scene, tmp_path):
        write(scene, tmp_path / "out")
        splits = {}
        for record in Manifest(tmp_path / "out/manifest.jsonl"):
            splits.setdefault(record["layout"], set()).add(record["split"])
        assert all(len(found) == 1 for found in splits.values())
        assert {split for found in splits.values() for split in found} == set(SPLITS[:2])

    def test_images_are_the_pixels_that_were_rendered(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        stored = cv2.imread(str(next((tmp_path / "out/images").rglob("000000.png"))))
        expected = render(scene, 0, layout=settle(scene, 0, progress=print)).image
        np.testing.assert_array_equal(cv2.cvtColor(stored, cv2.COLOR_BGR2RGB), expected)

    def test_data_yaml_has_relative_paths_of_splits(self, scene, tmp_path):
        write(scene, tmp_path / "out")
        data = YAML(typ="safe").load(tmp_path / "out/data.yaml")
        assert data == {"train": "images/train", "val": "images/val", "names": {0: "bolt", 1: "nut"}}
        assert [path.name for path in (tmp_path / "out").glob("*.y*ml")] == ["data.yaml"]

    def test_data_yaml_handles_one_split_and_quotes_class_names(self):
        data = YAML(typ="safe").load(data_yaml(["no", "12", 'a "b": c'], ["train"]))
        assert data["val"] == "images/train"
        assert data["names"] == {0: "no", 1: "12", 2: 'a "b": c'}

    def test_an_image_without_instances_has_an_empty_label(self, scene, tmp_path):
        def empty(scene, index, *, layout):
            return replace(render(scene, index, layout=layout), labels=Labels(64, 48, (), {"hidden": 3}))

        summary = write(scene, tmp_path / "out", frames=1, render=empty)
        assert (tmp_path / "out/labels/train/000000.txt").read_text() == ""
        assert (summary.instances, summary.dropped) == ({}, {"hidden": 3})

    def test_coco_reads_back_the_masks(self, scene, tmp_path, capsys):
        write(scene, tmp_path / "out")
        for split in SPLITS[:2]:
            coco = COCO(tmp_path / f"out/annotations/instances_{split}.json")
            records = {record["index"]: record for record in Manifest(tmp_path / "out/manifest.jsonl")}
            assert sorted(coco.imgs) == [index for index, record in records.items() if record["split"] == split]
            for index, image in coco.imgs.items():
                assert (tmp_path / f"out/images/{split}" / image["file_name"]).is_file()
                labels = Labels.from_json(records[index]["labels"])
                annotations = coco.imgToAnns[index]
                for annotation, entry in zip(annotations, labels.instances, strict=True):
                    x, y, width, height = annotation["bbox"]
                    mask = coco.annToMask(annotation)
                    np.testing.assert_array_equal(mask[y : y + height, x : x + width], entry.mask)
                    assert mask.sum() == annotation["area"] == entry.area
                    assert coco.cats[annotation["category_id"]]["name"] == entry.class_name
        capsys.readouterr()

    def test_exr_holds_every_layer(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        frame = render(scene, 0, layout=settle(scene, 0, progress=print))
        with OpenEXR.File(str(tmp_path / "out/layers/train/000000.exr"), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
        single = {"R", "G", "B", "A", "Z", "instance", "proxy_instance"}
        colours = {f"{layer}.{axis}" for layer in ("light", "captured", "highlight") for axis in "RGB"}
        assert set(channels) == single | colours | {f"normal.{axis}" for axis in "XYZ"}
        np.testing.assert_array_equal(channels["R"], frame.rgb[..., 0])
        np.testing.assert_array_equal(channels["normal.Y"], frame.layers.normal[..., 1])
        np.testing.assert_array_equal(channels["instance"], frame.instance)
        assert channels["instance"].dtype == np.uint32

    def test_images_can_be_jpeg_files(self, scene_data, write_scene, tmp_path):
        scene_data["output"]["image"] = "jpg"
        write(load_scene(write_scene(scene_data)), tmp_path / "out", frames=1)
        assert (tmp_path / "out/images/train/000000.jpg").read_bytes().startswith(b"\xff\xd8")

    @pytest.mark.parametrize(("light", "number"), [("uniform", 1), ("scene", 0)])
    def test_a_scene_without_lights_is_reported_once(self, light, number, scene_data, write_scene, tmp_path, caplog):
        del scene_data["lights"]
        scene = load_scene(write_scene(scene_data))
        assets = tuple(replace(asset, capture_light=light) for asset in scene.assets)
        write_dataset(replace(scene, assets=assets), tmp_path / "data", workers=1, render=render, settle=settle)
        assert sum("lights: no light is in the scene" in text for text in caplog.messages) == number

    def test_the_scene_file_is_stored(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        assert (tmp_path / "out/scene/scene.yaml").read_bytes() == scene.path.read_bytes()
        assert json.loads((tmp_path / "out/dataset.json").read_bytes())["scene"]["seed"] == 7


class TestSameBytes:
    def test_one_and_two_workers_make_the_same_bytes(self, scene, tmp_path, undisturbed):
        write(scene, tmp_path / "out", workers=2)
        assert contents(tmp_path / "out") == undisturbed

    @pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
    def test_a_run_stopped_in_a_frame_resumes_to_the_same_bytes(self, scene, tmp_path, undisturbed, error):
        out = tmp_path / "out"
        with pytest.raises(error):
            write(scene, out, render=RenderUntil(5, error))
        assert len(Manifest(out / "manifest.jsonl")) == 5
        assert write(scene, out).rendered == 7
        assert contents(out) == undisturbed

    @pytest.mark.extended
    def test_a_failed_worker_keeps_finished_frames(self, scene, tmp_path, undisturbed):
        out = tmp_path / "out"
        with pytest.raises(FrameError, match="frame 5 failed"):
            write(scene, out, render=RenderUntil(5, RuntimeError), workers=2)
        kept = len(Manifest(out / "manifest.jsonl"))
        assert kept >= 1
        assert write(scene, out).rendered == 12 - kept
        assert contents(out) == undisturbed

    def test_a_run_stopped_between_image_and_label_resumes_to_the_same_bytes(
        self, scene, tmp_path, undisturbed, monkeypatch
    ):
        out = tmp_path / "out"

        def fail(*args):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch, pytest.raises(MissingResourceError, match=r"No space .*: free disk space"):
            patch.setattr("mitsplat.formats.yolo.yolo_lines", fail)
            write(scene, out)
        assert (out / "images/train/000000.png").is_file()
        assert not list(out.rglob("*.txt"))
        assert not list(out.rglob(".*.part"))
        assert write(scene, out).rendered == 12
        assert contents(out) == undisturbed

    @pytest.mark.parametrize("torn", [1, 40, 300])
    def test_incomplete_last_lines_resume_to_the_same_bytes(self, scene, tmp_path, undisturbed, torn):
        out = tmp_path / "out"
        write(scene, out, frames=6)
        for name in ("manifest.jsonl", "timings.jsonl"):
            lines = (out / name).read_bytes().splitlines(keepends=True)
            (out / name).write_bytes(b"".join(lines[:-1]) + lines[-1][: min(torn, len(lines[-1]) - 1)])
        assert write(scene, out).rendered == 7
        assert contents(out) == undisturbed
        for line in (out / "timings.jsonl").read_text().splitlines():
            json.loads(line)

    def test_a_frame_that_lost_a_file_is_made_again(self, scene, tmp_path, undisturbed):
        out = tmp_path / "out"
        write(scene, out)
        next(out.rglob("000003.txt")).unlink()
        assert write(scene, out).rendered == 1
        assert contents(out) == undisturbed

    def test_two_runs_make_the_same_bytes_as_one(self, scene, tmp_path, undisturbed):
        write(scene, tmp_path / "out", frames=5)
        summary = write(scene, tmp_path / "out")
        assert (summary.frames, summary.rendered) == (12, 7)
        assert contents(tmp_path / "out") == undisturbed

    def test_added_layouts_make_the_same_bytes_as_one_run(self, scene, tmp_path, undisturbed):
        out = tmp_path / "out"
        write(load_scene(scene.path, overrides={"output.layouts": 2, "output.formats": scene.spec.output.formats}), out)
        assert write(scene, out).rendered == 4
        assert contents(out) == undisturbed

    def test_partial_files_are_removed_on_resume(self, scene, tmp_path, undisturbed):
        out = tmp_path / "out"
        write(scene, out, frames=2)
        (out / "images/train/.000002.png.123.part").write_bytes(b"half")
        write(scene, out)
        assert contents(out) == undisturbed

    def test_views_of_a_layout_get_the_same_object(self, scene, tmp_path):
        seen = []

        def watch(scene, index, *, layout):
            seen.append(layout)
            return render(scene, index, layout=layout)

        write(scene, tmp_path / "out", render=watch)
        assert len(set(map(id, seen))) == 3

    def test_settled_layouts_are_not_settled_again(self, scene, tmp_path):
        def never(scene, index, *, progress):
            raise AssertionError(index)

        write(scene, tmp_path / "out", frames=3)
        write(scene, tmp_path / "out", frames=4, settle=never)

    def test_settling_ahead_skips_layouts_that_exist_or_are_being_settled(self, scene, tmp_path, monkeypatch):
        """Layout 1 exists, and another process settles layout 2."""

        def lock(file, operation, length, layout):
            assert (operation, length) == (fcntl.LOCK_EX | fcntl.LOCK_NB, 1)
            if layout == 2:
                raise BlockingIOError

        layouts = tmp_path / "layouts"
        layouts.mkdir()
        (layouts / "0001.json").touch()
        monkeypatch.setattr(fcntl, "lockf", lock)
        job = FrameJob(scene, Catalogue((), (), (), ()), tmp_path, render, settle)
        job.settle_ahead([0, 1, 2])
        assert sorted(path.name for path in layouts.glob("*.json")) == ["0000.json", "0001.json"]
        assert job.load_layout((layouts / "0000.json").read_bytes()).index == 0


def never_render(scene, index, *, layout):
    raise AssertionError("rendered although the output was refused")


@pytest.mark.parametrize(
    ("before", "now", "told"),
    [
        (["box", "can"], ["box", "can"], None),
        (["box", "can"], ["box", "bottle", "can"], ("assets[1]", '"can"', '"bottle"')),
        (["box"], ["box", "can"], ("assets[1]", "null", '"can"')),
        ([{"name": "box", "size": [1, 2]}], [{"name": "box", "size": [1, 3]}], ("assets[0].size[1]", "2", "3")),
        ([], [None], ("assets", "[]", "[null]")),
    ],
)
def test_first_difference_names_key_and_values(before, now, told):
    assert folder.first_difference({"assets": before}, {"assets": now}) == told


class TestRefusals:
    def refuse(self, scene, out, message, **options):
        with pytest.raises(InputError, match=message):
            write(scene, out, render=never_render, **options)

    def test_resuming_with_another_seed_is_refused(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        other = load_scene(scene.path, overrides={"seed": 8})
        self.refuse(other, tmp_path / "out", r"cannot be resumed: scene\.seed was 7 and is 8")

    def test_resuming_with_another_size_is_refused(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        other = load_scene(scene.path, overrides={"output.width": 80})
        self.refuse(other, tmp_path / "out", r"scene\.output\.width was 64 and is 80")

    def test_resuming_with_another_table_names_its_key(self, scene, scene_data, write_scene, tmp_path):
        """The hash of its mesh, which differs too, would not say what to change back."""
        write(scene, tmp_path / "out", frames=1)
        scene_data["shapes"][0]["box"]["size"] = [1.5, 1, 0.1]
        other = load_scene(write_scene(scene_data))
        self.refuse(other, tmp_path / "out", r"scene\.shapes\[0\]\.box\.size\[0\] was 1\.0 and is 1\.5")

    def test_resuming_with_a_changed_asset_is_refused(self, scene, scene_data, write_scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        shutil.rmtree(tmp_path / "assets/nut")
        shutil.copytree(tmp_path / "assets/bolt", tmp_path / "assets/nut")
        manual = tmp_path / "assets/nut/asset.yaml"
        manual.write_text(manual.read_text().replace("bolt", "nut"))
        self.refuse(load_scene(scene.path), tmp_path / "out", r"inputs\.objects\[0\]\.splats was")

    def test_overwriting_replaces_all_images(self, scene, tmp_path):
        out = tmp_path / "out"
        write(scene, out)
        other = load_scene(scene.path, overrides={"seed": 8, "output.formats": ["yolo"]})
        assert write(other, out, frames=2, overwrite=True).frames == 2
        assert len(list(out.rglob("*.png"))) == 2
        assert not (out / "annotations").exists()

    @pytest.mark.parametrize("overwrite", [False, True])
    @pytest.mark.parametrize("files", [["thesis.tex"], ["images/train/1.png", "labels/train/1.txt", "data.yaml"]])
    def test_a_folder_with_other_files_is_refused_and_unchanged(self, scene, tmp_path, files, overwrite):
        out = tmp_path / "out"
        for file in files:
            (out / file).parent.mkdir(parents=True, exist_ok=True)
            (out / file).write_text("years of work")
        before = contents(out, without=())
        self.refuse(scene, out, "must be empty or a dataset of mitsplat", overwrite=overwrite)
        (out / "dataset.json").write_text("[]")
        self.refuse(scene, out, "must be empty or a dataset of mitsplat", overwrite=overwrite)
        (out / "dataset.json").write_text("{")
        self.refuse(scene, out, r"dataset\.json: cannot be read", overwrite=overwrite)
        (out / "dataset.json").unlink()
        assert contents(out, without=()) == before

    def test_a_second_writer_is_refused_by_process_and_host(self, scene, tmp_path):
        out = tmp_path / "out"

        def second(*args, **options):
            self.refuse(
                scene, out, rf"being written by another run \(process {os.getpid()} on {socket.gethostname()}\)"
            )
            return render(*args, **options)

        write(scene, out, frames=1, render=second)

    def test_a_file_in_place_of_the_folder_is_refused(self, scene, tmp_path):
        (tmp_path / "out").write_text("")
        self.refuse(scene, tmp_path / "out", r"out: must be a folder, and not below a file \(got a file\)")
        self.refuse(scene, tmp_path / "out/deeper", "deeper: must be a folder, and not below a file")

    def test_a_read_only_folder_is_refused(self, scene, tmp_path, monkeypatch):
        """The refusal is simulated, because the tests may run as root, who may write anywhere."""

        def denied(*args, **options):
            raise PermissionError(13, "Permission denied", "out")

        monkeypatch.setattr(folder, "write_text", denied)
        self.refuse(scene, tmp_path / "out", r"out: cannot be written or read \(Permission denied\)")

    def test_a_damaged_manifest_is_refused_by_its_line(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=3)
        manifest = tmp_path / "out/manifest.jsonl"
        lines = manifest.read_text().splitlines()
        manifest.write_text("\n".join([lines[0], "{", lines[2], ""]))
        self.refuse(scene, tmp_path / "out", r"manifest\.jsonl:2: must be the record of a frame")

    @pytest.mark.parametrize("frames", [0, 13])
    def test_a_number_of_frames_out_of_range_is_refused(self, scene, tmp_path, frames):
        self.refuse(scene, tmp_path / "out", rf"frames must be between 1 and 12, .* \(got {frames}\)", frames=frames)
        assert not (tmp_path / "out").exists()


class TestDevice:
    def test_the_device_of_each_run_is_recorded(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        write(scene, tmp_path / "out", frames=2, device="cpu")
        assert json.loads((tmp_path / "out/dataset.json").read_bytes())["device"] == "cpu"
        runs = [json.loads(line) for line in (tmp_path / "out/runs.jsonl").read_text().splitlines()]
        assert [(run["device"], run.get("gpus")) for run in runs] == [("cpu", None)] * 2

    def test_a_gpu_is_recorded_with_its_name(self, scene, tmp_path, monkeypatch):
        """The test needs no GPU: frames are drawn, and the current device of the process is mocked."""
        gpus = tuple(Gpu(name, 80 * 2**30, number, "", "") for number, name in enumerate(("One", "Two")))
        monkeypatch.setattr(pool, "current_device", lambda: Device("cuda", gpus))
        write(scene, tmp_path / "out", frames=1, device=Device("cuda", gpus))
        assert json.loads((tmp_path / "out/dataset.json").read_bytes())["device"] == "cuda"
        (run,) = map(json.loads, (tmp_path / "out/runs.jsonl").read_text().splitlines())
        assert (run["device"], run["gpus"]) == ("cuda", ["One", "Two"])
        assert read_content(tmp_path / "out")["device"] == "cuda"

    def begun_on(self, out, device):
        """Change or remove the device that a dataset records."""
        content = json.loads((out / "dataset.json").read_bytes())
        del content["device"]
        (out / "dataset.json").write_text(json.dumps(content | ({"device": device} if device else {}), indent=1))

    def test_resuming_on_another_device_is_refused_unless_allowed(self, scene, tmp_path, undisturbed):
        out = tmp_path / "out"
        write(scene, out, frames=2)
        self.begun_on(out, "cuda")
        with pytest.raises(InputError) as refused:
            write(scene, out, render=never_render)
        assert str(refused.value) == (
            f"{out}: cannot be resumed on the device cpu: it was started on cuda, whose pictures differ a little: give "
            "--device cuda, or --any-device for frames of both"
        )
        assert write(scene, out, any_device=True).rendered == 10
        assert json.loads((out / "dataset.json").read_bytes())["device"] == "cuda"  # device at the start
        assert {**contents(out), "dataset.json": ""} == {**undisturbed, "dataset.json": ""}

    def test_a_dataset_without_a_device_counts_as_cpu(self, scene, tmp_path):
        out = tmp_path / "out"
        write(scene, out, frames=2)
        self.begun_on(out, None)
        assert read_content(out)["scene"]["seed"] == 7
        assert write(scene, out).rendered == 10

    def test_a_dataset_of_an_unknown_device_is_refused(self, scene, tmp_path):
        write(scene, tmp_path / "out", frames=1)
        self.begun_on(tmp_path / "out", "tpu")
        with pytest.raises(InputError, match=r"must be a dataset of this version of mitsplat \(dataset.json: device: "):
            read_content(tmp_path / "out")

    @pytest.mark.extended
    def test_workers_use_the_device_of_their_caller(self, scene, tmp_path):
        """Each worker records its device. Earlier versions fell back to LLVM for any device of the caller."""
        write(scene, tmp_path / "out", render=Told(tmp_path), workers=2, device="cpu")
        assert {path.read_text() for path in tmp_path.glob("variant-*")} == {"llvm_ad_rgb"}

    @pytest.mark.parametrize("device", ["cuda", "cuda:all", "tpu"])
    def test_a_missing_device_is_refused_before_rendering(self, scene, tmp_path, device, monkeypatch):
        monkeypatch.setattr(devices, "visible_gpus", lambda: devices.MissingPrerequisite("there is none", "buy one"))
        words = (
            "device must be cpu, cuda"
            if device == "tpu"
            else f"{device} cannot be used, because there is none: buy one, or"
        )
        with pytest.raises((InputError, MissingResourceError), match=words):
            write(scene, tmp_path / "out", render=never_render, device=device)
        assert not (tmp_path / "out").exists()

    def test_auto_reports_the_chosen_device(self, scene, tmp_path, monkeypatch):
        monkeypatch.setattr(devices, "visible_gpus", lambda: devices.MissingPrerequisite("there is none", "buy one"))
        told = []
        write(scene, tmp_path / "out", frames=1, device="auto", progress=lambda *event: told.append(event[2]))
        assert told[1] == "device cpu: there is none"


@dataclass(frozen=True)
class Told:
    """Renderer that acts as :func:`render` and writes Mitsuba's variant to a file."""

    folder: Path

    def __call__(self, scene, index, *, layout):
        (self.folder / f"variant-{index}").write_text(str(mi.variant()))
        return render(scene, index, layout=layout)


class TestPictures:
    def test_masks_are_tinted_with_the_class_colour(self, scene):
        labels = render(scene, 0, layout=settle(scene, 0, progress=print)).labels
        entry = replace(labels.instances[0], box=(20, 20, 80, 80), mask=np.ones((60, 60), dtype=bool))
        image = np.zeros((100, 100, 3), np.uint8)
        drawn = draw_labels(image, replace(labels, width=100, height=100, instances=(entry,)))
        assert not image.any()
        np.testing.assert_array_equal(drawn[50, 50], np.rint(np.multiply(OPACITY, class_colour(entry.class_index))))

    def test_colours_of_many_classes_differ(self):
        assert len({class_colour(i) for i in range(64)}) == 64

    def test_layers_lie_side_by_side(self, scene):
        frame = render(scene, 0, layout=settle(scene, 0, progress=print))
        sheet = layer_sheet(frame)
        height, width = 48 + 24 + 6, 64 + 6
        assert sheet.shape == (2 * height - 6, 3 * width - 6, 3)
        tiles = [sheet[row : row + 48, left : left + 64] for row in (0, height) for left in (0, width, 2 * width)]
        np.testing.assert_array_equal(tiles[0], frame.image)
        np.testing.assert_array_equal(tiles[2].any(axis=-1), frame.instance > 0)
        np.testing.assert_array_equal(tiles[3].any(axis=-1), frame.depth > 0)
        assert (tiles[4] == 128).all() and not tiles[5].any()

    def test_the_sheet_shows_a_spread_of_frames(self, scene, tmp_path):
        summary = write(scene, tmp_path / "out")
        assert cv2.imread(str(summary.contact_sheet)).shape[1] == 4 * 480 + 3 * 6
