"""Settling time of the layouts of the detector's scenes, for ``python -m benchmarks.physics.settle layouts``.

Functions import modules of the detector experiment, because other measures run without its extras.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import lru_cache
from multiprocessing import get_context
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

if TYPE_CHECKING:
    from benchmarks.detector.material import Wanted
    from mitsplat.physics.drop import Drop

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
    if wanted.kind == "bags" and isinstance(mesh, trimesh.Trimesh):
        pieces, shape = hulls_of(mesh), trimesh.Trimesh(mesh.vertices, mesh.faces)
    else:
        pieces = [parts_hull(mesh, up)]
        shape = pieces[0]
    name = wanted.name if wanted.kind == "groceries" else "package"
    Asset(wanted.name, name, POINT, mesh=shape, pieces=tuple(pieces), density=DENSITY).save(wanted.out(work))


def time_layouts(hope: Path, work: Path, count: int, processes: int) -> None:
    """Print and record CPU seconds of the first layouts of each scene; missing assets are written to ``work``."""
    from benchmarks.detector.experiment import write_scene
    from benchmarks.detector.material import wanted_assets

    for wanted in wanted_assets(hope):
        if not (wanted.out(work) / "asset.yaml").exists():
            write_body(wanted, work)
    everything: list[float] = []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for name in SCENES:
            path = write_scene(work, name)
            rows = list(pool.map(time_layout, [(path, index, count) for index in range(count)]))
            seconds, draws, left_out = (np.array(column) for column in zip(*rows, strict=True))
            everything += seconds.tolist()
            for value, unit, what in (
                (np.median(seconds), "s", "median cpu"),
                (seconds.max(), "s", "slowest cpu"),
                (draws.mean(), "", "draws per layout"),
                (left_out.sum(), "", "left out"),
            ):
                figure(value, unit, name, what)
            print(
                f"{name}: {np.median(seconds):.2f} CPU s (median), {seconds.max():.2f} (slowest, layout "
                f"{seconds.argmax()}), {draws.mean():.2f} draws per layout, {left_out.sum()} objects left out",
                flush=True,
            )
    figure(len(everything), "", "all", "layouts")
    figure(np.median(everything), "s", "all", "median cpu")
    figure(max(everything) / np.median(everything), "", "all", "slowest by median")
    print(
        f"slowest: {max(everything) / np.median(everything):.1f} times the median of {np.median(everything):.2f} CPU s"
    )


def time_layout(job: tuple[Path, int, int]) -> tuple[float, int, int]:
    """Return CPU seconds of a layout, and the numbers of draws and of objects left out.

    Args:
        job: Scene file, index of the layout, and number of layouts.
    """
    path, index, count = job
    drop = _make_drop(path, count)
    with warp_settings():
        start = time.process_time()
        try:
            layout = drop.settle(index)
        except UnsettledLayoutError as error:
            layout = error.layout
        return time.process_time() - start, layout.certificate.attempts, len(layout.left_out)


@lru_cache(maxsize=1)
def _make_drop(path: Path, count: int) -> Drop:
    """Prepare the simulation of a scene; its last layout loads libraries."""
    from mitsplat.physics.drop import drop_of

    with warp_settings():
        drop = drop_of(load_scene(path, overrides={"output.layouts": count + 1}), lambda text: None)
        with suppress(UnsettledLayoutError):
            drop.settle(count)
    return drop
