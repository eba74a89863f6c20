"""Trainings of a few steps on small images, and what is refused before one begins."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from mitsplat.detector import libraries
from mitsplat.detector.training import RUN, Run, TrainSettings, open_run, train_detector
from mitsplat.errors import InputError, MissingResourceError
from tests.detector.painted import write_coco, write_yolo

TINY = TrainSettings(model="yolo11n-seg", steps=4, batch=4, size=64, share=0.25, device="cpu")

needs_ultralytics = pytest.mark.skipif(
    not all(map(find_spec, ("torch", "torchvision", "ultralytics"))), reason="Ultralytics and PyTorch are not installed"
)


@pytest.mark.parametrize("module", ["mitsplat.detector", "mitsplat.cli"])
def test_training_starts_without_mitsuba(module: str) -> None:
    heavy = ["mitsuba", "drjit", "warp", "torch", "ultralytics"]
    code = f"import {module}, sys; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


SETTINGS: dict[str, tuple[dict[str, Any], str]] = {
    "steps": ({"steps": 0}, r"steps must be 1 or more \(got 0\)"),
    "batch": ({"batch": 0}, r"batch must be 1 or more \(got 0\)"),
    "small": ({"size": 32}, r"size must be 64 or more \(got 32\)"),
    "odd": ({"size": 100}, r"size must be a multiple of 32 px \(got 100\)"),
    "share": ({"share": 1.0}, r"share of real images must lie between 0 and 1 \(got 1\)"),
    "seed": ({"seed": -1}, r"seed must be 0 or more"),
    "device": ({"device": "gpu"}, r"device must be auto, cpu, cuda or cuda:N \(got gpu\)"),
}


@pytest.mark.parametrize("wrong", SETTINGS)
def test_settings_out_of_range_are_refused(wrong: str) -> None:
    given, message = SETTINGS[wrong]
    with pytest.raises(InputError, match=message):
        TrainSettings(**given)


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    with pytest.raises(MissingResourceError, match=r"detectors need torch and .*: pip install 'mitsplat\[train\]'"):
        train_detector([tmp_path], tmp_path / "run")


@pytest.fixture
def no_libraries(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """As if Ultralytics were there; what it would have been told to train."""
    asked: list[dict[str, Any]] = []

    def train_job(job: Any, **settings: Any) -> SimpleNamespace:
        asked.append({"job": job, **settings})
        (job.run / "weights.pt").write_bytes(b"weights")
        for step in range(len(job.plan)):
            job.step(step + 1, 1.0)
        return SimpleNamespace(updates=len(job.plan), optimizer="AdamW", losses={}, resumed_at=0)

    steps = ModuleType("mitsplat.detector.fixed_steps")
    vars(steps).update(LAST="weights/last.pt", Job=SimpleNamespace, train_job=train_job)
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


def test_a_run_records_what_it_was_made_of(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 5, "val": 1}, mitsplat=True)
    photographs = write_coco(tmp_path / "photographs", 3, first=50)
    told: list[tuple[int, int, str]] = []
    run = train_detector(
        [cell, cell], tmp_path / "run", TINY, real=photographs, progress=lambda *args: told.append(args)
    )
    (asked,) = no_libraries
    assert asked["network"] == "yolo11n-seg.yaml" and asked["job"].masks and asked["job"].class_names == ("disc", "box")
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


def _other(**changes: Any) -> TrainSettings:
    return TrainSettings(**(vars(TINY) | changes))


def test_a_run_is_not_gone_on_with_by_other_means(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 5}, mitsplat=True)
    train_detector([cell], tmp_path / "run", TINY)
    for changes, message in (
        ({"steps": 5}, r"run: was begun with steps 4 \(got 5\): give another folder, or --overwrite"),
        ({"seed": 1, "batch": 2}, r"batch 4 \(got 2\), seed 0 \(got 1\)"),
        ({"model": "yolo11s-seg"}, r"model yolo11n-seg.yaml \(got yolo11s-seg.yaml\)"),
    ):
        with pytest.raises(InputError, match=message):
            train_detector([cell], tmp_path / "run", _other(**changes))
    assert train_detector([cell], tmp_path / "run", _other(workers=3, device="auto")).was_finished
    write_yolo(cell, {"train": 6})
    with pytest.raises(InputError, match="was begun with other images of datasets"):
        train_detector([cell], tmp_path / "run", TINY)


def _stranger(folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run/thesis.tex").write_text("")


def _others(folder: Path) -> None:
    write_yolo(folder / "other", {"train": 1}, classes=("disc", "box", "gear"))


def _empty(folder: Path) -> None:
    for path in folder.glob("cell/images/train/*"):
        path.unlink()


def _boxes(folder: Path) -> None:
    write_coco(folder / "boxes", 2, form="none")


REFUSED: dict[str, tuple[Callable[[Path], object], dict[str, Any], str]] = {
    "stranger": (_stranger, {}, r"run: holds something else than a run \(got thesis.tex\)"),
    "empty": (_empty, {}, r"cell: there is no image for train \(it has 1 for val\)"),
    "classes": (_others, {"more": "other"}, "other: its classes must be those of .*cell: it also has gear"),
    "real classes": (_others, {"real": "other"}, "other: its classes must be those of .*cell: it also has gear"),
    "boxes": (_boxes, {"real": "boxes"}, "boxes: masks are to be learnt, but photos/p0.png is labelled by boxes"),
    "weights": (lambda folder: None, {"weights": "none.pt"}, r"--weights must be a file .* \(got .*none.pt\)"),
    "file": (lambda folder: (folder / "run").write_text(""), {}, r"run: must be a folder \(got a file\)"),
}


@pytest.mark.parametrize("wrong", REFUSED)
def test_what_cannot_be_learnt_is_refused_before_it_begins(
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
    assert not (tmp_path / "run" / RUN).exists()


def test_boxes_are_learnt_by_a_network_of_boxes(no_libraries: list[dict[str, Any]], tmp_path: Path) -> None:
    cell = write_yolo(tmp_path / "cell", {"train": 2}, boxes=True)
    train_detector([cell], tmp_path / "run", _other(model="yolo11n"))
    assert no_libraries[0]["job"].masks is False


def test_a_run_that_is_not_finished_is_not_judged(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must be the folder of `mitsplat train` \(there is no run.json\)"):
        open_run(tmp_path)
    record = {"settings": {}, "classes": ["a"], "masks": True, "finished": None}
    (tmp_path / RUN).write_text(json.dumps(record))
    with pytest.raises(InputError, match="this training is not finished: run `mitsplat train` again"):
        open_run(tmp_path)
    (tmp_path / RUN).write_text("{")
    with pytest.raises(InputError, match=r"run\.json: cannot be read"):
        open_run(tmp_path)


@pytest.fixture(scope="module")
def torchvision() -> None:
    """Stands in for a torchvision that cannot be imported because it was built for another PyTorch."""
    try:
        import torchvision  # noqa: F401
    except (RuntimeError, ImportError):
        for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
            del sys.modules[name]
        from ultralytics.utils.nms import TorchNMS

        stand_in = ModuleType("torchvision")
        stand_in.__version__ = "0.0"  # type: ignore[attr-defined]
        stand_in.ops = SimpleNamespace(nms=TorchNMS.nms)  # type: ignore[attr-defined]
        sys.modules["torchvision"] = stand_in


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """A folder with a dataset, photographs, and a run on both."""
    folder = tmp_path_factory.mktemp("trained")
    write_yolo(folder / "cell", {"train": 6, "val": 4}, mitsplat=True)
    write_coco(folder / "photographs", 3, first=50)
    home = folder / "home"
    home.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(home))
        patch.delenv("YOLO_CONFIG_DIR", raising=False)
        run = train_detector([folder / "cell"], folder / "run", TINY, real=folder / "photographs")
    assert list(home.iterdir()) == []  # no settings, fonts or weights are put there
    return folder, run


def tensors(run: Run) -> dict[str, Any]:
    import torch

    found: dict[str, Any] = torch.load(run.weights, weights_only=False)["model"].state_dict()
    return found


@needs_ultralytics
@pytest.mark.slow
def test_the_same_command_gives_the_same_weights(trained: tuple[Path, Run]) -> None:
    folder, run = trained
    finished = run.record["finished"]
    assert finished["steps"] == finished["updates_of_weights"] == 4 and finished["real_images_taken"] == 4
    assert {path.name for path in run.path.iterdir()} == {".lock", "args.yaml", "results.csv", "run.json", "weights.pt"}
    again = train_detector([folder / "cell"], folder / "again", TINY, real=folder / "photographs")
    first, second = tensors(run), tensors(again)
    assert first.keys() == second.keys() and all(first[name].equal(second[name]) for name in first)
    other = train_detector([folder / "cell"], folder / "other", _other(seed=1), real=folder / "photographs")
    third = tensors(other)
    assert not all(first[name].equal(third[name]) for name in first)
