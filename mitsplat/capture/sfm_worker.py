"""Structure from motion by pycolmap, in a separate process: ``python -m mitsplat.capture.sfm_worker JOB``.

pycolmap can abort its process, and it breaks zlib if zlib was not used before the import. So other processes do not
import it. :mod:`mitsplat.capture.structure_from_motion` starts this module, monitors its progress and reads the results
in the job's folder.

JOB is a JSON file, see :func:`run`. In the same folder, ``model.npz`` is the result and ``status`` the present
activity.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import sys
import threading
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

zlib.compress(b"before pycolmap")

import numpy as np  # noqa: E402
import pycolmap  # noqa: E402

from mitsplat.capture.lens_separation import MAX_LENSES, assign_new_camera, error_of_shifted_lens, second_lens  # noqa: E402
from mitsplat.runtime.child_process import limit_memory  # noqa: E402
from mitsplat.runtime.cores import usable_cores  # noqa: E402

if TYPE_CHECKING:
    from mitsplat.arrays import Float64Array
    from mitsplat.storage.files import JsonObject

SEED = 1
SEQUENTIAL_OVERLAP = 10
MAX_SAMPSON = 4.0
"""Maximum error of a match that agrees with the cameras, as in COLMAP's own verification [px]."""

MAX_TRIALS = 2000
"""Trials of RANSAC per pair. They find 5 points of a pair with 30 % inliers with a probability of 0.99.

Most of the time of matching is spent on pairs with fewer inliers, because these show no common surface.
"""

BLOCK = 12
"""Images per block of exhaustive matching; results are stored, and progress is visible, per pair of blocks."""


def main(job_file: Path) -> None:
    """Run the job; an error is written as one line to the file ``error``."""
    folder = job_file.parent
    try:
        run(json.loads(job_file.read_text()), folder)
    except (ValueError, RuntimeError, OSError, KeyError, IndexError, MemoryError) as error:
        (folder / "error").write_text(" ".join(str(error).split()) or type(error).__name__)
        sys.exit(1)


def end_with_parent() -> None:
    """Exit this process when its parent, at the other end of standard input, ends for any reason.

    Otherwise it would continue to write to the database that the next run uses.
    """

    def watch() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run(job: JsonObject, folder: Path) -> None:
    """Find or read a model and store it.

    Args:
        job: Mapping with the key ``task``. "read" reads a COLMAP model from ``model`` within ``memory`` [bytes].
            "reconstruct" uses ``groups`` (names of the photos with shared intrinsics), ``images`` (their folder,
            relative to ``folder``), ``features``, ``first_octave``, ``matching`` ("exhaustive" or "sequential") and
            ``enough`` (number of photos below which the global mapper is also tried). "triangulate" uses the same keys
            and ``cameras`` (see :func:`known_model`).
        folder: Folder of the database and the results.
    """
    if job["task"] == "read":
        limit_memory(job["memory"])  # damaged files can declare arbitrarily large counts
        store(folder, [read_model(Path(job["model"]))])
        return
    images, database = folder / job["images"], folder / "database.db"
    extract(job, images, database, folder)
    match(job, database, folder)
    if job["task"] == "triangulate":
        write_status(folder, "triangulating")
        known = known_model(job["cameras"], database)
        (folder / "known").mkdir(exist_ok=True)
        found = pycolmap.triangulate_points(known, database, images, folder / "known", options=mapping())
        store(folder, [found])
    else:
        models = reconstruct(images, database, folder, job["enough"])
        store(folder, models, agreement(models[0], database) if models else {})


def read_model(source: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, as text only if it is not there in binary form.

    COLMAP ends the names of text files at their first space, so that they are read here.

    Raises:
        ValueError: If images of one name have different poses.
    """
    model = pycolmap.Reconstruction(str(source))
    if not all((source / f"{part}.bin").exists() for part in ("cameras", "images", "points3D")):
        lines = iter((source / "images.txt").read_text(encoding="utf-8").splitlines())
        for line in lines:
            if line.strip() and not line.lstrip().startswith("#"):
                values = line.split(maxsplit=9)
                model.image(int(values[0])).name = values[9].rstrip()
                next(lines, None)  # points of the image
    poses: dict[str, Float64Array] = {}
    for index in model.reg_image_ids():
        image = model.image(index)
        pose = image.cam_from_world().matrix()
        if not np.allclose(poses.setdefault(image.name, pose), pose):
            raise ValueError(f"two images with different poses have the name {image.name}")
    return model


def write_status(folder: Path, doing: str) -> None:
    """Write the present activity to the file ``status``."""
    part = folder / "status.part"
    part.write_text(doing)
    part.replace(folder / "status")  # atomic, because the parent reads it at any time


def assign_ids(job: JsonObject, images: Path, database: Path) -> None:
    """Assign image ids in the order of the job; photos of a group share a camera.

    Several threads store features in arbitrary order. Without this step, ids would differ between runs, and with them
    the order within pairs, the order of pairs, and all cameras.
    """
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["camera_model"]
    wanted = [name for names in job["groups"] for name in names]
    with pycolmap.Database.open(database) as opened:
        found = [image.name for image in sorted(opened.read_all_images(), key=lambda image: image.image_id)]
    if found == wanted:
        return
    places = places_of(wanted)
    if found == [places[name] for name in wanted]:  # matching was interrupted
        rename_images(database, {place: name for name, place in places.items()})
        return
    database.unlink()  # an interrupted run left only some of the images
    pycolmap.Database.open(database).close()
    for names in job["groups"]:
        pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, names, reader)


def extract(job: JsonObject, images: Path, database: Path, folder: Path) -> None:
    """Compute SIFT features of the photos that have none yet."""
    assign_ids(job, images, database)
    # Later than the creation of the database, which fails while the parent reads it.
    write_status(folder, "finding features")
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = usable_cores()  # COLMAP would use all cores; each needs memory for a photo
    options.sift.max_num_features = job["features"]
    options.sift.first_octave = job["first_octave"]
    for names in job["groups"]:
        pycolmap.extract_features(
            database,
            images,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )


def numbers_in(name: str) -> list[str | int]:
    """Return a key that sorts names by the numbers in them: frame2 before frame10, unlike COLMAP."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def places_of(names: Sequence[str]) -> dict[str, str]:
    """Return for each name its place in the order of the numbers in the names, as text that sorts in this order."""
    return {name: f"{place:08d}" for place, name in enumerate(sorted(names, key=numbers_in))}


def rename_images(database: Path, names: Mapping[str, str]) -> None:
    """Rename images of a database to the values of ``names``."""
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            image.name = names[image.name]
            opened.update_image(image)


def match(job: JsonObject, database: Path, folder: Path) -> None:
    """Compute verified matches of the pairs that have none yet."""
    write_status(folder, "matching")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = usable_cores()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.ransac.max_num_trials = MAX_TRIALS
    names = [name for group in job["groups"] for name in group]
    if job["matching"] == "sequential":
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = SEQUENTIAL_OVERLAP
        places = places_of(names)
        rename_images(database, places)  # COLMAP sorts names by their letters
        pycolmap.match_sequential(database, matching, pairing, verification, device=pycolmap.Device.cpu)
        rename_images(database, {place: name for name, place in places.items()})
    else:
        blocks = pycolmap.ExhaustivePairingOptions()
        blocks.block_size = BLOCK
        pycolmap.match_exhaustive(database, matching, blocks, verification, device=pycolmap.Device.cpu)


def reconstruct(images: Path, database: Path, folder: Path, enough: int) -> list[pycolmap.Reconstruction]:
    """Reconstruct all models and return them, the largest first.

    If photos that share a camera are of lenses with different focal lengths, all models are reconstructed again with a
    camera for each lens.
    """
    models, separated = find_models(images, database, folder, "models", enough), folder / "lenses.db"
    for number in range(1, MAX_LENSES):
        if not (models and (longer := second_lens(models[0]))):
            break
        if number == 1:
            shutil.copyfile(database, separated)
        assign_new_camera(separated, longer)
        again = find_models(images, separated, folder, f"lens{number}", enough)
        is_smaller = not again or again[0].num_reg_images() < models[0].num_reg_images()
        if is_smaller or again[0].compute_mean_reprojection_error() >= error_of_shifted_lens(models[0]):
            break
        models = again
    separated.unlink(missing_ok=True)
    return models


def find_models(images: Path, database: Path, folder: Path, name: str, enough: int) -> list[pycolmap.Reconstruction]:
    """Reconstruct all models, write them to the subfolder ``name``, and return them, the largest first.

    The incremental mapper is used. The global mapper is used if it registers more photos.
    """
    write_status(folder, "finding cameras")
    registered = itertools.count(1)
    output = folder / name
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    found = pycolmap.incremental_mapping(
        *(database, images, output, mapping()),
        next_image_callback=lambda: write_status(folder, f"finding cameras {next(registered)}"),
    )
    models = largest_first(found)
    if models and models[0].num_reg_images() >= enough:
        return models
    write_status(folder, "finding cameras at once")
    copy = folder / "global.db"
    shutil.copyfile(database, copy)  # calibration modifies the two-view geometries
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = SEED
    pycolmap.calibrate_view_graph(copy, calibration)
    at_once = pycolmap.GlobalPipelineOptions()
    at_once.random_seed = at_once.mapper.random_seed = SEED
    at_once.num_threads = at_once.mapper.num_threads = 1
    (output / "global").mkdir()
    others = largest_first(pycolmap.global_mapping(copy, images, output / "global", at_once))
    copy.unlink()
    if others and (not models or others[0].num_reg_images() > models[0].num_reg_images()):
        for model in others:
            model.extract_colors_for_all_images(images)
        return others
    return models


def mapping() -> pycolmap.IncrementalPipelineOptions:
    """Return the options of the incremental mapper."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    # Bundle adjustment with several threads sums in arbitrary order, so the cameras would differ between runs.
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = 3
    return options


def largest_first(found: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Sort the models by the number of registered photos, descending."""
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def known_model(cameras: dict[str, JsonObject], database: Path) -> pycolmap.Reconstruction:
    """Return a model with known cameras and without points, and store the cameras in the database.

    COLMAP refuses a lens of another model than that in the database.

    Args:
        cameras: Per photo ``width``, ``height``, COLMAP's ``model`` and ``params``, and ``camera_from_world``, shape
            (3, 4).
        database: Database that defines the image and camera ids.
    """
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        images = [image for image in opened.read_all_images() if image.name in cameras]
        lenses = {
            image.image_id: pycolmap.Camera(
                **{key: cameras[image.name][key] for key in ("model", "width", "height", "params")},
                camera_id=image.camera_id,
            )
            for image in images
        }
        for lens in lenses.values():
            opened.update_camera(lens)
    for image in images:
        known, camera = cameras[image.name], lenses[image.image_id]
        model.add_camera_with_trivial_rig(camera)
        placed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(placed, pycolmap.Rigid3d(np.array(known["camera_from_world"])))
    return model


def store(folder: Path, models: list[pycolmap.Reconstruction], shares: Mapping[str, float] | None = None) -> None:
    """Write the first model with its :func:`agreement`, and the names of photos in other models, to ``model.npz``."""
    arrays: dict[str, Any] = {"elsewhere": sorted(names_of(models[1:]) - names_of(models[:1]))}
    if models:
        arrays |= model_arrays(models[0])
        arrays["agreement"] = np.array([(shares or {}).get(name, 1.0) for name in arrays["names"]])
    np.savez(folder / "model.npz", **arrays)


def agreement(model: pycolmap.Reconstruction, database: Path) -> dict[str, float]:
    """Return, for each photo, the fraction of its verified matches that agree with the model's cameras.

    Points are triangulated only from matches that agree with the cameras. So a photo that is misplaced by a few matches
    has small reprojection errors, but a low fraction here. The error is the Sampson error (Hartley and Zisserman,
    11.4.3).
    """
    explained: dict[int, list[int]] = {index: [0, 0] for index in model.reg_image_ids()}
    with pycolmap.Database.open(database) as opened:
        pairs, geometries = opened.read_two_view_geometries()
        pixels = {index: opened.read_keypoints(index)[:, :2] for index in explained}
    cameras = {index: model.camera(model.image(index).camera_id) for index in explained}
    rays = {index: np.asarray(cameras[index].cam_from_img(pixels[index])) for index in explained}
    for pair, geometry in zip(pairs, geometries, strict=True):
        ids = pycolmap.pair_id_to_image_pair(pair)
        matches = np.asarray(geometry.inlier_matches)
        if not len(matches) or not all(index in explained for index in ids):
            continue
        one, other = (model.image(index) for index in ids)
        pose = other.cam_from_world() * one.cam_from_world().inverse()
        x, y, z = pose.translation
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose.rotation.matrix()
        a, b = (
            np.column_stack([rays[index][matches[:, side]], np.ones(len(matches))]) for side, index in enumerate(ids)
        )
        lines_b, lines_a = a @ essential.T, b @ essential
        spread = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
        errors = np.abs((b * lines_b).sum(axis=1)) / np.sqrt(np.maximum(spread, 1e-30))
        focal = sum(cameras[index].mean_focal_length() for index in ids) / 2
        good = int(np.count_nonzero(errors * focal < MAX_SAMPSON))
        for index in ids:
            explained[index][0] += good
            explained[index][1] += len(matches)
    return {model.image(index).name: good / total for index, (good, total) in explained.items() if total}


def names_of(models: list[pycolmap.Reconstruction]) -> set[str]:
    """Return the names of the registered photos."""
    return {model.image(index).name for model in models for index in model.reg_image_ids()}


def model_arrays(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Return the model as arrays: photos sorted by name, parameters padded with NaN."""
    ids = sorted(model.points3D)
    row = {point: index for index, point in enumerate(ids)}
    by_name = {model.image(index).name: model.image(index) for index in model.reg_image_ids()}
    images = [by_name[name] for name in sorted(by_name)]
    cameras = [model.camera(image.camera_id) for image in images]
    # Models from which other programs removed points still refer to them.
    seen = [
        sorted({row[point.point3D_id] for point in image.points2D if point.has_point3D() and point.point3D_id in row})
        for image in images
    ]
    params = np.full((len(images), 32), np.nan)
    for values, camera in zip(params, cameras, strict=True):
        values[: len(camera.params)] = camera.params
    return {
        "names": [image.name for image in images],
        "models": [camera.model_name for camera in cameras],
        "sizes": np.array([(camera.width, camera.height) for camera in cameras]).reshape(-1, 2),
        "params": params,
        "poses": np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4),
        "points": np.array([model.point3D(point).xyz for point in ids]).reshape(-1, 3),
        "colours": np.array([model.point3D(point).color for point in ids], dtype=np.uint8).reshape(-1, 3),
        "seen": np.array([index for indices in seen for index in indices], dtype=np.int32),
        "seen_counts": np.array([len(indices) for indices in seen], dtype=np.int64),
        "reprojection_error": model.compute_mean_reprojection_error() if ids else np.nan,
    }


if __name__ == "__main__":
    end_with_parent()
    main(Path(sys.argv[1]))
