"""One frame made again, from the scene and its index alone, and compared with a dataset that has it.

::

    frame.json        its line of the manifest, files and their SHA-256 included
    layouts/0001.json where its objects came to rest
    images/train/000007.png, ...   its files, named as in a dataset
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import SupportsIndex

from mitsplat.dataset.dataset_folder import IMPLIED, content_of, first_difference
from mitsplat.dataset.frame_job import FrameMaker, Render, Settle
from mitsplat.dataset.manifest import parse_line, read_lines
from mitsplat.dataset.own_files import CONTENT, MANIFEST, is_written, refuse_links
from mitsplat.dataset.preflight import count_faults, image_faults, layout_faults, refuse
from mitsplat.dataset.schema import check_record, read_content
from mitsplat.errors import InputError
from mitsplat.formats.registry import Catalogue
from mitsplat.frames.frame import render_frame
from mitsplat.physics.settle import settle_layout
from mitsplat.runtime.device import Device, current_device, use_device
from mitsplat.scene.planning.frame_plan import layout_of, whole
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import Record, open_regular, read_json, storage_errors, write_text

FRAME = "frame.json"


@dataclass(frozen=True)
class RemadeFrame:
    """A frame that was made again.

    Attributes:
        path: The folder of its files.
        record: Its line of the manifest.
        compared: How many files the dataset's frame has; 0 if there is no dataset, or not this frame in it.
        differing: Files whose bytes are not the same, or that only one of both has: the frame's, its layout's, and
            ``manifest.jsonl`` for its line.
        cause: The first difference of what both were made from; empty if there is none.
    """

    path: Path
    record: Record
    compared: int = 0
    differing: tuple[str, ...] = ()
    cause: str = ""


def remake_frame(
    scene: Scene,
    index: SupportsIndex,
    out: str | Path,
    *,
    dataset: str | Path | None = None,
    device: str | Device | None = None,
    render: Render = render_frame,
    settle: Settle = settle_layout,
) -> RemadeFrame:
    """Make one frame again, byte for byte as a dataset has it, from the scene and the frame's index alone.

    Args:
        scene: Its formats say which files there are.
        index: Of the frame; the dataset may have been made with fewer.
        out: Folder of its files: absent, empty, or of a frame that was made again, whose files are replaced.
        dataset: Folder to compare with; what is no dataset, or one without this frame, is not compared.
        device: As in :func:`mitsplat.write_dataset`, of this process.
        render: As there.
        settle: As there.

    Raises:
        InputError: If there is no such frame, the scene can come to nothing, or the folder holds something else.
        MissingResourceError: As there.
    """
    out, index = Path(out), whole(index, "frame")
    layout = layout_of(scene, index)
    catalogue = Catalogue.of(scene)
    refuse(scene, chain(count_faults(scene), layout_faults(scene), image_faults(scene, 1)))
    if out.exists() and not (out / FRAME).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} must be absent, empty, or hold a frame that was made again (it holds other files)")
    refuse_links(out)
    chosen = current_device() if device is None else use_device(device)
    place = f"layouts/{layout:04d}.json"
    maker = FrameMaker(scene, catalogue, out, render, settle)
    with storage_errors(out):
        text = maker.settled(layout, lambda said: None)
        _remove_frame(out)
        write_text(out / place, text)
        record, _ = maker.write(index, maker.keep(text))
        write_text(out / FRAME, json.dumps(record, indent=1) + "\n")
    known = None if dataset is None else _frame_of(Path(dataset), index)
    if dataset is None or known is None:
        return RemadeFrame(out, record)
    before, now = known["files"], record["files"]
    differing = sorted(file for file in {*before, *now} if before.get(file) != now.get(file))
    if known != {**json.loads(json.dumps(record)), "files": before}:
        differing.append(MANIFEST)
    if (Path(dataset) / place).is_file() and (Path(dataset) / place).read_bytes() != text.encode():
        differing.append(place)
    present = {**IMPLIED, **read_json(Path(dataset) / CONTENT)}
    found = first_difference(present, content_of(scene, catalogue, chosen.kind))
    cause = "" if found is None else "{} was {} and is {}".format(*found)
    return RemadeFrame(out, record, len(before), tuple(differing), cause)


def _remove_frame(out: Path) -> None:
    """Remove the files of a frame that was made before."""
    try:
        names = list(map(str, read_json(out / FRAME)["files"]))
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in [*names, *(str(path.relative_to(out)) for path in (out / "layouts").glob("[0-9]*.json"))]:
        if is_written(name):
            (out / name).unlink(missing_ok=True)


def _frame_of(dataset: Path, index: int) -> Record | None:
    """A frame's line in the manifest of a dataset, which another process may be writing.

    Raises:
        InputError: If it is not as it was written.
    """
    if not (dataset / CONTENT).is_file() or not (dataset / MANIFEST).is_file():
        return None
    content = read_content(dataset)
    start, found = f'{{"index":{index},'.encode(), None
    with open_regular(dataset / MANIFEST) as file:
        for line in read_lines(file):
            if line.startswith(start) and line.endswith(b"\n"):
                found = line  # of two, the later counts
    try:
        if found is None:
            return None
        record = parse_line(found)
        check_record(found, record, content)
        return record
    except ValueError as error:
        raise InputError(f"{dataset / MANIFEST}: must hold the record of frame {index} ({error})") from error
