"""From datasets to the weights of a detector, which Ultralytics trains.

The folder of a run::

    run.json          settings, versions, classes, images by digest; when it is finished, its steps, seconds and losses
    weights.pt        the final weights, once it is finished
    weights/last.pt   the last checkpoint, until then
    data/             the images as links and their labels, until then
    tiles/            what photographs are cut to, until then
    results.csv       losses and learning rates of every epoch of 50 steps, by Ultralytics
    args.yaml         all of Ultralytics' settings

"""

from __future__ import annotations

import fcntl
import json
import shutil
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mitsplat.detector.libraries import (
    check_device,
    check_weights,
    load_libraries,
    read_network,
    torch_device,
    versions,
)
from mitsplat.detector.mix import plan_images
from mitsplat.detector.photo_tiles import cut_photographs
from mitsplat.detector.sets import STRIDE, LabelledSet, check_masks, in_classes, read_set
from mitsplat.errors import InputError
from mitsplat.progress import Progress
from mitsplat.runtime.cores import usable_cores
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import open_in_place, read_json, remove_folder, storage_errors, write_text

RUN = "run.json"
WEIGHTS = "weights.pt"
_TILES = "tiles"
_OWN = frozenset((RUN, WEIGHTS, "weights", "data", _TILES, "results.csv", "args.yaml", ".lock", "evaluation"))
"""Names of what may lie in the folder of a run, beside temporary files and evaluations."""
_SETS = ("datasets", "real")
_MOST_WORKERS = 8


@dataclass(frozen=True)
class TrainSettings:
    """What decides the weights of a detector, beside its images.

    Attributes:
        model: The network's YAML file of Ultralytics; one of masks, such as ``yolo11n-seg``, or of boxes, ``yolo11n``.
        weights: A file of weights to start from, random ones if None. Nothing is ever downloaded.
        steps: Batches that are learnt from, each of which changes the weights once, however many images there are.
        batch: Images of a step.
        size: Longer side that images are scaled to [px], a multiple of 32.
        share: Of real images among those of each step, where there are some.
        real_size: Longer side at which photographs will be searched [px]. If it is more than ``size``, they are cut to
            tiles that show things as large.
        mirror: Whether half of the images are mirrored left to right: wrong of what is printed, and of left and right
            parts that are told apart.
        seed: Decides everything that is random.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``, as PyTorch counts GPUs.
        workers: Processes that read images, beside this one; if None, up to 8, and none on the CPU.
    """

    model: str = "yolo11n-seg.yaml"
    weights: Path | None = None
    steps: int = 1500
    batch: int = 16
    size: int = 640
    share: float = 0.1
    real_size: int | None = None
    mirror: bool = True
    seed: int = 0
    device: str = "auto"
    workers: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("batch", 1), ("size", 2 * STRIDE), ("seed", 0), ("workers", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{name} must be {least} or more (got {value})")
        if self.seed >= 2**32:
            raise InputError(f"seed must be less than 2^32 (got {self.seed})")
        if self.size % STRIDE:
            raise InputError(f"size must be a multiple of {STRIDE} px (got {self.size})")
        if not 0 < self.share < 1:
            raise InputError(f"share of real images must lie between 0 and 1 (got {self.share:g})")
        if self.real_size is not None and self.real_size < self.size:
            raise InputError(f"real_size must be no less than size, {self.size} px (got {self.real_size})")
        check_device(self.device)
        if self.weights is not None:
            object.__setattr__(self, "weights", Path(self.weights))

    def decisive(self) -> dict[str, Any]:
        """Those that decide what is learnt, not where."""
        settings = asdict(self) | {"weights": None if self.weights is None else file_hash(self.weights)}
        return {name: value for name, value in settings.items() if name not in ("device", "workers")}


@dataclass(frozen=True)
class Run:
    """The folder of a training.

    Attributes:
        path: The folder.
        record: What ``run.json`` says.
        was_finished: Whether there was nothing left to do.
    """

    path: Path
    record: dict[str, Any]
    was_finished: bool = False

    @property
    def weights(self) -> Path:
        """The final weights."""
        return self.path / WEIGHTS

    @property
    def class_names(self) -> tuple[str, ...]:
        """What it tells apart."""
        return tuple(self.record["classes"])

    @property
    def has_masks(self) -> bool:
        """Whether it predicts masks, or boxes alone."""
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
    """Train a detector on the training splits of datasets, or go on with the training in a folder.

    Args:
        datasets: Datasets of mitsplat with YOLO files, or any other that :func:`mitsplat.detector.read_set` takes.
        out: Folder of the run. One that was interrupted goes on from its last checkpoint to the same number of steps.
        settings: What decides the weights.
        real: Labelled photographs, of which every step has ``settings.share``.
        overwrite: Remove the run in the folder first.
        progress: Told of images that are read, and of steps.

    Raises:
        InputError: If images or labels are missing, torn or out of range, classes differ, masks are to be learnt from
            boxes, weights do not fit, ``real_size`` is of no photographs, or the folder holds something else or a run
            with other settings.
        MissingResourceError: If Ultralytics, the GPU or its memory is missing.
    """
    settings, out = settings or TrainSettings(), Path(out)
    if not datasets:
        raise InputError("there must be a dataset to learn from (got none)")
    if settings.real_size is not None and real is None:
        raise InputError("--real-size is that of photographs: name them by --real")
    if settings.weights is not None and not settings.weights.is_file():
        raise InputError(f"--weights must be a file of Ultralytics (.pt) that is there (got {settings.weights})")
    if not (out / RUN).is_file():
        check_folder(out, "a run")
    load_libraries()
    network, masks = read_network(settings.model)
    settings = replace(settings, model=network)
    sets, photographs = read_sets(datasets, real, masks=masks, progress=progress)
    for found in [*sets, *([photographs] if photographs else [])]:
        _check_apart(out, found)
    if settings.weights is not None:
        check_weights(settings.weights, network, masks=masks)
    device, device_name = torch_device(settings.device)
    record = {
        "settings": settings.decisive() | ({} if photographs else {"share": None}),
        "masks": masks,
        "classes": list(sets[0].class_names),
        "datasets": [found.described() for found in sets],
        "real": None if photographs is None else photographs.described(),
    }
    with storage_errors(out), _locked(out):
        if overwrite:
            _clear(out)
        kept = _kept(out, record)
        if kept is not None and kept.record.get("finished"):
            return replace(kept, was_finished=True)
        start = {"weights": str(settings.weights)} if settings.weights else {"network": network}
        record |= {"start": start, "device": device_name, "versions": versions(), "finished": None}
        write_text(out / RUN, json.dumps(record, indent=2) + "\n")
        finished = _train(sets, photographs, out, settings, masks=masks, device=device, progress=progress)
        write_text(out / RUN, json.dumps(record | {"finished": finished}, indent=2) + "\n")
        for name in ("data", _TILES, "weights"):
            remove_folder(out / name)
        return Run(out, record | {"finished": finished})


def open_run(path: str | Path) -> Run:
    """The run in a folder, which must be finished.

    Raises:
        InputError: If there is none, or it is not finished.
    """
    path = Path(path)
    run = _read_run(path)
    if run is None:
        raise InputError(f"{path}: must be the folder of `mitsplat train` (there is no {RUN})")
    if not run.record.get("finished") or not run.weights.is_file():
        raise InputError(f"{path}: this training is not finished: run `mitsplat train` again with the same settings")
    return run


def read_sets(
    datasets: Sequence[str | Path], real: str | Path | None, *, masks: bool, progress: Progress | None = None
) -> tuple[list[LabelledSet], LabelledSet | None]:
    """The training splits of datasets and of photographs, with the classes in the order of the first.

    Raises:
        InputError: As :func:`train_detector`.
    """
    found = [read_set(path, "train", progress) for path in datasets]
    if real is not None:
        found.append(read_set(real, "train", progress))
    for one in found:
        if all(instance.crowd for sample in one.samples for instance in sample.instances):
            raise InputError(f"{one.root}: nothing but crowds is labelled, from which nothing can be learnt")
    found = [in_classes(one, found[0].class_names, str(found[0].root)) for one in found]
    if masks:
        for one in found:
            check_masks(one)
    return (found, None) if real is None else (found[:-1], found[-1])


def write_data(sets: Sequence[LabelledSet], folder: Path) -> Path:
    """Write images, as links, and labels of sets as Ultralytics reads them, in a folder that is made anew.

    Labels are polygons where all instances have masks, and boxes otherwise.

    Returns:
        The list of the images, in the order of the sets.
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
                values = (instance.outlined() / (sample.width, sample.height)).ravel().tolist()
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
) -> dict[str, Any]:
    from mitsplat.detector import fixed_steps  # optional: it derives from Ultralytics

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
    workers = min(_MOST_WORKERS, usable_cores()) if settings.workers is None else settings.workers
    counted = {
        "steps": settings.steps,
        "images_a_step": settings.batch,
        "images_taken": int(plan.size),
        "real_images_taken": int((plan >= rendered).sum()),
    }
    started = time.perf_counter()
    if (out / fixed_steps.LAST).is_file() and fixed_steps.epochs_done(out) in (0, job.epochs):
        fixed_steps.finish_checkpoint(out)  # it was ended between its last step and its end
        return counted | {"seconds": 0.0, "resumed_at_step": settings.steps}
    outcome = fixed_steps.train_job(
        job,
        network=settings.model,
        weights=settings.weights,
        size=settings.size,
        mirror=settings.mirror,
        seed=settings.seed,
        device=device,
        workers=0 if device == "cpu" else workers,
    )
    return counted | {
        "updates_of_weights": outcome.updates,
        "optimizer": outcome.optimizer,
        "losses": outcome.losses,
        "seconds": round(time.perf_counter() - started, 1),
        "resumed_at_step": outcome.resumed_at,
    }


def _read_run(path: Path) -> Run | None:
    if not (path / RUN).is_file():
        return None
    try:
        record = read_json(path / RUN)
    except (OSError, ValueError) as error:
        raise InputError(f"{path / RUN}: cannot be read ({error})") from error
    if not isinstance(record, dict) or not {"settings", "classes", "masks"} <= record.keys():
        raise InputError(f"{path / RUN}: is not what `mitsplat train` writes")
    return Run(path, record)


def _kept(out: Path, record: dict[str, Any]) -> Run | None:
    """The run in a folder, which must be of the same settings and images."""
    kept = _read_run(out)
    if kept is None:
        return None
    was, now = kept.record["settings"], record["settings"]
    told = [
        f"{name} {str(was.get(name))[:20]} (got {str(now[name])[:20]})" for name in now if was.get(name) != now[name]
    ]
    told += [f"other images of {name}" for name in _SETS if _digests(kept.record.get(name)) != _digests(record[name])]
    if told:
        raise InputError(f"{out}: was begun with {', '.join(told)}: give another folder, or --overwrite")
    return kept


def _digests(described: Any) -> list[str]:
    sets = described if isinstance(described, list) else [described] if described else []
    return [found["digest"] for found in sets]


def check_folder(out: Path, kind: str, own: Collection[str] = ()) -> None:
    """Refuse a file, and a folder that holds something else than files of its ``own``; hidden ones do not count.

    Raises:
        InputError: Which says what ``kind`` of folder is wanted.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: must be a folder (got a file)")
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if strange := [name for name in names if not name.startswith(".") and name not in own]:
        raise InputError(f"{out}: holds something else than {kind} (got {strange[0]}): give another folder")


def _check_apart(out: Path, found: LabelledSet) -> None:
    """Refuse to learn from what lies in the folder of the run, which is removed from it."""
    folder = out.resolve()
    for path in (found.root, *(sample.path for sample in found.samples)):
        if path.resolve().is_relative_to(folder):
            raise InputError(f"{out}: must not hold what is learnt from (got {path}): give another folder")


def _clear(out: Path) -> None:
    for name in sorted(_OWN - {".lock"}):
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
            raise InputError(f"{out}: another training is at work in it") from error
        if links := [out / name for name in sorted(_OWN) if (out / name).is_symlink()]:
            raise InputError(f"{links[0]}: must not be a link, for a run is written in its own folder; remove it")
        yield
