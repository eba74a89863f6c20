"""Stage ``mitsplat capture``: from photographs or a video to a :class:`~mitsplat.capture.capture.Capture`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from mitsplat.arguments import check_type, path_of
from mitsplat.arrays import BoolArray
from mitsplat.capture.alignment.metric_frame import MetricFrame, find_metric_frame
from mitsplat.capture.boards.board_mask import bare_squares
from mitsplat.capture.capture import CAPTURE_FILE, Capture, Photo
from mitsplat.capture.exposure import even_exposure
from mitsplat.capture.geometric_masks import object_masks, object_points
from mitsplat.capture.isolation import ChosenObject, occluded_part
from mitsplat.capture.known_poses import read_poses, unnamed_photos
from mitsplat.capture.nerf_transforms import check_metric
from mitsplat.capture.photo_masks import add_masks, check_borders, cutout_masks, given_masks, model_masks, plain_masks
from mitsplat.capture.photos import SUFFIXES, Prepared, find_photos, prepare_photos, undistort
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.capture.pipeline.overview import capture_sheet
from mitsplat.capture.pipeline.picking import chosen_object
from mitsplat.capture.structure_from_motion import MIN_AGREEMENT, MIN_POINTS, SURE_AGREEMENT, SparseModel, find_cameras
from mitsplat.capture.video import choose_frames
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.progress import Progress
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import JsonObject, write_file, write_text

MIN_PHOTOS = 3

_HIDDEN = 0.03
"""Occluded fraction of the object above which the mask of a photo marks the occluded pixels as unknown."""
_MAX_HIDDEN = 0.5
"""Possibly occluded fraction of the object above which an occluded photo is rejected."""

_INPUTS = "inputs.json"
_PHOTOS = "sfm/photos.json"
"""Record of the inputs of the photo copies; written before the copies."""
_RESULT_FIELDS = ("given", "source", "reprojection_error", "doubtful", "unnamed", "copies")
"""Fields of a result that ``inputs.json`` stores in addition to the inputs."""


def capture_photos(
    photos: str | Path,
    out: str | Path,
    settings: CaptureSettings | None = None,
    *,
    progress: Progress | None = None,
) -> CaptureResult:
    """Find cameras, scale, gravity and masks of photographs.

    Results of an interrupted or finished run with the same inputs are reused.

    Args:
        photos: Folder of photographs of one object or place, or a video file.
        out: Capture folder. ``sfm/`` in it holds intermediate results for later runs, ``frames/`` the frames of a
            video.
        settings: Settings of the capture; by default those of :class:`CaptureSettings`.
        progress: Callback with the steps done, their total and the present activity.

    Raises:
        InputError: If there are fewer than three usable photographs, if no cameras can be found, or if an input lies in
            a folder that is overwritten.
        MissingResourceError: If COLMAP or the mask network fails to run.
    """
    photos, out = path_of(photos, "photos"), path_of(out, "out")
    settings = CaptureSettings() if settings is None else settings
    check_type(settings, CaptureSettings, "settings", "for example mitsplat.CaptureSettings(max_size=1200)")
    _check_outputs(out, photos, settings)
    if settings.masks is not None and not settings.masks.is_dir():
        raise InputError(f"{settings.masks}: no such folder of masks")
    if photos.is_file() and photos.suffix.lower() not in SUFFIXES:
        video = choose_frames(photos, out / "frames", most=settings.frames, least=MIN_PHOTOS, progress=progress)
        return replace(_capture(video.folder, out, settings, progress), video=video)
    return _capture(photos, out, settings, progress)


def _capture(photos: Path, out: Path, settings: CaptureSettings, progress: Progress | None) -> CaptureResult:
    """Make the capture of a folder of photographs."""
    files = find_photos(photos, masks=settings.masks)
    if len(files) < MIN_PHOTOS:
        raise InputError(f"{photos}: must hold at least {MIN_PHOTOS} photographs (got {len(files)})")
    inputs = _inputs(photos, files, settings)
    if (done := _load_finished(out, inputs)) is not None:
        return done
    work = out / "sfm"
    for marker in (_INPUTS, CAPTURE_FILE):  # images and masks will change
        (out / marker).unlink(missing_ok=True)
    _delete_outdated(out, inputs, settings)
    names = [path.relative_to(photos).as_posix() for path in files]
    unnamed = [] if settings.poses is None else unnamed_photos(settings.poses, names, photos)
    # Empty files are equal, but are no photos.
    hashes = {name: inputs["photos"][name] for name, path in zip(names, files, strict=True) if path.stat().st_size}
    copies = _find_copies(hashes, settings.named_photos) if settings.poses is None else []
    prepared, rejected = prepare_photos(
        photos,
        out / "images",
        excluded={*unnamed, *copies},
        max_size=settings.max_size,
        upright=settings.poses is None,
        masks=settings.masks,
        progress=progress,
    )
    if len(prepared) < MIN_PHOTOS:
        unused = rejected | dict.fromkeys(copies, "it is a copy of another photo")
        reasons = "; ".join(f"{name}: {reason}" for name, reason in sorted(unused.items())[:3])
        raise InputError(f"{photos}: needs at least {MIN_PHOTOS} usable photographs (got {len(prepared)}; {reasons})")
    given = None
    if settings.poses is not None:
        given, prepared = read_poses(settings.poses, prepared, work, progress, base=photos, unusable=list(rejected))
    by_file = {photo.file.name: photo for photo in prepared}
    model, frame, faults = _find_model(photos, by_file, given, settings, work, progress)
    rejected |= {by_file[file].name: fault for file, fault in faults.items()}
    capture = _in_frame(model, frame, by_file, rejected)
    lenses = {photo.name: photo.camera for photo in capture.photos}
    if settings.undistorted:
        capture = replace(capture, photos=tuple(undistort(photo) for photo in capture.photos))
    capture = even_exposure(capture)
    if settings.kind == "object":
        made = {photo.name: photo for photo in prepared}
        capture = _with_masks(capture, frame, settings, photos, made, lenses, out, progress)
        if len(capture.photos) < MIN_PHOTOS:
            name, reason = sorted(set(capture.rejected.items()) - set(rejected.items()))[0]
            raise InputError(
                f"{photos}: only {len(capture.photos)} photos can be segmented ({name}: {reason}); use --masks"
            )
    capture = capture.save(out)
    used = {photo.file.name for photo in capture.photos}
    for path in (out / "images").iterdir():
        if path.name not in used:
            path.unlink()
    write_file(out / "capture.png", lambda part: capture_sheet(capture).save(part, "PNG"))
    doubtful = _doubtful_photos(model, frame, by_file, {photo.name for photo in capture.photos})
    count = len(files) - len(unnamed) - len(copies)
    result = CaptureResult(capture, count, frame.source, model.reprojection_error, doubtful, unnamed, copies)
    record = {key: getattr(result, key) for key in _RESULT_FIELDS}
    write_text(out / _INPUTS, json.dumps({"inputs": inputs, **record}, indent=1))
    return result


def _in_frame(
    model: SparseModel, frame: MetricFrame, by_file: Mapping[str, Prepared], rejected: dict[str, str]
) -> Capture:
    """Return the capture of a reconstruction, without masks, in its metric frame."""
    photos = tuple(
        Photo(by_file[file].name, by_file[file].file, camera, None, model.seen[file])
        for file, camera in model.cameras.items()
    )
    capture = Capture(
        photos=photos,
        points=model.points,
        colours=model.colours,
        units=frame.units,
        up=frame.up,
        rejected=rejected,
        scale_error=frame.scale_error,
    ).transformed(frame.matrix)
    # The near distance depends on the units, and poses do not define one.
    near = tuple(replace(photo, camera=replace(photo.camera, near=0.01)) for photo in capture.photos)
    return replace(capture, photos=near, table=frame.table)


def _doubtful_photos(
    model: SparseModel, frame: MetricFrame, by_file: Mapping[str, Prepared], kept: Set[str]
) -> dict[str, float]:
    """Return the agreement of the ``kept`` photos whose camera neither the matches nor a target confirm."""
    return {
        by_file[file].name: share
        for file, share in model.agreement.items()
        if share < SURE_AGREEMENT and file not in frame.confirmed and by_file[file].name in kept
    }


def _check_outputs(out: Path, photos: Path, settings: CaptureSettings) -> None:
    """Raise InputError if an input lies in an output folder, or an output folder belongs to no capture.

    The reason is that unused files in output folders are deleted.
    """
    if out.resolve().is_relative_to(photos.resolve()):
        raise InputError(f"{out}: must not lie in the folder of the photographs, {photos}")
    if settings.masks is not None and settings.masks.resolve() == photos.resolve():
        raise InputError(f"{settings.masks}: the masks must not be the photographs")
    folders = [out / made for made in ("frames", "images", "masks", "sfm")]
    for given in (photos, settings.masks, settings.poses, settings.mask_model):
        for folder in folders:
            if given is not None and given.resolve().is_relative_to(folder.resolve()):
                raise InputError(f"{given}: must not lie in {folder}, which is overwritten")
    known = any((out / file).is_file() for file in (_PHOTOS, _INPUTS, CAPTURE_FILE))
    for folder in folders:
        if folder.is_symlink() or (folder.name != "frames" and not known and folder.exists() and any(folder.iterdir())):
            raise InputError(f"{folder}: already exists and is not part of a capture: choose another folder")


def _find_copies(hashes: Mapping[str, str], named: Collection[str]) -> list[str]:
    """Return the names of files that are copies of others.

    A copy of a training photo among the held-out photos would make the result look better than it is.

    Args:
        hashes: Hashes of the contents by name.
        named: Names that settings mention. One of them is kept if there are copies, else the shortest name.
    """
    first: dict[str, str] = {}
    for name in sorted(hashes, key=lambda name: (name not in named, len(name))):
        first.setdefault(hashes[name], name)
    return [name for name, content in hashes.items() if first[content] != name]


def _inputs(photos: Path, files: Sequence[Path], settings: CaptureSettings) -> JsonObject:
    """Return the inputs of a capture as JSON values: hashes of file contents, without absolute paths."""
    given = {name: getattr(settings, name) for name in ("poses", "masks", "mask_model")}
    kept = {name: value for name, value in asdict(settings).items() if name not in ("frames", *given)}
    others = [(name, at, path) for name, at in given.items() if at is not None for path in [at, *sorted(at.rglob("*"))]]
    return {
        "photos": {path.relative_to(photos).as_posix(): file_hash(path) for path in files},  # or frames of a video
        "settings": json.loads(json.dumps(kept, default=str)),
        "files": {f"{name}/{path.relative_to(at)}": file_hash(path) for name, at, path in others if path.is_file()},
    }


def _load_finished(out: Path, inputs: JsonObject) -> CaptureResult | None:
    """Return the result stored in ``out`` if it has the same inputs, else None."""
    try:
        record = json.loads((out / _INPUTS).read_text())
        if record["inputs"] != inputs or not (out / "capture.png").is_file():
            return None
        capture = Capture.load(out)
        return CaptureResult(capture, **{key: record[key] for key in _RESULT_FIELDS})
    except (OSError, ValueError, KeyError, TypeError):  # missing or damaged: recompute
        return None


def _delete_outdated(out: Path, inputs: JsonObject, settings: CaptureSettings) -> None:
    """Delete masks, and delete copies and matches of other photographs or other settings."""
    way = settings.max_size, settings.poses is None, settings.undistorted
    marker = json.dumps([inputs["photos"], *way], sort_keys=True)
    file = out / _PHOTOS
    if not (file.exists() and file.read_text() == marker):
        shutil.rmtree(out / "sfm", ignore_errors=True)
        shutil.rmtree(out / "images", ignore_errors=True)
        write_text(file, marker)
    elif settings.undistorted or settings.poses is not None:
        # Undistorted and turned images of an earlier run may have the names of the copies.
        shutil.rmtree(out / "images", ignore_errors=True)
    shutil.rmtree(out / "masks", ignore_errors=True)


def _find_model(
    photos: Path,
    by_file: dict[str, Prepared],
    given: SparseModel | None,
    settings: CaptureSettings,
    work: Path,
    progress: Progress | None,
) -> tuple[SparseModel, MetricFrame, dict[str, str]]:
    """Find consistent cameras and their metric frame.

    Returns:
        The sparse model without cameras that contradict the other cameras or the board, its metric frame, and the
        reason for each file without a camera.
    """
    model, faults = given, dict[str, str]()
    if model is None:
        model, faults = _remove_faulty_cameras(find_cameras(list(by_file.values()), work, progress))
    while True:
        _check_camera_count(photos, model, by_file, faults)
        frame = _metric_frame(model, by_file, settings)
        if not frame.wrong:
            break
        for file, error in frame.wrong.items():
            faults[file] = f"its camera is wrong: it sees the board {error:.0f} px from its position"
        rest, least = model.without_images(frame.wrong), 0 if settings.poses else MIN_POINTS
        model, further = _remove_faulty_cameras(rest, least)
        faults |= further
    absent = "the given poses do not contain it" if settings.poses else "it shares too few points with the other photos"
    elsewhere = "it matches only a smaller group of photos, for example of another object or side"
    for file in by_file.keys() - model.cameras.keys() - faults.keys():
        faults[file] = elsewhere if file in model.elsewhere else absent
    return model, frame, faults


def _check_camera_count(
    photos: Path, model: SparseModel, by_file: Mapping[str, Prepared], faults: Mapping[str, str]
) -> None:
    """Raise InputError if the model has fewer than ``MIN_PHOTOS`` cameras."""
    if len(model.cameras) < MIN_PHOTOS:
        reasons = "; ".join(f"{by_file[file].name}: {fault}" for file, fault in sorted(faults.items())[:3])
        raise InputError(
            f"{photos}: cameras of only {len(model.cameras)} of {len(by_file)} photos could be found, {MIN_PHOTOS} are "
            f"needed{f' ({reasons})' if reasons else ''}; take photos closer together, with texture on or below the "
            "object"
        )


def _remove_faulty_cameras(model: SparseModel, least: int = MIN_POINTS) -> tuple[SparseModel, dict[str, str]]:
    """Remove cameras that contradict the others or observe fewer than ``least`` points, and return the reasons."""
    shares = {file: model.agreement.get(file, 1.0) for file in model.cameras}
    wrong = {file: share for file, share in shares.items() if share < MIN_AGREEMENT}
    model, weak = model.without_images(wrong).without_weak_images(least)
    faults = {
        file: f"its camera is wrong: it agrees with only {share:.0%} of its matches" for file, share in wrong.items()
    }
    return model, faults | {
        file: f"only {points} points could be matched in it, {least} are needed" for file, points in weak.items()
    }


def _metric_frame(model: SparseModel, by_file: dict[str, Prepared], settings: CaptureSettings) -> MetricFrame:
    if settings.metric:
        if settings.poses is not None and settings.poses.suffix == ".json":
            check_metric(settings.poses)
        return MetricFrame(np.eye(4), "metre", "z", table=True, source="the poses given")
    return find_metric_frame(
        model,
        {file: by_file[file].file for file in model.cameras},
        board=settings.board,
        tag=settings.tag,
        scale_from=_stored_spots(settings.scale_from, by_file),
        centred=settings.kind == "object",
    )


def _stored_spots(
    scale_from: tuple[str, str, float] | None, by_file: dict[str, Prepared]
) -> tuple[str, str, float] | None:
    """Return ``scale_from`` with the names of the copies instead of those of the photos."""
    if scale_from is None:
        return None
    files = {photo.name: file for file, photo in by_file.items()}

    def stored(spot: str) -> str:
        name, colon, pixel = spot.rpartition(":")
        return f"{files.get(name, name)}{colon}{pixel}" if colon else files.get(spot, spot)

    one, other, metres = scale_from
    return stored(one), stored(other), metres


def _with_masks(
    capture: Capture,
    frame: MetricFrame,
    settings: CaptureSettings,
    source: Path,
    prepared: Mapping[str, Prepared],
    lenses: Mapping[str, Camera],
    out: Path,
    progress: Progress | None,
) -> Capture:
    """Add masks of the object: given by the user, by a network, by the photos themselves, or from points on it."""
    add = partial(add_masks, capture, folder=out / "masks", progress=progress)
    if settings.masks is not None:
        return check_borders(add(given_masks(settings.masks, prepared, lenses)), settings.masks)
    if settings.mask_model is not None:
        return add(model_masks(settings.mask_model))
    if not settings.has_hints:
        if (cut := cutout_masks(source, prepared, lenses)) is not None:
            return check_borders(add(cut), source)
        is_rendered = settings.poses is not None and frame.board is None
        if is_rendered and (plain := plain_masks(capture.photos)) is not None:
            return add(plain)
        if not frame.table:
            raise InputError(
                "no table was found below the object to segment it: pick it (--pick), give masks (--masks or "
                "--mask-model), place it on a textured surface, or capture it as an environment (--kind environment)"
            )
    hidden: dict[str, BoolArray] = {}
    bare = None if frame.board is None else partial(bare_squares, settings.board, frame.board)
    if frame.board is not None and not settings.has_hints:
        points = object_points(capture)
        above = points[points[:, 2] > 0]  # below them, the board may be visible under the object
    else:
        chosen = chosen_object(capture, settings.picks, settings.picks_not, settings.box)
        points, above = chosen.points, chosen.above
        capture, hidden = _reject_occluded(capture, chosen)
    return object_masks(capture, points, above, out / "masks", bare=bare, hidden=hidden, progress=progress)


def _reject_occluded(capture: Capture, chosen: ChosenObject) -> tuple[Capture, dict[str, BoolArray]]:
    """Reject photos in which other objects occlude much of the object, and find the occluded pixels of the others.

    Returns:
        The capture without the rejected photos, and the possibly occluded pixels, (H, W), by the name of the photo.
    """
    photos, rejected, hidden = [], dict(capture.rejected), dict[str, BoolArray]()
    for photo in capture.photos:
        occluded, possible, pixels = occluded_part(photo.camera, chosen.above, chosen.others)
        if occluded > _HIDDEN and possible > _MAX_HIDDEN:
            rejected[photo.name] = f"another object is in front of the object and may occlude {possible:.0%} of it"
            continue
        photos.append(photo)
        if occluded > _HIDDEN:
            hidden[photo.name] = pixels
    return replace(capture, photos=tuple(photos), rejected=rejected), hidden
