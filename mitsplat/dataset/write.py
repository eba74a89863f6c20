"""Writing of a dataset folder frame by frame; an interrupted run can be resumed.

::

    images/train/000000.png     labels/train/000000.txt     layers/train/000000.exr      (and the same for val)
    annotations/instances_train.json, instances_val.json    data.yaml    contact_sheet.jpg
    manifest.jsonl    one line per frame: files and their SHA-256, camera, draws, labels with masks and poses
    timings.jsonl     seconds per stage; separate, so that equal datasets have equal manifests
    runs.jsonl        command and device of every run that made frames
    dataset.json      everything that determines the content: scene, hashes of its inputs, kind of device, version
    shard.json        part of the dataset in this folder, if it is one of several
    scene/            copy of the scene file
    layouts/0000.json resting poses of the objects

A file gets its final name when it is complete and on disk. A frame gets its line in the manifest when all its files
are complete. Shards are datasets of their own that share everything except their frames; :mod:`mitsplat.dataset.shards`
merges them. ``data.yaml`` is the only YAML file at the top level, because Ultralytics takes the first one of a folder.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, groupby
from pathlib import Path

from mitsplat.arguments import check_whole_number, path_of
from mitsplat.dataset.dataset_files import SHEET, TIMINGS, layout_file, remove_folds
from mitsplat.dataset.dataset_folder import append_run, content_of, finish_folder, open_folder
from mitsplat.dataset.frame_job import FrameJob, RemoteFrameJob, Render, Settle, layout_errors
from mitsplat.dataset.preflight import refuse, run_faults
from mitsplat.dataset.records.manifest import Manifest, append_line
from mitsplat.dataset.shard_file import Shard
from mitsplat.engine.pool import check_workers, run_frames
from mitsplat.engine.ray import Cluster, load_ray, run_on_ray
from mitsplat.engine.resources import TYPICAL_MEMORY
from mitsplat.errors import InputError
from mitsplat.formats.registry import Catalogue
from mitsplat.frames.budget import worker_memory
from mitsplat.frames.frame import render_frame
from mitsplat.frames.time_estimate import RunTime
from mitsplat.physics.settle import is_cached, settle_layout
from mitsplat.progress import TIME_NOTE, Note, Progress
from mitsplat.runtime.device import Device, current_device, find_device
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.frame_plan import layout_index_of
from mitsplat.scene.planning.lens_warnings import lens_warnings
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import SPLITS, Record, read_json, storage_errors

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DatasetSummary:
    """Summary of a call of :func:`write_dataset`.

    Attributes:
        path: Dataset folder.
        frames: Number of frames in the dataset.
        rendered: Number of frames that this call rendered; the others existed before.
        images: Number of images by split.
        instances: Number of labelled instances by class.
        dropped: Number of unlabelled instances by the reasons of :class:`mitsplat.labels.labels.Labels`.
        marked: Number of labelled instances below a threshold, by the marks of
            :class:`mitsplat.labels.labels.InstanceLabel`.
        contact_sheet: Picture of some frames with their labels drawn.
        incomplete: Number of layouts that lack objects, because no draw with these objects came to rest.
        left_out: Number of these objects by name.
        unlabelled: True if there are objects, but no image has a label.
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
    overwrite: bool = False,
    progress: Progress | None = None,
    render: Render | None = None,
    settle: Settle | None = None,
    device: str | Device | None = None,
    any_device: bool = False,
) -> DatasetSummary:
    """Render the first ``frames`` frames of a scene (default: all) into the dataset folder ``out``.

    Existing frames of the same scene are reused. The bytes of images, labels and manifest do not depend on
    ``workers``, ``cluster`` or interruptions. The bytes of merged shards do not depend on the number of shards. The
    bytes depend on the kind of device: pictures of a GPU differ a little from those of a CPU.

    Args:
        scene: Scene to render; image size, formats and the seed are in ``scene.spec``.
        out: Folder; it is created if missing. It must be empty or a dataset.
        frames: Number of frames of the dataset, all its shards together.
        shard: Part of the dataset to render here; all frames if None.
        workers: Number of processes that render frames, see :func:`mitsplat.engine.pool.run_frames`. None selects the
            number that cores and memory of this machine allow, or that fits into the cluster.
        cluster: Cluster that renders the frames; processes of this machine if None.
        overwrite: Remove a dataset that is already in the folder.
        progress: Callback that is called after every finished frame and during slow steps.
        render: Replacement of :func:`mitsplat.frames.frame.render_frame`.
        settle: Replacement of :func:`mitsplat.physics.settle.settle_layout`.
        device: Device that renders frames, by the names of :mod:`mitsplat.runtime.device`; layouts are settled on CPUs.
            None selects the device of this process (see :func:`mitsplat.use_device`), or, on a cluster, the device
            given by its resources.
        any_device: Continue a dataset that was started on the other kind of device.

    Raises:
        InputError: If there are not so many ``frames``, a preflight check fails (see
            :mod:`mitsplat.dataset.preflight`), the folder cannot be written, is in use, holds other files, or holds a
            dataset of another scene; nothing is rendered then. Later, if another process changes the folder, or if more
            layouts lack objects than ``settle.incomplete`` allows.
        MissingResourceError: If the disk is full, the device is not available, or memory does not suffice for one
            frame.
        PartialResultError: If workers were lost, or finished files were removed, faster than frames could be made
            again.
    """
    Scene.check(scene)
    out = path_of(out, "out")
    count = _frame_count(scene, frames)
    check_workers(workers)
    catalogue = Catalogue.of(scene)
    indices = range(count) if shard is None else shard.frames(count, scene.spec.output.views)
    for warning in lens_warnings(scene.spec):
        _logger.warning("%s: %s: %s", scene.path, warning.text, warning.remedy)
    if not scene.is_lit:
        text = "no light is in the scene, so objects have neither shading nor shadows: add one"
        _logger.warning("%s: lights: %s, or set capture_light: scene in assets", scene.path, text)
    if render is None and settle is None:
        refuse(scene, run_faults(scene, indices, out=out, workers=workers, elsewhere=cluster is not None))
    if cluster is not None:
        used_device, cluster = cluster.on_device(device)
        load_ray()
    else:
        used_device = current_device() if device is None else find_device(device)
    content = content_of(scene, catalogue, used_device.kind)
    part = None if shard is None else shard.to_json(count)
    job = FrameJob(scene, catalogue, out, render or render_frame, settle or settle_layout)
    run = _Run(job, indices, count, workers, cluster, used_device, progress)
    with open_folder(
        out, content, scene.path, part, resume=True, overwrite=overwrite, any_device=any_device
    ) as manifest:
        rendered = run.render_missing(manifest)
        counts = FrameCounts()
        finish_folder(out, manifest, content, catalogue, counts.add)
        return counts.summary(out, rendered)


def _frame_count(scene: Scene, frames: int | None) -> int:
    """Return the number of frames of a dataset, by default all of the scene.

    Raises:
        InputError: If the scene has fewer frames.
    """
    count = scene.num_frames if frames is None else frames
    check_whole_number(count, "frames")
    if not 1 <= count <= scene.num_frames:
        raise InputError(
            f"frames must be between 1 and {scene.num_frames}, which is layouts x views of {scene.path} (got {count})"
        )
    return count


@dataclass(frozen=True, eq=False)
class _Run:
    """Run that renders the frames that a dataset lacks.

    Attributes:
        job: Job that renders a frame and writes its files.
        indices: Frames of this dataset or shard.
        frames: Number of frames of the dataset, all its shards together.
        workers: Number of worker processes, see :func:`write_dataset`.
        cluster: Cluster that renders the frames; processes of this machine if None.
        device: Device that renders the frames.
        progress: Progress callback.
    """

    job: FrameJob
    indices: range
    frames: int
    workers: int | None
    cluster: Cluster | None
    device: Device
    progress: Progress | None

    def render_missing(self, manifest: Manifest) -> int:
        """Render the frames that the manifest lacks, add them to it, and return their number.

        Raises:
            InputError: If more layouts lack objects than the scene allows.
        """
        scene, out = self.job.scene, self.job.out
        missing = (index for index in self.indices if index not in manifest)
        layouts = {layout: list(found) for layout, found in groupby(missing, partial(layout_index_of, scene))}

        def note(text: str) -> None:
            if self.progress is not None:
                self.progress(len(manifest), max(len(self.indices), len(manifest)), text)

        note("starting")
        if self.device.reason:
            note(f"device {self.device}: {self.device.reason}")
        if layouts:
            self._begin()
        incomplete = self._incomplete_layouts(manifest)
        num_missing = sum(map(len, layouts.values()))
        is_replaced = self.job.settle is not settle_layout
        unsettled = [layout for layout in layouts if is_replaced or not is_cached(scene, layout)]
        run_time = RunTime(len(unsettled), num_missing, settles_first=min(layouts, default=0) in unsettled)
        with closing(self._results(layouts, note)) as results:
            for record, seconds in results:
                append_line(out / TIMINGS, {"index": record["index"], **seconds})
                manifest.append(record)
                note(f"frame {record['index']}")
                if estimate := run_time.add(seconds):
                    note(f"{TIME_NOTE}{estimate}")
                incomplete.add(record["layout"], [(one["name"], one["reason"]) for one in record.get("left_out", ())])
        return num_missing

    def _begin(self) -> None:
        """Record a run that adds images, and remove lists of folds, which do not contain them."""
        out = self.job.out
        if remove_folds(out):
            _logger.warning(
                "%s: the lists of folds do not contain the new images and are removed: run `mitsplat split` again", out
            )
        append_run(out, self.workers, self.device.kind, [gpu.name for gpu in self.device.gpus])

    def _incomplete_layouts(self, manifest: Manifest) -> IncompleteLayouts:
        """Return the count of layouts that lack objects, with those that earlier runs settled."""
        scene = self.job.scene
        # The dataset may have more frames than were asked for.
        present = sorted({layout_index_of(scene, index) for index in chain(self.indices, manifest.indices)})
        incomplete = IncompleteLayouts(scene, max(-(-self.frames // scene.spec.output.views), len(present)))
        for layout in present:
            incomplete.read(self.job.out / layout_file(layout))
        return incomplete

    def _results(self, layouts: dict[int, list[int]], note: Note) -> Generator[tuple[Record, dict[str, float]]]:
        """Yield the record and the seconds of the stages of each frame, after its files were written to the folder."""
        job, workers = self.job, self.workers
        if self.cluster is None:
            memory = TYPICAL_MEMORY if workers is not None else worker_memory(job.scene)
            prepare, device = job.settle_ahead, self.device
            with closing(
                run_frames(job, layouts, workers=workers, note=note, memory=memory, device=device, prepare=prepare)
            ) as results:
                yield from results
            return
        with closing(run_on_ray(RemoteFrameJob(job), layouts, self.cluster, workers=workers, note=note)) as frames:
            for frame in frames:
                with storage_errors(job.out):
                    yield frame.write(job.out), frame.seconds


class IncompleteLayouts:
    """Limit of the number of layouts that lack objects.

    Args:
        scene: Scene with the limit ``settle.incomplete``.
        layouts: Number of layouts of the whole dataset, all its shards together.
    """

    def __init__(self, scene: Scene, layouts: int) -> None:
        self._scene, self._layouts = scene, layouts
        self._incomplete: dict[int, Sequence[tuple[str, str]]] = {}

    def read(self, path: Path) -> None:
        """Count a layout that an earlier run settled, if its file exists."""
        with suppress(FileNotFoundError):
            with layout_errors(path):
                layout = Layout.from_json(read_json(path))
            self.add(layout.index, [(self._scene.assets[one.asset].name, one.reason) for one in layout.left_out])

    def add(self, layout: int, left_out: Sequence[tuple[str, str]]) -> None:
        """Count a layout that lacks objects, given by name and reason.

        Raises:
            InputError: If too many layouts lack objects.
        """
        if not left_out:
            return
        self._incomplete[layout] = left_out
        share = self._scene.spec.settle.incomplete
        if len(self._incomplete) > share * self._layouts:
            counts = Counter(f"{name}: {reason}" for objects in self._incomplete.values() for name, reason in objects)
            often = "; ".join(f"{count} x {text}" for text, count in counts.most_common(3))
            raise InputError(
                f"{self._scene.path}: at most a fraction settle.incomplete = {share:g} of the {self._layouts} layouts "
                f"may lack objects that do not come to rest (got {len(self._incomplete)}, among them {often}); "
                "`mitsplat check` names regions without room, and tries each object alone"
            )


@dataclass
class FrameCounts:
    """Statistics of a dataset, counted in one pass over its records.

    Attributes:
        images, instances, dropped, marked: As in :class:`DatasetSummary`.
        left_out: Objects that each layout lacks, by name.
        placed: True if any image shows, or should show, an object with a class.
    """

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
        """Return the summary of a finished dataset, of which ``rendered`` frames are new."""
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
