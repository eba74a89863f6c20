"""Detector experiment: its arms, the photographs available to each run, and the evaluated images."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pycocotools.mask as coco_mask
import pytest
import trimesh
from ruamel.yaml import YAML

from benchmarks import record
from benchmarks.detector import __main__ as side_by_side
from benchmarks.detector import experiment, workshop
from benchmarks.detector.packages import make_bag, make_package, relabel
from mitsplat.errors import InputError
from mitsplat.scene.spec.scene_spec import SceneSpec

PLANS = [experiment.PLAN, Path("workshop.yaml")]


def scenes_of(plan: Path) -> list[str]:
    arms = experiment.read_arms(plan)["arms"].values()
    return sorted({scene for arm in arms for scene in experiment.scenes_of(arm)})


def is_quick(plan: Path, name: str) -> bool:
    """Return True for scenes without a change, and for each change of the scene ``table``."""
    return plan != experiment.PLAN or "+" not in name or name.startswith("table+")


@pytest.mark.parametrize(
    ("plan", "name"),
    [
        pytest.param(plan, name, marks=() if is_quick(plan, name) else pytest.mark.extended)
        for plan in PLANS
        for name in scenes_of(plan)
    ],
)
def test_every_scene_of_an_arm_is_valid(tmp_path, plan, name):
    written = YAML(typ="safe").load(experiment.write_scene(tmp_path, name, plan))
    base = experiment.base_of(experiment.read_arms(plan), name)
    assert SceneSpec.model_validate(written).name == base.stem


@pytest.mark.parametrize("plan", PLANS)
def test_every_change_is_used_by_a_scene(plan):
    changes = experiment.read_arms(plan)["changes"]
    assert {change for scene in scenes_of(plan) for change in scene.split("+")} == set(changes)


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """Write two photographs of each of five scenes, each with one object."""
    folder = tmp_path / "photos"
    folder.mkdir()
    images = []
    for scene in (0, 1, 2, 3, 6):
        for light in range(2):
            name = f"scene_{scene:04d}_{light:04d}.jpg"
            cv2.imwrite(str(folder / name), np.full((48, 64, 3), 90, dtype=np.uint8))
            images.append({"id": len(images) + 1, "file_name": name, "width": 64, "height": 48})
    labels = {
        "images": images,
        "annotations": [
            {"id": i["id"], "image_id": i["id"], "category_id": 1, "bbox": [8, 8, 20, 20], "area": 400, "iscrowd": 0}
            | {"segmentation": filled(8, 28)}
            for i in images
        ],
        "categories": [{"id": 1, "name": "tin"}],
    }
    (folder / "labels.json").write_text(json.dumps(labels))
    return tmp_path


def filled(left: int, right: int) -> dict[str, Any]:
    """Return the run lengths of a mask of 64 x 48 pixels that fills rows 8 to 27 between two columns."""
    mask = np.zeros((48, 64), dtype=np.uint8, order="F")
    mask[8:28, left:right] = 1
    encoded = coco_mask.encode(mask)
    return {"size": encoded["size"], "counts": encoded["counts"].decode()}


@pytest.mark.parametrize("arm", ["real", "hybrid_more", "synthetic"])
def test_photographs_are_judged_by_detectors_that_were_not_trained_on_them(work, monkeypatch, arm):
    """The mock detector finds only objects in images outside its training set.

    It finds all objects only if the scenes to evaluate are left out of the training. The detector of ``synthetic`` has
    masks, each of which has an IoU of 13 / 21 with its object.
    """
    seen: dict[str, set[str]] = {}

    def train(datasets: list[Path], run: Path, settings: Any, real: Path | None) -> Any:
        learnt = datasets + ([real] if real else [])
        seen[str(run)] = {path.name for folder in learnt for path in folder.glob("*.jpg")}
        told = {"finished": {"seconds": 1.0}, "settings": {"weights": None}}
        return SimpleNamespace(path=run, record=told, has_masks=arm == "synthetic")

    def evaluate(run: Path, data: Path, **_: Any) -> Any:
        truth = json.loads((data / "labels.json").read_text())
        hidden = {"scene_0000_0000.jpg"} if arm == "synthetic" else seen[str(run)]
        names = {image["id"]: image["file_name"] for image in truth["images"]}
        found = [
            {
                "image_id": a["image_id"],
                "category_id": 1,
                "bbox": a["bbox"],
                "score": 0.9,
                "segmentation": filled(7, 21),
            }
            for a in truth["annotations"]
            if names[a["image_id"]] not in hidden
        ]
        run.mkdir(parents=True)
        (run / "truth.json").write_text(json.dumps(truth))
        (run / "detections.json").write_text(json.dumps(found))
        return SimpleNamespace(path=run)

    monkeypatch.setattr(experiment, "train_detector", train)
    monkeypatch.setattr(experiment, "evaluate_detector", evaluate)
    monkeypatch.setattr(record, "_open", [{}])
    options = argparse.Namespace(
        work=work, arm=arm, seed=0, plan=experiment.PLAN, weights=None, device="cpu", workers=0, trained=False
    )
    experiment.measure(options)
    figures = {name: value for name, (value, _) in record._open[0].items()}
    assert len(seen) == (1 if arm == "synthetic" else 5)
    assert all(len(names) == (0 if arm == "synthetic" else 8) for names in seen.values())
    assert figures["map50_95"] == pytest.approx(1.0 if arm != "synthetic" else 0.9, abs=0.01)
    assert (figures["scenes"] == "") == (arm == "real")
    assert (figures["scene.1"], figures["scene.0"] < 1) == (pytest.approx(1.0), arm == "synthetic")
    assert len(figures["samples"]) == experiment.SAMPLES
    if arm == "synthetic":  # an IoU of 0.62 passes three of ten thresholds
        assert figures["masks.map50_95"] == pytest.approx(0.3 * 0.9, abs=0.01)
    else:
        assert "masks.map50_95" not in figures


def test_finished_trainings_are_evaluated_without_rendered_images(work, monkeypatch):
    run = work / "runs" / "synthetic-3-0"
    run.mkdir(parents=True)
    told = {"finished": {"seconds": 2.5}, "settings": {"weights": None}, "masks": False, "classes": []}
    (run / "run.json").write_text(json.dumps(told))
    (run / "weights.pt").touch()

    def evaluate(run: Path, data: Path, **_: Any) -> Any:
        (run / "truth.json").write_text((data / "labels.json").read_text())
        (run / "detections.json").write_text("[]")
        return SimpleNamespace(path=run)

    monkeypatch.setattr(experiment, "evaluate_detector", evaluate)
    monkeypatch.setattr(record, "_open", [{}])
    options = argparse.Namespace(work=work, arm="synthetic", seed=3, plan=experiment.PLAN, device="cpu", trained=True)
    experiment.measure(options)
    assert record._open[0]["training.0"] == [2.5, "s"]
    options.seed = 4
    with pytest.raises(InputError, match=r"synthetic-4-0: must be the folder of `mitsplat train`"):
        experiment.measure(options)


def test_detections_of_merged_classes_are_one_class():
    """Of three nuts, one is found as the other size, one as both sizes, and one is missed."""
    boxes = [[0, 0, 10, 10], [20, 0, 10, 10], [40, 0, 10, 10]]
    truth = {
        "images": [{"id": 1, "width": 64, "height": 64}],
        "categories": [{"id": 1, "name": "m16"}, {"id": 2, "name": "m20"}],
        "annotations": [
            {"id": k + 1, "image_id": 1, "category_id": c, "bbox": box, "area": 100, "iscrowd": 0}
            for k, (c, box) in enumerate(zip([1, 2, 2], boxes, strict=True))
        ],
    }
    found = [
        {"image_id": 1, "category_id": c, "bbox": boxes[k], "score": score}
        for c, k, score in [(2, 0, 0.9), (1, 1, 0.8), (2, 1, 0.7)]
    ]
    scores = experiment.scores_of_merged(truth, found, {"nut": ["m16", "m20"]})
    assert scores == {"all": scores["nut"], "nut": (pytest.approx(67 / 101), pytest.approx(67 / 101))}  # recall 2/3
    assert experiment.DetectionMatches(truth, found).average_precision().map50 < 0.3
    assert experiment.scores_of_merged(truth, found, {}) == {}


@pytest.mark.parametrize(("arm", "starts"), [("real", "coco.pt"), ("scratch", None)])
def test_an_arm_starts_from_its_stated_weights(work, monkeypatch, arm, starts):
    given: list[Path | None] = []
    monkeypatch.setattr(experiment, "train_detector", lambda *args, **_: given.append(args[2].weights))
    options = argparse.Namespace(work=work, arm=arm, seed=0, weights=Path("coco.pt"), device="cpu", workers=0)
    experiment.train_fold(options, experiment.read_arms(), 0)
    assert given == [starts and Path(starts)]


def test_folds_are_trained_in_parallel_and_judged_after_all_of_them(work, tmp_path):
    plan = experiment.read_arms()
    weights = tmp_path / "coco.pt"
    options = argparse.Namespace(work=work, plan=experiment.PLAN, workers=2, weights=weights, hope=tmp_path)
    options.render_devices, options.render_workers = ["cuda:0", "cuda:1"], 8
    todo = [("hybrid_more", 0), ("no_shadow", 0)]
    renders = {job.name: job for job in side_by_side.renders(todo, plan, options)}
    whole, changed = renders["render-table"], renders["render-table+no_shadow"]
    assert whole.everywhere and "--frames" not in whole.words and not changed.everywhere
    assert changed.after == ["render-table"] and changed.words[changed.words.index("--frames") + 1] == "128"
    trainings = {job.name: job for job in side_by_side.all_jobs(todo, plan, options) if job.kind == "train"}
    all_whole = [f"render-{name}" for name in plan["arms"]["hybrid_more"]["scenes"]]
    assert all(job.behind == all_whole for job in trainings.values())
    assert set(trainings["hybrid_more-0"].after) == {f"hybrid_more-0-{fold}" for fold in range(5)}
    assert trainings["hybrid_more-0-4"].after == all_whole
    assert trainings["no_shadow-0"].after == ["no_shadow-0-0"]


def test_jobs_run_in_order_on_free_devices_after_their_dependencies(tmp_path, capsys):
    def job(name: str, then: str, after: Sequence[str] = ()) -> side_by_side.Job:
        code = f"import os, sys; print(sys.argv[2], os.environ.get('CUDA_VISIBLE_DEVICES')); {then}"
        return side_by_side.Job(name, "train", [sys.executable, "-c", code], after, hides=name == "shy")

    jobs = [
        job("late", "pass", ["early"]),
        job("lost", "pass", ["wrong"]),
        job("early", "pass"),
        job("shy", "pass"),
        job("wrong", "raise SystemExit('no such thing')"),
    ]
    jobs.insert(0, replace(job("patient", "pass"), behind=["wrong"]))
    free = {"train": ["cuda:1"], "render": []}
    side_by_side.run_jobs(jobs, free, argparse.Namespace(work=tmp_path, minutes=5))
    lines = [line.split("min  ")[-1] for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        "early: cuda:1 None",
        "late: cuda:1 None",
        "shy: cuda 1",
        "wrong: status 1: no such thing",
        "patient: cuda:1 None",
        "not run because of the time limit or missing inputs: lost",
    ]
    assert free["train"] == ["cuda:1"]


def test_rendering_on_the_cpu_has_a_lower_priority_than_training(tmp_path, capsys):
    nice = [sys.executable, "-c", "import os; print(os.nice(0))"]
    jobs = [side_by_side.Job(kind, kind, nice) for kind in ("render", "train")]
    side_by_side.run_jobs(jobs, {"train": ["cpu"], "render": ["cpu"]}, argparse.Namespace(work=tmp_path, minutes=5))
    lines = dict(line.split("min  ")[-1].split(": ") for line in capsys.readouterr().out.splitlines())
    assert lines == {"render": str(min(19, os.nice(0) + 19)), "train": str(os.nice(0))}


@pytest.mark.extended
def test_labels_of_workshop_photographs_are_the_visible_pixels(tmp_path, physics, monkeypatch):
    monkeypatch.setattr(record, "_open", [{}])
    options = argparse.Namespace(work=tmp_path, first=0, scenes=2, photos="photos", views=1, width=160, samples=4)
    workshop.photograph_workshops(options)
    labels = json.loads((tmp_path / "photos/labels.json").read_text())
    assert [image["file_name"] for image in labels["images"]] == ["scene_0000_0000.jpg", "scene_0001_0000.jpg"]
    assert len(labels["categories"]) == 12 and len(labels["annotations"]) >= 8
    masks = [coco_mask.decode(one["segmentation"]) for one in labels["annotations"] if one["image_id"] == 1]
    assert np.max(np.sum(masks, axis=0)) == 1  # masks do not overlap
    photograph = cv2.imread(str(tmp_path / "photos/scene_0001_0000.jpg")).astype(float).mean(axis=2)
    assert photograph.shape == masks[0].shape == (120, 160) and 40 < photograph.mean() < 215
    edges = cv2.morphologyEx(np.max(masks, axis=0), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
    change = cv2.morphologyEx(photograph, cv2.MORPH_GRADIENT, np.ones((3, 3)))
    assert change[edges].mean() > 1.5 * np.median(change)  # outlines lie on image edges
    assert experiment.scene_of(labels["images"][1]["file_name"]) == 1


MADE = {"made_by": "workshop", "samples": 64, "width": 960}


@pytest.mark.parametrize(
    ("plan", "made", "scenes", "views", "fault"),
    [
        ("workshop.yaml", MADE, range(10), 5, None),
        ("development.yaml", MADE, range(10, 20), 5, None),
        ("cycles.yaml", MADE | {"made_by": "cycles_photos", "samples": 12}, [*range(4), *range(8, 12)], 4, None),
        ("cycles_96.yaml", MADE | {"made_by": "cycles_photos"}, range(12), 8, None),
        ("workshop.yaml", MADE, range(10, 20), 5, "scenes must be [0, "),
        ("workshop.yaml", MADE, range(9), 5, "scenes must be [0, "),
        ("development.yaml", MADE, range(10), 5, "scenes must be [10, "),
        ("cycles.yaml", MADE, range(12), 5, "made_by must be cycles_photos, as in the plan (got workshop)"),
        ("cycles_96.yaml", MADE | {"made_by": "cycles_photos", "samples": 12}, range(12), 8, "samples must be 64"),
        ("cycles_96.yaml", MADE | {"made_by": "cycles_photos"}, range(12), 4, "views must be [8]"),
        ("workshop.yaml", MADE | {"width": 480}, range(10), 5, "width must be 960"),
        ("workshop.yaml", None, range(10), 5, "made_by must be workshop, as in the plan (got None)"),
    ],
)
def test_photographs_of_another_plan_are_refused(tmp_path, plan, made, scenes, views, fault):
    arms = experiment.read_arms(Path(plan))
    folder = tmp_path / experiment.photos_of(arms)
    folder.mkdir()
    names = [f"scene_{scene:04d}_{view:04d}.jpg" for scene in scenes for view in range(views)]
    labels = {"images": [{"file_name": name} for name in names]} | ({} if made is None else {"info": made})
    (folder / "labels.json").write_text(json.dumps(labels))
    if fault is None:
        experiment.check_photographs(tmp_path, arms)
        return
    with pytest.raises(SystemExit, match="use the WORK of the plan") as raised:
        experiment.check_photographs(tmp_path, arms)
    assert fault in str(raised.value) and str(folder) in str(raised.value)


def test_a_folder_keeps_photographs_of_one_kind(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "_open", [{}])
    workshop.check_labels(tmp_path, MADE)
    workshop.write_labels(tmp_path, ["nut"], [], MADE)
    workshop.check_labels(tmp_path, MADE)
    with pytest.raises(SystemExit, match=r"'samples': 64, .* use another folder"):
        workshop.check_labels(tmp_path, MADE | {"samples": 12})


def test_a_brand_has_the_hues_of_its_scan():
    scan = make_package(1)  # a can
    own, others = (relabel(scan, 5, 2, own_colours=own) for own in (True, False))

    def hues(mesh: trimesh.Trimesh) -> np.ndarray:
        pixels = np.asarray(mesh.visual.material.baseColorTexture.convert("HSV").resize((256, 256))).reshape(-1, 3)
        counts = np.bincount(pixels[pixels[:, 1] > 60, 0] // 16, minlength=16)
        return counts / counts.sum()

    shared = [float(np.minimum(hues(scan), hues(mesh)).sum()) for mesh in (own, others)]
    assert shared[0] > shared[1] + 0.1


@pytest.mark.parametrize("seed", [*range(6), *range(90, 96)])
def test_packages_are_closed_and_printed(seed):
    package = make_package(seed)
    assert np.ptp(np.asarray(package.visual.material.baseColorTexture).reshape(-1, 3), axis=0).max() > 60
    assert (package.extents > 0.015).all() and (package.extents < 0.29).all()
    package.merge_vertices(merge_tex=True, merge_norm=True)
    assert package.is_watertight and package.volume > 0
    assert package.visual.uv.min() >= 0 and package.visual.uv.max() <= 1


@pytest.mark.parametrize("seed", range(8))
def test_bags_are_closed_and_folded(seed):
    bag = make_bag(seed)
    assert (bag.extents > 0.04).all() and (bag.extents < 0.4).all()
    bag.merge_vertices(merge_tex=True, merge_norm=True)
    assert bag.is_watertight and 0 < bag.volume < 0.8 * bag.convex_hull.volume


def test_listed_images_have_the_stated_number_of_views_per_layout(tmp_path):
    folder = tmp_path / "table"
    (folder / "images/train").mkdir(parents=True)
    (folder / "data.yaml").write_text("names: {0: tin}\n")
    for number in range(40):
        (folder / f"images/train/{number:06d}.jpg").touch()

    def numbers(**some: int) -> list[int]:
        listing = experiment.listed([folder], tmp_path / "listed", **some) / "train.txt"
        return [int(Path(line).stem) for line in listing.read_text().split()]

    assert numbers(first=8) == list(range(8))
    assert numbers(first=8, views=4) == [0, 1, 2, 3, 8, 9, 10, 11]
    assert numbers(first=10, views=2) == [0, 1, 8, 9, 16, 17, 24, 25, 32, 33]
    assert numbers(images=30, views=7) == [n for n in numbers(images=35, views=7) if n in numbers(images=30, views=7)]
    (folder / "images/train/000017.jpg").unlink()
    assert len(numbers(first=8, views=4)) == 8
    for some in ({"first": 10, "views": 2}, {"first": 48}, {"images": 50}):
        with pytest.raises(SystemExit, match=r"are missing|50 images are required"):
            numbers(**some)
