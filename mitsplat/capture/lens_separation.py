"""Separation of photos of two lenses that share one camera in COLMAP's database.

Photos without EXIF data do not state their focal length. If photos of two lenses or zoom settings share intrinsics,
COLMAP finds a focal length between those of both, and wrong poses with small reprojection errors. A bundle adjustment
of the finished model with one focal length per photo restores the ratio of both. Of photos of a statue of which every
second is enlarged 1.1 times, the lengths form two groups at a ratio of 1.10 with a standard deviation of 1 %.

Only :mod:`mitsplat.capture.sfm_worker` imports this module, because pycolmap must not be imported elsewhere.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from mitsplat.arrays import BoolArray

MAX_LENSES, MIN_PHOTOS, MIN_RATIO = 3, 3, 1.05
"""Maximum number of lenses, minimum number of photos of each, and minimum ratio of the focal lengths of two lenses."""
MIN_POINTS = 60
"""Minimum number of points that a photo must observe to determine its focal length within a few per cent."""
MIN_SEPARATION = 6.0
"""Minimum difference of two groups of logarithmic focal lengths, in standard deviations within the groups.

The best split of equally distributed values has 3.5, that of normally distributed ones 2.7.
"""


def second_lens(model: pycolmap.Reconstruction) -> list[int]:
    """Return the ids of photos that share a camera with others, but have longer focal lengths."""
    groups: dict[int, list[int]] = {}
    for index in sorted(model.reg_image_ids()):
        groups.setdefault(model.image(index).camera_id, []).append(index)
    if max(map(len, groups.values())) < 2 * MIN_PHOTOS:
        return []
    lengths = own_focal_lengths(model)
    for group in groups.values():
        counts = [model.image(index).num_points3D for index in group]
        longer = split_lengths([lengths[index] for index in group], counts)
        if longer.any():
            return list(np.array(group)[longer].tolist())
    return []


def own_focal_lengths(model: pycolmap.Reconstruction) -> Mapping[int, float]:
    """Return the focal length [px] of each photo after a bundle adjustment with one focal length per photo."""
    own = pycolmap.Reconstruction()
    for index in model.reg_image_ids():
        image = model.image(index)
        own.add_camera_with_trivial_rig(pycolmap.Camera(model.camera(image.camera_id).todict() | {"camera_id": index}))
        pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        placed = pycolmap.Image(name=image.name, keypoints=pixels, camera_id=index, image_id=index)
        own.add_image_with_trivial_frame(placed, image.cam_from_world())
    for point in model.points3D.values():
        own.add_point3D(point.xyz, point.track)
    _adjust(own)
    return {index: float(own.camera(index).mean_focal_length()) for index in own.reg_image_ids()}


def error_of_shifted_lens(model: pycolmap.Reconstruction) -> float:
    """Return the mean reprojection error [px] after a bundle adjustment that also moves principal points.

    A principal point off the centre, as of cropped photos, also makes the lengths of photos from above differ.
    """
    shifted = copy.copy(model)
    _adjust(shifted, refine_principal_point=True)
    shifted.update_point_3d_errors()
    return float(shifted.compute_mean_reprojection_error())


def _adjust(model: pycolmap.Reconstruction, *, refine_principal_point: bool = False) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = options.print_summary = False
    options.refine_principal_point = refine_principal_point
    options.ceres.solver_options.num_threads = 1  # several threads sum in arbitrary order
    pycolmap.bundle_adjustment(model, options)


def split_lengths(lengths: npt.ArrayLike, counts: npt.ArrayLike) -> BoolArray:
    """Return True for the photos of the longer lens, and for none if the lengths do not form two separate groups.

    Args:
        lengths: Focal length of each photo [px].
        counts: Number of points that each photo observes.
    """
    values = np.log(np.asarray(lengths, dtype=np.float64))
    sure = np.sort(values[np.asarray(counts) >= MIN_POINTS])
    splits = range(MIN_PHOTOS, len(sure) - MIN_PHOTOS + 1)
    if not splits:
        return np.zeros(len(values), dtype=bool)

    def squares(split: int) -> float:
        return float(sum(np.var(part) * len(part) for part in (sure[:split], sure[split:])))

    best = min(splits, key=squares)
    low, high = float(sure[:best].mean()), float(sure[best:].mean())
    spread = math.sqrt(squares(best) / (len(sure) - 2))
    is_separate = high - low >= max(math.log(MIN_RATIO), MIN_SEPARATION * spread)
    return np.asarray(is_separate & (values > (low + high) / 2))


def assign_new_camera(database: Path, indices: list[int]) -> None:
    """Give the photos with these ids, which share a camera, a camera of their own in a database."""
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        frames = {frame.frame_id: frame for frame in opened.read_all_frames()}
        lens = opened.read_camera(images[indices[0]].camera_id)  # a copy gets a new id
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, opened.write_camera(lens))
        rig = pycolmap.Rig()
        rig.add_ref_sensor(sensor)
        number = opened.write_rig(rig)
        for index in indices:
            image, frame = images[index], frames[images[index].frame_id]
            frame.rig_id = number
            frame.clear_data_ids()
            frame.add_data_id(pycolmap.data_t(sensor, index))
            opened.update_frame(frame)
            image.camera_id = sensor.id
            opened.update_image(image)
