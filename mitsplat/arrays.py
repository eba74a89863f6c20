"""Aliases of NumPy array types for annotations, and evenly spaced indices; docstrings state shapes and units.

Device arrays are annotated with Mitsuba's names, such as ``mi.Float`` and ``mi.Color3f``. These types exist once per
variant. Annotations are never evaluated, and mypy reads such names as ``Any``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
UInt32Array = npt.NDArray[np.uint32]
ByteImage = npt.NDArray[np.uint8]
"""Display-encoded RGB image, shape (H, W, 3), unless stated otherwise."""
AnyArray = npt.NDArray[Any]
"""Array of any element type."""
FloatingArray = npt.NDArray[np.floating[Any]]
"""Array of floats of any size."""
IntegerArray = npt.NDArray[np.integer[Any]]
"""Array of integers of any size."""


def evenly_spaced(total: int, count: int) -> list[int]:
    """Return at most ``count`` ascending indices below ``total`` at equal intervals, from the first to the last."""
    places: list[int] = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int)).tolist()
    return places
