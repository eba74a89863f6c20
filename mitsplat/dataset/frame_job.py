"""Unit of work of the engine: rendering one frame and writing its files, locally or from another machine."""

from __future__ import annotations

import fcntl
import json
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mitsplat.dataset.dataset_files import LOCK, layout_file
from mitsplat.errors import InputError, PartialResultError
from mitsplat.formats.registry import Catalogue, write_frame
from mitsplat.progress import Note, discard_note
from mitsplat.scene.layout import Layout, UnsettledLayoutError
from mitsplat.scene.planning.frame_plan import layout_index_of
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import (
    Record,
    link_file,
    open_in_place,
    open_regular,
    parse_json,
    storage_errors,
    write_bytes,
    write_file,
    write_text,
)

if TYPE_CHECKING:
    from mitsplat.frames.frame import Frame

Render = Callable[..., "Frame"]
"""Function with the signature of :func:`mitsplat.frames.frame.render_frame`."""
Settle = Callable[..., Layout]
"""Function with the signature of :func:`mitsplat.physics.settle.settle_layout`."""


@dataclass
class FrameJob:
    """Callable that renders one frame and writes its files; the unit of work of the engine.

    Attributes:
        scene: The scene.
        catalogue: Classes, keypoints and assets that labels refer to.
        out: Dataset folder.
        render: Function that renders a frame.
        settle: Function that settles a layout.
    """

    scene: Scene
    catalogue: Catalogue
    out: Path
    render: Render
    settle: Settle
    _cached_layout: Layout | None = None

    def __call__(self, index: int, note: Note, /) -> tuple[Record, dict[str, float]]:
        """Make frame ``index``, and return its record and the seconds of its stages."""
        start = time.perf_counter()
        layout = self._layout(layout_index_of(self.scene, index), note)
        settled = time.perf_counter()
        record, seconds = self.write(index, layout)
        return record, {**seconds, "settle": round(settled - start, 4)}

    def write(self, index: int, layout: Layout) -> tuple[Record, dict[str, float]]:
        """Render a frame and write its files, and return its record and the seconds of its stages."""
        frame = self.render(self.scene, index, layout=layout)
        rendered = time.perf_counter()
        with storage_errors(self.out):
            record = write_frame(frame, self.out, self.scene.spec, self.catalogue)
        stages = {**frame.seconds, "write": time.perf_counter() - rendered}
        return record, {stage: round(seconds, 4) for stage, seconds in stages.items()}

    def settle_to_json(self, index: int, note: Note) -> str:
        """Settle a layout and return it as JSON."""
        note(f"settling layout {index}")
        try:
            layout = self.settle(self.scene, index, progress=lambda text: note(f"layout {index}: {text}"))
        except UnsettledLayoutError as nothing:
            layout = nothing.layout
        return json.dumps(layout.to_json())

    def _layout(self, index: int, note: Note) -> Layout:
        """Return the layout from its file, which is made if it is missing."""
        if self._cached_layout is not None and self._cached_layout.index == index:
            return self._cached_layout
        path = self.out / layout_file(index)
        with storage_errors(self.out):
            self._settle_to_file(index, path, note)
            with layout_errors(path), open_regular(path) as file:
                return self.load_layout(file.read())

    def _settle_to_file(self, index: int, path: Path, note: Note, flags: int = 0) -> None:
        """Settle the layout if its file is missing; other processes that need the layout wait."""
        with open_in_place(path.parent / LOCK, "ab") as lock:
            # One byte is locked for each layout, until the file is closed or the process ends.
            fcntl.lockf(lock, fcntl.LOCK_EX | flags, 1, index)
            if not path.exists():
                write_text(path, self.settle_to_json(index, note))

    def settle_ahead(self, layouts: Sequence[int]) -> None:
        """Settle the layouts that have no file, except those that another process settles at that moment."""
        for index in layouts:
            path = self.out / layout_file(index)
            if not path.exists():
                with suppress(BlockingIOError):
                    self._settle_to_file(index, path, discard_note, fcntl.LOCK_NB)

    def load_layout(self, text: str | bytes) -> Layout:
        """Parse a layout from JSON and cache it; return the cached object if the index is the same.

        A layout is always parsed from its file, so a resumed run uses exactly the same numbers. All views get the same
        object, because the renderer detects an unchanged layout by object identity.
        """
        stored = parse_json(text.encode() if isinstance(text, str) else text)
        if self._cached_layout is None or self._cached_layout.index != stored["index"]:
            self._cached_layout = Layout.from_json(stored)
        return self._cached_layout


@contextmanager
def layout_errors(path: Path) -> Iterator[None]:
    """Convert errors in the file of a layout to an InputError."""
    try:
        yield
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: must be a valid layout ({error!r}); remove it and run again") from error


@dataclass(frozen=True)
class RemoteFrame:
    """Frame that was rendered on another machine.

    Attributes:
        record: Manifest record of the frame.
        seconds: Seconds by stage.
        contents: Contents of its files, by SHA-256.
        layout: Layout of the frame, as JSON.
    """

    record: Record
    seconds: dict[str, float]
    contents: dict[str, bytes]
    layout: str

    def write(self, out: Path) -> Record:
        """Write the files into a dataset folder; files with equal contents become hard links.

        Raises:
            OSError: If they cannot be written.
            PartialResultError: If a file was damaged in transfer.
        """
        layout = out / layout_file(self.record["layout"])
        if not layout.exists():
            write_text(layout, self.layout)
        written: dict[str, Path] = {}
        for file, digest in self.record["files"].items():
            if digest in written:
                found = write_file(out / file, partial(link_file, written[digest]))
            else:
                found = write_bytes(out / file, self.contents[digest])
            if found != digest:
                raise PartialResultError(f"{out / file}: must have the SHA-256 {digest} (got {found}); run again")
            written.setdefault(digest, out / file)
        return self.record


class RemoteFrameJob:
    """Settling of layouts and rendering of frames on a machine without the caller's files; results are returned.

    Args:
        job: The same work with the caller's files.
    """

    def __init__(self, job: FrameJob) -> None:
        self.job = job
        self._images = {name: (path.suffix, path.read_bytes()) for name, path in job.scene.images.items()}
        self._unpacked = False

    def cached_layout(self, layout: int) -> str | None:
        """Return a layout from the dataset folder, or None; must be called on the machine that has the folder."""
        path = self.job.out / layout_file(layout)
        return path.read_text() if path.exists() else None

    def settle(self, layout: int) -> str:
        """Settle a layout and return it as JSON."""
        return self.job.settle_to_json(layout, discard_note)

    def make(self, index: int, layout: str) -> RemoteFrame:
        """Make frame ``index`` of a layout."""
        self._unpack_images()
        with tempfile.TemporaryDirectory(prefix="mitsplat-") as folder:
            self.job.out = Path(folder)
            record, seconds = self.job.write(index, self.job.load_layout(layout))
            contents = {digest: (Path(folder) / file).read_bytes() for file, digest in record["files"].items()}
        return RemoteFrame(record, seconds, contents, layout)

    def _unpack_images(self) -> None:
        """Write the images of lights into a temporary folder, because Mitsuba reads them from files.

        The folder is removed together with this object.
        """
        if self._unpacked or not self._images:
            return
        folder = Path(tempfile.mkdtemp(prefix="mitsplat-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        images = {}
        for number, (name, (suffix, content)) in enumerate(self._images.items()):
            images[name] = folder / f"{number}{suffix}"
            images[name].write_bytes(content)
        self.job.scene = replace(self.job.scene, images=images)
        self._unpacked = True
