"""Import of libraries that run user-supplied ONNX networks."""

from __future__ import annotations

import importlib
import re
from types import ModuleType
from typing import Literal

from mitsplat.errors import MissingResourceError

MIN_ONNXRUNTIME = (1, 24)
"""First release of ONNX Runtime that reads no weights from outside the network's folder."""


def load_library(extra: Literal["depth", "masks"], name: str) -> ModuleType:
    """Import a library that runs networks by ONNX Runtime.

    Args:
        extra: Extra of mitsplat that installs the library.
        name: Module of the library.

    Raises:
        MissingResourceError: If the library or ONNX Runtime is not installed, or ONNX Runtime is too old.
    """
    try:
        runtime = importlib.import_module("onnxruntime")
        library = importlib.import_module(name)
    except ImportError as error:
        raise MissingResourceError(
            f"{extra.removesuffix('s')}s by a model need {name}: pip install 'mitsplat[{extra}]' ({error})"
        ) from error
    numbers = re.match(r"(\d+)\.(\d+)", runtime.__version__)
    if numbers is None or tuple(map(int, numbers.groups())) < MIN_ONNXRUNTIME:
        oldest = ".".join(map(str, MIN_ONNXRUNTIME))
        raise MissingResourceError(
            f"networks need onnxruntime {oldest} or newer, which reads no files outside of the network's folder (got "
            f"{runtime.__version__}): pip install 'onnxruntime>={oldest}'"
        )
    return library
