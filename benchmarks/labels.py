"""Seconds that truth, labels and files of a 1280x720 frame with 15 instances cost, on one core.

    python -m benchmarks.labels [--frames 7] [--size 1280x720]

The parts lie in a grid on the workcell's mat, seen by its own cameras; nothing is simulated. Medians; the load is printed
too. Silhouettes are rendering (each instance alone, on a canvas of nine images), labelling and writing are what remains.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

import mitsplat as ms
from mitsplat.settle import Instance, Layout, RestCertificate
from mitsplat.spec import FORMATS
from mitsplat.writers import Catalogue, write_frame

ROOT = Path(__file__).resolve().parents[1]
INSTANCES = 15
SETS = {
    "yolo": ("yolo",),
    "yolo, coco": ("yolo", "coco"),
    "yolo, coco, panoptic, instances, semantic": ("yolo", "coco", "panoptic", "instances", "semantic"),
    "bop": ("bop",),
    "all but yolo-pose": tuple(name for name in FORMATS if name != "yolo-pose"),
}


def grid(scene: ms.Scene) -> Layout:
    """Fifteen parts in three rows, each turned and resting on its lowest point."""
    instances = []
    for i in range(INSTANCES):
        asset = i % len(scene.assets)
        angle = 2.4 * i
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        mesh = scene.assets[asset].mesh
        pose[:3, 3] = (i % 5 - 2) * 0.055, (i // 5 - 1) * 0.055 - 0.08, -mesh.bounds[0][2] if mesh is not None else 0
        kind = scene.class_names.index(scene.assets[asset].class_name)
        instances.append(Instance(i + 1, asset, kind, pose))
    return Layout(0, tuple(instances), RestCertificate(True, 0, 0, 0, 0, 0, 0, 1))


def main() -> None:
    """Print the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--size", default="1280x720")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    scene = ms.load_scene(ROOT / "scenes/workcell.yaml", overrides={"output.width": width, "output.height": height})
    layout = grid(scene)
    frames = [ms.render_frame(scene, i, layout=layout) for i in range(options.frames + 1)][1:]
    print(f"load: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; this process on one of them")
    print(f"{width}x{height}, labelled instances per frame: {[len(frame.labels.instances) for frame in frames]}")
    for stage in ("render", "silhouettes", "label"):
        print(f"  {stage:12s} {statistics.median(frame.seconds[stage] for frame in frames):.3f} s")
    label = statistics.median(frame.seconds["label"] for frame in frames)
    catalogue = Catalogue.of(scene)
    for name, formats in SETS.items():
        spec = scene.spec.model_copy(update={"output": scene.spec.output.model_copy(update={"formats": formats})})
        seconds = []
        with tempfile.TemporaryDirectory() as folder:
            for frame in frames:
                start = time.perf_counter()
                write_frame(frame, Path(folder), spec, catalogue)
                seconds.append(time.perf_counter() - start)
        wrote = statistics.median(seconds)
        print(f"  write {wrote:.3f} s, with labelling {wrote + label:.3f} s: {name} ({spec.output.image})")


if __name__ == "__main__":
    main()
