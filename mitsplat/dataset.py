"""A dataset folder: written frame by frame, never half, resumable.

::

    images/train/000000.png     labels/train/000000.txt     layers/train/000000.exr      (and the same for val)
    annotations/instances_train.json, instances_val.json    data.yaml    contact_sheet.jpg
    manifest.jsonl    one line per frame: files and their SHA-256, camera, draws, labels with masks and poses
    timings.jsonl     seconds per stage; apart, so that equal datasets have equal manifests
    runs.jsonl        the command of every run that made frames
    dataset.json      what decides the content: effective scene, hashes of its inputs, version
    scene/            the scene file as it was given
    layouts/0000.json where the objects came to rest

A file gets its name when it is complete and on disk, and a frame its line in the manifest when all its files are.
``data.yaml`` is the only YAML file at the top, because Ultralytics, given the folder, takes the one it finds there.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shlex
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsplat.engine import Note, run_frames
from mitsplat.errors import InputError
from mitsplat.files import SPLITS, Record, write_file, write_text
from mitsplat.manifest import Manifest, append_line, cut_torn_line
from mitsplat.sheet import contact_sheet
from mitsplat.writers import FORMATS, Catalogue, write_collection, write_frame

if TYPE_CHECKING:
    from mitsplat.assets import Asset
    from mitsplat.frame import Frame
    from mitsplat.scene import Scene
    from mitsplat.settle import Layout

Render = Callable[..., "Frame"]
"""As :func:`mitsplat.frame.render_frame`."""
Settle = Callable[..., "Layout"]
"""As :func:`mitsplat.settle.settle_layout`."""
Progress = Callable[[int, int, str], None]
"""Takes the frames finished, the frames wanted and a few words on what is being done now."""

_CONTENT = "dataset.json"
_MANIFEST = "manifest.jsonl"
_TIMINGS = "timings.jsonl"
_RUNS = "runs.jsonl"
_SHEET = "contact_sheet.jpg"
_LOCK = ".lock"
_UNFINISHED = re.compile(r"\.lock|\.dataset\.json\.\d+\.part")
"""Names of what may be in a folder before ``dataset.json`` is."""
_ENTRIES = (
    *("images", "labels", "layers", "annotations", "layouts", "scene"),
    *("yolo-detect", "yolo-obb", "yolo-pose", "panoptic", "voc", "bop", "colmap"),
    *("depth", "normals", "instances", "semantic", "flow", "report.html"),
    *("data.yaml", _SHEET, _MANIFEST, _TIMINGS, _RUNS, _CONTENT, _LOCK),
)


@dataclass(frozen=True)
class DatasetSummary:
    """What a call of :func:`write_dataset` left behind.

    Attributes:
        path: The dataset's folder.
        frames: Frames in it.
        rendered: Frames that this call made; the others were there before.
        images: Images by split.
        instances: Labelled instances by class.
        dropped: What was not labelled, by the reasons of :class:`mitsplat.label.Labels`.
        marked: Labelled instances below a threshold, by the marks of :class:`mitsplat.label.InstanceLabel`.
        contact_sheet: Picture of some frames with their labels drawn.
    """

    path: Path
    frames: int
    rendered: int
    images: dict[str, int]
    instances: dict[str, int]
    dropped: dict[str, int]
    marked: dict[str, int]
    contact_sheet: Path


def write_dataset(
    scene: Scene,
    out: str | Path,
    *,
    frames: int | None = None,
    workers: int = 1,
    resume: bool = True,
    overwrite: bool = False,
    progress: Progress | None = None,
    render: Render | None = None,
    settle: Settle | None = None,
) -> DatasetSummary:
    """Render the first ``frames`` frames of a scene (default: all) into the dataset folder ``out``.

    Frames that are already there are kept if ``resume`` is set and they come from the same scene. The bytes of images,
    labels and manifest do not depend on ``workers`` or on interruptions.

    Args:
        scene: What to render; sizes, formats and the seed are in ``scene.spec``.
        out: Folder, made if missing. It must be empty or a dataset.
        frames: How many frames the dataset should have.
        workers: Processes that make frames, see :func:`mitsplat.engine.run_frames`.
        resume: Continue a dataset that is there; otherwise its presence is an error.
        overwrite: Remove a dataset that is there first.
        progress: Hears of every finished frame and of slow steps.
        render: What to use instead of :func:`mitsplat.frame.render_frame`.
        settle: What to use instead of :func:`mitsplat.settle.settle_layout`.

    Raises:
        InputError: If ``frames`` or a format is not available, the folder cannot be written, is in use, holds
            something else, or holds a dataset of another scene; nothing is rendered then.
    """
    from mitsplat.scene import layout_of

    out = Path(out)
    count = scene.num_frames if frames is None else frames
    if not 1 <= count <= scene.num_frames:
        raise InputError(
            f"frames must be between 1 and {scene.num_frames}, which is layouts x views of {scene.path} (got {count})"
        )
    formats = scene.spec.output.formats
    if unknown := set(formats) - set(FORMATS):
        raise InputError(f"output.formats must be among {', '.join(FORMATS)} (got {min(unknown)})")
    catalogue = Catalogue.of(scene)
    with _open_folder(scene, catalogue, out, resume=resume, overwrite=overwrite) as manifest:
        layouts: dict[int, list[int]] = {}
        for index in range(count):
            if index not in manifest:
                layouts.setdefault(layout_of(scene, index), []).append(index)

        def note(text: str) -> None:
            if progress is not None:
                progress(len(manifest), max(count, len(manifest)), text)

        note("starting")
        if layouts:
            command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
            append_line(out / _RUNS, {"command": command, "python": platform.python_version(), "workers": workers})
        make = _FrameMaker(scene, catalogue, out, render or _default_render(), settle or _default_settle())
        with closing(run_frames(make, layouts, workers=workers, note=note)) as results:
            for record, seconds in results:
                append_line(out / _TIMINGS, {"index": record["index"], **seconds})
                manifest.append(record)
                note(f"frame {record['index']}")
        manifest.sort()
        write_collection(out, manifest, catalogue, formats)
        contact_sheet(out, manifest, out / _SHEET)
        return _summarise(out, manifest, rendered=sum(map(len, layouts.values())))


def _default_render() -> Render:
    from mitsplat.frame import render_frame

    return render_frame


def _default_settle() -> Settle:
    from mitsplat.settle import settle_layout

    return settle_layout


@dataclass
class _FrameMaker:
    """Renders one frame and writes its files; the unit of work of the engine."""

    scene: Scene
    catalogue: Catalogue
    out: Path
    render: Render
    settle: Settle
    _kept: Layout | None = None

    def __call__(self, index: int, note: Note, /) -> tuple[Record, dict[str, float]]:
        from mitsplat.scene import layout_of

        start = time.perf_counter()
        layout = self._layout(layout_of(self.scene, index), note)
        settled = time.perf_counter()
        frame = self.render(self.scene, index, layout=layout)
        rendered = time.perf_counter()
        record = write_frame(frame, self.out, self.scene.spec, self.catalogue)
        stages = {**frame.seconds, "settle": settled - start, "write": time.perf_counter() - rendered}
        return record, {stage: round(seconds, 4) for stage, seconds in stages.items()}

    def _layout(self, index: int, note: Note) -> Layout:
        """The layout from its file, settled by the first process that asks while others wait for it.

        It is always read back, so that a resumed run works with the very same numbers, and stays the same object from
        view to view, by which the renderer knows that nothing moved.
        """
        from mitsplat.settle import Layout

        if self._kept is not None and self._kept.index == index:
            return self._kept
        path = self.out / f"layouts/{index:04d}.json"
        with (path.parent / _LOCK).open("ab") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX, 1, index)  # one byte per layout; freed with the file or the process
            if not path.exists():
                note(f"settling layout {index}")
                layout = self.settle(self.scene, index, progress=lambda text: note(f"layout {index}: {text}"))
                write_text(path, json.dumps(layout.to_json()))
        self._kept = Layout.from_json(json.loads(path.read_bytes()))
        return self._kept


@contextmanager
def _open_folder(scene: Scene, catalogue: Catalogue, out: Path, *, resume: bool, overwrite: bool) -> Iterator[Manifest]:
    """Lock and prepare the folder; its manifest, without the frames that miss a file."""
    content = _content(scene, catalogue)
    _check_own(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = (out / _LOCK).open("a+")
    except OSError as error:
        raise InputError(f"cannot write into {out}: {error.strerror}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise InputError(f"{out} is being written by another run (process {lock.read()})") from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        try:
            if overwrite:
                _remove_dataset(out)
            _check_resumable(out, content, resume=resume)
            _prepare(out, scene, content)
        except OSError as error:
            raise InputError(f"cannot write into {out}: {error.strerror} ({error.filename})") from error
        try:
            manifest = Manifest(out / _MANIFEST)
            for record in manifest:
                if not all((out / file).is_file() for file in record["files"]):
                    manifest.forget(record["index"])
            yield manifest
        finally:
            _remove_partial(out)


def _check_own(out: Path) -> None:
    """Refuse a folder that holds something other than a dataset of mitsplat, which must not be mixed up or removed."""
    try:
        present = json.loads((out / _CONTENT).read_bytes())
        own = isinstance(present, dict) and "mitsplat" in present
    except (FileNotFoundError, NotADirectoryError):
        own = not out.is_dir() or all(_UNFINISHED.fullmatch(entry.name) for entry in out.iterdir())
    except (OSError, ValueError) as error:
        raise InputError(f"{out / _CONTENT} cannot be read ({error})") from error
    if not own:
        raise InputError(f"{out} must be empty or a dataset of mitsplat (it holds other files)")


def _check_resumable(out: Path, content: dict[str, Any], *, resume: bool) -> None:
    """Refuse to continue a dataset against the caller's will, or one that another scene began."""
    if not (out / _CONTENT).exists():
        return
    if not resume:
        raise InputError(f"{out} already holds a dataset; resume it or overwrite it")
    present = json.loads((out / _CONTENT).read_bytes())
    if difference := _first_difference({**present, "libraries": None}, {**content, "libraries": None}):
        key, before, now = difference
        raise InputError(f"{out} cannot be resumed: {key} was {before} and is {now}; overwrite it or choose another")


def _prepare(out: Path, scene: Scene, content: dict[str, Any]) -> None:
    """Make what describes the run, by which the folder is known for a dataset, then the rest; clear what is torn."""
    _remove_partial(out)
    if not (out / _CONTENT).exists():
        write_text(out / _CONTENT, json.dumps(content, indent=1) + "\n")
    (out / "layouts").mkdir(exist_ok=True)
    if not (out / "scene" / scene.path.name).exists():
        write_file(out / "scene" / scene.path.name, lambda temporary: shutil.copyfile(scene.path, temporary))
    cut_torn_line(out / _TIMINGS)
    cut_torn_line(out / _RUNS)


def _remove_dataset(out: Path) -> None:
    """Remove what mitsplat writes and nothing else; its mark last, so that an interruption can be repeated."""
    for name in _ENTRIES:
        entry = out / name
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        elif name not in (_LOCK, _CONTENT):
            entry.unlink(missing_ok=True)
    (out / _CONTENT).unlink(missing_ok=True)


def _remove_partial(out: Path) -> None:
    for partial in out.rglob(".*.part"):
        partial.unlink(missing_ok=True)


def _content(scene: Scene, catalogue: Catalogue) -> dict[str, Any]:
    """What decides the bytes of a dataset, for comparison on resume, and the libraries, for the record."""
    from mitsplat import __version__

    inputs = {asset.name: _asset_hash(asset) for asset in (scene.environment, *scene.assets) if asset is not None}
    for shape, mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True):
        inputs[f"shape {shape.name}"] = _hash(mesh.vertices, mesh.faces)
    for light in scene.spec.lights:
        if image := getattr(light, "image", None):
            inputs[image] = hashlib.sha256((scene.path.parent / image).read_bytes()).hexdigest()
    libraries = ("mitsuba", "drjit", "newton", "mujoco-warp", "warp-lang", "numpy", "opencv-contrib-python-headless")
    return {
        "mitsplat": __version__,
        "scene": scene.spec.model_dump(mode="json", exclude={"output": {"layouts"}}),  # frames may be added
        "classes": list(scene.class_names),
        "keypoints": [list(names) for names in catalogue.keypoint_names],
        "assets": list(catalogue.assets),
        "inputs": inputs,
        "libraries": {name: importlib.metadata.version(name) for name in libraries},
    }


def _asset_hash(asset: Asset) -> str:
    splats, meshes = asset.splats, [mesh for mesh in (asset.mesh, *asset.pieces) if mesh is not None]
    arrays: list[Any] = [splats.means, splats.quats, splats.scales, splats.opacities, splats.sh]
    arrays += [array for mesh in meshes for array in (mesh.vertices, mesh.faces)]
    arrays += [asset.keypoint_array]
    physics = [asset.density, asset.mass or 0.0, asset.friction, asset.roughness, asset.specular, asset.white or 0.0]
    return _hash(*arrays, np.array(physics), np.frombuffer(asset.capture_light.encode(), dtype=np.uint8))


def _hash(*arrays: Any) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(str(np.shape(array)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _first_difference(before: Any, now: Any, key: str = "") -> tuple[str, str, str] | None:
    """Dotted key and the two values, as JSON, where two JSON values differ first."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in sorted({*before, *now}):
            inner = _first_difference(before.get(name), now.get(name), f"{key}.{name}" if key else name)
            if inner is not None:
                return inner
        return None
    return None if before == now else (key, json.dumps(before), json.dumps(now))


def _summarise(out: Path, manifest: Manifest, rendered: int) -> DatasetSummary:
    images, instances, dropped, marked = (Counter[str]() for _ in range(4))
    for record in manifest:
        images[record["split"]] += 1
        instances.update(label["class"] for label in record["labels"]["instances"])
        dropped.update(record["labels"]["dropped"])
        marked.update(mark for label in record["labels"]["instances"] for mark in label["marks"])
    return DatasetSummary(
        path=out,
        frames=len(manifest),
        rendered=rendered,
        images={split: images[split] for split in SPLITS},
        instances=dict(sorted(instances.items())),
        dropped=dict(dropped),
        marked=dict(sorted(marked.items())),
        contact_sheet=out / _SHEET,
    )
