"""Settings of a detector training."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from mitsplat.arguments import check_fields, check_least
from mitsplat.detector.libraries import STRIDE, check_device
from mitsplat.errors import InputError
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import JsonObject


@dataclass(frozen=True)
class TrainSettings:
    """Settings that, together with the images, determine the weights of a detector.

    Attributes:
        model: YAML file of an Ultralytics network, with masks (``yolo11n-seg``) or only boxes (``yolo11n``).
        weights: File of initial weights; random weights if None. Nothing is ever downloaded.
        steps: Number of batches, each with one update of the weights, independent of the number of images.
        batch: Images per step.
        size: Longer side to which images are scaled [px], a multiple of 32.
        share: Share of real images in the steps, if there are real images.
        real_size: Longer side of photographs at prediction [px]. If it is larger than ``size``, photographs are cut to
            tiles that show objects at this size.
        mirror: True to mirror half of the images left to right. This is wrong for printed text and for classes that
            differ only as left and right parts.
        seed: Seed of all random numbers.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``, with PyTorch's GPU numbers.
        workers: Number of additional processes that read images; if None, up to 8. There are none on the CPU.
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
        check_fields(self)
        check_least(self, steps=1, batch=1, size=2 * STRIDE, seed=0, workers=0)
        if self.seed >= 2**32:
            raise InputError(f"seed must be less than 2^32 (got {self.seed})")
        if self.size % STRIDE:
            raise InputError(f"size must be a multiple of {STRIDE} px (got {self.size})")
        if not 0 < self.share < 1:
            raise InputError(f"share of real images must lie between 0 and 1 (got {self.share:g})")
        if self.real_size is not None and self.real_size < self.size:
            raise InputError(f"real_size must be at least size, {self.size} px (got {self.real_size})")
        check_device(self.device)

    def weight_settings(self) -> JsonObject:
        """Return the settings that affect the weights, without ``device`` and ``workers``."""
        settings = asdict(self) | {"weights": None if self.weights is None else file_hash(self.weights)}
        return {name: value for name, value in settings.items() if name not in ("device", "workers")}
