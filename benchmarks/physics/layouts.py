"""Settling time of the layouts of the detector's scenes, for ``python -m benchmarks.physics.settle layouts``.

Functions import modules of the detector experiment, because other measures run without its extras.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from benchmarks.record import figure
from mitsplat.asset import Asset
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.physics.settle import warp_settings
from mitsplat.scene.layout import UnsettledLayoutError
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.scene import Scene

if TYPE_CHECKING:
    from benchmarks.detector.material import Wanted

SCENES = ("table", "seat", "carton", "stood", "packed")

POINT = Splats(
    means=np.zeros((1, 3), np.float32),
    quats=np.float32([[0, 0, 0, 1]]),
    scales=np.full((1, 3), 1e-3, np.float32),
    opacities=np.ones(1, np.float32),
    sh=np.zeros((1, 1, 3), np.float32),
)
"""Splats of assets that are simulated, but not rendered."""


def write_body(wanted: Wanted, work: Path) -> None:
    """Write an asset of :mod:`benchmarks.detector.material` with its mass and collision shape, but one Gaussian."""
    from benchmarks.detector.material import DENSITY, UP, hulls_of, parts_hull

    if wanted.kind == "brands":  # the scan's shape
        mesh, up = wanted.scan, UP.get(wanted.scan.stem, "y")
    else:
        mesh, up = wanted.mesh()
    bag = wanted.kind == "bags" and isinstance(mesh, trimesh.Trimesh)
    pieces = hulls_of(mesh) if bag else [parts_hull(mesh, up)]
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces) if bag else pieces[0]
    name = wanted.name if wanted.kind == "groceries" else "package"
    Asset(wanted.name, name, POINT, mesh=shape, pieces=tuple(pieces), density=DENSITY).save(wanted.out(work))


def time_layouts(hope: Path, work: Path, count: int) -> None:
    """Print and record CPU seconds of the first layouts of each scene; missing assets are written to ``work``."""
    from benchmarks.detector.experiment import write_scene
    from benchmarks.detector.material import wanted_assets

    for wanted in wanted_assets(hope):
        if not (wanted.out(work) / "asset.yaml").exists():
            write_body(wanted, work)
    everything: list[float] = []
    for name in SCENES:
        scene = load_scene(write_scene(work, name), overrides={"output.layouts": count + 1})
        seconds, draws, left_out = time_scene(scene, count)
        everything += seconds
        for value, unit, what in (
            (np.median(seconds), "s", "median cpu"),
            (max(seconds), "s", "slowest cpu"),
            (draws / count, "", "draws per layout"),
            (left_out, "", "left out"),
        ):
            figure(value, unit, name, what)
        print(
            f"{name}: {np.median(seconds):.2f} CPU s (median), {max(seconds):.2f} (slowest), "
            f"{draws / count:.1f} draws per layout, {left_out} objects left out",
            flush=True,
        )
    figure(np.median(everything), "s", "all", "median cpu")
    figure(max(everything) / np.median(everything), "", "all", "slowest by median")
    print(
        f"slowest: {max(everything) / np.median(everything):.1f} times the median of {np.median(everything):.2f} CPU s"
    )


def time_scene(scene: Scene, count: int) -> tuple[list[float], int, int]:
    """Return CPU seconds of each layout after the first one, and the numbers of draws and of objects left out."""
    from mitsplat.physics.drop import drop_of

    seconds, draws, left_out = [], 0, 0
    with warp_settings():
        drop = drop_of(scene, lambda text: None)
        for index in (count, *range(count)):  # the first one loads libraries
            start = time.process_time()
            try:
                layout = drop.settle(index)
            except UnsettledLayoutError as error:
                layout = error.layout
            if index < count:
                seconds.append(time.process_time() - start)
                draws += layout.certificate.attempts
                left_out += len(layout.left_out)
    return seconds, draws, left_out
