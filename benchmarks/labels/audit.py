"""Audit of random frames in every format, which must find no violation.

    python -m benchmarks.labels.audit [--frames 1000] [--size 128x96] [--out FOLDER]

The workcell's parts float at random poses and scales about the mat, without physics. Unlike in settled layouts, they
intersect, occlude each other, leave the image and come close to the camera.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.audit.audit import audit_dataset
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.spec.scene_spec import FORMATS
from mitsplat.scene.streams import random_stream

ROOT = Path(__file__).resolve().parents[2]
VIEWS = 8
MOST = 25
SKIPPED = ("yolo-pose", "exr")
"""Formats that need keypoints, or that hold nothing that an audit reads."""


def scatter(scene: ms.Scene, index: int, *, progress: Any = None) -> Layout:
    """Return a layout of up to :data:`MOST` parts in random poses."""
    rng = random_stream(scene.spec.seed, "scattered layout", index)
    instances = []
    for i in range(int(rng.integers(0, MOST, endpoint=True))):
        asset = int(rng.integers(len(scene.assets)))
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.normal((0, -0.08, 0.02), (0.07, 0.07, 0.03))
        kind = scene.class_names.index(scene.assets[asset].class_name)
        # Some ids exceed eight bits.
        instances.append(Instance(i + 1 if index % 2 else 300 * (i + 1), asset, kind, pose))
    return Layout(index, tuple(instances), NO_PHYSICS)


def main() -> None:
    """Print the label counts and the violations."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--size", default="128x96")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with recording("labels.audit", parser, options, ignore=("out",)):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Render the frames and audit them."""
    width, height = map(int, options.size.split("x"))
    overrides = {
        "environment": None,
        "quality": "fast",
        "output.width": width,
        "output.height": height,
        "output.layouts": -(-options.frames // VIEWS),
        "output.views": VIEWS,
        "output.image": "png",
        "depth_sensor": {"kind": "stereo"},
        "output.formats": [name for name in FORMATS if name not in SKIPPED],
    }
    scene = ms.load_scene(ROOT / "scenes/workcell.yaml", overrides=overrides)
    with tempfile.TemporaryDirectory() as folder:
        out = options.out or Path(folder) / "frames"
        start = time.perf_counter()
        summary = ms.write_dataset(scene, out, frames=options.frames, settle=scatter)
        made = time.perf_counter()
        found = audit_dataset(out)
        audited = time.perf_counter()
    for count, what in (
        (summary.frames, "frames"),
        (len(scene.spec.output.formats), "formats"),
        (found.instances, "instances"),
        (found.files, "files"),
        (sum(found.dropped.values()), "dropped"),
        (found.low_polygons, "low polygons"),
        (len(found.violations), "violations"),
    ):
        figure(count, "", what)
    print(f"{summary.frames} frames of {width}x{height} px in {made - start:.0f} s, audited in {audited - made:.0f} s")
    print(f"{found.instances} instances in {found.files} files; not labelled: {found.dropped}; marked: {found.marked}")
    print(f"masks in parts whose polygon is below an IoU of 0.99: {found.low_polygons}")
    print(f"violations: {len(found.violations)}")
    for file, text in found.violations[:20]:
        print(f"  {file}: {text}")


if __name__ == "__main__":
    main()
