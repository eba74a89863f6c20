"""Cameras of a dataset as COLMAP's text model: ``colmap/cameras.txt``, ``images.txt`` and an empty ``points3D.txt``.

Positions are in pixels with centres at +0.5, as in COLMAP; poses are camera_from_world, quaternions scalar first. Image
names are relative to ``images/``.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from scipy.spatial.transform import Rotation

from mitsplat.camera import Camera
from mitsplat.coco import camera_of, image_file
from mitsplat.files import Record, write_text


def write_colmap(root: Path, records: Iterable[Record]) -> None:
    """Write the three files."""
    models: dict[str, int] = {}
    images = []
    for record in records:
        camera = camera_of(record)
        number = models.setdefault(camera_model(camera), len(models) + 1)
        pose = camera.camera_from_world
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        values = " ".join(repr(float(value)) for value in (w, x, y, z, *pose[:3, 3]))
        name = image_file(record).removeprefix("images/")
        images.append(f"{record['index'] + 1} {values} {number} {name}\n\n")
    write_text(root / "colmap/cameras.txt", "".join(f"{number} {model}\n" for model, number in models.items()))
    write_text(root / "colmap/images.txt", "".join(images))
    write_text(root / "colmap/points3D.txt", "")


def camera_model(camera: Camera) -> str:
    """Model, size and parameters: PINHOLE, OPENCV (k1 k2 p1 p2), FULL_OPENCV (and k3 k4 k5 k6), OPENCV_FISHEYE."""
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
