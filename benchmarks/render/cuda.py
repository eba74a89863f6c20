"""Time of the renderer on a GPU, stage by stage, compared with gsplat and Mitsuba's splat renderer on the same splats.

    python -m benchmarks.render.cuda [--captures FOLDER] [--no-volprim] [--frames 30]

gsplat and PyTorch are used if installed. Times are medians of synchronised repeats. Stages of whole frames are those of
one process and one layout of the default scene; ``--frames 0`` omits them, and the settling.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

# isort: off
from benchmarks.render.captures import CAMERA, CAPTURES, crowd  # imports mitsplat, which must be imported before Dr.Jit

import drjit as dr
import mitsuba as mi
import numpy as np

# isort: on
from benchmarks.record import ROOT, figure, recording
from benchmarks.render.frame import time_frames
from benchmarks.render.volprim import render_volprim, volprim_scene
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.images.colour import encode_srgb
from mitsplat.quality import resolve_quality
from mitsplat.renderer.layers import make_sensor, render_splats


def median_ms(run: Callable[[], object], sync: Callable[[], None], repeats: int = 30) -> float:
    """Return the median time of a synchronised call [ms], after three calls to warm up."""
    times = []
    for i in range(repeats + 3):
        sync()
        start = time.perf_counter()
        run()
        sync()
        if i >= 3:
            times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def time_ours(splats: Splats) -> None:
    """Print the time of binning and march, per preset."""
    from mitsplat.renderer.projection.clouds import Placement, merge_clouds, upload_cloud
    from mitsplat.renderer.rays.sensors import view_of
    from mitsplat.renderer.splatting.march import march
    from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians

    clouds = merge_clouds([upload_cloud(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)])
    camera = view_of(make_sensor(CAMERA))
    placements = [Placement(0, np.eye(4), 1)]
    for name in ("fast", "balanced"):
        quality = resolve_quality(name)
        view = camera.sampled(quality.samples)

        def run_bin(view=view, quality=quality) -> TileLists:
            return bin_gaussians(clouds, placements, view, quality)

        lists = run_bin()

        def run_march(lists=lists, view=view, quality=quality) -> None:
            image = march(lists, view, quality)
            dr.eval(image.rgb, image.alpha)

        def run_all(run_bin=run_bin, run_march=run_march) -> None:
            run_march(run_bin())

        binning = median_ms(run_bin, dr.sync_thread)
        marching, whole = median_ms(run_march, dr.sync_thread), median_ms(run_all, dr.sync_thread)
        print(f"mitsplat {name}: whole {whole:.2f} ms (project, bin, sort {binning:.2f}, march {marching:.2f}), "
              f"{lists.visible} visible, {lists.pairs} pairs")  # fmt: skip

        def run_picture(name=name) -> np.ndarray:
            return render_splats(splats, CAMERA, quality=name).rgb

        pictured = median_ms(run_picture, dr.sync_thread)
        print(f"  render_splats with its picture on the host: {pictured:.2f} ms")
        for part, milliseconds in {"whole": whole, "bin": binning, "march": marching, "picture": pictured}.items():
            figure(milliseconds, "ms", name, part)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            run_all()
            kernels = dr.kernel_history()
        inside = sum(k["execution_time"] for k in kernels)
        figure(inside, "ms", name, "kernels")
        print(f"  of which inside kernels: {inside:.2f} ms in {len(kernels)} launches")


def time_gsplat(splats: Splats) -> np.ndarray:
    """Print the time of gsplat's forward pass; return its display-encoded image."""
    import torch
    from gsplat import rasterization

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(np.asarray(values, dtype=np.float32), device="cuda")

    data = tensor(splats.means), tensor(splats.quats[:, [3, 0, 1, 2]]), tensor(splats.scales), tensor(splats.opacities)
    view, intrinsics = tensor(CAMERA.camera_from_world)[None], tensor(CAMERA.intrinsics)[None]
    degree = splats.sh_degree

    def run() -> torch.Tensor:
        with torch.no_grad():
            image, _, _ = rasterization(
                *data, tensor_sh, view, intrinsics, CAMERA.width, CAMERA.height, sh_degree=degree, packed=False
            )
        return image

    tensor_sh = tensor(splats.sh)
    milliseconds = median_ms(run, torch.cuda.synchronize)
    figure(milliseconds, "ms", "gsplat")
    print(f"gsplat forward: {milliseconds:.2f} ms")
    return run()[0].cpu().numpy()


def main() -> None:
    """Parse the command line and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", type=Path, default=CAPTURES)
    parser.add_argument("--no-volprim", action="store_true")
    parser.add_argument("--frames", type=int, default=30)
    options = parser.parse_args()
    mi.set_variant("cuda_ad_rgb")
    with recording("render.cuda", parser, options, ignore=("captures",), gpu=True):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Print and record every time."""
    splats, name = crowd(options.captures)
    figure(len(splats), "", "gaussians")
    print(f"{name}, {CAMERA.width}x{CAMERA.height}")
    time_ours(splats)
    if options.frames:
        time_frames(ROOT / "scenes/workcell.yaml", options.frames, {})
    if not options.no_volprim:
        scene = volprim_scene(splats, CAMERA)
        milliseconds = median_ms(lambda: render_volprim(scene), dr.sync_thread, 3)
        figure(milliseconds, "ms", "volprim")
        print(f"ellipsoids + volprim_rf_basic: {milliseconds:.0f} ms")
    try:
        import gsplat  # noqa: F401
    except ImportError:
        print("gsplat is not installed")
        return
    theirs = time_gsplat(splats)
    layers = render_splats(splats, CAMERA)
    ours = encode_srgb(layers.rgb)
    error = np.mean((np.clip(theirs, 0, 1) - np.clip(ours, 0, 1)) ** 2)
    figure(-10 * np.log10(error), "dB", "gsplat", "psnr")
    print(f"difference of the two images: {-10 * np.log10(error):.1f} dB (alpha is not composited alike)")


if __name__ == "__main__":
    main()
