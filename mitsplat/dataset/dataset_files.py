"""Names of the files that mitsplat writes into a dataset folder, and removal of these files.

Other files in that folder are never removed. Folders of a dataset must not be links, so nothing outside is changed.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.formats.registry import TABLE
from mitsplat.formats.yolo import TASKS
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.files import SPLITS, JsonObject, read_json

CONTENT = "dataset.json"
MANIFEST = "manifest.jsonl"
TIMINGS = "timings.jsonl"
RUNS = "runs.jsonl"
SHEET = "contact_sheet.jpg"
SHARD = "shard.json"
LOCK = ".lock"
_ENTRIES = ("images", "layouts", "scene", "report.html", SHEET, MANIFEST, TIMINGS, RUNS, CONTENT, SHARD, LOCK)
_UNFINISHED = re.compile(r"\.lock|shard\.json|\.(dataset|shard)\.json\.\d+\.part")
"""Names of files that may be in a folder before ``dataset.json`` exists."""
_PARTIAL = re.compile(r"\..+\.\d+\.part")
"""Names of unfinished files of :func:`mitsplat.storage.files.write_file`."""

_SPLIT = f"(?:{'|'.join(SPLITS)})"
_TASK = f"(?:{'|'.join(task.folder for task in TASKS.values() if task.folder)})?"
_FRAME = r"\d{6,}"
_IMAGE = rf"{_FRAME}\.(?:png|jpg)"
_FOLD_LIST = r"fold\d+_(?:train|val)\.txt"
_WRITTEN = re.compile(
    "|".join(
        (
            rf"{_TASK}images/{_SPLIT}/{_IMAGE}",
            rf"{_TASK}labels/{_SPLIT}/{_FRAME}\.txt",
            rf"{_TASK}labels/{_SPLIT}\.cache",  # label cache of Ultralytics
            rf"{_TASK}(?:data\.yaml|{_FOLD_LIST})",
            rf"{_TASK}folds/fold\d+(?:\.yaml|_(?:train|val)\.json)",
            r"layouts/(?:\d{4,}\.json|\.lock)",
            r"scene/[^/]+\.ya?ml",
            rf"layers/{_SPLIT}/{_FRAME}\.exr",
            rf"annotations/(?:instances|polygons|amodal|panoptic|poses)_{_SPLIT}\.json",
            rf"(?:depth|depth-sensor|normals|instances|semantic|panoptic)/{_SPLIT}/{_FRAME}\.png",
            rf"flow/{_SPLIT}/{_FRAME}\.flo",
            rf"bop/{_SPLIT}/\d+/(?:rgb|depth)/{_IMAGE}",
            rf"bop/{_SPLIT}/\d+/(?:mask|mask_visib)/{_FRAME}_\d+\.png",
            rf"bop/{_SPLIT}/\d+/scene_(?:camera|gt|gt_info)\.json",
            r"bop/camera\.json",
            r"bop/models/(?:obj_\d+\.ply|models_info\.json)",
            r"colmap/(?:cameras|images|points3D)\.txt",
            r"(?:.+/)?\.[^/]+\.\d+\.part",
        )
    )
)
"""Names of all files that mitsplat writes into the subfolders of a dataset, relative to the dataset."""


def layout_file(index: int) -> str:
    """Return the name of the file of a layout, relative to the dataset."""
    return f"layouts/{index:04d}.json"


def hash_poses(layout: JsonObject) -> str:
    """Return the SHA-256 of the objects of a layout in JSON and of their poses; of its number if it has no objects.

    Layouts without objects have no poses that training and validation could have in common.
    """
    digest = ContentHash()
    digest.add_json(layout["instances"] or layout["index"])
    return digest.hexdigest()


def is_unfinished(name: str) -> bool:
    """Return True if a file of this name may be in a folder before ``dataset.json`` exists."""
    return _UNFINISHED.fullmatch(name) is not None


def is_written(name: str) -> bool:
    """Return True if mitsplat writes a file of this name, relative to the dataset, into a subfolder of a dataset."""
    return _WRITTEN.fullmatch(name) is not None


def refuse_links(out: Path) -> None:
    """Refuse a dataset with linked folders, because writes and removals would change files outside of the dataset.

    The path of the dataset itself may contain a link. Files of single frames may be links too, because a new file
    replaces the link.

    Raises:
        InputError: If a folder of the dataset, or a file directly in its folder, is a link.
    """
    for name in sorted({*_ENTRIES, *_format_entries(), "folds"}):
        top = out / name
        links = [top] if top.is_symlink() else []
        for folder, folders, _ in os.walk(top) if not links else ():
            links += [Path(folder, inner) for inner in folders if Path(folder, inner).is_symlink()]
        if links:
            raise InputError(
                f"{links[0]}: must not be a link, because a dataset must lie in its own folder; remove the link"
            )


def remove_dataset(out: Path) -> None:
    """Remove only files that mitsplat writes; ``dataset.json`` goes last, so an interrupted removal can be repeated."""
    remove_folds(out)
    for name in sorted({*_format_entries(out), *_ENTRIES} - {LOCK, CONTENT}):
        entry = out / name
        if entry.is_dir():
            _remove_written(out, entry)
        else:
            entry.unlink(missing_ok=True)
    (out / CONTENT).unlink(missing_ok=True)


def _remove_written(out: Path, top: Path) -> None:
    """Remove the files that mitsplat writes from a folder of a dataset, and its subfolders that are then empty."""
    for folder, _, names in os.walk(top, topdown=False):
        for name in names:
            file = Path(folder, name)
            if is_written(file.relative_to(out).as_posix()):
                file.unlink()
        with suppress(OSError):  # the folder holds other files
            Path(folder).rmdir()


def _format_entries(out: Path | None = None) -> list[str]:
    """Return the top-level entries of a dataset's formats, or of all formats if ``dataset.json`` cannot be read."""
    try:
        formats = TABLE if out is None else read_json(out / CONTENT)["scene"]["output"]["formats"]
        return [entry for name in formats for entry in TABLE[name].entries]
    except (OSError, ValueError, LookupError, TypeError):
        return _format_entries()


def remove_folds(out: Path) -> bool:
    """Remove the image lists for cross-validation, and return True if there were any."""
    found = False
    for folder in {out / task.folder for task in TASKS.values()}:
        for file in folder.glob("fold*_*.txt"):
            if re.fullmatch(_FOLD_LIST, file.name):
                file.unlink()
                found = True
        if (folder / "folds").is_dir():
            _remove_written(out, folder / "folds")
    return found


def remove_partial(out: Path) -> None:
    """Remove unfinished files."""
    for folder, _, names in os.walk(out):
        for name in names:
            if _PARTIAL.fullmatch(name):
                (Path(folder) / name).unlink(missing_ok=True)
