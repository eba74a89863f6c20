"""Time of ground truth, labels and files of a 1280x720 frame with 15 instances, on one core [s].

    python -m benchmarks.labels.cost [--frames 7] [--size 1280x720]

The parts lie in a grid on the workcell's mat, seen by its own cameras, without simulation. Times are medians of CPU
seconds, which other programs hardly affect, with wall-clock seconds in brackets; the load is printed too. Silhouettes
are part of rendering (each instance alone, on a canvas of nine images); the remaining stages are labels and files.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.formats.registry import Catalogue, write_frame
from mitsplat.labels.labels import LabelRules, Truth, label_instances
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.spec.scene_spec import FORMATS

ROOT = Path(__file__).resolve().parents[2]
INSTANCES = 15
SETS = {
    "yolo": ("yolo",),
    "yolo, coco": ("yolo", "coco"),
    "yolo, coco, panoptic, instances, semantic": ("yolo", "coco", "panoptic", "instances", "semantic"),
    "bop": ("bop",),
    "all but yolo-pose": tuple(name for name in FORMATS if name != "yolo-pose"),
}


def grid(scene: ms.Scene) -> Layout:
    """Return fifteen parts in three rows, each rotated and resting on its lowest point."""
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
    return Layout(0, tuple(instances), NO_PHYSICS)


def truth_of(frame: ms.Frame) -> Truth:
    """Return the maps of a frame, with the silhouettes of its labels."""
    alone = {label.id: label.amodal for label in frame.labels.instances}
    return Truth(frame.instance, frame.layers.proxy_instance, alone, frame.depth)


def clocks() -> np.ndarray:
    """Return CPU seconds of this process, and wall-clock seconds."""
    return np.array([time.process_time(), time.perf_counter()])


def main() -> None:
    """Print the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--size", default="1280x720")
    options = parser.parse_args()
    with recording("labels.cost", parser, options):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Render, label and write frames."""
    width, height = map(int, options.size.split("x"))
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    scene = ms.load_scene(
        ROOT / "scenes/workcell.yaml",
        overrides={"output.width": width, "output.height": height, "depth_sensor": {"kind": "stereo"}},
    )
    layout = grid(scene)
    frames = [ms.render_frame(scene, i, layout=layout) for i in range(options.frames + 1)][1:]
    truths = [truth_of(frame) for frame in frames]
    print(f"load: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; this process on one of them")
    print(f"{width}x{height}, labelled instances per frame: {[len(frame.labels.instances) for frame in frames]}")
    for stage in ("render", "silhouettes", "label"):
        median = statistics.median(frame.seconds[stage] for frame in frames)
        figure(median, "s", "wall", stage)
        print(f"  {stage:12s} ({median:.3f} s)")
    catalogue = Catalogue.of(scene)
    for name, formats in SETS.items():
        spec = scene.spec.model_copy(update={"output": scene.spec.output.model_copy(update={"formats": formats})})
        labelling, writing = [], []
        with tempfile.TemporaryDirectory() as folder:
            for frame, truth in zip(frames, truths, strict=True):
                start = clocks()
                labels = label_instances(truth, layout.instances, scene.class_names, LabelRules())
                labelled = clocks()
                write_frame(replace(frame, labels=labels), Path(folder), spec, catalogue)
                labelling.append(labelled - start)
                writing.append(clocks() - labelled)
        label, write = np.median(labelling, axis=0), np.median(writing, axis=0)
        figure(label[0], "s", name, "label")
        figure(write[0], "s", name, "write")
        print(
            f"  label {label[0]:.3f} + write {write[0]:.3f} = {label[0] + write[0]:.3f} s "
            f"(wall {label[1] + write[1]:.3f} s): {name}; image {spec.output.image}"
        )


if __name__ == "__main__":
    main()
