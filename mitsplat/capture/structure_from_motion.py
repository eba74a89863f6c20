"""Structure from motion: cameras and points from photographs, or from a COLMAP model that exists.

The work is done by COLMAP (Schönberger and Frahm 2016; global mapper: Pan et al. 2024) in
:mod:`mitsplat.capture.sfm_worker`.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import subprocess
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array, Int32Array
from mitsplat.capture.photos import Prepared
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.camera import Camera
from mitsplat.progress import Progress
from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.storage.files import write_text

MIN_POINTS = 30
"""Points that a photo must observe: with fewer, cameras 20 % off were measured at reprojection errors of 0.2 px."""

MIN_AGREEMENT = 0.5
"""Share of a photo's matches that its camera must explain. On photographs of a statue it was 98 % or more for each."""

SURE_AGREEMENT = 0.65
"""Share below which a camera is doubtful, unless a board says otherwise."""

ENOUGH = 0.8
"""Share of registered photos below which the global mapper is tried as well."""

_MODEL_PARTS = ("cameras", "images", "points3D")
_READ_MEMORY = 2 << 30
"""Address space for reading a model, beside 100 times the size of its files [bytes]."""
_READ_SECONDS = 30
"""Time for reading a model, beside a second for each megabyte [s]."""

_MODELS: Mapping[str, tuple[int, ...]] = {
    # Places of COLMAP's parameters fx, fy, cx, cy, then k1, k2, p1, p2, k3, k4, k5, k6; -1: 0.
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
    "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 6, 7),  # k1, k2, k3, k4
}


@dataclass(frozen=True, eq=False)
class SparseModel:
    """What structure from motion found; its scale and frame are arbitrary.

    Attributes:
        cameras: Of the registered images, by file name.
        points: Triangulated points, shape (N, 3).
        colours: Of the points, 8-bit, shape (N, 3).
        seen: Indices of the points that each image observes.
        elsewhere: Names of images that only smaller models hold.
        reprojection_error: Mean over all observations [px].
        agreement: Share of each image's matches with the others that its camera explains; 1 where unknown.
    """

    cameras: Mapping[str, Camera]
    points: Float64Array
    colours: npt.NDArray[np.uint8]
    seen: Mapping[str, Int32Array]
    elsewhere: frozenset[str] = frozenset()
    reprojection_error: float = float("nan")
    agreement: Mapping[str, float] = field(default_factory=dict)

    def without_weak(self, min_points: int = MIN_POINTS) -> tuple[SparseModel, dict[str, int]]:
        """The model without images that observe fewer points, and how many those observe.

        Points that fewer than two images are left to see go too, which can weaken further images.
        """
        counts = {name: len(indices) for name, indices in self.seen.items()}
        weak = {name: count for name, count in counts.items() if count < min_points}
        if not weak:
            return self, {}
        rest, weaker = self.without(weak).without_weak(min_points)
        return rest, weak | weaker

    def without(self, names: Collection[str]) -> SparseModel:
        """The model without some images, and without the points that fewer than two others see."""
        kept = [name for name in self.cameras if name not in names]
        observers = np.zeros(len(self.points), dtype=np.int64)
        for name in kept:
            observers[self.seen[name]] += 1
        stays = observers >= 2
        place = np.cumsum(stays) - 1
        return SparseModel(
            {name: self.cameras[name] for name in kept},
            self.points[stays],
            self.colours[stays],
            {name: place[self.seen[name][stays[self.seen[name]]]].astype(np.int32) for name in kept},
            self.elsewhere,
            self.reprojection_error,
            self.agreement,
        )


def find_cameras(photos: Sequence[Prepared], folder: Path, progress: Progress | None = None) -> SparseModel:
    """Cameras of photographs and the points they share. What an interrupted run had found of it is used.

    Raises:
        InputError: If no two photos share enough points to begin with.
        MissingResourceError: If COLMAP ends its process.
    """
    return _read_arrays(_run({"task": "reconstruct", **_job(photos, folder)}, folder, progress), photos)


def find_points(
    photos: Sequence[Prepared], cameras: Mapping[str, Camera], folder: Path, progress: Progress | None = None
) -> SparseModel:
    """Points that photographs with known cameras share; the cameras stay as they are.

    Raises:
        InputError: If COLMAP cannot use them.
        MissingResourceError: If COLMAP ends its process.
    """
    known = {
        name: {
            "width": camera.width,
            "height": camera.height,
            "model": "OPENCV_FISHEYE" if camera.lens == "fisheye" else "FULL_OPENCV",
            "params": [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion, *[0.0] * 8][
                : 8 if camera.lens == "fisheye" else 12
            ],
            "camera_from_world": camera.camera_from_world[:3].tolist(),
        }
        for name, camera in cameras.items()
    }
    job = _job(photos, folder) | {"groups": [[photo.file.name] for photo in photos], "camera_model": "FULL_OPENCV"}
    model = _read_arrays(_run({"task": "triangulate", "cameras": known, **job}, folder, progress), photos)
    seen = {name: model.seen.get(name, np.zeros(0, dtype=np.int32)) for name in cameras}
    return SparseModel(cameras, model.points, model.colours, seen, reprojection_error=model.reprojection_error)


def read_model(source: Path, folder: Path) -> SparseModel:
    """A COLMAP model, ``cameras``, ``images`` and ``points3D`` as ``.bin`` or ``.txt``.

    Args:
        source: The model's folder.
        folder: For intermediate files.

    Raises:
        InputError: If it is damaged or its lens model is not one of OpenCV's.
        MissingResourceError: If COLMAP ends its process.
    """
    parts = [source / f"{name}{suffix}" for name in _MODEL_PARTS for suffix in (".bin", ".txt")]
    if odd := [path for path in parts if path.exists() and not path.is_file()]:
        raise InputError(f"{odd[0]}: must be a file")
    size = sum(path.stat().st_size for path in parts if path.exists())
    job = {"task": "read", "model": str(source), "memory": _READ_MEMORY + 100 * size}
    try:
        arrays = _run(job, folder, None, seconds=_READ_SECONDS + size / 1e6)
    except InputError as error:
        raise InputError(f"{source}: not a readable COLMAP model ({error})") from error
    return _read_arrays(arrays, ())


def opencv_camera(
    model: str, width: int, height: int, params: npt.ArrayLike, camera_from_world: Float64Array
) -> Camera:
    """The camera with COLMAP's parameters; both put pixel centres at +0.5.

    Raises:
        InputError: If the lens model is not one of OpenCV's, or shows more than it can.
    """
    if model not in _MODELS:
        raise InputError(
            f"lens model {model} is not supported: use one of {', '.join(_MODELS)}, or undistort the images"
        )
    values = np.append(np.asarray(params, dtype=np.float64), 0.0)
    fx, fy, cx, cy, *distortion = (float(values[place]) for place in _MODELS[model])
    # Quaternions of text files have few digits: the nearest rotation.
    u, _, vt = np.linalg.svd(camera_from_world[:3, :3])
    pose = np.eye(4)
    pose[:3, :3] = (u @ vt).T
    pose[:3, 3] = -pose[:3, :3] @ camera_from_world[:3, 3]
    fisheye = model == "OPENCV_FISHEYE"
    try:
        return Camera(
            *(int(width), int(height), fx, fy, cx, cy, pose),
            distortion=tuple(distortion) if fisheye or any(distortion) else (),
            lens="fisheye" if fisheye else "opencv",
        )
    except ValueError as error:
        raise InputError(f"a camera of lens model {model} cannot be used: {error}") from error


def _job(photos: Sequence[Prepared], folder: Path) -> dict[str, Any]:
    """What to do for so many photos: finer features for few, neighbours only for many.

    It names the photos as seen from its own folder, so that what was found of them is still of use when both move.
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    for photo in photos:
        groups.setdefault(photo.lens, []).append(photo.file.name)
    few, many = len(photos) <= 100, len(photos) > 150
    return {
        "images": os.path.relpath(photos[0].file.parent, folder),
        "groups": list(groups.values()),
        "features": 8192 if few else 4096,
        "first_octave": -1 if few else 0,
        "matching": "sequential" if many else "exhaustive",
        "camera_model": "SIMPLE_RADIAL",
        "enough": ENOUGH * len(photos),
    }


def _run(
    job: Mapping[str, Any], folder: Path, progress: Progress | None, *, seconds: float = math.inf
) -> dict[str, npt.NDArray[Any]]:
    """Have the child do the job within a time; what an earlier one of the same input stored in the database is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(job, indent=1)
    file, database = folder / "job.json", folder / "database.db"
    if not file.exists() or file.read_text() != text:
        database.unlink(missing_ok=True)
        write_text(file, text)
    for name in ("model.npz", "error", "status"):
        (folder / name).unlink(missing_ok=True)
    until = time.monotonic() + seconds
    with (folder / "log.txt").open("wb") as log:
        child = subprocess.Popen(
            python_command("-m", "mitsplat.capture.sfm_worker", file.resolve()),
            env=python_environment(),
            stdin=subprocess.PIPE,  # closes when this process ends, and the child with it
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            while True:
                try:
                    status = child.wait(timeout=0.3)
                    break
                except subprocess.TimeoutExpired:
                    if time.monotonic() > until:
                        raise InputError(f"COLMAP did not end within {seconds:.0f} s") from None
                    if progress is not None:
                        progress(*_reached(job, folder))
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
            if child.stdin is not None:
                child.stdin.close()
    if status:
        if (folder / "error").exists():
            raise InputError((folder / "error").read_text())
        raise MissingResourceError(
            f"COLMAP ended with {f'signal {-status}' if status < 0 else f'status {status}'} while "
            f"{_doing(folder) or 'starting'}; its messages are in {folder / 'log.txt'}"
        )
    with (folder / "model.npz").open("rb") as stored, np.load(stored, allow_pickle=False) as arrays:
        return dict(arrays)


def _doing(folder: Path) -> str:
    try:
        return (folder / "status").read_text()
    except OSError:
        return ""


def _reached(job: Mapping[str, Any], folder: Path) -> tuple[int, int, str]:
    """Steps done, of how many, and what is being done."""
    stage, _, count = _doing(folder).rpartition(" ")
    if not count.isdecimal():
        stage, count = _doing(folder), "0"
    photos = sum(map(len, job.get("groups", [])))
    if stage == "finding features":
        return _rows(folder / "database.db", "keypoints"), photos, stage
    if stage == "matching":
        near = photos if job["matching"] == "exhaustive" else 18  # overlap 10 and powers of two up to 512
        pairs = sum(min(place, near) for place in range(photos))
        return min(_rows(folder / "database.db", "two_view_geometries"), pairs), pairs, stage
    return min(int(count), photos), photos, stage or "starting COLMAP"


def _rows(database: Path, table: str) -> int:
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # not there yet, or being written
        return 0


def _read_arrays(arrays: Mapping[str, npt.NDArray[Any]], photos: Sequence[Prepared]) -> SparseModel:
    """The child's result.

    Raises:
        InputError: If it found nothing.
    """
    if "names" not in arrays or not len(arrays["names"]):
        raise InputError(
            f"no two of the {len(photos)} photos share enough points to find cameras from; take them closer together, "
            "sharp, and with texture on or under the object"
        )
    names = [str(name) for name in arrays["names"]]
    cameras = {
        name: opencv_camera(str(model), int(width), int(height), params, pose)
        for name, model, (width, height), params, pose in zip(
            names, arrays["models"], arrays["sizes"], arrays["params"], arrays["poses"], strict=True
        )
    }
    seen = np.split(arrays["seen"], np.cumsum(arrays["seen_counts"])[:-1])
    return SparseModel(
        cameras,
        arrays["points"],
        arrays["colours"],
        dict(zip(names, seen, strict=True)),
        frozenset(map(str, arrays["elsewhere"])),
        float(arrays["reprojection_error"]),
        dict(zip(names, arrays["agreement"].tolist(), strict=True)),
    )
