"""The files that mitsplat writes into a dataset's folder: their names, and which of them may be removed.

Nothing else in that folder is removed, and nothing outside of it is reached: its folders must not be links.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.formats.registry import TABLE
from mitsplat.formats.yolo import TASKS
from mitsplat.storage.files import SPLITS, read_json

CONTENT = "dataset.json"
MANIFEST = "manifest.jsonl"
TIMINGS = "timings.jsonl"
RUNS = "runs.jsonl"
SHEET = "contact_sheet.jpg"
SHARD = "shard.json"
LOCK = ".lock"
_ENTRIES = ("images", "layouts", "scene", "report.html", SHEET, MANIFEST, TIMINGS, RUNS, CONTENT, SHARD, LOCK)
_UNFINISHED = re.compile(r"\.lock|shard\.json|\.(dataset|shard)\.json\.\d+\.part")
"""Names of what may be in a folder before ``dataset.json`` is."""
_PARTIAL = re.compile(r"\..+\.\d+\.part")
"""Of what :func:`mitsplat.storage.files.write_file` has not finished."""

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
            rf"{_TASK}labels/{_SPLIT}\.cache",  # Ultralytics' copy of these labels
            rf"{_TASK}(?:data\.yaml|{_FOLD_LIST})",
            rf"{_TASK}folds/fold\d+(?:\.yaml|_(?:train|val)\.json)",
            r"layouts/(?:\d{4,}\.json|\.lock)",
            r"scene/[^/]+\.ya?ml",
            rf"layers/{_SPLIT}/{_FRAME}\.exr",
            rf"annotations/(?:instances|amodal|panoptic|poses)_{_SPLIT}\.json",
            rf"(?:depth|depth-sensor|normals|instances|semantic|panoptic)/{_SPLIT}/{_FRAME}\.png",
            rf"flow/{_SPLIT}/{_FRAME}\.flo",
            rf"voc/(?:JPEGImages/{_IMAGE}|Annotations/{_FRAME}\.xml|ImageSets/Main/{_SPLIT}\.txt|labelmap\.txt)",
            rf"label-studio/(?:{_SPLIT}/{_FRAME}\.json|config\.xml)",
            rf"bop/{_SPLIT}/\d+/(?:rgb|depth)/{_IMAGE}",
            rf"bop/{_SPLIT}/\d+/(?:mask|mask_visib)/{_FRAME}_\d+\.png",
            rf"bop/{_SPLIT}/\d+/scene_(?:camera|gt|gt_info)\.json",
            r"bop/models/(?:obj_\d+\.ply|models_info\.json)",
            r"colmap/(?:cameras|images|points3D)\.txt",
            r"(?:.+/)?\.[^/]+\.\d+\.part",
        )
    )
)
"""Files in the folders of a dataset, relative to it."""


def is_unfinished(name: str) -> bool:
    """Whether a file may be in a folder before it is known for a dataset."""
    return _UNFINISHED.fullmatch(name) is not None


def is_written(name: str) -> bool:
    """Whether mitsplat writes a file of this name, relative to a dataset, into one of its folders."""
    return _WRITTEN.fullmatch(name) is not None


def refuse_links(out: Path) -> None:
    """Refuse a dataset parts of which lie elsewhere: to write or remove them would change what is not its own.

    The dataset's folder may be reached through a link. Files of single frames may be links, too: a new file replaces
    the link.

    Raises:
        InputError: If one of its folders, or a file in its own folder, is a link.
    """
    for name in sorted({*_ENTRIES, *_entries_of_all(), "folds"}):
        top = out / name
        links = [top] if top.is_symlink() else []
        for folder, folders, _ in os.walk(top) if not links else ():
            links += [Path(folder, inner) for inner in folders if Path(folder, inner).is_symlink()]
        if links:
            raise InputError(f"{links[0]}: must not be a link, for a dataset is written in its own folder; remove it")


def remove_dataset(out: Path) -> None:
    """Remove what mitsplat writes and nothing else; its mark last, so that an interruption can be repeated."""
    remove_folds(out)
    for name in sorted({*_entries(out), *_ENTRIES} - {LOCK, CONTENT}):
        entry = out / name
        if entry.is_dir():
            _remove_written(out, entry)
        else:
            entry.unlink(missing_ok=True)
    (out / CONTENT).unlink(missing_ok=True)


def _remove_written(out: Path, top: Path) -> None:
    """Remove the files in a folder of a dataset that mitsplat writes, and those folders that hold nothing else."""
    for folder, _, names in os.walk(top, topdown=False):
        for name in names:
            file = Path(folder, name)
            if is_written(file.relative_to(out).as_posix()):
                file.unlink()
        with suppress(OSError):  # it holds other files
            Path(folder).rmdir()


def _entries(out: Path) -> list[str]:
    """What the formats of a dataset have in its folder, or all formats where it does not say which it has."""
    try:
        formats = read_json(out / CONTENT)["scene"]["output"]["formats"]
        return [entry for name in formats for entry in TABLE[name].entries]
    except (OSError, ValueError, LookupError, TypeError):
        return _entries_of_all()


def _entries_of_all() -> list[str]:
    return [entry for format in TABLE.values() for entry in format.entries]


def remove_folds(out: Path) -> bool:
    """Remove the lists of a division for cross-validation; whether there were any."""
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
    """Remove what was not finished."""
    for folder, _, names in os.walk(out):
        for name in names:
            if _PARTIAL.fullmatch(name):
                (Path(folder) / name).unlink(missing_ok=True)
