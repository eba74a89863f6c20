"""Measurement of the time that the dataset of a scene takes on this machine."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from mitsplat.dataset.frame_job import FrameJob
from mitsplat.findings import Finding
from mitsplat.formats.registry import Catalogue
from mitsplat.frames.frame import render_frame
from mitsplat.frames.time_estimate import describe_time
from mitsplat.physics.settle import is_cached, settle_layout
from mitsplat.scene.scene import Scene


def measure_time(scene: Scene) -> Finding:
    """Measure the time of the first layout that is not cached and of two images, and estimate that of the dataset.

    The first image also compiles kernels, so the second one counts. The layout is cached for the run.

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
        for view in (0, min(1, views - 1)):
            start = time.perf_counter()
            job.write(index + view, layout)
            image = time.perf_counter() - start
    return Finding("time", True, describe_time(len(left), settle, scene.num_frames, image))
