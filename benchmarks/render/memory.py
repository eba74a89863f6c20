"""Peak memory of stages that grow with a scene, each in its own process.

    python -m benchmarks.render.memory [--gaussians 5000000] [--objects 200] [--variant llvm_ad_rgb]

Images are 1280x720. Memory is that of the process [GiB]: after loading the case's data, and its peak.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

# isort: off
from benchmarks.render.captures import CAMERA, synthetic  # imports mitsplat, which must be imported before Dr.Jit

import drjit as dr
import mitsuba as mi
import numpy as np

# isort: on
from benchmarks.record import figure, recording
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers, render_silhouettes
from mitsplat.runtime.variant import ensure_variant


def peak() -> float:
    """Return the peak memory of this process so far [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def report(name: str, run: Callable[[], object]) -> None:
    """Run a case, and print its additional memory."""
    before = peak()
    run()
    dr.sync_thread()
    figure(before, "GiB", "loaded")
    figure(peak(), "GiB", "peak")
    figure(peak() - before, "GiB", "added")
    print(f"{name:60s}{before:7.2f} loaded{peak():7.2f} at most", flush=True)


def forward(count: int) -> None:
    """Render an image of many Gaussians."""
    scene = mi.load_dict({"type": "scene", "splats": make_splats_shape(synthetic(count), instance=1)})
    integrator = make_integrator(quality="fast", shadow="none")
    report(f"render {count} Gaussians", lambda: render_layers(integrator, scene, CAMERA))


def backward(count: int) -> None:
    """Compute the gradients of an image of many Gaussians."""
    from mitsplat.renderer.differentiation.backward import pack_cloud, render_differentiable
    from mitsplat.renderer.layers import make_sensor
    from mitsplat.renderer.rays.sensors import view_of

    splats = synthetic(count)
    names = ("means", "quats", "scales", "opacities", "sh")
    inputs = [mi.Float(np.asarray(getattr(splats, name)).ravel()) for name in names]
    dr.enable_grad(inputs)
    means, quats, scales, opacities, sh = inputs

    def run() -> None:
        cloud = pack_cloud(means, quats, scales, opacities, sh, splats.sh.shape[1])
        rgb, alpha = render_differentiable(cloud, view_of(make_sensor(CAMERA)), Quality())
        dr.backward(dr.sum(sum(rgb, alpha)))
        dr.eval(*(dr.grad(value) for value in inputs))

    report(f"gradients of {count} Gaussians", run)


def silhouettes(objects: int) -> None:
    """Render silhouettes of many objects of 2000 Gaussians each."""
    rng, splats = np.random.default_rng(0), synthetic(2000)
    splats = replace(splats, means=0.04 * splats.means, scales=0.04 * splats.scales)
    shapes: dict[str, Any] = {}
    for number in range(1, objects + 1):
        pose = np.eye(4)
        pose[:3, 3] = CAMERA.world_from_camera[:3] @ (*rng.uniform((-1.2, -0.7), (1.2, 0.7)), 2.0, 1.0)
        shapes[f"instance_{number}"] = make_splats_shape(splats, pose, instance=number)
    scene = mi.load_dict({"type": "scene", **shapes})
    integrator = make_integrator(quality=PRESETS["fast"], shadow="none")
    render_layers(integrator, scene, CAMERA)
    report(f"silhouettes of {objects} objects", lambda: render_silhouettes(integrator, scene, CAMERA))


CASES = {"forward": forward, "backward": backward, "silhouettes": silhouettes}


def main() -> None:
    """Parse the command line, and run each case in its own process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    parser.add_argument("--objects", type=int, default=200)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--case", choices=CASES, help="run this case in this process")
    options = parser.parse_args()
    if options.case is None:
        for case in CASES:
            subprocess.run(
                [sys.executable, "-m", "benchmarks.render.memory", *sys.argv[1:], "--case", case], check=True
            )
        return
    mi.set_variant(options.variant)
    ensure_variant()
    with recording("render.memory", parser, options, gpu=options.variant.startswith("cuda")):
        CASES[options.case](options.objects if options.case == "silhouettes" else options.gaussians)


if __name__ == "__main__":
    main()
