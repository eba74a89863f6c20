"""Cameras of a dataset as a COLMAP text model: ``colmap/cameras.txt``, ``images.txt`` and an empty ``points3D.txt``.

Positions are in pixels with centres at +0.5, as in COLMAP. Poses are camera_from_world with scalar-first quaternions.
Image names are relative to ``images/``.
"""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from mitsplat.errors import InputError
from mitsplat.formats.coco import image_file
from mitsplat.formats.format import AnnotationWriter, Catalogue
from mitsplat.geometry.camera import Camera
from mitsplat.storage.files import GrowingFile, Record


class ModelWriter(AnnotationWriter):
    """Writer of the three files."""

    def __init__(self, root: Path, catalogue: Catalogue) -> None:
        names = ("cameras", "images", "points3D")
        self._cameras, self._images, points = (GrowingFile(root / f"colmap/{name}.txt") for name in names)
        super().__init__((self._cameras, self._images, points))
        self._models: dict[str, int] = {}

    def add(self, record: Record) -> None:
        """Add a frame."""
        camera = Camera.from_json(record["camera"])
        model = camera_model(camera)
        if model not in self._models:
            self._models[model] = len(self._models) + 1
            self._cameras.write(f"{self._models[model]} {model}\n")
        pose = camera.camera_from_world
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        values = " ".join(repr(float(value)) for value in (w, x, y, z, *pose[:3, 3]))
        name = image_file(record).removeprefix("images/")
        self._images.write(f"{record['index'] + 1} {values} {self._models[model]} {name}\n\n")


def camera_model(camera: Camera) -> str:
    """Return the line of a camera: model, size and parameters.

    Models are PINHOLE, OPENCV (k1 k2 p1 p2), FULL_OPENCV (and k3 k4 k5 k6) and OPENCV_FISHEYE.

    Raises:
        InputError: If the lens has thin-prism distortion.
    """
    if len(camera.distortion) > 8:
        raise InputError(
            f"colmap must have a lens without thin-prism distortion (got s1 to s4 = {list(camera.distortion[8:])})"
        )
    values = [camera.fx, camera.fy, camera.cx, camera.cy]
    if not camera.distortion:
        model = "PINHOLE"
    elif camera.lens == "fisheye":
        model = "OPENCV_FISHEYE"
        values += camera.distortion
    elif len(camera.distortion) == 4:
        model = "OPENCV"
        values += camera.distortion
    else:
        model = "FULL_OPENCV"
        values += (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
    return f"{model} {camera.width} {camera.height} {' '.join(repr(float(value)) for value in values)}"
