"""Trial run of a scene: labels of its first images, and the time that its dataset takes on this machine."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsplat.dataset.frame_job import FrameJob
from mitsplat.findings import Finding
from mitsplat.formats.registry import Catalogue
from mitsplat.frames.frame import render_frame
from mitsplat.frames.time_estimate import describe_time
from mitsplat.physics.settle import is_cached, settle_layout
from mitsplat.scene.layout import Layout
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import Record


def measure_run(scene: Scene) -> Iterator[Finding]:
    """Settle the first layout that is not cached, and render two images of it.

    Yields a finding about labels if the images have none, and the estimated time of the dataset. The first image also
    compiles kernels, so the second one counts. The layout is cached for the run.

    Raises:
        InputError: If the layout does not settle.
    """
    layouts = range(scene.spec.output.layouts)
    left = [index for index in layouts if not is_cached(scene, index)]
    start = time.perf_counter()
    layout = settle_layout(scene, left[0] if left else 0)
    settle = time.perf_counter() - start
    with tempfile.TemporaryDirectory(prefix="mitsplat-") as folder:
        job = FrameJob(scene, Catalogue.of(scene), Path(folder), render_frame, settle_layout)
        index, views = layout.index * scene.spec.output.views, scene.spec.output.views
        records = []
        for view in (0, min(1, views - 1)):
            start = time.perf_counter()
            records.append(job.write(index + view, layout)[0])
            image = time.perf_counter() - start
    if not any(record["labels"]["instances"] for record in records):
        yield _no_labels(records, layout)
    yield Finding("time", True, describe_time(len(left), settle, scene.num_frames, image))


def _no_labels(records: list[Record], layout: Layout) -> Finding:
    """Return the finding about images without any label, with the likely cause."""
    dropped: Counter[str] = Counter()
    for record in records:
        dropped.update(record["labels"]["dropped"])
    counts = ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count) or "no objects"
    lowest = min((one.world_from_object[2, 3] for one in layout.instances), default=-np.inf)
    height = float(records[0]["camera"]["world_from_camera"][2][3])
    remedy = "`mitsplat preview` shows what the camera sees"
    if height < lowest:
        remedy = f"the camera is below all objects, at z = {height:.3g} m: does z of its world point up?"
    return Finding("labels", False, f"the first images have no label (not labelled: {counts})", remedy)
