"""Re-rendering of one frame from the scene and its index alone, and comparison with a dataset that contains it.

::

    frame.json        manifest record of the frame, with its files and their SHA-256
    layouts/0001.json resting poses of its objects
    images/train/000007.png, ...   its files, named as in a dataset
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import SupportsIndex

from mitsplat.arguments import path_of
from mitsplat.dataset.dataset_files import CONTENT, MANIFEST, is_written, layout_file, refuse_links
from mitsplat.dataset.dataset_folder import DEFAULT_CONTENT, content_of, first_difference
from mitsplat.dataset.frame_job import FrameJob, Render, Settle
from mitsplat.dataset.preflight import count_faults, image_faults, layout_faults, refuse
from mitsplat.dataset.records.manifest import parse_line, read_lines
from mitsplat.dataset.records.record_schema import check_record, read_content
from mitsplat.errors import InputError
from mitsplat.formats.registry import Catalogue
from mitsplat.frames.frame import render_frame
from mitsplat.physics.settle import settle_layout
from mitsplat.progress import discard_note
from mitsplat.runtime.device import Device, current_device, use_device
from mitsplat.scene.planning.frame_plan import layout_index_of, to_index
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import Record, is_inside, open_regular, read_json, storage_errors, write_text

FRAME = "frame.json"


@dataclass(frozen=True)
class RerenderedFrame:
    """Frame that was rendered again.

    Attributes:
        path: Folder of its files.
        record: Manifest record of the frame.
        compared: Number of files of the dataset's frame; 0 if there is no dataset, or the dataset lacks this frame.
        differing: Files with different bytes, and files that only one of both has. They are files of the frame, the
            file of its layout, and ``manifest.jsonl`` if the record differs.
        cause: First difference of the inputs of both; empty if there is none.
    """

    path: Path
    record: Record
    compared: int = 0
    differing: tuple[str, ...] = ()
    cause: str = ""


def rerender_frame(
    scene: Scene,
    index: SupportsIndex,
    out: str | Path,
    *,
    dataset: str | Path | None = None,
    device: str | Device | None = None,
    render: Render = render_frame,
    settle: Settle = settle_layout,
) -> RerenderedFrame:
    """Render one frame again from the scene and the frame's index alone, byte for byte as in the dataset.

    Args:
        scene: Scene; its formats determine the files that are written.
        index: Index of the frame; it may exceed the number of frames of the dataset.
        out: Output folder. It must be absent, empty, or hold a frame of an earlier call, whose files are replaced.
        dataset: Dataset folder to compare with. The comparison is skipped if it is no dataset or lacks this frame.
        device: Device of this process, as in :func:`mitsplat.write_dataset`.
        render: As in :func:`mitsplat.write_dataset`.
        settle: As in :func:`mitsplat.write_dataset`.

    Raises:
        InputError: If there is no such frame, a preflight check fails, or the folder holds other files.
        MissingResourceError: If the device is not available, or memory does not suffice for one frame.
    """
    Scene.check(scene)
    out, index = path_of(out, "out"), to_index(index, "frame")
    layout = layout_index_of(scene, index)
    catalogue = Catalogue.of(scene)
    refuse(scene, chain(count_faults(scene), layout_faults(scene), image_faults(scene, 1)))
    if out.exists() and not (out / FRAME).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} must be absent, empty, or hold a frame of an earlier call (it holds other files)")
    refuse_links(out)
    used_device = current_device() if device is None else use_device(device)
    file = layout_file(layout)
    job = FrameJob(scene, catalogue, out, render, settle)
    with storage_errors(out):
        text = job.settle_to_json(layout, discard_note)
        _remove_frame(out)
        write_text(out / file, text)
        record, _ = job.write(index, job.load_layout(text))
        write_text(out / FRAME, json.dumps(record, indent=1) + "\n")
    dataset = None if dataset is None else Path(dataset)
    stored = None if dataset is None else _read_frame(dataset, index)
    if dataset is None or stored is None:
        return RerenderedFrame(out, record)
    before, now = stored["files"], record["files"]
    differing = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    if stored != {**json.loads(json.dumps(record)), "files": before}:
        differing.append(MANIFEST)
    if not (dataset / file).is_file() or (dataset / file).read_bytes() != text.encode():
        differing.append(file)
    difference = first_difference(
        DEFAULT_CONTENT | read_json(dataset / CONTENT), content_of(scene, catalogue, used_device.kind)
    )
    cause = "" if difference is None else "{} was {} and is {}".format(*difference)
    return RerenderedFrame(out, record, len(before), tuple(differing), cause)


def _remove_frame(out: Path) -> None:
    """Remove the files of a frame from an earlier call."""
    try:
        names = list(map(str, read_json(out / FRAME)["files"]))
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in [*names, *(str(path.relative_to(out)) for path in (out / "layouts").glob("[0-9]*.json"))]:
        if is_written(name) and is_inside(out, name):
            (out / name).unlink(missing_ok=True)


def _read_frame(dataset: Path, index: int) -> Record | None:
    """Read the record of a frame from the manifest of a dataset, which another process may be writing.

    Raises:
        InputError: If the line is damaged.
    """
    if not (dataset / CONTENT).is_file() or not (dataset / MANIFEST).is_file():
        return None
    content = read_content(dataset)
    start, last_line = f'{{"index":{index},'.encode(), None
    with open_regular(dataset / MANIFEST) as file:
        for line in read_lines(file):
            if line.startswith(start) and line.endswith(b"\n"):
                last_line = line  # the last of several lines counts
    if last_line is None:
        return None
    try:
        record = parse_line(last_line)
        check_record(last_line, record, content)
        return record
    except ValueError as error:
        raise InputError(f"{dataset / MANIFEST}: must hold the record of frame {index} ({error})") from error
