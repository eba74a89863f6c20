"""Merging of separately rendered shards into the dataset that a single run would have written."""

from __future__ import annotations

import heapq
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

from mitsplat.dataset.dataset_files import CONTENT, RUNS, TIMINGS
from mitsplat.dataset.dataset_folder import DEFAULT_CONTENT, finish_folder, first_difference, open_finished, open_folder
from mitsplat.dataset.records.manifest import Manifest, read_lines
from mitsplat.dataset.records.record_schema import read_content
from mitsplat.dataset.shard_file import describe_shard, read_shard
from mitsplat.dataset.write import DatasetSummary, FrameCounts
from mitsplat.errors import InputError
from mitsplat.formats.registry import Catalogue
from mitsplat.progress import Progress
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import (
    JsonObject,
    Record,
    link_file,
    open_regular,
    read_json,
    resolve_inside,
    splits_of,
    write_file,
)


def merge_shards(
    shards: Sequence[str | Path], out: str | Path, *, overwrite: bool = False, progress: Progress | None = None
) -> DatasetSummary:
    """Merge datasets that differ only in their frames, and compare every file with its SHA-256.

    Files become hard links to the shards' files if both are on one file system. An interrupted call can be repeated.

    Args:
        shards: Folders of finished datasets, in any order: all shards of one dataset.
        out: Folder of the merged dataset; it is created if missing.
        overwrite: Remove a dataset that is already in the folder.
        progress: Callback that is called for every frame.

    Raises:
        InputError: If the shards are not of one dataset, one is missing, unfinished or damaged, or two hold the same
            frame. Nothing is written then, except if the content of a file does not match its SHA-256.
    """
    folders, out = [Path(shard) for shard in shards], Path(out)
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError(f"each shard must be given once (got {', '.join(map(str, folders))})")
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise InputError(f"{out}: must not be one of the shards")
    content = _common_content(folders)
    stated = _check_complete(folders)
    with ExitStack() as stack:
        manifests = {folder: stack.enter_context(open_finished(folder, content, write=False)) for folder in folders}
        total = _check_frames(manifests, stated)
        splits = splits_of(content["scene"]["output"])
        catalogue = Catalogue(content["classes"], content["keypoints"], content["assets"], (), splits=splits)
        scene_file = _scene_file(folders[0])
        _check_layouts(folders)
        if overwrite:  # check all files before the old dataset is removed
            for folder, part in manifests.items():
                for record in part:
                    _check_files(folder, record)
        manifest = stack.enter_context(open_folder(out, content, scene_file, None, resume=True, overwrite=overwrite))
        for folder, part in manifests.items():
            for record in part:
                index = record["index"]
                if index not in manifest:
                    _link_files(folder, out, record)
                    manifest.append(record)
                if progress is not None:
                    progress(len(manifest), total, f"frame {index}")
        for folder in folders:
            for layout in _layouts(folder):
                write_file(out / "layouts" / layout.name, partial(link_file, layout))
        for name in (TIMINGS, RUNS):
            write_file(out / name, partial(_join_lines, [folder / name for folder in folders]))
        counts = FrameCounts()
        finish_folder(out, manifest, content, catalogue, counts.add)
        if "bop" in content["scene"]["output"]["formats"]:
            for model in _models(folders[0], content):
                write_file(out / "bop/models" / model.name, partial(shutil.copyfile, model))
        return counts.summary(out, rendered=0)


def _common_content(folders: Sequence[Path]) -> JsonObject:
    """Return the content of ``dataset.json``, which must be equal in all shards."""
    contents: list[JsonObject] = []
    for folder in folders:
        read_content(folder)  # validates the file; the raw content is read next
        contents.append({**DEFAULT_CONTENT, **read_json(folder / CONTENT)})
        if difference := first_difference(contents[0], contents[-1]):
            key, one, other = difference
            raise InputError(
                f"{folders[0]} and {folder} are not of one dataset: {key} is {one} in the first, {other} in the second"
            )
    if not contents:
        raise InputError("at least one shard is needed (got none)")
    return contents[0]


def _check_complete(folders: Sequence[Path]) -> int | None:
    """Return the number of frames of the whole dataset, as stated by its shards.

    The number is None if all folders are whole datasets.
    """
    stored = {folder: read_shard(folder) for folder in folders}
    parts = {folder: part for folder, part in stored.items() if part is not None}
    if not parts:
        return None
    sizes = {(part["of"], part["frames"]) for part in parts.values()}
    if len(parts) < len(stored) or len(sizes) > 1:
        given = ", ".join(f"{folder}: {describe_shard(part)}" for folder, part in stored.items())
        raise InputError(f"shards must be of one division of one dataset (got {given})")
    count, frames = next(iter(sizes))
    missing = set(range(1, count + 1)) - {part["shard"] for part in parts.values()}
    if missing or len(parts) > count:
        raise InputError(f"each of the {count} shards must be given once (missing: {sorted(missing) or 'none'})")
    return frames


def _check_frames(manifests: Mapping[Path, Manifest], stated: int | None) -> int:
    """Return the number of frames of all shards together; refuse missing frames and frames in two shards."""
    indices = [((index, folder) for index in manifest.indices) for folder, manifest in manifests.items()]
    last, last_folder, first_missing = -1, Path(), -1
    for index, folder in heapq.merge(*indices):
        if index == last:
            raise InputError(f"frame {index} is in both {last_folder} and {folder}")
        if index > last + 1 and first_missing < 0:
            first_missing = last + 1
        last, last_folder = index, folder
    if last < 0 and stated is None:
        raise InputError(f"{', '.join(map(str, manifests))}: must have at least one image; finish this shard first")
    total = sum(map(len, manifests.values()))
    count = last + 1 if stated is None else stated
    if missing := max(count, last + 1) - total:
        first = last + 1 if first_missing < 0 else first_missing
        raise InputError(f"{missing} of {count} frames are in no shard, the first is {first}: finish the shards first")
    return total


def _join_lines(files: Sequence[Path], target: Path) -> None:
    """Concatenate the lines of several files; a file may be missing or end in an incomplete line."""
    with target.open("wb") as out:
        for file in files:
            with suppress(FileNotFoundError), open_regular(file) as lines:
                out.writelines(line for line in read_lines(lines) if line.endswith(b"\n"))


def _check_layouts(folders: Sequence[Path]) -> None:
    """Check that a layout that is in two shards is the same in both."""
    seen: dict[str, Path] = {}
    for folder in folders:
        for layout in _layouts(folder):
            other = seen.setdefault(layout.name, layout)
            if other != layout and other.read_bytes() != layout.read_bytes():
                raise InputError(f"{other} and {layout} must be the same: the shards settled one layout differently")


def _layouts(folder: Path) -> list[Path]:
    """Return the layout files of a shard."""
    return [_inside(folder, path) for path in sorted((folder / "layouts").glob("[0-9]*.json"))]


def _models(folder: Path, content: JsonObject) -> list[Path]:
    """Return the files of the BOP models."""
    numbers = sorted(set(range(1, len(content["assets"]) + 1)) - {one + 1 for one in content.get("distractors", ())})
    names = ["models_info.json", *(f"obj_{number:06d}.ply" for number in numbers)]
    return [_inside(folder, folder / "bop/models" / name) for name in names]


def _scene_file(folder: Path) -> Path:
    """Return the path of the scene file that a dataset contains."""
    names = sorted((folder / "scene").glob("[!.]*"))
    if len(names) != 1:
        raise InputError(f"{folder / 'scene'}: must hold only the scene file (got {len(names)} files)")
    return _inside(folder, names[0])


def _inside(folder: Path, path: Path) -> Path:
    """Return a file of a shard, and refuse it if it lies outside of the shard."""
    try:
        return resolve_inside(folder, str(path.relative_to(folder)))
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error


def _check_files(folder: Path, record: Record) -> None:
    for file, digest in record["files"].items():
        source = _source(folder, file, record)
        _check_content(source, file_hash(source), digest)


def _link_files(folder: Path, out: Path, record: Record) -> None:
    for file, digest in record["files"].items():
        source = _source(folder, file, record)
        found = write_file(out / file, partial(link_file, source))
        if found != digest:
            (out / file).unlink()
        _check_content(source, found, digest)


def _source(folder: Path, file: str, record: Record) -> Path:
    """Return a file of a shard's frame."""
    try:
        return resolve_inside(folder, file)
    except InputError as error:
        raise InputError(f"{folder}: frame {record['index']}: {error}; render that shard again") from error


def _check_content(source: Path, found: str, digest: str) -> None:
    if found != digest:
        raise InputError(
            f"{source}: must have the SHA-256 {digest}, as its manifest states (got {found}); remove it and render "
            "that shard again"
        )
