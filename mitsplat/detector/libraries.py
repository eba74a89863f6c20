"""Import of Ultralytics and PyTorch without downloads and without telemetry.

Both libraries are optional and take seconds to import. They are therefore imported inside functions.
"""

from __future__ import annotations

import atexit
import importlib.metadata
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING

from mitsplat.arguments import list_in_words
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.storage.cache import remove_in_process

if TYPE_CHECKING:
    import torch

WEIGHTS_ERRORS = (
    *(OSError, EOFError, UnpicklingError, RuntimeError),
    *(ValueError, LookupError, TypeError, AttributeError),
)
"""Exceptions that a damaged weights file can raise."""

STRIDE = 32
"""Divisor of the image sides in Ultralytics' networks [px]."""

MIN_TORCH = "2.6"
"""First PyTorch release that lists the classes of a file before it loads it; the safe loader needs this."""

_DEVICE = re.compile(r"auto|cpu|cuda(:[0-9]{1,2})?")


def check_device(device: str) -> None:
    """Check the syntax of a device name.

    Raises:
        InputError: If the name is no device.
    """
    if not _DEVICE.fullmatch(device):
        raise InputError(f"device must be auto, cpu, cuda or cuda:N (got {device})")


def load_libraries() -> None:
    """Import Ultralytics offline and silent, with its settings in a folder that is removed at the end of this process.

    ``YOLO_CONFIG_DIR`` and ``YOLO_VERBOSE`` keep values that the user has set.

    Weights files are pickles. The safe loader of Ultralytics accepts only known classes, and it cannot be turned off
    here.

    Raises:
        MissingResourceError: If a library is not installed, or PyTorch is too old for the safe loader.
    """
    missing = [name for name in ("torch", "torchvision", "ultralytics") if find_spec(name) is None]
    if missing:
        raise MissingResourceError(f"detectors need {list_in_words(missing, 'and')}: pip install 'mitsplat[train]'")
    import torch

    # Without this function, Ultralytics silently uses a loader that executes code.
    if not hasattr(torch.serialization, "get_unsafe_globals_in_checkpoint"):
        raise MissingResourceError(
            f"detectors need PyTorch {MIN_TORCH} or newer, which reads weights without executing code from them "
            f"(got {torch.__version__}): pip install 'torch>={MIN_TORCH}'"
        )
    os.environ["YOLO_OFFLINE"] = "true"
    os.environ["YOLO_AUTOINSTALL"] = "false"
    os.environ.setdefault("YOLO_VERBOSE", "false")
    os.environ["ULTRALYTICS_SAFE_LOAD"] = "true"
    if "YOLO_CONFIG_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="mitsplat-ultralytics-")
        os.environ["YOLO_CONFIG_DIR"] = folder
        atexit.register(remove_in_process, folder, os.getpid())
    from ultralytics.nn import tasks
    from ultralytics.utils.events import events

    # Ultralytics reads these variables at import, which may have happened before this call.
    tasks.SAFE_LOAD = True
    events.enabled = False


def check_torchvision() -> None:
    """Check that torchvision can be imported; prediction uses its non-maximum suppression.

    Raises:
        MissingResourceError: If torchvision was built for another PyTorch.
    """
    try:
        import torchvision  # noqa: F401
    except (RuntimeError, ImportError, OSError) as error:
        raise MissingResourceError(
            "torchvision cannot be imported, because it was built for another PyTorch: install both from one source "
            f"({str(error).splitlines()[0]})"
        ) from error


def versions() -> dict[str, str]:
    """Return the versions of the libraries that affect the result of a training."""
    import ultralytics

    found = {}
    for name in ("mitsplat", "torch", "torchvision", "numpy"):
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found | {"ultralytics": str(ultralytics.__version__)}


def torch_device(device: str) -> tuple[str, str]:
    """Return the device name of Ultralytics and the product name of the device.

    Raises:
        InputError: If the GPU number does not exist.
        MissingResourceError: If PyTorch finds no GPU.
    """
    import torch

    check_device(device)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device == "cpu" or (device == "auto" and not count):
        return "cpu", "cpu"
    if not count:
        raise MissingResourceError(f"{device} cannot be used, because PyTorch finds no GPU: use --device cpu")
    number = int(device.partition(":")[2] or 0)
    if number >= count:
        raise InputError(f"the GPUs that PyTorch finds are cuda:0 to cuda:{count - 1} (got {device})")
    return str(number), str(torch.cuda.get_device_name(number))


def read_network(model: str) -> tuple[str, bool]:
    """Return the name of a network's YAML file for Ultralytics, and True if the network predicts masks.

    Args:
        model: ``yolo11n-seg.yaml``, the same without suffix, or the path of such a file.

    Raises:
        InputError: If there is no such network, or it predicts neither boxes nor masks.
    """
    from ultralytics.nn.tasks import guess_model_task, yaml_model_load

    name = model if Path(model).suffix in (".yaml", ".yml") else f"{model}.yaml"
    try:
        content = yaml_model_load(name)
        task = guess_model_task(content)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"--model must be a network of Ultralytics, such as yolo11n-seg (got {model})") from error
    if task not in ("detect", "segment"):
        raise InputError(f"--model must predict boxes or masks, such as yolo11n or yolo11n-seg (got {model}: {task})")
    head = str(content["head"][-1][-2])
    if "World" in head or "YOLOE" in head:
        raise InputError(f"--model must not be an open-vocabulary network (got {model}: {head})")
    return name, task == "segment"


def check_weights(weights: Path, network: str, *, masks: bool, classes: int | None = None) -> None:
    """Check that a weights file fits a network.

    Args:
        weights: The file.
        network: Name of the network's YAML file.
        masks: True if the network predicts masks.
        classes: Required number of classes; any number if None.

    Raises:
        InputError: If the file cannot be read, or its tensors have other names or shapes.
    """
    from ultralytics.nn.tasks import DetectionModel, SegmentationModel

    found = load_weights(weights)
    kind = SegmentationModel if masks else DetectionModel
    if classes not in (None, len(found.names)):
        raise InputError(f"{weights}: must have {classes} classes (got {len(found.names)})")
    model = kind(network, nc=len(found.names), verbose=False)
    # The width of the class branch depends on the initial weights, whose number of classes may differ.
    model.load(found, verbose=False)
    expected, own = model.state_dict(), found.state_dict()
    for name in sorted(expected.keys() | own.keys()):
        shapes = [tuple(tensors[name].shape) if name in tensors else None for tensors in (own, expected)]
        if shapes[0] != shapes[1]:
            raise InputError(
                f"{weights}: does not fit {network}: {name} must have the shape {shapes[1] or 'none'} "
                f"(got {shapes[0] or 'none'})"
            )


@contextmanager
def linked_weights(path: Path) -> Iterator[str]:
    """Yield the path of a temporary link to a weights file, by which Ultralytics reads the file unchanged.

    Ultralytics treats some file names as its own releases: it downloads these files again and removes them if they look
    damaged. It drops characters from other names.
    """
    with tempfile.TemporaryDirectory(prefix="mitsplat-weights-") as folder:
        link = Path(folder) / "given.pt"
        link.symlink_to(path.resolve())
        yield str(link)


def check_weights_exist(path: Path) -> None:
    """Raise InputError unless the path is an existing file with the suffix of weights."""
    if not path.is_file() or path.suffix != ".pt":
        raise InputError(f"--weights must be an existing weights file of Ultralytics (.pt) (got {path})")


def load_weights(path: Path) -> torch.nn.Module:
    """Load the network of a weights file.

    Raises:
        InputError: If the file is missing, unreadable or not from Ultralytics.
    """
    from ultralytics.nn.tasks import load_checkpoint

    check_weights_exist(path)
    try:
        with linked_weights(path) as name:
            return load_checkpoint(name)[0]
    except WEIGHTS_ERRORS as error:
        raise InputError(f"{path}: cannot be read as weights of Ultralytics ({type(error).__name__})") from error
