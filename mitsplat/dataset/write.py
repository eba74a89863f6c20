"""A dataset folder: written frame by frame, never half, resumable.

::

    images/train/000000.png     labels/train/000000.txt     layers/train/000000.exr      (and the same for val)
    annotations/instances_train.json, instances_val.json    data.yaml    contact_sheet.jpg
    manifest.jsonl    one line per frame: files and their SHA-256, camera, draws, labels with masks and poses
    timings.jsonl     seconds per stage; apart, so that equal datasets have equal manifests
    runs.jsonl        the command of every run that made frames, and its device
    dataset.json      what decides the content: effective scene, hashes of its inputs, kind of device, version
    shard.json        which part of the dataset this is, if it is one of several
    scene/            the scene file as it was given
    layouts/0000.json where the objects came to rest

A file gets its name when it is complete and on disk, and a frame its line in the manifest when all its files are.
Shards are datasets of their own that share everything but their frames; :mod:`mitsplat.dataset.shards` joins them.
``data.yaml`` is the only YAML file at the top, because Ultralytics, given the folder, takes the one it finds there.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

from mitsplat.dataset.dataset_folder import Shard, append_run, content_of, finish_folder, open_folder
from mitsplat.dataset.frame_job import FrameMaker, RemoteFrames, Render, Settle, layout_errors
from mitsplat.dataset.manifest import append_line
from mitsplat.dataset.own_files import SHEET, TIMINGS, remove_folds
from mitsplat.dataset.preflight import refuse, run_faults
from mitsplat.engine.pool import check_workers, run_frames
from mitsplat.engine.ray import Cluster, load_ray, run_on_ray
from mitsplat.engine.resources import TYPICAL
from mitsplat.errors import InputError
from mitsplat.formats.registry import FORMATS, Catalogue
from mitsplat.frames.budget import worker_memory
from mitsplat.frames.frame import render_frame
from mitsplat.physics.settle import settle_layout
from mitsplat.progress import Note, Progress
from mitsplat.runtime.device import Device, current_device, find_device
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.frame_plan import layout_of
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import SPLITS, Record, read_json, storage_errors

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DatasetSummary:
    """What a call of :func:`write_dataset` left behind.

    Attributes:
        path: The dataset's folder.
        frames: Frames in it.
        rendered: Frames that this call made; the others were there before.
        images: Images by split.
        instances: Labelled instances by class.
        dropped: What was not labelled, by the reasons of :class:`mitsplat.labels.labels.Labels`.
        marked: Labelled instances below a threshold, by the marks of :class:`mitsplat.labels.labels.InstanceLabel`.
        contact_sheet: Picture of some frames with their labels drawn.
        incomplete: Layouts that lack objects, because no draw with them came to rest.
        left_out: Those objects by name.
        unlabelled: Whether there are objects, but no image has a label.
    """

    path: Path
    frames: int
    rendered: int
    images: dict[str, int]
    instances: dict[str, int]
    dropped: dict[str, int]
    marked: dict[str, int]
    contact_sheet: Path
    incomplete: int = 0
    left_out: dict[str, int] = field(default_factory=dict)
    unlabelled: bool = False


def write_dataset(
    scene: Scene,
    out: str | Path,
    *,
    frames: int | None = None,
    shard: Shard | None = None,
    workers: int | None = 1,
    cluster: Cluster | None = None,
    resume: bool = True,
    overwrite: bool = False,
    progress: Progress | None = None,
    render: Render | None = None,
    settle: Settle | None = None,
    device: str | Device | None = None,
    any_device: bool = False,
) -> DatasetSummary:
    """Render the first ``frames`` frames of a scene (default: all) into the dataset folder ``out``.

    Frames that are already there are kept if ``resume`` is set and they come from the same scene. The bytes of images,
    labels and manifest do not depend on ``workers``, ``cluster`` or interruptions, and those of all shards merged not
    on their number. They do on the kind of the device: pictures of a GPU differ a little from those of a CPU.

    Args:
        scene: What to render; sizes, formats and the seed are in ``scene.spec``.
        out: Folder, made if missing. It must be empty or a dataset.
        frames: How many frames the dataset should have, all its shards together.
        shard: Which part of it to make here; all of it if None.
        workers: Processes that make frames, see :func:`mitsplat.engine.pool.run_frames`; None is as many as pay, or as
            fit into the cluster.
        cluster: Where frames are made, if not in processes of this machine.
        resume: Continue a dataset that is there; otherwise its presence is an error.
        overwrite: Remove a dataset that is there first.
        progress: Hears of every finished frame and of slow steps.
        render: What to use instead of :func:`mitsplat.frames.frame.render_frame`.
        settle: What to use instead of :func:`mitsplat.physics.settle.settle_layout`.
        device: What frames are rendered on, as :mod:`mitsplat.runtime.device` names them; layouts are settled on CPUs.
        That of
            this process if None, see :func:`mitsplat.use_device`, and on a cluster what its resources say.
        any_device: Continue a dataset that was begun on the other kind of device.

    Raises:
        InputError: If ``frames`` or a format is not available, the scene can come to nothing (see
            :mod:`mitsplat.dataset.preflight`), the folder cannot be written, is in use, holds something else, or holds
            a dataset of another scene; nothing is rendered then. Later, if what is in it is changed by someone else, or
            more layouts lack objects than ``settle.incomplete`` says.
        MissingResourceError: If the disk is full, the device is not here, or memory does not suffice for one frame.
        PartialResultError: If workers were lost, or finished files removed, faster than frames could be made again.
    """
    out = Path(out)
    count = scene.num_frames if frames is None else frames
    if not 1 <= count <= scene.num_frames:
        raise InputError(
            f"frames must be between 1 and {scene.num_frames}, which is layouts x views of {scene.path} (got {count})"
        )
    formats = scene.spec.output.formats
    if unknown := set(formats) - set(FORMATS):
        raise InputError(f"output.formats must be among {', '.join(FORMATS)} (got {min(unknown)})")
    check_workers(workers)
    catalogue = Catalogue.of(scene)
    wanted = range(count) if shard is None else shard.frames(count, scene.spec.output.views)
    if render is None and settle is None:
        refuse(scene, run_faults(scene, wanted, out=out, workers=workers, elsewhere=cluster is not None))
    if cluster is not None:
        chosen, cluster = cluster.on_device(device)
        load_ray()
    else:
        chosen = current_device() if device is None else find_device(device)
    content = content_of(scene, catalogue, chosen.kind)
    part = None if shard is None else shard.to_json(count)
    with open_folder(
        out, content, scene.path, part, resume=resume, overwrite=overwrite, any_device=any_device
    ) as manifest:
        layouts: dict[int, list[int]] = {}
        for index in wanted:
            if index not in manifest:
                layouts.setdefault(layout_of(scene, index), []).append(index)

        def note(text: str) -> None:
            if progress is not None:
                progress(len(manifest), max(len(wanted), len(manifest)), text)

        note("starting")
        if chosen.reason:
            note(f"device {chosen}: {chosen.reason}")
        if layouts:
            if remove_folds(out):
                _logger.warning(
                    "%s: lists of folds lack the new images and are removed: run `mitsplat split` again", out
                )
            append_run(out, workers, chosen.kind, [gpu.name for gpu in chosen.gpus])
        shortfall = Shortfall(scene, -(-count // scene.spec.output.views))
        for layout in sorted({layout_of(scene, index) for index in wanted}):
            shortfall.read(out / f"layouts/{layout:04d}.json")
        make = FrameMaker(scene, catalogue, out, render or render_frame, settle or settle_layout)
        with closing(_results(make, layouts, workers, cluster, chosen, note)) as results:
            for record, seconds in results:
                append_line(out / TIMINGS, {"index": record["index"], **seconds})
                manifest.append(record)
                note(f"frame {record['index']}")
                shortfall.add(record["layout"], [(one["name"], one["reason"]) for one in record.get("left_out", ())])
        counts = FrameCounts()
        finish_folder(out, manifest, content, catalogue, counts.add)
        return counts.summary(out, rendered=sum(map(len, layouts.values())))


def _results(
    make: FrameMaker,
    layouts: dict[int, list[int]],
    workers: int | None,
    cluster: Cluster | None,
    device: Device,
    note: Note,
) -> Generator[tuple[Record, dict[str, float]]]:
    """Records of frames whose files are in the folder, and the seconds of their stages."""
    if cluster is None:
        memory = TYPICAL if workers is not None else worker_memory(make.scene)
        with closing(run_frames(make, layouts, workers=workers, note=note, memory=memory, device=device)) as made:
            yield from made
        return
    with closing(run_on_ray(RemoteFrames(make), layouts, cluster, workers=workers, note=note)) as parcels:
        for parcel in parcels:
            with storage_errors(make.out):
                yield parcel.unpack(make.out), parcel.seconds


class Shortfall:
    """Refuses a dataset of which more layouts lack objects than the scene bears.

    Args:
        scene: With its ``settle.incomplete``.
        layouts: Of the whole dataset, all its shards together.
    """

    def __init__(self, scene: Scene, layouts: int) -> None:
        self._scene, self._layouts = scene, layouts
        self._lacking: dict[int, Sequence[tuple[str, str]]] = {}

    def read(self, path: Path) -> None:
        """Count a layout that an earlier run settled, if it did."""
        with suppress(FileNotFoundError):
            with layout_errors(path):
                layout = Layout.from_json(read_json(path))
            self.add(layout.index, [(self._scene.assets[one.asset].name, one.reason) for one in layout.left_out])

    def add(self, layout: int, left_out: Sequence[tuple[str, str]]) -> None:
        """Count a layout that lacks objects of these names, for these reasons.

        Raises:
            InputError: If too many do.
        """
        if not left_out:
            return
        self._lacking[layout] = left_out
        share = self._scene.spec.settle.incomplete
        if len(self._lacking) > share * self._layouts:
            told = Counter(f"{name}: {reason}" for objects in self._lacking.values() for name, reason in objects)
            often = "; ".join(f"{count} x {text}" for text, count in told.most_common(3))
            raise InputError(
                f"{self._scene.path}: at most a share of settle.incomplete = {share:g} of the {self._layouts} layouts "
                f"may lack objects that do not come to rest (got {len(self._lacking)}, among them {often}); "
                "`mitsplat check` tries each object alone"
            )


@dataclass
class FrameCounts:
    """What is counted while a dataset's records are read once."""

    images: Counter[str] = field(default_factory=Counter)
    instances: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    marked: Counter[str] = field(default_factory=Counter)
    left_out: dict[int, Counter[str]] = field(default_factory=dict)
    placed: bool = False

    def add(self, record: Record) -> None:
        """Count a frame."""
        labels = record["labels"]
        self.images[record["split"]] += 1
        self.instances.update(label["class"] for label in labels["instances"])
        self.dropped.update(labels["dropped"])
        self.placed |= bool(labels["instances"] or any(labels["dropped"].values()))
        self.marked.update(mark for label in labels["instances"] for mark in label["marks"])
        if record.get("left_out"):
            self.left_out[record["layout"]] = Counter(one["name"] for one in record["left_out"])

    def summary(self, out: Path, rendered: int) -> DatasetSummary:
        """What is in a finished dataset, ``rendered`` frames of it new."""
        return DatasetSummary(
            path=out,
            frames=self.images.total(),
            rendered=rendered,
            images={split: self.images[split] for split in SPLITS if split != "test" or self.images[split]},
            instances=dict(sorted(self.instances.items())),
            dropped=dict(self.dropped),
            marked=dict(sorted(self.marked.items())),
            incomplete=len(self.left_out),
            left_out=dict(sorted(sum(self.left_out.values(), Counter[str]()).items())),
            contact_sheet=out / SHEET,
            unlabelled=self.placed and not self.instances,
        )
