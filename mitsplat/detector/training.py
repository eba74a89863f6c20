"""Training of an Ultralytics detector on datasets.

The run folder::

    run.json          settings, versions, classes, digests of the images; after the end also steps, seconds and losses
    weights.pt        final weights, after the end
    weights/last.pt   last checkpoint, until the end
    data/             images as links and their labels, until the end
    tiles/            tiles of the photographs, until the end
    results.csv       losses and learning rates of each epoch of 50 steps, by Ultralytics
    args.yaml         all settings of Ultralytics
"""

from __future__ import annotations

import fcntl
import json
import shutil
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from mitsplat.detector.labelled_sets.labelled_set import LabelledSet, check_masks, match_classes, reorder_classes
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.libraries import (
    check_weights,
    check_weights_exist,
    load_libraries,
    read_network,
    torch_device,
    versions,
)
from mitsplat.detector.mix import plan_images
from mitsplat.detector.photo_tiles import cut_photographs
from mitsplat.detector.train_settings import TrainSettings
from mitsplat.errors import InputError
from mitsplat.progress import Progress
from mitsplat.runtime.cores import usable_cores
from mitsplat.storage.files import JsonObject, open_in_place, read_json, remove_folder, storage_errors, write_text

RUN_FILE = "run.json"
WEIGHTS = "weights.pt"
_TILES = "tiles"
_RUN_FILES = frozenset(
    (RUN_FILE, WEIGHTS, "weights", "data", _TILES, "results.csv", "args.yaml", ".lock", "evaluation")
)
"""Names of files that a run folder may contain, in addition to temporary files."""
_SET_KEYS = ("datasets", "real")
_MAX_WORKERS = 8


@dataclass(frozen=True)
class Run:
    """A training run.

    Attributes:
        path: Folder of the run.
        record: Content of ``run.json``.
        was_finished: True if the run was already finished, so no step was left.
    """

    path: Path
    record: JsonObject
    was_finished: bool = False

    @property
    def weights(self) -> Path:
        """Path of the final weights."""
        return self.path / WEIGHTS

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(self.record["classes"])

    @property
    def has_masks(self) -> bool:
        """True if the detector predicts masks."""
        return bool(self.record["masks"])


def train_detector(
    datasets: Sequence[str | Path],
    out: str | Path,
    settings: TrainSettings | None = None,
    *,
    real: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Train a detector on the training splits of datasets, or resume the training in a folder.

    Args:
        datasets: mitsplat datasets with YOLO files, or other folders that :func:`mitsplat.detector.read_set` accepts.
        out: Folder of the run. An interrupted run resumes from its last checkpoint and ends at the same number of
            steps.
        settings: Training settings.
        real: Labelled photographs, which make up ``settings.share`` of the images. Labels of classes that the datasets
            do not have are not used; a warning names them.
        overwrite: Remove an existing run in the folder first.
        progress: Called after each image that is read, and after each step.

    Raises:
        InputError: If images or labels are missing, truncated or out of range, the classes of datasets differ, the
            photographs lack a class, or a mask model gets box labels. Also if the weights do not fit, ``real_size`` is
            set without photographs, or the folder contains other files or a run with other settings.
        MissingResourceError: If Ultralytics or the GPU is missing, or the GPU memory is too small.
    """
    settings, out = settings or TrainSettings(), Path(out)
    if not datasets:
        raise InputError("training needs at least one dataset (got none)")
    if settings.real_size is not None and real is None:
        raise InputError("--real-size needs photographs: give them with --real")
    if settings.weights is not None:
        check_weights_exist(settings.weights)
    if not (out / RUN_FILE).is_file():
        check_folder(out, "a run")
    load_libraries()
    network, masks = read_network(settings.model)
    settings = replace(settings, model=network)
    sets, photographs = read_sets(datasets, real, masks=masks, progress=progress)
    for found in [*sets, *([photographs] if photographs else [])]:
        _check_separate(out, found)
    if settings.weights is not None:
        check_weights(settings.weights, network, masks=masks)
    device, device_name = torch_device(settings.device)
    record = {
        "settings": settings.weight_settings() | ({} if photographs else {"share": None}),
        "masks": masks,
        "classes": list(sets[0].class_names),
        "datasets": [found.to_record() for found in sets],
        "real": None if photographs is None else photographs.to_record(),
    }
    with storage_errors(out), _locked(out):
        if overwrite:
            _clear(out)
        kept = _existing_run(out, record)
        if kept is not None and kept.record.get("finished"):
            return replace(kept, was_finished=True)
        start = {"weights": str(settings.weights)} if settings.weights else {"network": network}
        record |= {"start": start, "device": device_name, "versions": versions(), "finished": None}
        write_text(out / RUN_FILE, json.dumps(record, indent=2) + "\n")
        finished = _train(sets, photographs, out, settings, masks=masks, device=device, progress=progress)
        write_text(out / RUN_FILE, json.dumps(record | {"finished": finished}, indent=2) + "\n")
        for name in ("data", _TILES, "weights"):
            remove_folder(out / name)
        return Run(out, record | {"finished": finished})


def open_run(path: str | Path) -> Run:
    """Open the finished run in a folder.

    Raises:
        InputError: If there is no run, or it is not finished.
    """
    path = Path(path)
    run = _read_run(path)
    if run is None:
        raise InputError(f"{path}: must be the folder of `mitsplat train` (there is no {RUN_FILE})")
    if not run.record.get("finished") or not run.weights.is_file():
        raise InputError(f"{path}: this training is not finished: run `mitsplat train` again with the same settings")
    return run


def read_sets(
    datasets: Sequence[str | Path], real: str | Path | None, *, masks: bool, progress: Progress | None = None
) -> tuple[list[LabelledSet], LabelledSet | None]:
    """Read the training splits of datasets and of photographs, with the class order of the first dataset.

    Raises:
        InputError: As :func:`train_detector`.
    """
    found = [read_set(path, "train", progress) for path in datasets]
    classes, owner = found[0].class_names, str(found[0].root)
    found = [reorder_classes(one, classes, owner) for one in found]
    if real is not None:
        found.append(match_classes(read_set(real, "train", progress), classes, owner))
    for one in found:
        if all(instance.crowd for sample in one.samples for instance in sample.instances):
            raise InputError(
                f"{one.root}: all labels are crowds, which cannot be used for training; set iscrowd to 0 if each is "
                "one object, because CVAT exports masks as crowds"
            )
    if masks:
        for one in found:
            check_masks(one)
    return (found, None) if real is None else (found[:-1], found[-1])


def write_data(sets: Sequence[LabelledSet], folder: Path) -> Path:
    """Write images (as links) and labels in Ultralytics' layout, in a folder that is emptied first.

    Labels are polygons if all instances have masks, and boxes otherwise.

    Returns:
        File that lists the images, in the order of the sets.
    """
    remove_folder(folder)
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    polygons = all(i.has_mask for found in sets for sample in found.samples for i in sample.instances)
    images = []
    for number, sample in enumerate(sample for found in sets for sample in found.samples):
        image = folder.absolute() / f"images/{number:07d}{sample.path.suffix.lower()}"
        image.symlink_to(sample.path.absolute())
        lines = []
        for instance in sample.instances:
            if instance.crowd:
                continue
            if polygons:
                values = (instance.outline_points() / (sample.width, sample.height)).ravel().tolist()
            else:
                x0, y0, x1, y1 = instance.box
                w, h = sample.width, sample.height
                values = [(x0 + x1) / 2 / w, (y0 + y1) / 2 / h, (x1 - x0) / w, (y1 - y0) / h]
            lines.append(" ".join([str(instance.class_index), *(f"{value:.6f}" for value in values)]) + "\n")
        (folder / f"labels/{number:07d}.txt").write_text("".join(lines))
        images.append(str(image))
    listing = folder / "images.txt"
    listing.write_text("\n".join(images) + "\n")
    return listing


def _train(
    sets: Sequence[LabelledSet],
    photographs: LabelledSet | None,
    out: Path,
    settings: TrainSettings,
    *,
    masks: bool,
    device: str,
    progress: Progress | None,
) -> JsonObject:
    from mitsplat.detector import fixed_steps  # optional dependency: this module subclasses Ultralytics

    rendered = sum(len(found.samples) for found in sets)
    if photographs is not None and settings.real_size is not None and settings.real_size > settings.size:
        remove_folder(out / _TILES)
        photographs = cut_photographs(photographs, settings.real_size, settings.size, out / _TILES)
    plan = plan_images(
        rendered,
        0 if photographs is None else len(photographs.samples),
        share=settings.share,
        steps=settings.steps,
        batch=settings.batch,
        seed=settings.seed,
    )
    listing = write_data([*sets, *([] if photographs is None else [photographs])], out / "data")

    def step(done: int, loss: float) -> None:
        if progress is not None:
            progress(done, settings.steps, f"training, loss {loss:.3g}")

    job = fixed_steps.Job(out, listing, sets[0].class_names, plan, masks, step)
    workers = min(_MAX_WORKERS, usable_cores()) if settings.workers is None else settings.workers
    counts = {
        "steps": settings.steps,
        "images_a_step": settings.batch,
        "images_taken": int(plan.size),
        "real_images_taken": int((plan >= rendered).sum()),
    }
    started = time.perf_counter()
    if (out / fixed_steps.LAST_CHECKPOINT).is_file() and fixed_steps.epochs_done(out) in (0, job.epochs):
        fixed_steps.finish_checkpoint(out)  # the process ended between the last step and the export of the weights
        return counts | {"seconds": 0.0, "resumed_at_step": settings.steps}
    outcome = fixed_steps.train_job(job, settings, device=device, workers=0 if device == "cpu" else workers)
    return counts | {
        "updates_of_weights": outcome.updates,
        "optimizer": outcome.optimizer,
        "losses": outcome.losses,
        "seconds": round(time.perf_counter() - started, 1),
        "resumed_at_step": outcome.resumed_at,
    }


def _read_run(path: Path) -> Run | None:
    if not (path / RUN_FILE).is_file():
        return None
    try:
        record = read_json(path / RUN_FILE)
    except (OSError, ValueError) as error:
        raise InputError(f"{path / RUN_FILE}: cannot be read ({error})") from error
    if not isinstance(record, dict) or not {"settings", "classes", "masks"} <= record.keys():
        raise InputError(f"{path / RUN_FILE}: must be a file written by `mitsplat train`")
    return Run(path, record)


def _existing_run(out: Path, record: JsonObject) -> Run | None:
    """Return the run in a folder, which must have the same settings and images, or None."""
    kept = _read_run(out)
    if kept is None:
        return None
    was, now = kept.record["settings"], record["settings"]
    differences = [
        f"{name} {str(was.get(name))[:20]} (got {str(now[name])[:20]})" for name in now if was.get(name) != now[name]
    ]
    differences += [
        f"other images of {name}" for name in _SET_KEYS if _digests(kept.record.get(name)) != _digests(record[name])
    ]
    if differences:
        raise InputError(f"{out}: was started with {', '.join(differences)}: choose another folder, or use --overwrite")
    return kept


def _digests(described: JsonObject | list[JsonObject] | None) -> list[str]:
    sets = described if isinstance(described, list) else [described] if described else []
    return [found["digest"] for found in sets]


def check_folder(out: Path, kind: str, own: Collection[str] = ()) -> None:
    """Refuse a path that is a file, or a folder with visible files whose names are not in ``own``.

    Raises:
        InputError: If the path is refused; the message names the expected ``kind`` of folder.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: must be a folder (got a file)")
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if strange := [name for name in names if not name.startswith(".") and name not in own]:
        raise InputError(f"{out}: must contain only {kind} (got {strange[0]}): choose another folder")


def _check_separate(out: Path, found: LabelledSet) -> None:
    """Refuse a run folder that contains training images, because files of the run folder are removed."""
    folder = out.resolve()
    for path in (found.root, *(sample.path for sample in found.samples)):
        if path.resolve().is_relative_to(folder):
            raise InputError(f"{out}: must not contain training images (got {path}): choose another folder")


def _clear(out: Path) -> None:
    for name in sorted(_RUN_FILES - {".lock"}):
        path = out / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    out.mkdir(parents=True, exist_ok=True)
    with open_in_place(out / ".lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{out}: another training is running in this folder") from error
        if links := [out / name for name in sorted(_RUN_FILES) if (out / name).is_symlink()]:
            raise InputError(
                f"{links[0]}: must not be a link, because a run is written only in its own folder: remove the link"
            )
        yield
