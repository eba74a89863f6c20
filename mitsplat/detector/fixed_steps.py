"""Ultralytics trainer with a fixed number of steps and a fixed image plan; needs the extra ``train``.

An epoch here is :data:`EPOCH` steps, not one pass through the images. The schedule by epochs (learning rate,
checkpoints, end of the mosaics) is then the same for any number of images. A step is one batch and one update of the
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
from mitsplat.detector.libraries import WEIGHTS_ERRORS, linked_weights
from mitsplat.detector.train_settings import TrainSettings
from mitsplat.errors import InputError, MissingResourceError

EPOCH = 50
"""Steps between checkpoints; an interrupted training resumes from the last checkpoint."""
_MAX_WARM_UP_STEPS = 100
"""Most steps of the learning-rate warm-up; shorter trainings use a tenth of their steps."""
_MAX_ADAMW_STEPS = 10_000
"""Largest number of steps for AdamW; longer trainings use MuSGD.

Ultralytics' ``auto`` has the same rule, but derives the number of steps from the number of images.
"""
_OUTLINE_POINTS = 1000
"""Number of points to which Ultralytics resamples every outline with no more points."""

LAST_CHECKPOINT = "weights/last.pt"
"""Path of the last checkpoint, relative to the run folder."""


@dataclass(frozen=True)
class Job:
    """Inputs of a training.

    Attributes:
        run: Folder of the run.
        images: File that lists the images; the plan refers to its lines.
        class_names: Names of the classes.
        plan: Image indices, shape (steps, batch).
        masks: True to train masks, False to train only boxes.
        step: Callback with the number of finished steps and the loss.
    """

    run: Path
    images: Path
    class_names: tuple[str, ...]
    plan: Int64Array
    masks: bool
    step: Callable[[int, float], None]

    @property
    def epochs(self) -> int:
        """Number of epochs, which is also the number of checkpoints."""
        return -(-len(self.plan) // EPOCH)


@dataclass(frozen=True)
class TrainingOutcome:
    """Result of a training.

    Attributes:
        weights: File of the final weights, averaged over the last steps.
        updates: Total number of weight updates.
        resumed_at: Step at which the training resumed; 0 for a new training.
        losses: Last losses by name.
        optimizer: Name of the optimiser.
    """

    weights: Path
    updates: int
    resumed_at: int
    losses: dict[str, float]
    optimizer: str


def train_job(job: Job, settings: TrainSettings, *, device: str, workers: int) -> TrainingOutcome:
    """Train a detector; resume from the checkpoint of the run if there is one.

    Args:
        job: Inputs of the training.
        settings: Network, initial weights, image size, mirroring and seed; the job determines steps and batches.
        device: Device name of Ultralytics.
        workers: Number of processes that read images; 0 on the CPU.
    """
    epochs, batch = job.epochs, job.plan.shape[1]
    options: dict[str, Any] = {
        "task": "segment" if job.masks else "detect",
        "model": settings.model,
        "epochs": epochs,
        "batch": batch,
        "nbs": batch,  # one update of the weights per batch
        "imgsz": settings.size,
        "fliplr": 0.5 if settings.mirror else 0.0,
        "seed": settings.seed,
        "deterministic": True,
        "device": device,
        "workers": workers,
        "cache": "ram",
        "val": False,
        "plots": False,
        "patience": 0,
        "warmup_epochs": min(_MAX_WARM_UP_STEPS, len(job.plan) // 10) / min(EPOCH, len(job.plan)),
        "close_mosaic": round(epochs / 10),
        "save_dir": str(job.run),
        "exist_ok": True,
        "verbose": False,
        # Same choice as Ultralytics' "auto" for this number of updates.
        "optimizer": "MuSGD" if len(job.plan) > _MAX_ADAMW_STEPS else "AdamW",
        "lr0": 0.01 if len(job.plan) > _MAX_ADAMW_STEPS else round(0.01 / (4 + len(job.class_names)), 6),
        "momentum": 0.9,
        "warmup_bias_lr": 0.0,
    }
    callbacks: defaultdict[str, list[Callable[[Any], None]]] = defaultdict(list)
    callbacks["on_train_epoch_start"].append(_FixedStepsTrainer.begin_epoch)
    callbacks["on_train_batch_end"].append(_FixedStepsTrainer.end_step)
    last = job.run / LAST_CHECKPOINT
    with ExitStack() as links:
        options["pretrained"] = links.enter_context(linked_weights(settings.weights)) if settings.weights else False
        if last.is_file():
            options["resume"] = links.enter_context(linked_weights(last))
        trainer = (_MaskTrainer if job.masks else _BoxTrainer)(job, options, callbacks)
        trainer.train()
    return trainer.outcome()


def finish_checkpoint(run: Path) -> Path:
    """Write the final weights of a run from its last checkpoint, and return their path."""
    final, part = run / "weights.pt", run / ".weights.pt.part"
    part.unlink(missing_ok=True)  # an existing link of this name would be followed
    strip_optimizer(run / LAST_CHECKPOINT, str(part))
    part.replace(final)
    return final


def epochs_done(run: Path) -> int:
    """Return the number of finished epochs in the checkpoint of a run.

    Raises:
        InputError: If the checkpoint cannot be read.
    """
    try:
        with linked_weights(run / LAST_CHECKPOINT) as name:
            return int(torch_safe_load(name)[0]["epoch"]) + 1
    except WEIGHTS_ERRORS as error:
        raise InputError(
            f"{run / LAST_CHECKPOINT}: cannot be read ({type(error).__name__}): start again with --overwrite"
        ) from error


class _PlanSampler(Sampler[int]):
    """Sampler of the image indices of all steps from ``first`` on; its length is that of one epoch."""

    def __init__(self, plan: Int64Array) -> None:
        self._plan, self.first = plan, 0

    def __iter__(self) -> Iterator[int]:
        yield from self._plan[self.first :].ravel().tolist()

    def __len__(self) -> int:
        return int(min(EPOCH, len(self._plan)) * self._plan.shape[1])


class _FixedStepsTrainer:
    """Common part of the box and the mask trainer."""

    def __init__(self, job: Job, options: dict[str, Any], callbacks: dict[str, list[Callable[[Any], None]]]) -> None:
        self.job, self.order, self.taken, self.updates = job, _PlanSampler(job.plan), 0, 0
        super().__init__(overrides=options, _callbacks=callbacks)  # type: ignore[call-arg]

    def get_dataset(self) -> dict[str, Any]:
        """Return the content of a ``data.yaml``.

        Ultralytics' own method would read the file, and would download a font for it.
        """
        names = dict(enumerate(self.job.class_names))
        return {"train": str(self.job.images), "val": "", "names": names, "nc": len(names), "channels": 3}

    def get_dataloader(self: Any, dataset_path: str, batch_size: int = 16, rank: int = 0, mode: str = "train") -> Any:
        """Return a loader of batches in the order of the plan.

        There is no validation. Ultralytics only inspects the validation loader, so it gets the training loader.
        """
        if mode != "train":
            return self.train_loader
        if hasattr(self, "train_loader"):  # Ultralytics would continue with half of the batch
            raise MissingResourceError(
                f"the GPU ran out of memory with {self.job.plan.shape[1]} images of {self.args.imgsz} px per step: "
                "use a smaller --batch or --size"
            )
        with redirect_stdout(io.StringIO()):  # "verbose" does not silence this progress bar
            dataset = self.build_dataset(dataset_path, mode, batch_size)
        images = self.job.images.read_text().splitlines()
        if dataset.im_files != images:
            raise InputError(f"{self.job.images}: Ultralytics read {len(dataset.im_files)} of {len(images)} images")
        for label in dataset.labels:  # resampling here and not in every mosaic saves a fifth of all augmentation
            if max(map(len, label["segments"]), default=_OUTLINE_POINTS) <= _OUTLINE_POINTS:
                resample_segments(label["segments"], n=_OUTLINE_POINTS)
        if dataset.cache == "ram":
            _set_mosaic_images(dataset.transforms, self.job.plan.ravel().tolist())
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
        """Return a placeholder; Ultralytics only reads the names of its metrics."""
        return SimpleNamespace(metrics=SimpleNamespace(keys=[]))

    def begin_epoch(self: Any) -> None:
        """Set the start of the sampler in the plan to this epoch."""
        self.order.first = self.epoch * EPOCH
        self.taken = self.order.first

    def end_step(self: Any) -> None:
        """Count a step, and stop after the last step."""
        self.taken += 1
        self.job.step(self.taken, float(self.loss.detach()))
        self.stop = self.stop or self.taken == len(self.job.plan)

    def optimizer_step(self: Any) -> None:
        """Update the weights."""
        self.updates += 1
        super().optimizer_step()  # type: ignore[misc]

    def validate(self: Any) -> tuple[dict[str, float], None]:
        """Return no metrics: validation costs as much as training, and the last weights are used anyway."""
        return {}, None

    def save_model(self: Any) -> bool:
        """Write a checkpoint; the file gets its final name after it is complete."""
        last = self.last
        self.last = self.best = last.with_suffix(".part")
        try:
            super().save_model()  # type: ignore[misc]
            self.last.replace(last)
        finally:
            self.last = self.best = last
        return True

    def save_metrics(self: Any, metrics: dict[str, float]) -> None:
        """Write losses and learning rates without the validation metrics, which do not exist here."""
        super().save_metrics({name: v for name, v in metrics.items() if not name.startswith(("val/", "metrics/"))})  # type: ignore[misc]

    def final_eval(self) -> None:
        """Write the final weights without an evaluation."""
        finish_checkpoint(self.job.run)

    def outcome(self: Any) -> TrainingOutcome:
        """Return the result of the training."""
        resumed_at = min(self.start_epoch * EPOCH, len(self.job.plan))
        return TrainingOutcome(
            self.job.run / "weights.pt",
            resumed_at + self.updates,
            resumed_at,
            {name: round(float(value), 5) for name, value in self.tloss.items()},
            type(self.optimizer).__name__,
        )


def _set_mosaic_images(transforms: Any, indices: list[int]) -> None:
    """Draw the other images of mosaics from the plan, so that real images keep their share."""
    for transform in transforms.transforms:
        if isinstance(transform, Mosaic):
            transform.get_indexes = partial(random.choices, indices, k=transform.n - 1)
        elif hasattr(transform, "transforms"):
            _set_mosaic_images(transform, indices)


class _BoxTrainer(_FixedStepsTrainer, DetectionTrainer):
    pass


class _MaskTrainer(_FixedStepsTrainer, SegmentationTrainer):
    pass
