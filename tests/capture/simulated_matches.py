"""Reconstruction from simulated features and matches: ``python -m tests.capture.simulated_matches FOLDER CASE``.

A separate process, because pycolmap must not be imported by tests. CASE is a JSON object with the arguments of
:func:`simulate`. The output is a JSON object with the focal lengths of the cameras [px] and the largest error of a
camera centre, as a share of its distance.
"""

from __future__ import annotations

import json
import sys
from itertools import combinations
from pathlib import Path

import numpy as np

from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.sfm_worker import pycolmap, reconstruct

WIDTH, HEIGHT, FOCAL = 1200, 900, 1000.0
Photo = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Indices of the observed points, their pixels, and the centre of the camera."""


def simulate(offset: tuple[float, float], ratio: float, noise: float = 0.5) -> list[Photo]:
    """Return 20 photos of an ellipsoid on a table, 6 of them from above.

    Args:
        offset: Position of the principal point relative to the centre of the image [px].
        ratio: Focal length of every second photo, divided by that of the others.
        noise: Standard deviation of features [px].
    """
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.25, -0.25, 0], [0.25, 0.25, 0], (1200, 3))
    solid = rng.normal(size=(300, 3))
    points[:300] = solid / np.linalg.norm(solid, axis=1, keepdims=True) * [0.05, 0.05, 0.03] + [0, 0, 0.03]
    photos = []
    for number in range(20):
        azimuth, elevation = number * 2.4, np.radians(86 if number >= 14 else 35) + rng.uniform(-0.07, 0.07)
        flat = np.cos(elevation)
        back = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
        centre = back * rng.uniform(0.45, 0.6)
        right = np.cross([0, 0, 1], back) / flat
        seen = (points - centre) @ np.stack([right, np.cross(right, back), -back]).T
        length = FOCAL * (ratio if number % 2 else 1)
        pixels = length * seen[:, :2] / seen[:, 2:] + np.array([WIDTH, HEIGHT]) / 2 + offset
        pixels += rng.normal(size=pixels.shape) * noise
        inside = np.flatnonzero((pixels > 0).all(1) & (pixels < [WIDTH, HEIGHT]).all(1) & (rng.random(1200) < 0.5))
        photos.append((inside, pixels[inside], centre))
    return photos


def write_database(path: Path, photos: list[Photo]) -> None:
    """Write a database in which all photos share a camera."""
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[1.2 * WIDTH, WIDTH / 2, HEIGHT / 2, 0]
    )
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with pycolmap.Database.open(path) as opened:
        lens.camera_id = opened.write_camera(lens)
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, lens.camera_id)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(sensor)
        frame = pycolmap.Frame()
        frame.rig_id = opened.write_rig(rig)
        ids = []
        for number, (_, pixels, _) in enumerate(photos):
            ids.append(opened.write_image(pycolmap.Image(name=f"{number}.png", camera_id=lens.camera_id)))
            frame.clear_data_ids()
            frame.add_data_id(pycolmap.data_t(sensor, ids[-1]))
            opened.write_frame(frame)
            opened.write_keypoints(ids[-1], pixels.astype(np.float32))
        for a, b in combinations(range(len(photos)), 2):
            _, *places = np.intersect1d(photos[a][0], photos[b][0], return_indices=True)
            matches = np.column_stack(places).astype(np.uint32)
            opened.write_matches(ids[a], ids[b], matches)
            found = pycolmap.estimate_two_view_geometry(lens, photos[a][1], lens, photos[b][1], matches, options)
            opened.write_two_view_geometry(ids[a], ids[b], found)


def main(folder: Path, case: str) -> None:
    """Simulate photos, reconstruct them, and print the result."""
    photos = simulate(**json.loads(case))
    write_database(folder / "database.db", photos)
    model = reconstruct(folder, folder / "database.db", folder, len(photos))[0]
    images = [model.image(index) for index in model.reg_image_ids()]
    truth = np.array([photos[int(Path(image.name).stem)][2] for image in images])
    _, residuals = fit_similarity(np.array([image.projection_center() for image in images]), truth)
    error = np.linalg.norm(residuals, axis=1).max() / np.linalg.norm(truth, axis=1).mean()
    lengths = sorted(camera.mean_focal_length() for camera in model.cameras.values())
    sys.stdout.write(json.dumps({"photos": len(images), "lengths": lengths, "error": error}) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
