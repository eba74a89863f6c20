"""Trainings of a few steps on small images, and input refused before the start."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from mitsplat.cli import app
from mitsplat.detector import libraries
from mitsplat.detector.detector_evaluation import coco_truth, evaluate_detector, write_evaluation
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.libraries import check_weights, load_weights
from mitsplat.detector.mix import plan_images
from mitsplat.detector.scores import DetectionMatches
from mitsplat.detector.train_settings import TrainSettings
from mitsplat.detector.training import RUN_FILE, Run, open_run, read_sets, train_detector, write_data
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.storage.content_hash import file_hash
from tests.conftest import contents
from tests.detector.painted import paint, write_coco, write_yolo

TINY = TrainSettings(model="yolo11n-seg", steps=4, batch=4, size=64, share=0.25, device="cpu")

needs_ultralytics = pytest.mark.skipif(
    not all(map(find_spec, ("torch", "torchvision", "ultralytics"))), reason="Ultralytics and PyTorch are not installed"
)


@pytest.mark.parametrize("module", ["mitsplat.detector", "mitsplat.cli"])
def test_importing_detector_and_cli_loads_no_heavy_library(module: str) -> None:
    heavy = ["mitsuba", "drjit", "warp", "torch", "ultralytics"]
    code = f"import {module}, sys; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


SETTINGS: dict[str, tuple[dict[str, Any], str]] = {
    "steps": ({"steps": 0}, r"steps must be at least 1 \(got 0\)"),
    "batch": ({"batch": 0}, r"batch must be at least 1 \(got 0\)"),
    "small": ({"size": 32}, r"size must be at least 64 \(got 32\)"),
    "odd": ({"size": 100}, r"size must be a multiple of 32 px \(got 100\)"),
    "share": ({"share": 1.0}, r"share of real images must lie between 0 and 1 \(got 1\)"),
    "real_size": ({"real_size": 320}, r"real_size must be at least size, 640 px \(got 320\)"),
    "large seed": ({"seed": 2**32}, r"seed must be less than 2\^32 \(got 4294967296\)"),
    "seed": ({"seed": -1}, r"seed must be at least 0"),
    "text": ({"steps": "10"}, r"steps must be a whole number \(got str '10'\)"),
    "device": ({"device": "gpu"}, r"device must be auto, cpu, cuda or cuda:N \(got gpu\)"),
}


@pytest.mark.parametrize("wrong", SETTINGS)
def test_settings_out_of_range_are_refused(wrong: str) -> None:
    given, message = SETTINGS[wrong]
    with pytest.raises(InputError, match=message):
        TrainSettings(**given)


def test_missing_libraries_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    with pytest.raises(
        MissingResourceError,
        match=r"detectors need torch, torchvision and ultralytics: pip install 'mitsplat\[train\]'",
    ):
        train_detector([tmp_path], tmp_path / "run")


@pytest.fixture
def no_libraries(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Mock an installed Ultralytics, and return the recorded training jobs."""
    asked: list[dict[str, Any]] = []

    def train_job(job: Any, settings: TrainSettings, **_: Any) -> SimpleNamespace:
        asked.append({"job": job, "settings": settings})
        (job.run / "weights.pt").write_bytes(b"weights")
        for step in range(len(job.plan)):
            job.step(step + 1, 1.0)
        return SimpleNamespace(updates=len(job.plan), optimizer="AdamW", losses={}, resumed_at=0)

    steps = ModuleType("mitsplat.detector.fixed_steps")
    vars(steps).update(LAST_CHECKPOINT="weights/last.pt", Job=SimpleNamespace, train_job=train_job)
    steps.Job = lambda run, images, classes, plan, masks, step: SimpleNamespace(  # type: ignore[attr-defined]
        run=run, images=images, class_names=classes, plan=plan, masks=masks, step=step
    )
    monkeypatch.setitem(sys.modules, "mitsplat.detector.fixed_steps", steps)
    monkeypatch.setattr("mitsplat.detector.fixed_steps", steps, raising=False)
    for name, value in (
        ("load_libraries", lambda: None),
        ("read_network", lambda model: (f"{model.removesuffix('.yaml')}.yaml", "-seg" in model)),
        ("check_weights", lambda weights, network, masks: None),
        ("torch_device", lambda device: ("cpu", "cpu")),
        ("versions", dict),
    ):
        monkeypatch.setattr(f"mitsplat.detector.training.{name}", value)
    return asked


def test_a_run_records_its_datasets_and_settings(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 5, "val": 1}, mitsplat=True)
    photographs = write_coco(tmp_path / "photographs", 3, first=50)
    told: list[tuple[int, int, str]] = []
    run = train_detector(
        [cell, cell], tmp_path / "run", TINY, real=photographs, progress=lambda *args: told.append(args)
    )
    (asked,) = no_libraries
    assert (
        asked["settings"].model == "yolo11n-seg.yaml"
        and asked["job"].masks
        and asked["job"].class_names == ("disc", "box")
    )
    assert len(asked["job"].plan) == 4 and (asked["job"].plan >= 10).sum() == 4
    assert told[-1][:2] == (4, 4)
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record == run.record and record["settings"]["steps"] == 4
    assert [found["images"] for found in record["datasets"]] == [5, 5] and record["real"]["kind"] == "coco"
    assert record["finished"]["real_images_taken"] == 4 and record["finished"]["images_taken"] == 16
    assert not (tmp_path / "run/data").exists()
    again = train_detector([cell, cell], tmp_path / "run", TINY, real=photographs)
    assert again.was_finished and len(no_libraries) == 1
    assert open_run(tmp_path / "run").class_names == ("disc", "box")
    over = train_detector([cell, cell], tmp_path / "run", TINY, real=photographs, overwrite=True)
    assert not over.was_finished and len(no_libraries) == 2


def test_labels_of_other_classes_are_not_used_and_named(
    no_libraries: list[dict[str, Any]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Photographs show 2 discs, which the datasets do not have as a class, and 4 boxes."""
    cell = write_yolo(tmp_path / "cell", {"train": 5}, mitsplat=True)
    for path in cell.glob("labels/train/*"):
        path.write_text("".join("0" + line[1:] for line in path.read_text().splitlines(keepends=True)))
    (cell / "data.yaml").write_text("train: images/train\nnames: [box]\n")
    photographs = write_coco(tmp_path / "photographs", 3, first=7)
    before = Counter(name for seed in (7, 8, 9) for name, _ in paint(seed)[1])
    _, real = read_sets([cell], photographs, masks=True)
    assert real is not None and real.class_names == ("box",) and dict(real.other_labels) == {"disc": before["disc"]}
    assert [len(sample.instances) for sample in real.samples] == [1, 2, 1]
    assert {i.class_index for sample in real.samples for i in sample.instances} == {0}
    message = f"{photographs}: not used, because {cell} does not have these classes: disc (2 labels)"
    assert [one.getMessage() for one in caplog.records] == [message]
    run = train_detector([cell], tmp_path / "run", TINY, real=photographs)
    assert run.record["real"]["instances"] == {"box": before["box"]}
    assert run.record["real"]["other_labels"] == {"disc": 2}
    assert "other_labels" not in run.record["datasets"][0]
    evaluation = write_evaluation(real, [], tmp_path / "evaluation", masks=True, about={})
    assert evaluation.results["data"]["other_labels"] == {"disc": 2}
    assert "Labels of other classes, not used</th><td>2 disc</td>" in evaluation.page.read_text()


def test_photographs_are_cut_to_tiles_of_the_test_size(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 5}, mitsplat=True)
    photographs = write_coco(tmp_path / "photographs", 3, first=50)
    listed: list[str] = []
    train_job = sys.modules["mitsplat.detector.fixed_steps"].train_job

    def look(job: Any, settings: TrainSettings, **options: Any) -> Any:
        listed.extend(job.images.read_text().splitlines())
        return train_job(job, settings, **options)

    sys.modules["mitsplat.detector.fixed_steps"].train_job = look  # type: ignore[attr-defined]
    run = train_detector([cell], tmp_path / "run", _other(real_size=96), real=photographs)
    assert len(listed) == 5 + 4 * 3 and run.record["real"]["images"] == 3
    assert no_libraries[0]["job"].plan.max() >= 5 + 3
    assert not (tmp_path / "run/tiles").exists()
    with pytest.raises(InputError, match=r"was started with real_size 96 \(got None\)"):
        train_detector([cell], tmp_path / "run", TINY, real=photographs)
    with pytest.raises(InputError, match="--real-size needs photographs: give them with --real"):
        train_detector([cell], tmp_path / "other", _other(real_size=96))


def _other(**changes: Any) -> TrainSettings:
    return TrainSettings(**(vars(TINY) | changes))


def test_a_run_is_not_resumed_with_other_settings(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 5}, mitsplat=True)
    train_detector([cell], tmp_path / "run", TINY)
    for changes, message in (
        ({"steps": 5}, r"run: was started with steps 4 \(got 5\): choose another folder, or use --overwrite"),
        ({"seed": 1, "batch": 2}, r"batch 4 \(got 2\), seed 0 \(got 1\)"),
        ({"model": "yolo11s-seg"}, r"model yolo11n-seg.yaml \(got yolo11s-seg.yaml\)"),
    ):
        with pytest.raises(InputError, match=message):
            train_detector([cell], tmp_path / "run", _other(**changes))
    assert train_detector([cell], tmp_path / "run", _other(workers=3, device="auto", share=0.9)).was_finished
    write_yolo(cell, {"train": 6})
    with pytest.raises(InputError, match="was started with other images of datasets"):
        train_detector([cell], tmp_path / "run", TINY)


def _stranger(folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run/thesis.tex").write_text("")


def _own_names(folder: Path) -> None:
    (folder / "run/data").mkdir(parents=True)
    (folder / "run/data/notes.txt").write_text("mine")


def _crowds(folder: Path) -> None:
    labels = write_coco(folder / "crowds", 2) / "labels.json"
    content = json.loads(labels.read_text())
    for annotation in content["annotations"]:
        annotation["iscrowd"] = 1
    labels.write_text(json.dumps(content))


def _others(folder: Path) -> None:
    write_yolo(folder / "other", {"train": 1}, classes=("disc", "box", "gear"))


def _renamed(folder: Path) -> None:
    root = write_yolo(folder / "other", {"train": 1})
    (root / "data.yaml").write_text((root / "data.yaml").read_text().replace("box", "gear"))


def _gears(folder: Path) -> None:
    root = write_yolo(folder / "other", {"train": 1}, classes=("disc", "gear", "box"))
    (root / "labels/train/000000.txt").write_text("1 0.5 0.5 0.2 0.2\n")


def _empty(folder: Path) -> None:
    for path in folder.glob("cell/images/train/*"):
        path.unlink()


def _boxes(folder: Path) -> None:
    write_coco(folder / "boxes", 2, form="none")


REFUSED: dict[str, tuple[Callable[[Path], object], dict[str, Any], str]] = {
    "stranger": (_stranger, {}, r"run: must contain only a run \(got thesis.tex\)"),
    "own names": (_own_names, {}, r"run: must contain only a run \(got data\)"),
    "crowds": (_crowds, {"real": "crowds"}, "crowds: all labels are crowds"),
    "empty": (_empty, {}, r"cell: there are no images for train \(it has 1 for val\)"),
    "classes": (_others, {"more": "other"}, "other: its classes must be those of .*cell: it also has gear"),
    "real classes": (
        _renamed,
        {"real": "other"},
        r"other: its classes must contain those of .*cell: it lacks box \(its other classes are gear\); rename",
    ),
    "real labels": (
        _gears,
        {"real": "other"},
        r"other: its images must have labels of the classes of .*cell \(got gear \(1 labels\)\)",
    ),
    "boxes": (_boxes, {"real": "boxes"}, "boxes: a mask model needs mask labels, but photos/p0.png has only boxes"),
    "weights": (
        lambda folder: None,
        {"weights": "none.pt"},
        r"--weights must be an existing weights file .* \(got .*none.pt\)",
    ),
    "file": (lambda folder: (folder / "run").write_text(""), {}, r"run: must be a folder \(got a file\)"),
}


@pytest.mark.parametrize("wrong", REFUSED)
def test_invalid_training_data_is_refused_before_training(
    no_libraries: list[dict[str, Any]], tmp_path: Path, wrong: str
) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 2, "val": 1}, mitsplat=True)
    spoil, given, message = REFUSED[wrong]
    spoil(tmp_path)
    datasets = [cell, *([tmp_path / given["more"]] if "more" in given else [])]
    real = tmp_path / given["real"] if "real" in given else None
    settings = _other(weights=tmp_path / given["weights"]) if "weights" in given else TINY
    with pytest.raises(InputError, match=message) as told:
        train_detector(datasets, tmp_path / "run", settings, real=real)
    assert "\n" not in str(told.value) and not no_libraries
    assert not (tmp_path / "run" / RUN_FILE).exists()


def test_a_dataset_inside_of_the_run_folder_is_refused(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    write_yolo(tmp_path / "run/data", {"train": 2}, mitsplat=True)
    (tmp_path / "run" / RUN_FILE).write_text(json.dumps({"settings": {}, "classes": ["a"], "masks": True}))
    before = contents(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "run/data")
    for dataset in (tmp_path / "run/data", tmp_path / "link"):
        with pytest.raises(InputError, match="run: must not contain training images"):
            train_detector([dataset], tmp_path / "run", TINY, overwrite=True)
    assert {path: data for path, data in contents(tmp_path).items() if "/link/" not in path} == before


def test_datasets_with_boxes_are_trained_by_a_box_network(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 2}, boxes=True)
    train_detector([cell], tmp_path / "run", _other(model="yolo11n"))
    assert no_libraries[0]["job"].masks is False


def test_an_unfinished_run_is_not_evaluated(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must be the folder of `mitsplat train` \(there is no run.json\)"):
        open_run(tmp_path)
    record = {"settings": {}, "classes": ["a"], "masks": True, "finished": None}
    (tmp_path / RUN_FILE).write_text(json.dumps(record))
    with pytest.raises(InputError, match="this training is not finished: run `mitsplat train` again"):
        open_run(tmp_path)
    (tmp_path / RUN_FILE).write_text("{")
    with pytest.raises(InputError, match=r"run\.json: cannot be read"):
        open_run(tmp_path)


@pytest.fixture(scope="module")
def torchvision() -> None:
    """Replace a torchvision that cannot be imported because it was built for another PyTorch."""
    libraries.load_libraries()
    try:
        import torchvision  # noqa: F401
    except (RuntimeError, ImportError):
        for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
            del sys.modules[name]
        from ultralytics.utils.nms import TorchNMS

        stand_in = ModuleType("torchvision")
        stand_in.__spec__ = ModuleSpec("torchvision", None)
        stand_in.ops = SimpleNamespace(nms=TorchNMS.nms)  # type: ignore[attr-defined]
        sys.modules["torchvision"] = stand_in


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a folder with a dataset and photographs."""
    folder = tmp_path_factory.mktemp("data")
    write_yolo(folder / "cell", {"train": 40, "val": 16}, mitsplat=True)
    write_coco(folder / "photographs", 3, first=900)
    return folder


@pytest.fixture(scope="module")
def trained(data: Path, torchvision: None, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Train a detector for 100 steps, so that it finds some objects."""
    return train_detector([data / "cell"], tmp_path_factory.mktemp("runs") / "run", _other(steps=100, batch=8, size=96))


def tensors(run: Run) -> dict[str, Any]:
    import torch

    found: dict[str, Any] = torch.load(run.weights, weights_only=False)["model"].state_dict()
    return found


def typed(data: Path, folder: Path) -> Run:
    """Train with the settings TINY by the command line in a new process, and check that no other files are left."""
    for name in ("home", "tmp"):
        (folder / name).mkdir()
    hidden = ("YOLO_CONFIG_DIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    environment |= {"HOME": str(folder / "home"), "TMPDIR": str(folder / "tmp")}
    command = [sys.executable, "-c", "from mitsplat.cli import main; main()", "train", str(data / "cell")]
    command += ["--real", str(data / "photographs"), "--model", "yolo11n-seg", "--steps", "4", "--batch", "4"]
    command += ["--size", "64", "--share", "0.25", "--device", "cpu", "-o", str(folder / "again")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0].startswith(f"run: {folder / 'again'} (4 steps of 4 images, 4 of 16 real, ")
    left = [path for name in ("home", "tmp") for path in (folder / name).rglob("*") if path.is_file()]
    assert [path for path in left if "matplotlib" not in str(path)] == []
    return open_run(folder / "again")


@needs_ultralytics
@pytest.mark.slow
def test_the_same_command_gives_the_same_weights(data: Path, tmp_path: Path) -> None:
    def train(name: str, **changes: Any) -> Run:
        return train_detector([data / "cell"], tmp_path / name, _other(**changes), real=data / "photographs")

    before = contents(data)
    run, other = train("run"), train("other", seed=1)
    again = typed(data, tmp_path)
    assert contents(data) == before
    finished = run.record["finished"]
    assert finished["steps"] == finished["updates_of_weights"] == 4 and finished["real_images_taken"] == 4
    assert {path.name for path in run.path.iterdir()} == {".lock", "args.yaml", "results.csv", "run.json", "weights.pt"}
    first, second, third = tensors(run), tensors(again), tensors(other)
    assert first.keys() == second.keys() and all(first[name].equal(second[name]) for name in first)
    assert not all(first[name].equal(third[name]) for name in first)
    # Training can continue from the trained weights, with the same network only.
    onward = train("onward", weights=run.weights)
    assert onward.record["settings"]["weights"] == file_hash(run.weights)
    for model, message in (("yolo11n", r"does not fit yolo11n.yaml: .* must have"), ("yolo11s-seg", "does not fit")):
        with pytest.raises(InputError, match=message):
            train("wrong", weights=run.weights, model=model)
    (tmp_path / "torn.pt").write_bytes(run.weights.read_bytes()[:-1000])
    with pytest.raises(InputError, match=r"torn\.pt: cannot be read as weights of Ultralytics"):
        train("wrong", weights=tmp_path / "torn.pt")
    for model, message in (
        ("yolo11z", r"a network of Ultralytics, .* \(got yolo11z\)"),
        ("yolo11n-pose", "got .*pose"),
    ):
        with pytest.raises(InputError, match=message):
            train("wrong", model=model)
    assert not (tmp_path / "wrong").exists()


@needs_ultralytics
@pytest.mark.slow
def test_weights_of_many_classes_can_be_trained_further_and_evaluated(
    data: Path, torchvision: None, tmp_path: Path
) -> None:
    """Weights with many classes, such as COCO's, have a wider branch in Ultralytics than weights with few classes."""
    import torch
    from ultralytics.nn.tasks import SegmentationModel

    many = SegmentationModel("yolo11n-seg.yaml", nc=80, verbose=False)
    torch.save({"model": many}, tmp_path / "many.pt")
    run = train_detector([data / "cell"], tmp_path / "run", _other(weights=tmp_path / "many.pt"))
    assert tensors(run)["model.23.cv3.0.0.1.bn.bias"].shape == (80,)
    onward = train_detector([data / "cell"], tmp_path / "onward", _other(weights=run.weights))
    for each in (run, onward):
        assert evaluate_detector(each.path, data / "cell", device="cpu").results["box"]


@needs_ultralytics
@pytest.mark.slow
def test_an_interrupted_run_resumes_to_the_same_number_of_steps(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mitsplat.detector import fixed_steps

    monkeypatch.setattr(fixed_steps, "EPOCH", 2)
    settings = _other(steps=7)
    told: list[int] = []

    def interrupt(done: int, total: int, doing: str) -> None:
        if doing.startswith("training"):
            told.append(done)
            if told == [1, 2, 3, 4, 5]:
                raise KeyboardInterrupt

    def train(folder: str) -> Run:
        return train_detector([data / "cell"], tmp_path / folder, settings, progress=interrupt)

    with pytest.raises(KeyboardInterrupt):
        train("run")
    with pytest.raises(InputError, match="this training is not finished"):
        open_run(tmp_path / "run")
    shutil.copytree(tmp_path / "run", tmp_path / "torn", symlinks=True)
    run = train("run")
    assert told == [1, 2, 3, 4, 5, 5, 6, 7]  # continues from the checkpoint after step 4
    finished = run.record["finished"]
    assert (finished["resumed_at_step"], finished["updates_of_weights"], finished["steps"]) == (4, 7, 7)
    assert run.weights.is_file() and not (run.path / "weights").exists()
    (tmp_path / "torn/weights/last.pt").write_bytes(b"torn")
    with pytest.raises(InputError, match=r"last\.pt: cannot be read .*: start again with --overwrite"):
        train("torn")


@needs_ultralytics
def test_a_batch_is_not_reduced_when_memory_runs_out(torchvision: None) -> None:
    from mitsplat.detector import fixed_steps

    trainer = SimpleNamespace(
        train_loader=None, job=SimpleNamespace(plan=np.zeros((3, 16))), args=SimpleNamespace(imgsz=640)
    )
    with pytest.raises(
        MissingResourceError, match="ran out of memory with 16 images of 640 px per step: use a smaller --batch"
    ):
        fixed_steps._FixedStepsTrainer.get_dataloader(trainer, "images.txt")


@needs_ultralytics
@pytest.mark.slow
def test_every_step_uses_the_images_of_the_plan(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mosaics of four images each take their images from the plan as well."""
    from mitsplat.detector import fixed_steps

    batches: list[list[str]] = []
    others: list[int] = []
    preprocess, mosaic = fixed_steps._MaskTrainer.preprocess_batch, fixed_steps.Mosaic.get_params

    def look(self: Any, batch: dict[str, Any]) -> Any:
        batches.append([Path(name).stem for name in batch["im_file"]])
        return preprocess(self, batch)

    def mix(self: Any, labels: dict[str, Any]) -> Any:
        drawn = mosaic(self, labels)
        others.extend(int(Path(label["im_file"]).stem) for label in drawn["mix_labels"])
        return drawn

    monkeypatch.setattr(fixed_steps._MaskTrainer, "preprocess_batch", look)
    monkeypatch.setattr(fixed_steps.Mosaic, "get_params", mix)
    run = train_detector([data / "cell"], tmp_path / "run", TINY, real=data / "photographs")
    plan = plan_images(40, 3, share=0.25, steps=4, batch=4, seed=0)
    assert batches == [[f"{index:07d}" for index in step] for step in plan.tolist()]
    assert len(others) == 3 * 16 and set(others) <= set(plan.ravel().tolist()) < set(range(43))
    assert 4 <= sum(index >= 40 for index in others) <= 24  # 12 are expected from a quarter, 3 from all images alike
    assert run.record["finished"]["real_images_taken"] == 4


@needs_ultralytics
@pytest.mark.slow
@pytest.mark.parametrize("mirror", [True, False])
def test_images_are_mirrored_only_with_the_option(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mirror: bool
) -> None:
    from ultralytics.data.augment import RandomFlip

    mirrored: list[bool] = []
    apply = RandomFlip.apply_image

    def look(self: Any, labels: dict[str, Any], params: dict[str, Any]) -> Any:
        before = labels["img"].copy()
        after = apply(self, labels, params)
        if self.direction == "horizontal":
            mirrored.append(bool((after["img"] != before).any()))
        return after

    monkeypatch.setattr(RandomFlip, "apply_image", look)
    train_detector([data / "cell"], tmp_path / "run", _other(mirror=mirror))
    assert len(mirrored) == 16
    assert 3 <= sum(mirrored) <= 13 if mirror else not any(mirrored)


@needs_ultralytics
@pytest.mark.slow
def test_precision_agrees_with_ultralytics(data: Path, trained: Run, tmp_path: Path) -> None:
    """The precision equals that of Ultralytics' validation with its settings aligned to those of mitsplat.

    Aligned settings: images letterboxed to squares, and masks compared in all pixels. The detections of that validation
    then score the same by COCO's rules. They differ from predictions: a box may have several classes, and empty masks
    are
    included. The precision that Ultralytics itself computes is within 0.006. It uses areas of trapezoids, whereas COCO
    takes
    the mean of 101 precisions, so that a perfect class has 0.995.
    """
    from ultralytics import YOLO

    found = read_set(data / "cell", "val")
    write_data([found], tmp_path / "same")
    (tmp_path / "same/data.yaml").write_text(
        f"path: {tmp_path / 'same'}\ntrain: images.txt\nval: images.txt\nnames: [disc, box]\n"
    )
    theirs = YOLO(str(trained.weights)).val(
        data=str(tmp_path / "same/data.yaml"), imgsz=96, device="cpu", workers=0, plots=False, verbose=False,
        rect=False, conf=0.001, iou=0.7, max_det=300, save_json=True, mask_ratio=1, overlap_mask=False,
        project=str(tmp_path / "ultralytics"),
    )  # fmt: skip
    (file,) = (tmp_path / "ultralytics").rglob("predictions.json")
    predictions = [entry | {"image_id": int(entry["image_id"]) + 1} for entry in json.loads(file.read_text())]
    evaluation = evaluate_detector(trained.path, data / "cell", tmp_path / "out", device="cpu")
    truth = coco_truth(found, masks=True)
    for kind, iou_type, own in (("box", "bbox", theirs.box), ("mask", "segm", theirs.seg)):
        score, result = DetectionMatches(truth, predictions, iou_type).average_precision(), evaluation.results[kind]  # type: ignore[arg-type]
        assert score.map50_95 > 0.3
        assert (own.map, own.map50) == pytest.approx((score.map50_95, score.map50), abs=0.006)
        assert (result["map50_95"], result["map50"]) == pytest.approx((score.map50_95, score.map50), abs=0.005)
    done = CliRunner().invoke(app, ["evaluate", str(trained.path), str(data / "cell"), "--device", "cpu"])
    again = trained.path / "evaluation/cell-val"
    assert done.exit_code == 0 and done.stdout.splitlines()[-1] == f"report: {again / 'report.html'}"
    assert f"boxes: mAP50-95 {evaluation.results['box']['map50_95']:.3f}, mAP50 " in done.stdout
    assert (again / "detections.json").read_bytes() == (evaluation.path / "detections.json").read_bytes()


@needs_ultralytics
@pytest.mark.slow
def test_invalid_evaluation_data_is_refused(data: Path, trained: Run, tmp_path: Path) -> None:
    write_yolo(tmp_path / "boxes", {"val": 1}, boxes=True)
    gears = write_yolo(tmp_path / "gears", {"val": 1}) / "data.yaml"
    gears.write_text(gears.read_text().replace("box", "gear"))
    for folder, options, message in (
        ("boxes", {}, "has only boxes"),
        ("gears", {}, r"gears: its classes must contain those of .*run: it lacks box \(its other classes are gear\)"),
        ("boxes", {"split": "test"}, "there are no images for test"),
        ("boxes", {"size": 100}, r"--size must be a multiple of 32 px \(got 100\)"),
        ("boxes", {"device": "cuda:all"}, "device must be auto, cpu, cuda or cuda:N"),
    ):
        with pytest.raises(InputError, match=message):
            evaluate_detector(trained.path, tmp_path / folder, tmp_path / "out", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


@needs_ultralytics
@pytest.mark.slow
def test_weights_with_any_name_are_read_offline_and_not_changed(
    data: Path, trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError(f"a connection was asked for: {args}")

    for name in ("getaddrinfo", "create_connection"):
        monkeypatch.setattr(socket, name, refuse)
    monkeypatch.chdir(tmp_path)
    for name in ("yolo11n-seg.pt", "yolov5n.pt", "o'clock.pt"):  # Ultralytics would download the first two
        Path(name).write_bytes(b"torn" * 1000)
        with pytest.raises(InputError, match="cannot be read as weights"):
            load_weights(Path(name))
        assert Path(name).read_bytes() == b"torn" * 1000
        shutil.copy(trained.weights, name)
        check_weights(Path(name), "yolo11n-seg.yaml", masks=True, classes=2)
    shutil.copytree(trained.path, tmp_path / "bob's run")
    found = evaluate_detector(tmp_path / "bob's run", data / "cell", device="cpu")
    assert found.results["box"] == evaluate_detector(trained.path, data / "cell", device="cpu").results["box"]
    (tmp_path / "bob's run" / trained.weights.name).write_bytes(b"torn")
    with pytest.raises(InputError, match="cannot be read as weights"):
        evaluate_detector(tmp_path / "bob's run", data / "cell", device="cpu")


@needs_ultralytics
def test_the_check_of_mixed_precision_downloads_nothing(torchvision: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ultralytics' check of mixed precision on a GPU needs weights. Offline it continues without downloading them."""
    import torch
    from ultralytics.utils import ONLINE
    from ultralytics.utils.checks import check_amp

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError(f"a connection was asked for: {args}")

    for name in ("getaddrinfo", "create_connection"):
        monkeypatch.setattr(socket, name, refuse)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "NVIDIA H200")
    parameters = [SimpleNamespace(device=torch.device("cuda"))]
    model = SimpleNamespace(parameters=lambda: iter(parameters), stride=torch.tensor([32]))
    assert not ONLINE
    assert check_amp(model) is True
