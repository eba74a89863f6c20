"""Audit of the COLMAP model, which is read by pycolmap."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsplat.audit.dataset_check import DatasetCheck, EntryCursor, Violations, is_close, prefixed
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.storage.files import JsonObject

_POINTS = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [-0.15, 0.05, 0.8], [0.12, -0.2, 1.5]])
"""Points in front of a camera, in its frame, whose pixels determine its model and parameters, shape (5, 3)."""
_PIXEL_TOLERANCE = 1e-6
"""Tolerance between projections of OpenCV and COLMAP [px]."""


class ColmapCheck(DatasetCheck):
    """Check of ``colmap/``; pycolmap runs in a process of its own, because it may abort the process."""

    def __init__(self, root: Path) -> None:
        self._model = root / "colmap"
        names = ("cameras", "images", "points3D")
        self._missing = [name for name in names if not (self._model / f"{name}.txt").is_file()]
        images = iter(()) if self._missing else self._read_images()
        self._images = EntryCursor("colmap/images.txt", images, "images")

    def _read_images(self) -> Iterator[tuple[int, JsonObject]]:
        points = json.dumps(_POINTS.tolist())
        command = python_command("-m", "mitsplat.audit.colmap_worker", self._model.resolve(), points)
        with (
            tempfile.TemporaryFile("w+") as errors,
            subprocess.Popen(
                command, env=python_environment(), stdout=subprocess.PIPE, stderr=errors, text=True
            ) as child,
        ):
            try:
                for line in child.stdout or ():
                    image = json.loads(line)
                    yield image["id"] - 1, image
                if status := child.wait():
                    errors.seek(0)
                    lines = errors.read().strip().splitlines() or [f"its process ended with status {status}"]
                    raise ValueError(lines[-1])
            finally:
                child.kill()

    def check(self, frame: DecodedFrame) -> Violations:
        """Compare the image's pose, and the projections of some points by its camera, with those of the manifest."""
        for image in () if self._missing else (yield from self._images.entry_of(frame)):
            yield from prefixed(self._images.file, f"frame {frame.index}", self._check(frame, image))

    def _check(self, frame: DecodedFrame, image: JsonObject) -> Iterator[str]:
        if image["name"] != f"{frame.split}/{frame.image_name}":
            yield f"its name is {image['name']}, not {frame.split}/{frame.image_name}"
        if not is_close(image["camera_from_world"], frame.camera_from_world[:3], 1e-8):
            yield "its pose differs from the manifest's camera"
        if image["size"] != list(frame.size) or not is_close(image["pixels"], frame.project(_POINTS), _PIXEL_TOLERANCE):
            yield "its camera differs from that of the manifest"

    def finish(self) -> Violations:
        """Report missing files and check the remaining entries."""
        for name in self._missing:
            yield f"colmap/{name}.txt", "is missing"
        yield from self._images.finish()
