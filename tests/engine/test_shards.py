"""Datasets made in shards, on Ray or with other numbers of workers: the same bytes as from one run."""

import errno
import fcntl
import json
import os
import pickle
import re
import shutil
import sys
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mitsplat.dataset.frame_job import FrameJob, RemoteFrameJob
from mitsplat.dataset.records.manifest import Manifest, encode_line
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.engine import ray as cluster
from mitsplat.engine.answers import LostWorkersError
from mitsplat.engine.ray import Cluster
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.formats.registry import Catalogue
from mitsplat.frames.frame import Renderer
from mitsplat.progress import discard_note
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.spec.scene_spec import FORMATS
from tests.cli.typed import run
from tests.conftest import BOTH, nut_and_bolt, small_scene
from tests.dataset.test_write import contents, render, settle, write
from tests.engine.faults import KilledOnce


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    return small_scene(folder, nut_and_bolt(), BOTH, layouts=3, views=4, formats=list(FORMATS))


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    write(scene, folder)
    return contents(folder)


def write_shards(scene, folder, count, **options):
    shards = [folder / f"{number}" for number in range(1, count + 1)]
    for number, shard in enumerate(shards, start=1):
        write(scene, shard, shard=Shard(number, count), **options)
    return shards


class TestSameBytes:
    @pytest.mark.extended
    def test_more_workers_than_layouts_make_the_same_bytes(self, scene, tmp_path, whole):
        write(scene, tmp_path / "out", workers=4)
        assert contents(tmp_path / "out") == whole

    @pytest.mark.parametrize("count", [1, 2, 3, 5])
    def test_shards_merged_in_any_order_make_the_same_bytes(self, scene, tmp_path, whole, count):
        shards = write_shards(scene, tmp_path / "shards", count)
        assert merge_shards(shards[::-1], tmp_path / "out").frames == 12
        assert contents(tmp_path / "out") == whole
        assert len((tmp_path / "out/timings.jsonl").read_text().splitlines()) == 12

    def test_a_stopped_merge_resumes_to_the_same_bytes(self, scene, tmp_path, whole):
        shards = write_shards(scene, tmp_path / "shards", 3)

        def stop(done, total, text):
            if done == 5:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            merge_shards(shards, tmp_path / "out", progress=stop)
        assert len(Manifest(tmp_path / "out/manifest.jsonl")) == 5
        merge_shards(shards, tmp_path / "out")
        assert contents(tmp_path / "out") == whole

    def test_a_shard_can_be_resumed(self, scene, tmp_path, whole):
        shards = write_shards(scene, tmp_path / "shards", 2)
        next(shards[1].rglob("000011.txt")).unlink()
        assert write(scene, shards[1], shard=Shard(2, 2)).rendered == 1
        merge_shards(shards, tmp_path / "out")
        assert contents(tmp_path / "out") == whole

    @pytest.mark.parametrize("locked", [True, False])
    def test_read_only_shards_merge_to_the_same_bytes(self, scene, tmp_path, whole, locked, monkeypatch):
        """Shards may be on a read-only share. A run on another machine that writes a shard holds its lock."""
        shards = write_shards(scene, tmp_path / "shards", 2)
        if not locked:
            for shard in shards:
                (shard / ".lock").unlink()
        opened = Path.open

        def read_only(path, mode="r", *args, **kwargs):
            if tmp_path / "shards" in path.parents and set(mode) & set("wax+"):
                raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
            return opened(path, mode, *args, **kwargs)

        monkeypatch.setattr(Path, "open", read_only)
        merge_shards(shards, tmp_path / "out")
        assert contents(tmp_path / "out") == whole
        if locked:
            with opened(shards[0] / ".lock", "a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                with pytest.raises(InputError, match="is being written by another run"):
                    merge_shards(shards, tmp_path / "again")


@pytest.mark.parametrize(("total", "views", "count"), [(12, 4, 3), (12, 4, 5), (10, 4, 3), (1, 4, 1), (1000, 1, 7)])
def test_shards_divide_the_frames(total, views, count):
    parts = [list(Shard(number, count).frames(total, views)) for number in range(1, count + 1)]
    assert list(chain(*parts)) == list(range(total))
    assert all(parts)
    if -(-total // views) >= count:  # shards of whole layouts
        assert all(part[0] % views == 0 for part in parts)


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "a/b", "1/0", "-1/2", ""])
def test_an_invalid_shard_is_refused(text):
    with pytest.raises(InputError, match=r"a shard must be I/N"):
        Shard.parse(text)


class TestRefusals:
    @pytest.fixture
    def shards(self, scene, tmp_path):
        return write_shards(scene, tmp_path / "shards", 3)

    def refuse(self, shards, out, message):
        with pytest.raises(InputError, match=message):
            merge_shards(shards, out)

    def test_a_missing_or_repeated_shard_is_refused(self, shards, tmp_path):
        self.refuse(shards[:2], tmp_path / "out", r"each of the 3 shards must be given once \(missing: \[3\]\)")
        self.refuse([*shards, shards[0]], tmp_path / "out", "each shard must be given once")
        assert not (tmp_path / "out").exists()

    def test_an_unfinished_shard_is_refused(self, shards, tmp_path):
        manifest = shards[1] / "manifest.jsonl"
        manifest.write_bytes(b"".join(manifest.read_bytes().splitlines(keepends=True)[:-1]))
        self.refuse(
            shards, tmp_path / "out", r"1 of 12 frames are in no shard, the first is 7: finish the shards first"
        )

    def test_a_damaged_file_is_refused(self, shards, tmp_path):
        picture = next((shards[1] / "images").rglob("000005.png"))
        data = bytearray(picture.read_bytes())
        data[-20] ^= 1
        picture.write_bytes(data)
        self.refuse(shards, tmp_path / "out", rf"{picture}: must have the SHA-256 [0-9a-f]+, as its manifest states")
        assert not (tmp_path / "out" / picture.relative_to(shards[1])).exists()

    def test_a_damaged_manifest_is_refused(self, shards, tmp_path):
        manifest = shards[2] / "manifest.jsonl"
        data = bytearray(manifest.read_bytes())
        data[100] ^= 1
        manifest.write_bytes(data)
        self.refuse(shards, tmp_path / "out", r"manifest\.jsonl:1: must be the record of a frame \(its checksum")

    def test_a_shard_of_another_scene_is_refused(self, scene, shards, tmp_path):
        other = load_scene(scene.path, overrides={"seed": 8})
        write(other, shards[1], shard=Shard(2, 3), overwrite=True)
        self.refuse(shards, tmp_path / "out", r"are not of one dataset: scene\.seed is 0 in the first, 8 in the second")

    def test_a_shard_of_another_device_is_refused(self, shards, tmp_path):
        file = shards[1] / "dataset.json"
        file.write_text(file.read_text().replace('"device": "cpu"', '"device": "cuda"'))
        self.refuse(
            shards, tmp_path / "out", 'are not of one dataset: device is "cpu" in the first, "cuda" in the second'
        )

    def test_a_shard_of_another_division_is_refused(self, scene, shards, tmp_path):
        write(scene, tmp_path / "whole")
        self.refuse([*shards, tmp_path / "whole"], tmp_path / "out", "must be of one division of one dataset")
        with pytest.raises(InputError, match="it was shard 1/3 of 12 images and is shard 2/3 of 12"):
            write(scene, shards[0], shard=Shard(2, 3))
        with pytest.raises(InputError, match="it was shard 1/3 of 12 images and is a whole dataset"):
            write(scene, shards[0])

    def test_a_layout_that_differs_between_shards_is_refused(self, shards, tmp_path):
        shutil.copy(shards[0] / "layouts/0000.json", shards[1] / "layouts/0000.json")
        with (shards[1] / "layouts/0000.json").open("a") as file:
            file.write(" ")
        self.refuse(shards, tmp_path / "out", "must be the same: the shards settled one layout differently")

    def test_a_manifest_that_names_files_outside_is_refused(self, shards, tmp_path):
        """The manifest refers to files outside of the folder and has a valid checksum."""
        manifest = shards[0] / "manifest.jsonl"
        records = list(Manifest(manifest))
        (tmp_path / "secret").write_text("")
        for name in ("../../secret", "../1/images/train/000000.png", "/etc/passwd"):
            records[0]["files"] = {name: "0" * 64}
            manifest.write_bytes(b"".join(map(encode_line, records)))
            self.refuse(
                shards,
                tmp_path / "out",
                r"file names must be relative to the dataset and lie in its folder \(got '" + name,
            )

    def test_a_shard_as_output_folder_is_refused(self, shards):
        self.refuse(shards, shards[0], "must not be one of the shards")

    def test_a_shard_that_is_being_written_is_refused(self, scene, shards, tmp_path):
        def merge(*args, **options):
            self.refuse(shards, tmp_path / "out", f"is being written by another run \\(process {os.getpid()}")
            return render(*args, **options)

        next(shards[1].rglob("000006.txt")).unlink()
        write(scene, shards[1], shard=Shard(2, 3), render=merge)


def test_the_merge_command_merges_and_logs(scene, tmp_path, whole, capsys):
    shards = write_shards(scene, tmp_path / "shards", 2)
    assert run("merge", *shards, "-o", tmp_path / "out", "--json") == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"dataset: {tmp_path / 'out'} (")
    events = [json.loads(line) for line in err.splitlines()]
    assert [event["event"] for event in events] == ["started", *["progress"] * 12, "finished"]
    assert contents(tmp_path / "out") == whole
    assert run("merge", shards[0], "-o", tmp_path / "other", "--json") == 2
    event = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert (event["event"], event["status"], event["error"]) == ("failed", 2, "InputError")
    assert event["message"].startswith("each of the 2 shards must be given once")


@pytest.fixture(scope="module")
def ray():
    """Start Ray on this machine with four CPUs, for any real number, and a custom resource."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'mitsplat[cluster]'")
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    ray.init("local", num_cpus=4, resources={"camera": 1}, include_dashboard=False, log_to_driver=False)
    yield ray
    ray.shutdown()
    del os.environ["PYTHONPATH"]


@pytest.mark.usefixtures("ray")
class TestRay:
    def test_a_run_resumed_on_ray_with_a_killed_worker_makes_the_same_bytes(self, scene, tmp_path, whole):
        """The run resumes on Ray, where a worker is killed. No layout is settled twice and no frame is lost."""
        told = []
        write(scene, tmp_path / "out", frames=3)
        options = {"render": KilledOnce(tmp_path, 6), "settle": partial(only_later, 1), "workers": None}
        progress = lambda *event: told.append(event)  # noqa: E731
        assert write(scene, tmp_path / "out", cluster=Cluster(), progress=progress, **options).rendered == 9
        assert any(text.startswith("the worker of frame 6 was lost") for *_, text in told)
        assert told[-1][:2] == (12, 12)
        assert contents(tmp_path / "out") == whole

    def test_a_ray_worker_without_memory_loses_no_frame(self, scene, tmp_path, whole):
        """The worker raises Dr.Jit's GPU out-of-memory error. Another one makes its frame, and no worker is added."""
        told = []
        write(
            scene,
            tmp_path / "out",
            cluster=Cluster(resources={"CPU": 1}),
            workers=None,
            render=ExhaustedOnce(tmp_path, 6),
            progress=lambda *event: told.append(event[2]),
        )
        assert "memory ran out in frame 6, which is repeated with 3 workers" in told
        assert contents(tmp_path / "out") == whole

    def test_an_input_error_of_a_ray_worker_keeps_its_sentence(self, scene, tmp_path):
        with pytest.raises(InputError, match=r"^no frame 5$"):
            write(scene, tmp_path / "out", cluster=Cluster(), workers=1, render=refuse_5)

    def test_ray_workers_reserve_the_stated_resources(self, scene, tmp_path):
        summary = write(scene, tmp_path / "out", frames=2, cluster=Cluster(resources={"camera": 1, "CPU": 1}))
        assert summary.rendered == 2
        with pytest.raises(MissingResourceError, match=r"no node of the Ray cluster has CPU=1, camera=2 for a worker"):
            write(scene, tmp_path / "other", cluster=Cluster(resources={"CPU": 1, "camera": 2}))


@dataclass(frozen=True)
class ExhaustedOnce:
    """Renderer that runs out of memory once, at one frame."""

    folder: Path
    index: int

    def __call__(self, scene, index, *, layout):
        mark = self.folder / "exhausted"
        if index == self.index and not mark.exists():
            mark.touch()
            raise RuntimeError("jit_malloc(): out of memory! Could not allocate 4 GiB of device memory.")
        return render(scene, index, layout=layout)


@pytest.mark.parametrize(
    ("resources", "device", "kind", "reserved"),
    [
        (None, None, "cpu", {"CPU": 2}),
        (None, "cpu", "cpu", {"CPU": 2}),
        (None, "cuda", "cuda", {"CPU": 1, "GPU": 0.125}),
        ({"CPU": 4}, None, "cpu", {"CPU": 4}),
        ({"GPU": 1}, None, "cuda", {"GPU": 1}),
        ({"GPU": 1}, "cuda", "cuda", {"GPU": 1}),
        ({"CPU": 4}, "cpu", "cpu", {"CPU": 4}),
    ],
)
def test_the_device_determines_the_reserved_resources(resources, device, kind, reserved):
    found, cluster = Cluster(resources=resources).on_device(device)
    assert (found.kind, cluster.resources) == (kind, reserved)


@pytest.mark.parametrize(
    ("resources", "device", "words"),
    [
        ({"CPU": 4.0}, "cuda", r"must include a GPU, such as GPU=0\.125, for the device cuda \(got CPU=4\)"),
        ({"CPU": 4, "GPU": 1}, "cpu", r"must not include a GPU for the device cpu \(got CPU=4,GPU=1\)"),
        (None, "cuda:1", r"device must be cpu or cuda on a cluster, because Ray assigns the GPUs \(got cuda:1\)"),
        (None, "auto", r"device must be cpu or cuda on a cluster, because Ray assigns the GPUs \(got auto\)"),
    ],
)
def test_devices_that_a_cluster_lacks_are_refused(scene, tmp_path, capsys, resources, device, words):
    with pytest.raises(InputError, match=words):
        write(scene, tmp_path / "out", cluster=Cluster(resources=resources), device=device)
    options = ["--resources", ",".join(f"{name}={amount}" for name, amount in resources.items())] if resources else []
    assert run("render", scene.path, "-o", tmp_path / "out", "--engine", "ray", "--device", device, *options) == 2
    assert re.search(words, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


class FakeRay:
    """Mock of the parts of Ray that describe machines."""

    def __init__(self, **nodes):
        self.alive, self.started = nodes, []

    def nodes(self):
        return [{"NodeID": name, "Alive": cpus > 0, "Resources": {"CPU": cpus}} for name, cpus in self.alive.items()]

    def is_initialized(self):
        return True

    def put(self, value):
        return value

    def remote(self, kind):
        start = SimpleNamespace(remote=lambda *arguments: self.started.append(arguments) or object())
        return SimpleNamespace(options=lambda **options: start)


@pytest.mark.parametrize(("resources", "threads"), [({"CPU": 4.0}, 4), ({"CPU": 0.5}, 1), ({"node": 1.0}, None)])
def test_a_ray_worker_has_a_thread_for_each_reserved_cpu(monkeypatch, resources, threads):
    ray = FakeRay(head=8.0)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(ray, "nodes", lambda: [{"NodeID": "a", "Alive": True, "Resources": {"CPU": 8.0, "node": 1.0}}])
    cluster._Actors(None, Cluster(resources=resources), 1).start()
    assert [arguments[1:] for arguments in ray.started] == [("cpu", threads)]
    used = []
    monkeypatch.setattr(cluster, "use_shared_device", lambda *device: used.append(device))
    monkeypatch.setattr(ray, "get", lambda job: SimpleNamespace(make=lambda frame, layout: frame), raising=False)
    assert cluster._Actor(["job"], "cpu", threads).make(3, "layout").result == 3
    assert used == [("cpu", threads)]


class DirectRay(FakeRay):
    """Mock of Ray whose actors answer at once in this process."""

    exceptions = SimpleNamespace(RayError=ConnectionError)

    def put(self, value):
        return SharedValue(value)

    def get(self, reference):
        return reference.value

    def kill(self, actor):
        pass

    def wait(self, references, **_):
        return references[:1], references[1:]

    def remote(self, kind):
        def method(function):
            return SimpleNamespace(
                remote=lambda *arguments: SharedValue(
                    function(*(one.value if isinstance(one, SharedValue) else one for one in arguments))
                )
            )

        def start(*arguments):
            actor = kind(*arguments)
            return SimpleNamespace(settle=method(actor.settle), make=method(actor.make))

        return SimpleNamespace(options=lambda **options: SimpleNamespace(remote=start))


@dataclass(frozen=True, eq=False)
class SharedValue:
    """Reference to a value in Ray's object store."""

    value: object


class FailingOnce:
    """Job whose layout can be settled at the second try."""

    settled = 0

    def cached_layout(self, layout):
        return None

    def settle(self, layout):
        self.settled += 1
        if self.settled == 1:
            raise MemoryError("no memory")
        return "layout"

    def make(self, index, layout):
        return index, layout


def test_a_layout_that_failed_on_ray_is_settled_again(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", DirectRay(head=4.0))
    monkeypatch.setattr(cluster, "use_shared_device", lambda *device: None)
    found = cluster.run_on_ray(FailingOnce(), {0: [0, 1]}, Cluster(resources={"CPU": 2.0}), note=discard_note)
    assert sorted(found) == [(0, "layout"), (1, "layout")]


def test_machines_that_join_are_reported_once(monkeypatch):
    ray, now = FakeRay(head=2.0, first=5.0), [0.0]
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(cluster.time, "monotonic", lambda: now[0])

    def free_slots(**nodes):
        ray.alive |= nodes
        now[0] += 10.0
        return pool.free_slots()

    pool = cluster._Actors(None, Cluster(resources={"CPU": 2.0}), None)
    assert (pool.room, free_slots()) == (3, 0)
    assert (free_slots(second=4.0), free_slots()) == (2, 0)
    assert free_slots(second=0.0, first=0.0) == 0  # lost workers are restarted there, so these are no new places
    assert free_slots(again=4.0) == 2
    few = pool = cluster._Actors(None, Cluster(resources={"CPU": 2.0}), 2)
    workers = [few.start(), few.start()]
    assert (few.room, free_slots(third=8.0)) == (2, 0)
    del few._actors[workers[0]]
    assert free_slots(fourth=8.0) == 1
    assert free_slots(**dict.fromkeys(ray.alive, 0.0)) == 0
    now[0] += cluster._MACHINE_TIMEOUT
    with pytest.raises(LostWorkersError, match=r"^no node .* CPU=2 for a worker any more; finished frames are kept"):
        free_slots()


@pytest.mark.parametrize(("address", "place"), [(None, "on this machine"), ("auto", "at 'auto'")])
def test_a_ray_that_does_not_start_is_reported(monkeypatch, address, place):
    class Late(FakeRay):
        def is_initialized(self):
            return False

        def init(self, **options):
            raise Exception("The node timed out.\nSee its log.")

    monkeypatch.setitem(sys.modules, "ray", Late())
    with pytest.raises(MissingResourceError, match=rf"^no Ray cluster {place}: The node timed out\.$"):
        cluster._Actors(None, Cluster(address), None)


def test_ray_starts_without_the_current_folder_of_the_caller(monkeypatch):
    """Ray would otherwise put this folder on the import path of its workers."""

    class Started(FakeRay):
        def is_initialized(self):
            return False

        def init(self, runtime_env, **options):
            self.environment = runtime_env["env_vars"], os.environ["PYTHONSAFEPATH"]
            self.content = list(Path(runtime_env["working_dir"]).iterdir())

    ray = Started(head=2.0)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    cluster._Actors(None, Cluster(resources={"CPU": 2.0}), None)
    assert (ray.environment, ray.content) == (({"PYTHONSAFEPATH": "1"}, "1"), [])
    assert "PYTHONSAFEPATH" not in os.environ


def test_images_of_lights_are_sent_with_the_job(scene_data, write_scene, tmp_path):
    """Remote workers open no path of the caller's machine: the folder has been removed."""
    cv2.imwrite(str(tmp_path / "sky.png"), np.full((4, 8, 3), 90, dtype=np.uint8))
    scene_data["lights"] = [{"kind": "environment", "image": "sky.png"}]
    home = load_scene(write_scene(scene_data))
    image = home.images["sky.png"].read_bytes()
    job = RemoteFrameJob(FrameJob(home, Catalogue.of(home), tmp_path / "out", render, settle))
    sent = pickle.dumps(job)
    for path in (*home.path.parent.glob("*.yaml"), tmp_path / "sky.png"):
        path.unlink()
    there = pickle.loads(sent)
    frame = there.make(0, there.settle(0))
    assert frame.record["lights"][0]["image"] == "sky.png"
    (copy,) = there.job.scene.images.values()
    assert copy.read_bytes() == image and tmp_path not in copy.parents
    renderer = Renderer(there.job.scene, quality="fast")
    emitter = renderer.scene_builder._emitter(plan_frame(there.job.scene, 0).lights[0], False)
    assert renderer.scene_builder._latest["environment map"][0] == str(copy)
    assert copy.name in str(emitter)
    scene = there.job.scene
    there.make(1, there.settle(0))
    assert there.job.scene is scene  # the renderer identifies its uploads by the scene object
    del there, renderer, emitter
    assert not copy.exists()


def only_later(first, scene, index, *, progress):
    """Settle a layout, and fail for layouts that were settled before."""
    assert index >= first
    return settle(scene, index, progress=progress)


def refuse_5(scene, index, *, layout):
    if index == 5:
        raise InputError("no frame 5")
    return render(scene, index, layout=layout)


@pytest.mark.parametrize("text", ["CPU", "CPU=0", "=3", "CPU=x", "CPU=nan", "CPU=2,,", "CPU=1_0", "CPU=٣"])
def test_invalid_resources_are_refused(text):
    with pytest.raises(InputError, match=r"resources must be NAME=AMOUNT"):
        Cluster.parse_resources(text)


def test_missing_ray_is_named(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingResourceError, match=r"needs Ray: pip install 'mitsplat\[cluster\]'"):
        write(scene, tmp_path / "out", cluster=Cluster())
