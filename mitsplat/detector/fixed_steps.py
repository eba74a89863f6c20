"""Ultralytics' trainer with a fixed number of steps, and images that a plan names. Needs the extra ``train``.

Its epoch is here no walk through the images but :data:`EPOCH` steps: what Ultralytics does by epochs (the learning
rate, checkpoints, the end of mosaics) is the same for any number of images. A step is one batch and one update of the
weights.
"""

from __future__ import annotations

import io
import random
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch.utils.data import Sampler
from ultralytics.data.augment import Mosaic
from ultralytics.data.build import InfiniteDataLoader, seed_worker
from ultralytics.models.yolo.detect.train import DetectionTrainer
from ultralytics.models.yolo.segment.train import SegmentationTrainer
from ultralytics.nn.tasks import torch_safe_load
from ultralytics.utils.ops import resample_segments
from ultralytics.utils.torch_utils import strip_optimizer

from mitsplat.arrays import Int64Array
from mitsplat.detector.libraries import UNREADABLE, under_another_name
from mitsplat.errors import InputError, MissingResourceError

EPOCH = 50
"""Steps after which a checkpoint is kept, from which an interrupted training goes on."""
_WARM_UP = 100
"""Most steps until the learning rate is whole; a tenth of shorter trainings."""
_MANY = 10_000
"""Steps beyond which Ultralytics takes MuSGD, and AdamW up to it; it counts them by images, here they are known."""
_OUTLINE = 1000
"""Points that Ultralytics gives every outline that has no more."""

LAST = "weights/last.pt"
"""The checkpoint that a training goes on from, below the folder of its run."""


@dataclass(frozen=True)
class Job:
    """What to train.

    Attributes:
        run: Folder of the run.
        images: File that lists the images; what the plan counts.
        class_names: Classes.
        plan: Indices of images, shape (steps, batch).
        masks: Whether masks are learnt, or boxes alone.
        step: Told how many steps are done, and the loss.
    """

    run: Path
    images: Path
    class_names: tuple[str, ...]
    plan: Int64Array
    masks: bool
    step: Callable[[int, float], None]

    @property
    def epochs(self) -> int:
        """How often a checkpoint is kept."""
        return -(-len(self.plan) // EPOCH)


@dataclass(frozen=True)
class TrainingOutcome:
    """How a training went.

    Attributes:
        weights: File of the final weights, averaged over the last steps.
        updates: Times that the weights were changed, in all.
        resumed_at: Step at which it went on, 0 if it began.
        losses: The last ones, by their names.
        optimizer: What changed the weights.
    """

    weights: Path
    updates: int
    resumed_at: int
    losses: dict[str, float]
    optimizer: str


def train_job(
    job: Job, *, network: str, weights: Path | None, size: int, mirror: bool, seed: int, device: str, workers: int
) -> TrainingOutcome:
    """Train, from the run's checkpoint if it has one.

    Args:
        job: What to train.
        network: Name of the network's YAML file.
        weights: What to start from, or None for random weights.
        size: Longer side of images [px].
        mirror: Whether half of them are mirrored left to right.
        seed: Decides everything that is random.
        device: As Ultralytics names it.
        workers: Processes that read images; none on the CPU.
    """
    epochs, batch = job.epochs, job.plan.shape[1]
    settings: dict[str, Any] = {
        "task": "segment" if job.masks else "detect",
        "model": network,
        "epochs": epochs,
        "batch": batch,
        "nbs": batch,  # one update of the weights for each batch
        "imgsz": size,
        "fliplr": 0.5 if mirror else 0.0,
        "seed": seed,
        "deterministic": True,
        "device": device,
        "workers": workers,
        "cache": "ram",
        "val": False,
        "plots": False,
        "patience": 0,
        "warmup_epochs": min(_WARM_UP, len(job.plan) // 10) / min(EPOCH, len(job.plan)),
        "close_mosaic": round(epochs / 10),
        "save_dir": str(job.run),
        "exist_ok": True,
        "verbose": False,
        # As Ultralytics' "auto" for as many updates.
        "optimizer": "MuSGD" if len(job.plan) > _MANY else "AdamW",
        "lr0": 0.01 if len(job.plan) > _MANY else round(0.01 / (4 + len(job.class_names)), 6),
        "momentum": 0.9,
        "warmup_bias_lr": 0.0,
    }
    callbacks: defaultdict[str, list[Callable[[Any], None]]] = defaultdict(list)
    callbacks["on_train_epoch_start"].append(_FixedSteps.begin_epoch)
    callbacks["on_train_batch_end"].append(_FixedSteps.end_step)
    last = job.run / LAST
    with ExitStack() as links:
        settings["pretrained"] = links.enter_context(under_another_name(weights)) if weights else False
        if last.is_file():
            settings["resume"] = links.enter_context(under_another_name(last))
        trainer = (_Masks if job.masks else _Boxes)(job, settings, callbacks)
        trainer.train()
    return trainer.outcome()


def finish_checkpoint(run: Path) -> Path:
    """The final weights of a run, made of its last checkpoint."""
    final, part = run / "weights.pt", run / ".weights.pt.part"
    part.unlink(missing_ok=True)  # a link of this name would be followed
    strip_optimizer(run / LAST, str(part))
    part.replace(final)
    return final


def epochs_done(run: Path) -> int:
    """Epochs after which the checkpoint of a run was kept.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        with under_another_name(run / LAST) as name:
            return int(torch_safe_load(name)[0]["epoch"]) + 1
    except UNREADABLE as error:
        raise InputError(
            f"{run / LAST}: cannot be read ({type(error).__name__}): begin anew with --overwrite"
        ) from error


class _Plan(Sampler[int]):
    """Indices of the images of all steps from the ``first`` on; as long as an epoch."""

    def __init__(self, plan: Int64Array) -> None:
        self._plan, self.first = plan, 0

    def __iter__(self) -> Iterator[int]:
        yield from self._plan[self.first :].ravel().tolist()

    def __len__(self) -> int:
        return int(min(EPOCH, len(self._plan)) * self._plan.shape[1])


class _FixedSteps:
    """What both trainers have in common."""

    def __init__(self, job: Job, settings: dict[str, Any], callbacks: dict[str, Any]) -> None:
        self.job, self.order, self.taken, self.updates = job, _Plan(job.plan), 0, 0
        super().__init__(overrides=settings, _callbacks=callbacks)  # type: ignore[call-arg]

    def get_dataset(self) -> dict[str, Any]:
        """What Ultralytics would read from ``data.yaml``, for which it would also fetch a font."""
        names = dict(enumerate(self.job.class_names))
        return {"train": str(self.job.images), "val": "", "names": names, "nc": len(names), "channels": 3}

    def get_dataloader(self: Any, dataset_path: str, batch_size: int = 16, rank: int = 0, mode: str = "train") -> Any:
        """Batches in the order of the plan. There is no validation: its loader is only looked at."""
        if mode != "train":
            return self.train_loader
        if hasattr(self, "train_loader"):  # Ultralytics would go on with half of the batch
            raise MissingResourceError(
                f"the GPU's memory has run out with {self.job.plan.shape[1]} images of {self.args.imgsz} px a step: "
                "give a smaller --batch or --size"
            )
        with redirect_stdout(io.StringIO()):  # a bar that its silence does not reach
            dataset = self.build_dataset(dataset_path, mode, batch_size)
        images = self.job.images.read_text().splitlines()
        if dataset.im_files != images:
            raise InputError(f"{self.job.images}: Ultralytics read {len(dataset.im_files)} of {len(images)} images")
        for label in dataset.labels:  # once, not anew in every mosaic: a fifth of all augmentation
            if max(map(len, label["segments"]), default=_OUTLINE) <= _OUTLINE:
                resample_segments(label["segments"], n=_OUTLINE)
        if dataset.cache == "ram":
            _mix_mosaics(dataset.transforms, self.job.plan.ravel().tolist())
        generator = torch.Generator()
        generator.manual_seed(self.args.seed)
        return InfiniteDataLoader(
            dataset=dataset,
            batch_size=batch_size,
            sampler=self.order,
            num_workers=self.args.workers,
            prefetch_factor=4 if self.args.workers else None,
            pin_memory=self.device.type == "cuda",
            collate_fn=dataset.collate_fn,
            worker_init_fn=seed_worker,
            generator=generator,
        )

    def get_validator(self) -> SimpleNamespace:
        """None: all that is asked of it are the names of its metrics."""
        return SimpleNamespace(metrics=SimpleNamespace(keys=[]))

    def begin_epoch(self: Any) -> None:
        """Know where in the plan a loader that begins now is."""
        self.order.first = self.epoch * EPOCH
        self.taken = self.order.first

    def end_step(self: Any) -> None:
        """Count a step, and end after the last."""
        self.taken += 1
        self.job.step(self.taken, float(self.loss.detach()))
        self.stop = self.stop or self.taken == len(self.job.plan)

    def optimizer_step(self: Any) -> None:
        """Update the weights."""
        self.updates += 1
        super().optimizer_step()  # type: ignore[misc]

    def validate(self: Any) -> tuple[dict[str, float], None]:
        """Nothing: it costs as much as training, and the last weights are taken."""
        return {}, None

    def save_model(self: Any) -> bool:
        """Keep a checkpoint, which gets its name when it is complete."""
        last = self.last
        self.last = self.best = last.with_suffix(".part")
        try:
            super().save_model()  # type: ignore[misc]
            self.last.replace(last)
        finally:
            self.last = self.best = last
        return True

    def save_metrics(self: Any, metrics: dict[str, float]) -> None:
        """Keep losses and learning rates, but no metrics of a validation that there is not."""
        super().save_metrics({name: v for name, v in metrics.items() if not name.startswith(("val/", "metrics/"))})  # type: ignore[misc]

    def final_eval(self) -> None:
        """Make the final weights, and judge them not."""
        finish_checkpoint(self.job.run)

    def outcome(self: Any) -> TrainingOutcome:
        """How it went."""
        resumed_at = min(self.start_epoch * EPOCH, len(self.job.plan))
        return TrainingOutcome(
            self.job.run / "weights.pt",
            resumed_at + self.updates,
            resumed_at,
            {name: round(float(value), 5) for name, value in self.tloss.items()},
            type(self.optimizer).__name__,
        )


def _mix_mosaics(transforms: Any, indices: list[int]) -> None:
    """Have mosaics take their other images from those of the plan, among which real ones have their share."""
    for transform in transforms.transforms:
        if isinstance(transform, Mosaic):
            transform.get_indexes = partial(random.choices, indices, k=transform.n - 1)
        elif hasattr(transform, "transforms"):
            _mix_mosaics(transform, indices)


class _Boxes(_FixedSteps, DetectionTrainer):
    pass


class _Masks(_FixedSteps, SegmentationTrainer):
    pass
