"""Dataset folder: lock, permitted previous contents, description of the run, and completion."""

from __future__ import annotations

import errno
import fcntl
import importlib.metadata
import io
import json
import os
import platform
import shlex
import shutil
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import IO, TYPE_CHECKING

from ruamel.yaml import YAML

from mitsplat.dataset.contact_sheet import ContactSheet
from mitsplat.dataset.dataset_files import (
    CONTENT,
    LOCK,
    MANIFEST,
    RUNS,
    SHARD,
    SHEET,
    TIMINGS,
    is_unfinished,
    refuse_links,
    remove_dataset,
    remove_partial,
)
from mitsplat.dataset.inputs import describe_inputs
from mitsplat.dataset.records.manifest import Manifest, append_line, remove_incomplete_line
from mitsplat.dataset.records.record_schema import check_record
from mitsplat.dataset.shard_file import describe_shard, read_shard
from mitsplat.errors import InputError, PartialResultError
from mitsplat.formats.registry import Catalogue, CollectionWriter
from mitsplat.storage.files import (
    JsonObject,
    Record,
    open_in_place,
    open_regular,
    read_json,
    storage_errors,
    write_file,
    write_text,
)
from mitsplat.storage.format_version import FORMAT_VERSION, FORMAT_VERSIONS, check_format_version
from mitsplat.version import __version__

if TYPE_CHECKING:
    from mitsplat.runtime.device import Kind
    from mitsplat.scene.scene import Scene

DEFAULT_CONTENT = {FORMAT_VERSION: 1, "device": "cpu"}
"""Default values of keys that are absent in ``dataset.json``."""
_MAX_LOCK_TEXT = 200
"""Maximum number of characters of a lock file that an error message shows."""


@contextmanager
def open_folder(
    out: Path,
    content: JsonObject,
    scene_file: Path,
    shard: dict[str, int] | None,
    *,
    resume: bool,
    overwrite: bool,
    any_device: bool = False,
) -> Iterator[Manifest]:
    """Lock and prepare the folder of a dataset, and yield its manifest without the frames that miss a file.

    Args:
        out: Dataset folder; it is created if missing.
        content: Content of ``dataset.json``.
        scene_file: Scene file, copied to ``scene/``.
        shard: Content of ``shard.json``, or None for a whole dataset.
        resume: Accept a dataset that is already in the folder.
        overwrite: Remove a dataset that is already in the folder.
        any_device: Resume a dataset that was started on another kind of device.

    Raises:
        InputError: If the folder cannot be written, is in use, or holds other files.
        MissingResourceError: If the disk is full.
    """
    _check_is_dataset(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = open_in_place(out / LOCK, "a+")
    except OSError as error:
        raise InputError(_lock_error(out, error)) from error
    with lock:
        _take_lock(out, lock)
        try:
            with storage_errors(out):
                lock.truncate(0)
                lock.write(f"process {os.getpid()} on {socket.gethostname()}")
                lock.flush()
                refuse_links(out)
                if overwrite:
                    remove_dataset(out)
                _check_resumable(out, content, shard, resume=resume, any_device=any_device)
                _prepare(out, scene_file, content, shard)
                yield Manifest(
                    out / MANIFEST,
                    is_valid=lambda record: missing_file(out, record) is None,
                    check=partial(check_record, content=content),
                )
        finally:
            remove_partial(out)


def _lock_error(out: Path, error: OSError) -> str:
    if error.errno in (errno.ELOOP, errno.EMLINK, errno.EINVAL):
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"{out}: must be a folder, and not below a file (got a file)"
    return f"{out}: cannot be written ({error.strerror})"


@contextmanager
def open_finished(out: Path, content: JsonObject, *, write: bool) -> Iterator[Manifest]:
    """Lock a finished dataset against writers and yield its manifest.

    Args:
        out: Dataset folder. It may be on a read-only file system, such as a share of another machine.
        content: Content of its ``dataset.json``.
        write: Allow files to be added. If False, nothing in the folder is changed or created.

    Raises:
        InputError: If the dataset is in use or damaged, or if a write would go through a link.
    """
    lock: IO[str] | None = None
    try:
        if write:
            lock = open_in_place(out / LOCK, "a+")
        else:
            with suppress(FileNotFoundError):  # no run has written this dataset here
                lock = io.TextIOWrapper(open_regular(out / LOCK), errors="replace")
    except OSError as error:
        raise InputError(_lock_error(out, error)) from error
    with lock or nullcontext():
        if lock is not None:
            _take_lock(out, lock)
        if write:
            refuse_links(out)
        yield Manifest(out / MANIFEST, check=partial(check_record, content=content), writable=False)


def _take_lock(out: Path, lock: IO[str]) -> None:
    """Lock the folder, and refuse it if another run is writing it.

    The lock belongs to the open file, so it is released however the process ends. A file that is open for reading only
    gets a shared lock, so that several readers can use the folder.
    """
    try:
        fcntl.flock(lock, (fcntl.LOCK_EX if lock.writable() else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        raise InputError(f"{out} is being written by another run ({lock.read(_MAX_LOCK_TEXT)})") from None


def append_run(out: Path, workers: int | None, device: str, gpus: Sequence[str] = ()) -> None:
    """Append command, Python version, number of workers and device of this process to the log of runs."""
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    run = {"command": command, "python": platform.python_version(), "workers": workers, "device": device}
    append_line(out / RUNS, run | ({"gpus": list(gpus)} if gpus else {}))


def finish_folder(
    out: Path, manifest: Manifest, content: JsonObject, catalogue: Catalogue, visit: Callable[[Record], object]
) -> None:
    """Sort the manifest, and write the contact sheet and the collection files in one pass over all records.

    Args:
        out: Dataset folder; all its frames must be present.
        manifest: Records of its frames.
        content: Content of ``dataset.json``.
        catalogue: Classes, keypoints and assets that the labels refer to.
        visit: Callback that is called with every record.

    Raises:
        PartialResultError: If a file was removed in the meantime.
    """

    def refuse_missing(file: Path | None) -> None:
        if file is not None:
            raise PartialResultError(f"{file}: must not be removed while its dataset is written; run again")

    def add(record: Record) -> None:
        refuse_missing(missing_file(out, record))
        collection.add(record)
        sheet.add(record)
        visit(record)

    refuse_missing(None if (out / CONTENT).is_file() else out / CONTENT)
    sheet = ContactSheet(out, len(manifest))
    with CollectionWriter(out, catalogue, content["scene"]["output"]["formats"]) as collection:
        manifest.sort(add)
        collection.commit()
    sheet.write(out / SHEET)


def missing_file(out: Path, record: Record) -> Path | None:
    """Return the first missing file of a frame, or None if all are present."""
    missing = next((file for file in record["files"] if not os.path.isfile(f"{out}/{file}")), None)  # noqa: PTH113
    return None if missing is None else out / missing


def _check_is_dataset(out: Path) -> None:
    """Refuse a folder that holds anything else than a mitsplat dataset.

    Other files must not be mixed with a dataset or removed.
    """
    present: object = None
    try:
        present = read_json(out / CONTENT)
        is_dataset = isinstance(present, dict) and "mitsplat" in present
    except (FileNotFoundError, NotADirectoryError):
        is_dataset = not out.is_dir() or all(is_unfinished(entry.name) for entry in out.iterdir())
    except (OSError, ValueError) as error:
        raise InputError(f"{out / CONTENT}: cannot be read ({error})") from error
    if not is_dataset:
        raise InputError(f"{out}: must be empty or a dataset of mitsplat (it holds other files)")
    check_format_version(present, FORMAT_VERSIONS[CONTENT], out / CONTENT)


def _check_resumable(
    out: Path, content: JsonObject, shard: dict[str, int] | None, *, resume: bool, any_device: bool
) -> None:
    """Refuse an existing dataset if ``resume`` is False, or if another scene, device or shard started it."""
    if not (out / CONTENT).exists():
        return
    if not resume:
        raise InputError(f"{out}: already holds a dataset: resume it, overwrite it or choose another folder")
    present = {**DEFAULT_CONTENT, **read_json(out / CONTENT)}
    not_compared = {"libraries": None, "device": None}
    if difference := first_difference(present | not_compared, content | not_compared):
        key, before, now = difference
        raise InputError(
            f"{out}: cannot be resumed: {key} was {before} and is {now}: overwrite it or choose another folder"
        )
    if present["device"] != content["device"] and not any_device:
        raise InputError(
            f"{out}: cannot be resumed on the device {content['device']}: it was started on {present['device']}, whose "
            f"pictures differ a little: give --device {present['device']}, or --any-device for frames of both"
        )
    stored = read_shard(out)
    if stored != shard:
        change = f"it was {describe_shard(stored)} and is {describe_shard(shard)}"
        raise InputError(f"{out}: cannot be resumed: {change}: overwrite it or choose another folder")


def _prepare(out: Path, scene_file: Path, content: JsonObject, shard: dict[str, int] | None) -> None:
    """Write the files that describe the run, create the other files and folders, and remove unfinished files and lines.

    ``dataset.json`` marks the folder as a dataset, so it is written before the other files.
    """
    remove_partial(out)
    if not (out / CONTENT).exists():
        if shard is not None:
            write_text(out / SHARD, json.dumps(shard) + "\n")
        write_text(out / CONTENT, json.dumps(content, indent=1) + "\n")
    (out / "layouts").mkdir(exist_ok=True)
    if not (out / "scene" / scene_file.name).exists():
        write_file(out / "scene" / scene_file.name, lambda temporary: _write_scene(scene_file, content, temporary))
    for file in (out / name for name in (MANIFEST, TIMINGS, RUNS)):
        if file.is_file() and file.stat().st_nlink > 1:  # the original of a hard-linked copy must not change
            write_file(file, partial(shutil.copyfile, file))
    remove_incomplete_line(out / TIMINGS)
    remove_incomplete_line(out / RUNS)


def _write_scene(scene_file: Path, content: JsonObject, path: Path) -> None:
    """Copy the scene file; write an equivalent file for a scene made in Python."""
    if scene_file.exists():
        shutil.copyfile(scene_file, path)
    else:
        YAML(typ="safe", pure=True).dump(content["scene"], path)


def content_of(scene: Scene, catalogue: Catalogue, device: Kind) -> JsonObject:
    """Return the content of ``dataset.json``: everything that determines the bytes of a dataset, and library versions.

    The library versions are informative only; they are not compared on resume.
    """
    simulation = ("mitsuba", "drjit", "newton", "mujoco", "mujoco-warp", "warp-lang")
    libraries = (*simulation, "numpy", "opencv-contrib-python-headless")
    return {
        FORMAT_VERSION: FORMAT_VERSIONS[CONTENT],
        "device": device,
        "mitsplat": __version__,
        # Frames may be added on resume, and settle.incomplete changes no frame.
        "scene": scene.spec.model_dump(mode="json", exclude={"output": {"layouts"}, "settle": {"incomplete"}}),
        "classes": list(scene.class_names),
        "keypoints": [list(names) for names in catalogue.keypoint_names],
        "assets": list(catalogue.assets),
        **({"distractors": list(catalogue.distractors)} if catalogue.distractors else {}),
        **({"centroids": list(map(list, scene.centroids))} if scene.spec.conveyor is not None else {}),
        "inputs": describe_inputs(scene),
        "libraries": {name: importlib.metadata.version(name) for name in libraries},
    }


def first_difference(before: object, now: object, key: str = "") -> tuple[str, str, str] | None:
    """Return the first difference of two JSON values, or None if they are equal.

    The difference is its dotted key and both values as JSON text; a missing value is ``null``. Keys are compared in
    their order, so that a key of the scene is named before the hash of the mesh that depends on it.
    """
    if isinstance(before, dict) and isinstance(now, dict):
        for name in {**before, **now}:
            inner = first_difference(before.get(name), now.get(name), f"{key}.{name}" if key else name)
            if inner is not None:
                return inner
        return None
    if isinstance(before, list) and isinstance(now, list):
        pairs = enumerate(zip_longest(before, now))
        found = (first_difference(one, other, f"{key}[{place}]") for place, (one, other) in pairs)
        if (inner := next(filter(None, found), None)) is not None:
            return inner
    return None if before == now else (key, json.dumps(before), json.dumps(now))
