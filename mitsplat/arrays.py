"""Names of array types: what an annotation can say of an array; its shape and unit stand in docstrings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
ByteImage = npt.NDArray[np.uint8]
"""Display-encoded RGB, (H, W, 3), unless said otherwise."""
