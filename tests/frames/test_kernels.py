"""Kernel compilation: later frames reuse compiled kernels."""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.frames.frame import Renderer
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import render_layers, render_silhouettes
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightDraw

WORKCELL = Path(__file__).parents[2] / "scenes/workcell.yaml"


@pytest.fixture(autouse=True)
def nothing_of_earlier_tests() -> None:
    """Free emitters and materials of earlier tests.

    Kernels cover all kinds of emitters and materials that exist; if some were freed during a test, other kernels would
    be compiled.
    """
    gc.collect()


def strewn(index: int, assets: list[int]) -> Layout:
    """Return an unsettled layout of the workcell: objects side by side over the mat."""
    instances = []
    for number, asset in enumerate(assets, start=1):
        pose = np.eye(4)
        pose[:3, 3] = 0.06 * (number % 3 - 1), -0.08 + 0.06 * (number // 3 - 1), 0.02
        instances.append(Instance(number, asset, 0, pose))
    return Layout(index, tuple(instances), NO_PHYSICS)


def compiled(renderer: Renderer, index: int, layout: Layout) -> tuple[int, int]:
    """Count the kernels that a frame runs, and those not run by any earlier frame.

    All objects are in view, and none reaches the camera's plane: such rare views need a few kernels of their own. The
    focal length differs between frames.
    """
    plan = plan_frame(renderer.scene, index)
    azimuth = np.radians(180 + 37 * index % 220)  # in the scene's range of azimuths, not from behind the wall
    eye = 0.4 * np.cos(azimuth), 0.4 * np.sin(azimuth) - 0.08, 0.5
    camera = Camera.look_at(eye, (0, -0.08, 0), width=96, height=54, fov_x=50 - index / 10)
    dr.kernel_history_clear()
    scene = mi.load_dict(renderer.scene_builder.describe(layout, plan.lights))
    render_layers(renderer.integrator, scene, camera, seed=plan.seed)
    render_silhouettes(renderer.integrator, scene, camera)
    run = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    return len(run), sum(not entry["cache_hit"] or entry["cache_disk"] for entry in run)


def test_another_layout_compiles_no_new_kernels() -> None:
    scene = load_scene(WORKCELL)
    with Renderer(scene) as renderer, dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        first = strewn(0, [0, 1, 2, 3, 3])
        # The first view of a layout builds data shared by its other views.
        compiled(renderer, 0, first)
        usual, _ = compiled(renderer, 1, first)
        for index, layout in (
            (2, first),
            (12, strewn(1, [4, 5, 6, 7, 8])),
            (13, strewn(1, [4, 5, 6, 7, 8])),
            (24, strewn(2, [9, 2, 10, 11, 5, 4, 3])),
        ):
            run, new = compiled(renderer, index, layout)
            assert run > 50
            # Dr.Jit evaluates scheduled arrays of equal size in one kernel: where two sizes happen to be equal, one new
            # kernel replaces two.
            assert new <= max(usual - run, 0), f"frame {index}: {new} of {run} kernels"


@pytest.mark.extended
def test_drawn_lights_compile_no_new_kernels() -> None:
    """Position, size, radiance and number of up to four lights vary; each set of kinds was rendered before."""
    scene = load_scene(WORKCELL)
    sides = LightDraw(vary="frame", count=(0, 3), distance=(0.5, 1.5), size=((0.1, 0.1), (0.4, 0.2)))
    lights = (AreaLight(draw=sides), EnvironmentLight(draw=LightDraw(vary="frame", radiance=(0.3, 1.0))))
    scene = replace(scene, spec=scene.spec.model_copy(update={"lights": lights}))
    numbers = [len(plan_frame(scene, index).lights) for index in range(40)]
    layout = strewn(0, [0, 1, 2, 3, 3])
    with Renderer(scene) as renderer, dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        # The second view of a layout builds data shared by its other views. On a GPU, a single emitter has kernels of
        # its own after several emitters were rendered.
        for number in (1, 2, 1):
            for _ in range(2):
                compiled(renderer, numbers.index(number), layout)
        for number in (1, 2, 3, 4):
            last = max(index for index, lights in enumerate(numbers) if lights == number)
            run, new = compiled(renderer, last, layout)
            assert run > 50 and new == 0, f"{number} lights: {new} of {run} kernels"
