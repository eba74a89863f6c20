"""Fit of a capture by mitsplat and by gsplat: held-out PSNR and SSIM, and time, in one table.

    python -m benchmarks.assets.fit CAPTURE --device cuda --gsplat
    python -m benchmarks.assets.fit --synthetic spur_gear --device cuda --iterations 3000

The second command renders photos of an asset's splats and fits them with all default settings of a fit. It also prints
the time of kernels in a step, measured kernel by kernel in a few steps, and the rest.

gsplat follows its ``examples/simple_trainer.py mcmc``: same photos, split, seeds, losses, rates and budget; its
D-SSIM is computed by PyTorch's convolutions. gsplat takes pinhole cameras only: undistort a capture's photos first.
"""

from __future__ import annotations

import argparse
import hashlib
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

# isort: off
from mitsplat.runtime.device import use_device  # which must be imported before Dr.Jit

import drjit as dr
import numpy as np

# isort: on
from benchmarks.assets.photographed import photograph_asset
from benchmarks.assets.strategy_classic import Classic
from benchmarks.record import ROOT, figure, recording
from mitsplat.capture.capture import Capture
from mitsplat.fit.fit_settings import FitProgress, FitSettings
from mitsplat.fit.initial_points import seed_points
from mitsplat.fit.strategy_mcmc import seed_splats
from mitsplat.fit.trainer import fit_capture
from mitsplat.fit.training_view import TrainingView
from mitsplat.runtime import recorded_kernels as recorded


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--synthetic", metavar="ASSET", help="asset of scenes/assets, instead of a capture")
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--max-size", type=int, default=800)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--replay", choices=("on", "off"), default="on", help="record and replay kernels")
    parser.add_argument("--classic", action="store_true", help="classic densification of 3DGS instead of MCMC")
    parser.add_argument("--gsplat", action="store_true")
    args = parser.parse_args()
    if (args.capture is None) == (args.synthetic is None):
        parser.error("give a capture, or --synthetic")
    device = use_device(args.device)
    recorded.REPLAY = args.replay == "on"
    with recording("assets.fit", parser, args, gpu=device.kind == "cuda"), tempfile.TemporaryDirectory() as folder:
        settings = FitSettings(gaussians=args.gaussians, iterations=args.iterations, max_size=args.max_size)
        if args.synthetic:
            capture = photograph_asset(ROOT / "scenes/assets" / args.synthetic, Path(folder), args.max_size)
        else:
            capture = Capture.load(args.capture)
            settings = replace(
                settings, masks="off", background="black", coarse=0.0, opacity_weight=0.01, depth_weight=0.0
            )
        if args.classic:  # the strategy removes large Gaussians itself
            settings = replace(settings, scale_weight=0.0)
        compare(args, capture, settings)


def compare(args: argparse.Namespace, capture: Capture, settings: FitSettings) -> None:
    print(f"{len(capture.photos)} photos, {args.gaussians} Gaussians, {args.iterations} iterations, {args.max_size} px")
    print("fit                  s      PSNR    SSIM   Gaussians")
    watch = Watch(settings.iterations)
    with tempfile.TemporaryDirectory() as folder:
        classic = Classic(settings.gaussians, settings.refine_every) if args.classic else None
        own = fit_capture(capture, folder, settings, densification=classic, progress=watch)
        digest = hashlib.sha256((Path(folder) / "splats.ply").read_bytes()).hexdigest()
    keep("mitsplat", own.seconds, own.psnr, own.ssim, len(own.splats))
    print(f"mitsplat {args.device:11} {own.seconds:7.1f} {own.psnr:7.2f} {own.ssim:7.4f} {len(own.splats)}")
    print(f"    splats.ply has SHA-256 {digest[:16]}")
    watch.say()
    if args.gsplat:
        seconds, psnr, ssim, count = fit_with_gsplat(capture, settings)
        keep("gsplat", seconds, psnr, ssim, count)
        print(f"gsplat               {seconds:7.1f} {psnr:7.2f} {ssim:7.4f} {count}")


class Watch:
    """Timer of the steps between a fit's reports, and of the kernels in one interval.

    Args:
        iterations: Steps of the fit.
    """

    def __init__(self, iterations: int) -> None:
        self.before, self.timed = int(0.7 * iterations), int(0.9 * iterations)
        self.last: tuple[int, float] | None = None
        self.spans: list[float] = []
        self.kernels, self.launches, self.compiled = 0.0, 0.0, 0

    def __call__(self, now: FitProgress) -> None:
        """Record a report of the fit."""
        at = time.perf_counter()
        counting = dr.flag(dr.JitFlag.KernelHistory)
        if self.last is not None and now.step > self.before:
            steps = now.step - self.last[0]
            if counting:
                history = dr.kernel_history()
                self.kernels = sum(entry["execution_time"] for entry in history) / steps
                self.launches = len(history) / steps
                self.compiled = sum(not entry.get("cache_hit", True) for entry in history)
                self.timed = 1 << 60
            else:
                self.spans.append(1e3 * (at - self.last[1]) / steps)
        dr.set_flag(dr.JitFlag.KernelHistory, now.step >= self.timed)
        dr.kernel_history_clear()
        self.last = now.step, time.perf_counter()

    def say(self) -> None:
        """Print and record the time of a step after 70 % of the fit, where the number of Gaussians is constant."""
        dr.set_flag(dr.JitFlag.KernelHistory, False)
        if not (self.spans and self.launches):
            return
        step = statistics.median(self.spans)
        print(
            f"    {step:.2f} ms a step, {self.kernels:.2f} of them in kernels, {self.launches:.0f} launches, "
            f"{self.compiled} kernels compiled in the timed steps"
        )
        for value, unit, name in (
            (step, "ms", "step"),
            (self.kernels, "ms", "kernels"),
            (self.launches, "", "launches"),
            (self.compiled, "", "compiled"),
        ):
            figure(value, unit, "mitsplat", "a step", name)


def keep(name: str, seconds: float, psnr: float, ssim: float, count: int) -> None:
    """Record a row."""
    figure(seconds, "s", name, "seconds")
    figure(psnr, "dB", name, "psnr")
    figure(ssim, "", name, "ssim")
    figure(count, "", name, "gaussians")


def fit_with_gsplat(capture: Capture, settings: FitSettings) -> tuple[float, float, float, int]:
    """Fit with gsplat; return seconds, held-out PSNR [dB] and SSIM, and the number of Gaussians."""
    import torch
    from gsplat import rasterization
    from gsplat.strategy import MCMCStrategy

    torch.manual_seed(settings.seed)
    scale = min(1.0, settings.max_size / max(capture.photos[0].camera.width, capture.photos[0].camera.height))
    sights = [TrainingView(photo, scale, masked=False) for photo in capture.training]
    held_out = [TrainingView(photo, scale, masked=False) for photo in capture.held_out]
    centres = np.array([sight.camera.centre for sight in sights])
    extent = 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    rng = np.random.default_rng([settings.seed, 0])
    cameras, seen = [sight.camera for sight in sights], [photo.seen for photo in capture.training]
    points, colours = seed_points(capture.points, capture.colours, cameras, seen, None, rng, settings.gaussians)
    start = seed_splats(points / extent, colours, settings.sh_degree)

    def leaf(values: np.ndarray) -> torch.nn.Parameter:
        return torch.nn.Parameter(torch.tensor(values, dtype=torch.float32, device="cuda"))

    params = torch.nn.ParameterDict(
        {
            "means": leaf(start.means),
            "scales": leaf(np.log(start.scales)),
            "quats": leaf(start.quats[:, [3, 0, 1, 2]]),
            "opacities": leaf(np.log(start.opacities / (1 - start.opacities))),
            "sh0": leaf(start.sh[:, :1]),
            "shN": leaf(start.sh[:, 1:]),
        }
    )
    rates = {"means": settings.rate_means, "scales": settings.rate_scales, "quats": settings.rate_quats}
    rates |= {"opacities": settings.rate_opacities, "sh0": settings.rate_sh, "shN": settings.rate_sh / 20}
    optimisers = {k: torch.optim.Adam([{"params": params[k], "lr": r, "name": k}], eps=1e-15) for k, r in rates.items()}
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimisers["means"], 0.01 ** (1 / settings.iterations))
    strategy = MCMCStrategy(
        cap_max=settings.gaussians,
        refine_start_iter=settings.iterations // 50,
        refine_stop_iter=settings.iterations * 4 // 5,
        refine_every=settings.refine_every,
    )
    strategy.check_sanity(params, optimisers)
    state = strategy.initialize_state()

    def tensors(sight: TrainingView) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        view = sight.camera.camera_from_world.copy()
        view[:3, 3] /= extent
        colour = sight.picture.astype(np.float32)
        return tuple(
            torch.tensor(v, dtype=torch.float32, device="cuda") for v in (view, sight.camera.intrinsics, colour)
        )

    def render(sight: TrainingView, degree: int) -> tuple[torch.Tensor, dict[str, object]]:
        view, intrinsics, _ = data[id(sight)]
        picture, _, info = rasterization(
            params["means"],
            params["quats"],
            torch.exp(params["scales"]),
            torch.sigmoid(params["opacities"]),
            torch.cat([params["sh0"], params["shN"]], 1),
            view[None],
            intrinsics[None],
            sight.camera.width,
            sight.camera.height,
            sh_degree=degree,
            packed=False,
        )
        return picture[0], info

    data = {id(sight): tensors(sight) for sight in (*sights, *held_out)}
    taps = torch.exp(-0.5 * (torch.arange(-5, 6, device="cuda") / 1.5) ** 2)
    window = torch.outer(taps / taps.sum(), taps / taps.sum()).expand(3, 1, 11, 11)

    def ssim(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        a, b = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]
        maps = torch.cat([a, b, a * a, b * b, a * b])
        ma, mb, aa, bb, ab = torch.nn.functional.conv2d(maps, window, padding=5, groups=3)
        top = (2 * ma * mb + 1e-4) * (2 * (ab - ma * mb) + 9e-4)
        return (top / ((ma * ma + mb * mb + 1e-4) * (aa - ma * ma + bb - mb * mb + 9e-4))).mean()

    torch.cuda.synchronize()
    began = time.monotonic()
    for step in range(settings.iterations):
        epoch, turn = divmod(step, len(sights))
        number = int(np.random.default_rng([settings.seed, 1, epoch]).permutation(len(sights))[turn])
        sight = sights[number]
        seen_now, info = render(sight, min(settings.sh_degree, 5 * step // settings.iterations))
        truth = data[id(sight)][2]
        loss = (1 - settings.ssim_share) * (seen_now - truth).abs().mean()
        loss = loss + settings.ssim_share * (1 - ssim(seen_now, truth))
        loss = loss + settings.opacity_weight * torch.sigmoid(params["opacities"]).mean()
        loss = loss + settings.scale_weight * torch.exp(params["scales"]).mean()
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        rate = schedule.get_last_lr()[0]
        schedule.step()
        strategy.step_post_backward(params, optimisers, state, step, info, lr=rate)
    torch.cuda.synchronize()
    seconds = time.monotonic() - began
    with torch.no_grad():
        pictures = [render(sight, settings.sh_degree)[0].cpu().numpy() for sight in held_out]
    found = [sight.compare(picture, None) for sight, picture in zip(held_out, pictures, strict=True)]
    mean = np.mean([[photo.psnr, photo.ssim] for photo in found], axis=0)
    return seconds, float(mean[0]), float(mean[1]), len(params["means"])


if __name__ == "__main__":
    main()
