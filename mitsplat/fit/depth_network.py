"""Depth maps of photos from an ONNX network of the user, such as Depth Anything v2 (Yang et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.capture.capture import Photo, stored_name
from mitsplat.errors import InputError
from mitsplat.fit.depth_priors import DepthKind, DepthMaps
from mitsplat.progress import Progress
from mitsplat.runtime.onnx_networks import load_library
from mitsplat.storage.content_hash import ContentHash, file_hash
from mitsplat.storage.files import write_file
from mitsplat.version import __version__

if TYPE_CHECKING:
    import onnxruntime

FloatImage = Float32Array

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of display-encoded ImageNet pixels: red, green, blue."""
_INPUT_EDGE = 518
"""Shorter edge of the network input [px] if the network accepts any size, as in the code of Depth Anything."""
_PATCH = 14
"""Patch size of the network [px]; input edges are multiples of it."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


def model_maps(
    photos: Sequence[Photo], model: Path, folder: Path, kind: DepthKind = "inverse", *, progress: Progress | None = None
) -> DepthMaps:
    """Compute depth maps of photos with a network, and cache them in a folder.

    A cached map is used until the photo, the network or the version of this package changes.

    Args:
        photos: Photos.
        model: The network, an ONNX file.
        folder: Folder of the cached maps.
        kind: Kind of the network output.
        progress: Called after each photo.

    Raises:
        InputError: If the file does not exist or is not such a network.
        MissingResourceError: If onnxruntime is not installed, or too old.
    """
    if not model.is_file():
        raise InputError(f"{model}: no such file")
    weights = __version__.encode() + bytes.fromhex(file_hash(model))
    files: dict[str, Path] = {}
    network = None
    for done, photo in enumerate(photos, start=1):
        gain = b"" if photo.gain is None else repr(photo.gain).encode()
        key = ContentHash(weights, photo.image_hash, gain).hexdigest()[:16]
        file = folder / f"{key}_{stored_name(photo.name, '.npy')}"
        if not file.exists():
            network = network or DepthNetwork(open_session(model), model)
            write_file(file, partial(_save, network.depths(photo.read().rgb)))
        files[photo.name] = file
        if progress is not None:
            progress(done, len(photos), "depths")
    return DepthMaps(files, kind)


def open_session(model: Path) -> onnxruntime.InferenceSession:
    """Open an onnxruntime session of a network on the CPU.

    Raises:
        InputError: If the file is not a network.
        MissingResourceError: If onnxruntime is not installed, or too old.
    """
    onnxruntime = load_library("depth", "onnxruntime")
    try:
        return onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base class
        raise InputError(f"{model}: not a network in ONNX ({' '.join(str(error).split())})") from error


class DepthNetwork:
    """A network that maps a picture to depths or inverse depths.

    Args:
        session: Session of onnxruntime.
        path: Path of the network, for error messages.

    Raises:
        InputError: If the input of the network is not one picture of floats, shape (1, 3, H, W).
    """

    def __init__(self, session: onnxruntime.InferenceSession, path: Path) -> None:
        self._session, self._path = session, path
        inputs = session.get_inputs()
        shape, kind = list(inputs[0].shape), inputs[0].type
        fits = len(inputs) == 1 and len(shape) == 4 and (shape[1] == 3 or not isinstance(shape[1], int))
        if not fits or kind not in _TYPES:
            given = ", ".join(f"{i.name}: {i.type} {list(i.shape)}" for i in inputs)
            raise InputError(f"{path}: must take one picture of floats, shape (1, 3, H, W) (got {given})")
        self._name, self._type = inputs[0].name, _TYPES[kind]
        self._height, self._width = (edge if isinstance(edge, int) and edge > 0 else None for edge in shape[2:])

    def depths(self, rgb: FloatImage) -> FloatImage:
        """Return the network output for a picture (H, W, 3), display-encoded in [0, 1].

        The output has the aspect ratio of the picture. It is not enlarged above the resolution of the network.

        Raises:
            InputError: If the network fails, or does not return one finite number per pixel.
        """
        height, width = rgb.shape[:2]
        scale = _INPUT_EDGE / min(height, width)
        size = (self._width or _patch_multiple(scale * width), self._height or _patch_multiple(scale * height))
        picture = (cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC) - _MEAN) / _DEVIATION
        batch = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=self._type)
        try:
            found = np.asarray(self._session.run(None, {self._name: batch})[0], dtype=np.float32)
        except Exception as error:  # onnxruntime's errors have no common base class
            raise InputError(
                f"{self._path}: fails on {size[0]}x{size[1]} px ({' '.join(str(error).split())})"
            ) from error
        values = (
            found.reshape(found.shape[-2:]) if found.ndim >= 2 and found.size == np.prod(found.shape[-2:]) else found
        )
        if values.ndim != 2 or min(values.shape) < 2 or not np.isfinite(values).all():
            raise InputError(
                f"{self._path}: must return one finite number per pixel, shape (1, H, W) (got shape {found.shape}, "
                f"{np.count_nonzero(~np.isfinite(found))} not finite)"
            )
        shrink = min(1.0, max(values.shape) / max(height, width))
        output_size = (max(1, round(shrink * width)), max(1, round(shrink * height)))
        return np.asarray(cv2.resize(values, output_size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _patch_multiple(edge: float) -> int:
    return max(1, round(edge / _PATCH)) * _PATCH


def _save(values: FloatImage, path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, values)
