"""Structure from motion: cameras and points from photographs, or from an existing COLMAP model.

The computation is done by COLMAP (Schönberger and Frahm 2016; global mapper: Pan et al. 2024) in
:mod:`mitsplat.capture.sfm_worker`.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import subprocess
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import AnyArray, Float64Array, Int32Array
from mitsplat.capture.photos import Prepared
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import nearest_rigid
from mitsplat.geometry.triangulation import count_observers
from mitsplat.progress import Progress
from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.storage.files import JsonObject, write_text

MIN_POINTS = 30
"""Minimum number of points that a photo must observe.

With fewer points, camera errors of 20 % were measured at reprojection errors of 0.2 px.
"""

MIN_AGREEMENT = 0.5
"""Minimum fraction of a photo's matches that agree with its camera; in photos of a statue, all had 98 % or more."""

SURE_AGREEMENT = 0.65
"""Fraction of agreeing matches below which a camera is doubtful, unless a board confirms it."""

ENOUGH = 0.8
"""Fraction of registered photos below which the global mapper is also tried."""

MIN_FOLDER = 3
"""Minimum number of photos without EXIF data in a folder that have intrinsics of their own."""

_MODEL_PARTS = ("cameras", "images", "points3D")
_READ_MEMORY = 2 << 30
"""Address space for reading a model, in addition to 100 times the size of its files [bytes]."""
_READ_SECONDS = 30
"""Time limit for reading a model, in addition to one second per megabyte [s]."""

_MODELS: Mapping[str, tuple[int, ...]] = {
    # Indices of COLMAP's parameters fx, fy, cx, cy, then k1, k2, p1, p2, k3, k4, k5, k6; -1 stands for 0.
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
    "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 6, 7),  # k1, k2, k3, k4
    "RADIAL_FISHEYE": (0, 0, 1, 2, 3, 4, -1, -1),
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2, 3, -1, -1, -1),
}


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Result of structure from motion, in arbitrary scale and frame.

    Attributes:
        cameras: Cameras of the registered images, by file name.
        points: Triangulated points, shape (N, 3).
        colours: 8-bit colours of the points, shape (N, 3).
        seen: Indices of the points that each image observes, shape (K,) each.
        elsewhere: Names of images that only smaller models contain.
        reprojection_error: Mean reprojection error over all observations [px].
        agreement: Fraction of each image's matches that agree with its camera; 1 where unknown.
    """

    cameras: Mapping[str, Camera]
    points: Float64Array
    colours: npt.NDArray[np.uint8]
    seen: Mapping[str, Int32Array]
    elsewhere: frozenset[str] = frozenset()
    reprojection_error: float = float("nan")
    agreement: Mapping[str, float] = field(default_factory=dict)

    def without_weak_images(self, min_points: int = MIN_POINTS) -> tuple[SparseModel, dict[str, int]]:
        """Return the model without images that observe fewer points, and the number of points that those observe.

        Points that fewer than two remaining images observe are removed too, which can make more images weak.
        """
        counts = {name: len(indices) for name, indices in self.seen.items()}
        weak = {name: count for name, count in counts.items() if count < min_points}
        if not weak:
            return self, {}
        rest, weaker = self.without_images(weak).without_weak_images(min_points)
        return rest, weak | weaker

    def without_images(self, names: Collection[str]) -> SparseModel:
        """Return the model without the named images, and without points that fewer than two other images observe."""
        kept = [name for name in self.cameras if name not in names]
        stays = count_observers([self.seen[name] for name in kept], len(self.points)) >= 2
        place = np.cumsum(stays) - 1
        return replace(
            self,
            cameras={name: self.cameras[name] for name in kept},
            points=self.points[stays],
            colours=self.colours[stays],
            seen={name: place[self.seen[name][stays[self.seen[name]]]].astype(np.int32) for name in kept},
        )


def find_cameras(photos: Sequence[Prepared], folder: Path, progress: Progress | None = None) -> SparseModel:
    """Find the cameras of photographs and their common points; results of an interrupted run are reused.

    Raises:
        InputError: If no two photos share enough points to start with.
        MissingResourceError: If COLMAP aborts its process.
    """
    groups, shared = lens_groups(photos), lens_groups(photos, by_folder=False)
    model = _reconstruct(photos, groups, folder, progress)
    # Folders of few photos can be of one camera, whose intrinsics need all of them.
    if len(model.cameras) < ENOUGH * len(photos) and len(shared) < len(groups):
        with suppress(InputError):
            model = max(model, _reconstruct(photos, shared, folder / "shared", progress), key=_count_sure)
    return model


def _reconstruct(
    photos: Sequence[Prepared], groups: Sequence[Sequence[Prepared]], folder: Path, progress: Progress | None
) -> SparseModel:
    """Find the cameras of photos that share intrinsics in groups."""
    return _read_arrays(_run({"task": "reconstruct", **_job(photos, groups, folder)}, folder, progress), photos)


def _count_sure(model: SparseModel) -> int:
    """Return the number of cameras that agree with most of their matches."""
    return sum(share >= SURE_AGREEMENT for share in model.agreement.values())


def find_points(
    photos: Sequence[Prepared], cameras: Mapping[str, Camera], folder: Path, progress: Progress | None
) -> SparseModel:
    """Triangulate the common points of photographs with fixed, known cameras.

    Raises:
        InputError: If COLMAP cannot use the cameras.
        MissingResourceError: If COLMAP aborts its process.
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
    job = _job(photos, [[photo] for photo in photos], folder) | {"camera_model": "FULL_OPENCV"}
    model = _read_arrays(_run({"task": "triangulate", "cameras": known, **job}, folder, progress), photos)
    seen = {name: model.seen.get(name, np.zeros(0, dtype=np.int32)) for name in cameras}
    return SparseModel(cameras, model.points, model.colours, seen, reprojection_error=model.reprojection_error)


def read_colmap_model(source: Path, folder: Path) -> SparseModel:
    """Read a COLMAP model: ``cameras``, ``images`` and ``points3D`` as ``.bin`` or ``.txt``.

    Args:
        source: Folder of the model.
        folder: Folder for intermediate files.

    Raises:
        InputError: If the model is damaged or its lens model is none of OpenCV's.
        MissingResourceError: If COLMAP aborts its process.
    """
    parts = [source / f"{name}{suffix}" for name in _MODEL_PARTS for suffix in (".bin", ".txt")]
    if odd := [path for path in parts if path.exists() and not path.is_file()]:
        raise InputError(f"{odd[0]}: must be a file")
    if not any(path.exists() for path in parts):
        raise InputError(
            f"{source}: must hold the files cameras and images of a COLMAP model, as .bin or .txt (got none)"
        )
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
    """Return the camera with COLMAP's parameters; both conventions put pixel centres at +0.5.

    Raises:
        InputError: If the lens model is none of OpenCV's, or the camera is invalid.
    """
    if model not in _MODELS:
        raise InputError(
            f"lens model {model} is not supported: use one of {', '.join(_MODELS)}, or undistort the images"
        )
    values = np.append(np.asarray(params, dtype=np.float64), 0.0)
    fx, fy, cx, cy, *distortion = (float(values[place]) for place in _MODELS[model])
    # Quaternions of text files have few digits, so use the nearest rotation.
    pose = np.asarray(np.linalg.inv(nearest_rigid(camera_from_world)))
    fisheye = model.endswith("_FISHEYE")
    try:
        return Camera(
            *(int(width), int(height), fx, fy, cx, cy, pose),
            distortion=tuple(distortion) if fisheye or any(distortion) else (),
            lens="fisheye" if fisheye else "opencv",
        )
    except ValueError as error:
        raise InputError(f"a camera of lens model {model} cannot be used: {error}") from error


def lens_groups(photos: Sequence[Prepared], *, by_folder: bool = True) -> list[list[Prepared]]:
    """Group the photos that share intrinsics: those of one size and equal EXIF data.

    Without EXIF data, and with ``by_folder``, they are also of one folder, because another folder is often that of
    another camera or zoom setting. Folders of fewer than :data:`MIN_FOLDER` photos form one group.
    """
    folders = [Path(photo.name).parent for photo in photos]
    sizes = Counter((photo.lens, folder) for photo, folder in zip(photos, folders, strict=True))
    groups: dict[tuple[tuple[str, ...], Path | None], list[Prepared]] = {}
    for photo, folder in zip(photos, folders, strict=True):
        is_apart = by_folder and len(photo.lens) == 2 and sizes[photo.lens, folder] >= MIN_FOLDER
        groups.setdefault((photo.lens, folder if is_apart else None), []).append(photo)
    return list(groups.values())


def _job(photos: Sequence[Prepared], groups: Sequence[Sequence[Prepared]], folder: Path) -> JsonObject:
    """Return the job for the photos: finer features for few photos, sequential matching for many.

    The job has the photo folder relative to its own folder, so that results stay valid when both are moved together.
    """
    few, many = len(photos) <= 100, len(photos) > 150
    return {
        "images": os.path.relpath(photos[0].file.parent, folder),
        "groups": [[photo.file.name for photo in group] for group in groups],
        "features": 8192 if few else 4096,
        "first_octave": -1 if few else 0,
        "matching": "sequential" if many else "exhaustive",
        "camera_model": "SIMPLE_RADIAL",
        "enough": ENOUGH * len(photos),
    }


def _run(job: JsonObject, folder: Path, progress: Progress | None, *, seconds: float = math.inf) -> dict[str, AnyArray]:
    """Run the job in a child process within a time limit.

    The database of an earlier run with the same job is reused.
    """
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
            stdin=subprocess.PIPE,  # closes when this process ends, which ends the child
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
                        raise InputError(
                            f"COLMAP did not end within {seconds:.0f} s: give fewer or smaller photos"
                        ) from None
                    if progress is not None:
                        progress(*_progress_of(job, folder))
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
            f"{_read_status(folder) or 'starting'}; its messages are in {folder / 'log.txt'}"
        )
    with (folder / "model.npz").open("rb") as stored, np.load(stored, allow_pickle=False) as arrays:
        return dict(arrays)


def _read_status(folder: Path) -> str:
    try:
        return (folder / "status").read_text()
    except OSError:
        return ""


def _progress_of(job: JsonObject, folder: Path) -> tuple[int, int, str]:
    """Return the steps done, their total and the present activity."""
    stage, _, count = _read_status(folder).rpartition(" ")
    if not count.isdecimal():
        stage, count = _read_status(folder), "0"
    photos = sum(map(len, job.get("groups", [])))
    if stage == "finding features":
        return _count_rows(folder / "database.db", "keypoints"), photos, stage
    if stage == "matching":
        near = photos if job["matching"] == "exhaustive" else 18  # overlap 10 and powers of two up to 512
        pairs = sum(min(place, near) for place in range(photos))
        return min(_count_rows(folder / "database.db", "two_view_geometries"), pairs), pairs, stage
    return min(int(count), photos), photos, stage or "starting COLMAP"


def _count_rows(database: Path, table: str) -> int:
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # missing, or locked by a writer
        return 0


def _read_arrays(arrays: Mapping[str, AnyArray], photos: Sequence[Prepared]) -> SparseModel:
    """Return the result of the child process.

    Raises:
        InputError: If no cameras were found.
    """
    if "names" not in arrays or not len(arrays["names"]):
        raise InputError(
            f"no two of the {len(photos)} photos share enough points to find cameras; take sharp photos "
            "closer together, with texture on or below the object"
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
