"""Aliases of NumPy array types for annotations; shapes and units are stated in docstrings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
ByteImage = npt.NDArray[np.uint8]
"""Display-encoded RGB image, shape (H, W, 3), unless stated otherwise."""
