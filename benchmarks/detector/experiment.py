"""One arm of the detector experiment with one seed: rendering, training, and evaluation on photographs.

    python -m benchmarks.detector.experiment WORK ARM SEED [--plan workshop.yaml] [--device cuda:0] [--weights FILE.pt]
        [--fold 0] [--trained]
    python -m benchmarks.detector WORK --weights FILE.pt         # all arms and seeds, in parallel

WORK is the output of ``benchmarks.detector.material``, with arms in ``arms.yaml``; with ``--plan workshop.yaml``, it is
that of ``benchmarks.detector.workshop``, with arms in the plan; ``--plan cycles.yaml`` evaluates the same trainings on
the photographs of ``benchmarks.detector.cycles_photos``. Photographs show a few scenes under several lights. An
arm that is trained on photographs is trained once for each fold of scenes, on the other scenes, and evaluated on the
fold; detections of all folds are evaluated together. Precision is also computed for samples of scenes, drawn with
replacement and equal for every arm, which give intervals of an arm and of differences.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import deepcopy
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from benchmarks.record import figure, recording
from mitsplat.detector import DetectionMatches, TrainSettings, evaluate_detector, train_detector
from mitsplat.detector.detector_evaluation import NMS_IOU
from mitsplat.detector.losses import error_gains
from mitsplat.detector.scores import Detection, overlaps
from mitsplat.detector.training import Run, open_run
from mitsplat.storage.files import write_text

HERE = Path(__file__).parent
PLAN = Path("arms.yaml")
VIEWS = 8
"""Views per layout, as in ``groceries.yaml`` and the shipped scenes."""
SAMPLES = 200
"""Number of draws of scenes with replacement."""


def read_arms(plan: Path = PLAN) -> dict[str, Any]:
    """Read ``arms.yaml``, or another plan beside it; its entries replace those of the plan that it is ``like``."""
    content = dict(YAML(typ="safe").load((HERE / plan).read_text()))
    return read_arms(Path(content["like"])) | content if "like" in content else content


def scenes_of(arm: Mapping[str, Any]) -> list[str]:
    """Return the training scenes of an arm by name: their changes, joined by ``+``."""
    return ["+".join([scene, *([arm["change"]] if "change" in arm else [])]) for scene in arm.get("scenes", [])]


def result_of(arm: str, seed: int, plan: Path = PLAN) -> str:
    """Return the name of the recorded result of an arm and a seed."""
    return f"detector.experiment-{arm}-{seed}" + ("" if plan == PLAN else f"-plan_{plan.stem}")


def base_of(plan: Mapping[str, Any], scene: str) -> Path:
    """Return the scene file that a scene changes: ``scene`` of its first change, or that of the plan."""
    return HERE / str(plan["changes"][scene.partition("+")[0]].get("scene", plan["scene"]))


def state_of_scenes(plan: Mapping[str, Any], arm: str) -> str:
    """Return a hash of an arm's training scenes without its own change; only arms of equal scenes are compared.

    Empty if there are none.
    """
    unchanged = [scene.partition("+")[0] for scene in scenes_of(plan["arms"][arm])]
    if not unchanged:
        return ""
    bases = "".join(path.read_text() for path in dict.fromkeys(base_of(plan, scene) for scene in unchanged))
    changes = [plan["changes"][scene] for scene in unchanged]
    return hashlib.sha256((bases + json.dumps(changes)).encode()).hexdigest()[:16]


def write_scene(work: Path, name: str, plan: Path = PLAN) -> Path:
    """Write a scene with the changes in its name, by dotted key; null values are removed at the end."""
    arms = read_arms(plan)
    scene = YAML(typ="safe").load(base_of(arms, name).read_text())
    rows = [row for change in name.split("+") for row in arms["changes"][change].items() if row[0] != "scene"]
    # Later list entries are processed first, so that indices remain those of groceries.yaml.
    gone = sorted({row for row in rows if row[1] is None}, reverse=True)
    for key, value in [row for row in rows if row[1] is not None] + gone:
        *way, last = [int(part) if part.isdigit() else part for part in key.split(".")]
        place = scene
        for step in way:
            place = place.setdefault(step, {}) if isinstance(place, dict) else place[step]
        if value is None:
            if not isinstance(place, list) or last < len(place):
                del place[last]
        elif isinstance(place, list) and last == len(place):
            place.append(deepcopy(value))
        else:
            place[last] = deepcopy(value)
    path = work / f"{name}.yaml"
    with path.open("w") as file:
        YAML(typ="safe").dump(scene, file)
    return path


def folds_of(plan: Mapping[str, Any], arm: str) -> list[set[int]]:
    """Return the evaluation scenes of each training of an arm: all at once, if it is not trained on photographs."""
    folds = [set(fold) for fold in plan["folds"]]
    return folds if plan["arms"][arm].get("real") else [set().union(*folds)]


def photos_of(plan: Mapping[str, Any]) -> str:
    """Return the folder of WORK with a plan's photographs."""
    return str(plan.get("photos", "photos"))


def check_photographs(work: Path, plan: Mapping[str, Any]) -> None:
    """Refuse photographs that are not those of a plan, because scores of different photographs are not comparable.

    Raises:
        SystemExit: If their maker, their quality, their scenes or the number of views differs from what the plan states
            in ``photographs``. Plans without this key are not checked.
    """
    wanted, path = plan.get("photographs"), work / photos_of(plan) / "labels.json"
    if wanted is None:
        return
    labels = json.loads(path.read_text())
    made = labels.get("info", {})
    views = Counter(scene_of(image["file_name"]) for image in labels["images"])
    scenes = sorted(wanted.get("scenes", set().union(*map(set, plan["folds"]))))
    found = [(key, made.get(key), wanted[key]) for key in ("made_by", "samples", "width")]
    found += [("scenes", sorted(views), scenes), ("views", sorted(set(views.values())), [wanted["views"]])]
    for key, got, expected in found:
        if got != expected:
            raise SystemExit(f"{path}: {key} must be {expected}, as in the plan (got {got}): use the WORK of the plan")


def scene_of(image: str) -> int:
    """Return the scene of a photograph, from its name."""
    found = re.search(r"scene_(\d+)_", image)
    if found is None:
        raise SystemExit(f"{image} is not named scene_NNNN_LLLL")
    return int(found[1])


def photographs(work: Path, scenes: set[int], name: str, photos: str = "photos") -> Path:
    """Write a COCO folder of the photographs of some scenes, from another folder of WORK."""
    folder = work / (name if photos == "photos" else f"{name}_{photos}")
    with (work / photos / "labels.json").open() as file:
        labels = json.load(file)
    labels["images"] = [image for image in labels["images"] if scene_of(image["file_name"]) in scenes]
    kept = {image["id"] for image in labels["images"]}
    labels["annotations"] = [one for one in labels["annotations"] if one["image_id"] in kept]
    folder.mkdir(exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for image in labels["images"]:
            if not (folder / image["file_name"]).exists():
                shutil.copy(work / photos / image["file_name"], folder)
        write_text(folder / "labels.json", json.dumps(labels))
    return folder


def listed(
    rendered: list[Path], folder: Path, *, images: int | None = None, first: int | None = None, views: int = VIEWS
) -> Path:
    """Write a YOLO folder that lists some of the rendered images.

    Args:
        rendered: Datasets.
        folder: Folder of the list.
        images: Number of images, in an order that does not depend on the number; None for all.
        first: Number of first images of each dataset, to compare equal contents; None for all.
        views: Number of first views of each layout, of :data:`VIEWS`; with fewer views, the first images have more
            layouts.

    Raises:
        SystemExit: If there are too few images.
    """
    some = []
    for one in rendered:
        found = {int(path.stem): path.resolve() for path in (one / "images" / "train").iterdir()}
        wanted = [i for i in sorted(found) if i % VIEWS < views]
        if first is not None:
            wanted = [i for i in range(first * VIEWS // views) if i % VIEWS < views]
            if not found.keys() >= set(wanted):
                raise SystemExit(f"{one}: some of its first {first} images are missing")
        some += [found[i] for i in wanted]
    if images is not None:
        if len(some) < images:
            raise SystemExit(f"{images} images are required (got {len(some)})")
        some = [some[i] for i in sorted(np.random.default_rng(0).permutation(len(some))[:images])]
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "train.txt", "".join(f"{path}\n" for path in some))
    names = YAML(typ="safe").load((rendered[0] / "data.yaml").read_text())["names"]
    described = StringIO()
    YAML(typ="safe").dump({"train": "train.txt", "names": names}, described)
    write_text(folder / "data.yaml", described.getvalue())
    return folder


def scores_of_merged(
    truth: Mapping[str, Any], detections: Sequence[Detection], merged: Mapping[str, Sequence[str]]
) -> dict[str, tuple[float, float]]:
    """Return mAP50-95 and mAP50 of ``all`` classes and of each merged class, if classes are merged.

    As within any class, of two detections of a merged class that overlap by more than :data:`NMS_IOU`, only the one
    with the higher score counts.

    Args:
        truth: Labels, a COCO dataset.
        detections: Detections, in COCO's results format.
        merged: Names of classes by name of the merged class.
    """
    if not merged:
        return {}
    number = {category["name"]: category["id"] for category in truth["categories"]}
    new = {number[name]: number[names[0]] for names in merged.values() for name in names}
    called = {number[names[0]]: name for name, names in merged.items()}
    labels = [one | {"category_id": new.get(one["category_id"], one["category_id"])} for one in truth["annotations"]]
    categories = [
        one | {"name": called.get(one["id"], one["name"])}
        for one in truth["categories"]
        if new.get(one["id"], one["id"]) == one["id"]
    ]
    found: list[Detection] = []
    kept: dict[tuple[int, int], list[Detection]] = {}
    for one in sorted(detections, key=lambda detection: -detection["score"]):
        if one["category_id"] in new:
            one = one | {"category_id": new[one["category_id"]]}
            others = kept.setdefault((one["image_id"], one["category_id"]), [])
            if others and overlaps([one["bbox"]], [other["bbox"] for other in others]).max() > NMS_IOU:
                continue
            others.append(one)
        found.append(one)
    whole = DetectionMatches({**truth, "annotations": labels, "categories": categories}, found).average_precision()
    return {"all": (whole.map50_95, whole.map50)} | {
        name: whole.classes[name] for name in merged if name in whole.classes
    }


def main() -> None:
    """Train and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("arm")
    parser.add_argument("seed", type=int)
    parser.add_argument("--plan", type=Path, default=PLAN)
    parser.add_argument("--weights", type=Path, help="initial weights; random if absent or if the arm requires it")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--fold", type=int, help="train only this fold, for parallel trainings")
    parser.add_argument("--trained", action="store_true", help="evaluate finished trainings, without rendered images")
    options = parser.parse_args()
    if options.fold is not None:
        trained = train_fold(options, read_arms(options.plan), options.fold)
        print(f"{options.arm} {options.seed}: fold {options.fold} in {trained.record['finished']['seconds']:.0f} s")
        return
    ignore = ("work", "device", "workers", "weights", "fold", "trained")
    with recording("detector.experiment", parser, options, ignore=ignore, gpu=options.device != "cpu"):
        measure(options)


def run_of(options: argparse.Namespace, fold: int) -> Path:
    """Return the folder of a training."""
    return Path(options.work) / "runs" / f"{options.arm}-{options.seed}-{fold}"


def train_fold(options: argparse.Namespace, plan: Mapping[str, Any], number: int) -> Run:
    """Train an arm on its rendered images, and on photographs of other folds."""
    arm = dict(plan["arms"][options.arm])
    work: Path = options.work
    rendered = [work / "data" / scene for scene in scenes_of(arm)]
    if some := {key: arm[key] for key in ("images", "first", "views") if key in arm}:
        rendered = [listed(rendered, work / "listed" / f"{options.arm}-{options.seed}", **some)]
    given = {"weights": options.weights} | plan["train"] | arm.get("train", {})
    settings = TrainSettings(**given, seed=options.seed, device=options.device, workers=options.workers)
    real = None
    if arm.get("real"):
        check_photographs(work, plan)
        folds = folds_of(plan, options.arm)
        real = photographs(work, set().union(*folds) - folds[number], f"without_fold_{number}", photos_of(plan))
    run = run_of(options, number)
    # Without rendered images, photographs are the training set, and not an addition.
    return train_detector(rendered or [real], run, settings, real=real if rendered else None)


def measure(options: argparse.Namespace) -> None:
    """Train an arm for all folds, and evaluate it."""
    plan, work = read_arms(options.plan), options.work
    check_photographs(work, plan)
    folds = folds_of(plan, options.arm)
    everything = photographs(work, set().union(*folds), "all_photos", photos_of(plan))
    size = plan["arms"][options.arm].get("test_size", plan["test_size"])
    detections, truth = [], {}
    for number, fold in enumerate(folds):
        trained = open_run(run_of(options, number)) if options.trained else train_fold(options, plan, number)
        figure(trained.record["finished"]["seconds"], "s", "training", number)
        found = evaluate_detector(trained.path, everything, split="all", size=size, device=options.device)
        truth = json.loads((found.path / "truth.json").read_text())
        judged = {image["id"] for image in truth["images"] if scene_of(image["file_name"]) in fold}
        detections += [
            one for one in json.loads((found.path / "detections.json").read_text()) if one["image_id"] in judged
        ]
    suffix = "" if photos_of(plan) == "photos" else f"-{photos_of(plan)}"
    out = work / "found" / f"{options.arm}-{options.seed}{suffix}.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps([one for one in detections if one["score"] >= 0.01]))
    for name, (strict, loose) in scores_of_merged(truth, detections, plan.get("merged", {})).items():
        figure(strict, "", "merged", name, "map50_95")
        figure(loose, "", "merged", name, "map50")
    matches = DetectionMatches(truth, detections)
    whole = matches.average_precision()
    figure(whole.map50_95, "", "map50_95")
    figure(whole.map50, "", "map50")
    if trained.has_masks:
        masks = DetectionMatches(truth, detections, "segm").average_precision()
        figure(masks.map50_95, "", "masks", "map50_95")
        figure(masks.map50, "", "masks", "map50")
    for name, (strict, _) in whole.classes.items():
        figure(strict, "", "class", name)
    for name, gain in error_gains(truth, detections, whole).items():
        figure(gain, "", "gain", name)
    by_scene: dict[int, list[int]] = {}
    for image in truth["images"]:
        by_scene.setdefault(scene_of(image["file_name"]), []).append(image["id"])
    for name, images in by_scene.items():
        figure(matches.average_precision(images).map50_95, "", "scene", name)
    rng = np.random.default_rng(0)
    draws = rng.integers(len(by_scene), size=(SAMPLES, len(by_scene)))
    scenes = list(by_scene.values())
    figure(
        [matches.average_precision([image for i in draw for image in scenes[i]]).map50_95 for draw in draws],
        "",
        "samples",
    )
    figure(state_of_scenes(plan, options.arm), "", "scenes")
    figure("random" if trained.record["settings"]["weights"] is None else "COCO", "", "start")
    print(f"{options.arm} {options.seed}: mAP50-95 {whole.map50_95:.3f}, mAP50 {whole.map50:.3f}")


if __name__ == "__main__":
    main()
