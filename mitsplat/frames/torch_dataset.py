"""Endless stream of labelled frames for PyTorch, rendered during training. Needs the extra ``torch``.

::

    from torch.utils.data import DataLoader
    from mitsplat.frames.torch_dataset import FrameStream

    stream = FrameStream(ms.load_scene("scenes/workcell.yaml"))
    for images, targets in DataLoader(stream, 4, num_workers=2, collate_fn=stream.collate,
                                      multiprocessing_context="spawn"):
        losses = detector(images, targets)
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from mitsplat.errors import InputError
from mitsplat.frames.frame import Frame
from mitsplat.frames.sequence import render_frames
from mitsplat.quality import Quality
from mitsplat.scene.scene import Scene
from mitsplat.scene.splits import split_of

Sample = tuple[torch.Tensor, dict[str, torch.Tensor]]
"""Image and detection target."""


class FrameStream(IterableDataset[Sample]):
    """Endless frames of a scene in the format of torchvision's detection models.

    Layouts of the validation and test splits (``output.validation``, ``output.test``) are left out, so that a dataset
    of the same scene can evaluate the detector. With N worker processes of a ``DataLoader``, worker k renders every
    Nth of the other layouts, so that no layout is rendered twice. The scene's seed determines all frames:
    ``ms.load_scene(path, overrides={"seed": 1})`` gives others. Workers must be spawned, because a renderer does not
    survive a fork.

    Each sample is an image, (3, H, W) float32 from 0 to 1, and a target:

    ======== ============================ ===================================
    boxes    (N, 4) float32               x0, y0, x1, y1 [px]
    labels   (N,) int64                   index of the class + 1; 0 is nothing
    masks    (N, H, W) uint8              visible pixels
    area     (N,) float32                 of the masks [px]
    image_id () int64                     index of the frame
    ======== ============================ ===================================

    Args:
        scene: The scene; its number of layouts is ignored.
        quality: As in :func:`mitsplat.render_frame`.

    Raises:
        InputError: If ``scene`` is not a scene, such as the path of a scene file, or if it has no layouts for training.
    """

    def __init__(self, scene: Scene, *, quality: str | Quality | None = None) -> None:
        super().__init__()
        Scene.check(scene)
        output = scene.spec.output
        if output.validation + output.test >= 1:
            raise InputError(
                f"{scene.path}: output.validation and output.test must leave layouts for training (got "
                f"{output.validation:g} and {output.test:g})"
            )
        self.scene, self.quality = scene, quality

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        output = self.scene.spec.output
        training = (k for k in itertools.count() if split_of(k, output) == "train")
        layouts = itertools.islice(training, first, None, step)
        indices = (layout * output.views + view for layout in layouts for view in range(output.views))
        for frame in render_frames(self.scene, indices, quality=self.quality, progress=False):
            yield sample_of(frame)

    @staticmethod
    def collate(samples: Sequence[Sample]) -> tuple[list[torch.Tensor], list[dict[str, torch.Tensor]]]:
        """Collate a batch as lists, because images show different numbers of objects."""
        return [image for image, _ in samples], [target for _, target in samples]


def sample_of(frame: Frame) -> Sample:
    """Convert a frame to an image and a target, see :class:`FrameStream`."""
    labels = frame.labels.instances
    masks = np.zeros((len(labels), *frame.image.shape[:2]), dtype=np.uint8)
    for mask, label in zip(masks, labels, strict=True):
        x0, y0, x1, y1 = label.box
        mask[y0:y1, x0:x1] = label.mask
    target: dict[str, torch.Tensor] = {
        "boxes": torch.tensor([label.box for label in labels], dtype=torch.float32).reshape(-1, 4),
        "labels": torch.tensor([label.class_index + 1 for label in labels], dtype=torch.int64),
        "masks": torch.from_numpy(masks),
        "area": torch.tensor([label.area for label in labels], dtype=torch.float32),
        "image_id": torch.tensor(frame.index),
    }
    return torch.from_numpy(np.moveaxis(frame.image, 2, 0).astype(np.float32) / 255), target
