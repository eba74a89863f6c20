"""Correlation of an asset's verdict with its true errors, on captures of known solids with one fault each.

    python -m benchmarks.assets.verdicts OUT [--only NAME ...] [--judge]

Solids on a board, or on a cloth among other objects, are path-traced in a few small photographs. Faults are too few
photos, photos from one side, blur, noise, no texture, gloss, drifting exposure, and others. The cameras are given, in
unknown units, because structure from motion rarely works with photographs as small as these. The figures of an asset's
verdict are compared with its true errors in views from all around without photos: by rank correlation (Spearman), and
by agreement between a passed verdict and a good asset. OUT stores finished captures for later runs. ``--judge`` repeats
the verdicts of the same fits, and ``--done`` only evaluates results of an earlier run.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import shift
from scipy.stats import bootstrap, spearmanr

from benchmarks.assets.clutter import room, transforms, walk
from benchmarks.assets.judged import on_truth
from benchmarks.assets.known import BOARD, chamfer, solid, speckled, table_scene
from benchmarks.assets.photographing import by_name, photograph, show_where
from benchmarks.record import figure, recording
from mitsplat.asset import Asset
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.errors import InputError
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import spiral
from mitsplat.images.masks import iou
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE, show_asset
from mitsplat.reconstruct.pipeline.asset_pipeline import asset_from_photos
from mitsplat.reconstruct.reconstruct import AssetJob, ReconstructSettings
from mitsplat.reconstruct.surface import SurfaceSettings
from mitsplat.runtime.variant import ensure_variant

WIDTH, SAMPLES = 320, 12
AROUND, CLOSE, FINE = 8, 26.0, 24
"""Number of views of the comparison, their field of view [degrees], and samples per pixel."""
FIT = FitSettings(gaussians=4000, iterations=500, max_size=WIDTH)
SURFACE = SurfaceSettings(voxels=96, faces=4000)
GOOD = {"psnr": 24.0, "splat_iou": 0.95, "mesh_iou": 0.94, "chamfer": 1.0, "scale": 1.0}
"""True errors of a good asset: thresholds of the verdict, 1 % of the diagonal, and 1 % of the scale."""
MOST = {"chamfer", "scale", "cut"}
"""Truths, and figures of a verdict, of which less is better."""
MOST_OF_VERDICT = {"offset", "spread", "lost", "scale_error"}
STANDS_FOR = (
    ("psnr", "psnr"),
    ("psnr_object", "psnr"),
    ("splat_iou", "splat_iou"),
    ("mesh_iou", "mesh_iou"),
    ("mesh_iou", "chamfer"),
    ("spread", "chamfer"),
    ("offset", "chamfer"),
    ("lost", "cut"),
    ("scale_error", "scale"),
)
"""True error that each figure of the verdict estimates."""
RESAMPLES = 2000


@dataclass(frozen=True)
class Case:
    """A capture and its fault.

    Attributes:
        name: Name of the capture.
        shape: Key of ``SHAPES``.
        cloth: True for a cloth in a cluttered room with a given size, False for a board.
        photos: Number of photos.
        arc: Share of the circle covered by photos.
        heights: Share of the rising rounds covered by photos.
        blur: Longest motion blur [px]; every photo has its own length and direction.
        noise: Standard deviation in display-encoded values.
        contrast: Contrast of the speckles.
        finish: (metallic, roughness) of a principled BSDF, or matt.
        drift: Standard deviation of the logarithm of the exposure.
        beside: True if another object is at the point that the cameras look at.
        sunk: Depth of the solid in its support [m].
        zoom: Focal length relative to the usual one.
    """

    name: str
    shape: str = "solid"
    cloth: bool = False
    photos: int = 36
    arc: float = 1.0
    heights: float = 1.0
    blur: float = 0.0
    noise: float = 0.008
    contrast: float = 1.6
    finish: tuple[float, float] | None = None
    drift: float = 0.0
    beside: bool = False
    sunk: float = 0.0
    zoom: float = 1.0


CASES = (
    Case("board"),
    Case("cloth", cloth=True, photos=36),
    Case("bowl", "bowl"),
    Case("bracket", "bracket"),
    Case("plate", "plate"),
    Case("twelve photos", photos=12),
    Case("eight photos", photos=8),
    Case("sixteen photos on cloth", cloth=True, photos=16),
    Case("half around", photos=20, arc=0.5),
    Case("third around", photos=20, arc=0.33),
    Case("half around on cloth", cloth=True, photos=24, arc=0.5),
    Case("low only", photos=24, heights=0.33),
    Case("slight blur", blur=4.0),
    Case("heavy blur", blur=14.0),
    Case("blur on cloth", cloth=True, photos=36, blur=7.0),
    Case("noise", noise=0.05),
    Case("heavy noise", noise=0.12),
    Case("no texture", contrast=0.0),
    Case("no texture on cloth", cloth=True, photos=36, contrast=0.0),
    Case("gloss", finish=(0.0, 0.15)),
    Case("metal", finish=(0.9, 0.2)),
    Case("metal bracket", "bracket", finish=(0.9, 0.25), photos=20),
    Case("thing beside", cloth=True, photos=36, beside=True),
    Case("drift", drift=0.25),
    Case("drift on cloth", cloth=True, photos=36, drift=0.25),
    Case("sunk in cloth", cloth=True, photos=36, sunk=0.012),
    Case("small", zoom=0.5),
    Case("small on cloth", cloth=True, photos=36, zoom=0.6),
    Case("few noisy of a bowl", "bowl", photos=12, noise=0.03),
    Case("blurred plate", "plate", blur=6.0, photos=20),
    Case("sixty photos", photos=60),
    Case("close", zoom=1.4),
    Case("close plate", "plate", zoom=1.4),
    Case("close sixty photos", photos=60, zoom=1.4),
    Case("close slight blur", blur=4.0, zoom=1.4),
)


def bowl() -> trimesh.Trimesh:
    """Return a bowl, whose inside is in no silhouette."""
    outer = trimesh.creation.cylinder(0.045, 0.05, sections=64)
    inner = trimesh.creation.cylinder(0.039, 0.05, sections=64)
    inner.apply_translation((0, 0, 0.007))
    return trimesh.boolean.difference([outer, inner], engine="manifold")


def bracket() -> trimesh.Trimesh:
    """Return two plates at a right angle."""
    flat, up = trimesh.creation.box((0.09, 0.05, 0.012)), trimesh.creation.box((0.012, 0.05, 0.06))
    up.apply_translation((-0.039, 0, 0.024))
    return trimesh.boolean.union([flat, up], engine="manifold")


def plate() -> trimesh.Trimesh:
    """Return a slab of 8 mm."""
    return trimesh.creation.box((0.1, 0.07, 0.008))


SHAPES = {"solid": solid, "bowl": bowl, "bracket": bracket, "plate": plate}


def standing(case: Case) -> trimesh.Trimesh:
    """Return a case's solid in its pose [m]."""
    mesh = SHAPES[case.shape]()
    mesh.apply_translation((0, 0, -mesh.bounds[0, 2] - case.sunk))
    return mesh


def cameras(case: Case) -> list[Camera]:
    """Return hand-held cameras: samples of a longer walk around the given share of the circle."""
    whole = walk(round(case.photos / (case.arc * case.heights)), WIDTH)
    low = whole[: round(case.heights * len(whole))]
    turns = [np.arctan2(camera.centre[1], camera.centre[0]) % (2 * np.pi) / (2 * np.pi) for camera in low]
    taken = [camera for camera, turn in zip(low, turns, strict=True) if turn <= case.arc]
    return [replace(camera, fx=case.zoom * camera.fx, fy=case.zoom * camera.fy) for camera in taken]


def views_around(mesh: trimesh.Trimesh, width: int = WIDTH, lowest: float = 10.0) -> list[Camera]:
    """Return views of a solid from all around above its support, for which there are no photos."""
    sines = np.sin(np.radians(np.linspace(lowest, 65, AROUND)))
    middle = mesh.bounds.mean(axis=0)
    return [
        Camera.look_at(middle + 0.32 * way, middle, width=width, height=3 * width // 4, fov_x=CLOSE)
        for way in spiral(sines)
    ]


def spoil(clean: Path, photos: Path, case: Case) -> None:
    """Write photos with the case's faults."""
    rng = np.random.default_rng(6)
    photos.mkdir(parents=True, exist_ok=True)
    for path in sorted(clean.glob("*.png")):
        light = (np.array(Image.open(path)) / 255) ** 2.2 * np.exp(case.drift * rng.normal())
        length, turn = case.blur * rng.random(), np.pi * rng.random()
        if length > 0:
            steps = np.outer(np.linspace(-0.5, 0.5, 9), length * np.array([np.sin(turn), np.cos(turn), 0]))
            light = np.mean([shift(light, step, order=1, mode="nearest") for step in steps], axis=0)
        noisy = light.clip(0, 1) ** (1 / 2.2) + rng.normal(0, case.noise, light.shape)
        Image.fromarray(np.rint(255 * noisy.clip(0, 1)).astype(np.uint8)).save(photos / path.name)


def take(case: Case, mesh: trimesh.Trimesh, folder: Path) -> None:
    """Path-trace a case's photos and comparison views, with masks of the solid in these."""
    finish = None if case.finish is None else dict(zip(("metallic", "roughness"), case.finish, strict=True))
    shape = speckled(mesh, contrast=case.contrast, finish=finish)
    around = room(case.beside) if case.cloth else table_scene(BOARD, np.random.default_rng(5))
    scene = around | {"solid": shape}
    photograph(scene, cameras(case), folder / "clean", samples=SAMPLES, noise=0.0)
    spoil(folder / "clean", folder / "photos", case)
    views = views_around(mesh)
    photograph(scene, views, folder / "around", samples=FINE, noise=0.0)
    show_where(scene, "solid", views, folder / "shown")
    show_where({"type": "scene", "solid": shape}, "solid", views, folder / "alone")


def truth_of(case: Case, mesh: trimesh.Trimesh, folder: Path) -> dict[str, float]:
    """Compute the true errors of an asset, aligned by its cameras: shares, dB or %."""
    _, matrix, _ = on_truth(folder / "asset", by_name(cameras(case)))
    made = Asset.load(folder / "asset").transformed(matrix)
    views, colours, overlaps = views_around(mesh), [], []
    for name, view in zip(by_name(views), show_asset(made.splats, made.mesh, views), strict=True):
        shown, alone = (np.array(Image.open(folder / what / name)) > 0 for what in ("shown", "alone"))
        photo = np.array(Image.open(folder / "around" / name).convert("RGB")) / 255
        colours.append((photo[shown] ** 2.2, view.render[shown].clip(0, 1) ** 2.2))
        splats = view.alpha >= 0.5
        overlaps.append((iou(splats, alone), iou(view.mesh, alone), 1 - (splats & alone).sum() / alone.sum()))
    wanted, seen = (np.concatenate(parts) for parts in zip(*colours, strict=True))
    gain = (wanted * seen).sum(axis=0) / np.maximum((seen**2).sum(axis=0), 1e-9)
    error = ((wanted ** (1 / 2.2) - (seen * gain).clip(0, 1) ** (1 / 2.2)) ** 2).mean()
    splat_iou, mesh_iou, cut = np.mean(overlaps, axis=0)
    return {
        "psnr": float(-10 * np.log10(error)),
        "splat_iou": float(splat_iou),
        "mesh_iou": float(mesh_iou),
        "cut": float(cut),
        "chamfer": 100 * chamfer(made.mesh, mesh),
        "scale": 100 * abs(float(np.cbrt(np.linalg.det(matrix[:3, :3]))) - 1),
    }


def is_good(truth: Mapping[str, float]) -> bool:
    """Return True if an asset satisfies the thresholds of a good one."""
    return all(truth[name] <= limit if name in MOST else truth[name] >= limit for name, limit in GOOD.items())


def measure(case: Case, folder: Path, judge: bool) -> dict[str, Any]:
    """Return verdict and truth of a case, from an earlier run if it was made of the same case."""
    mesh, marker, done = standing(case), folder / "photos.json", folder / "done.json"
    made = json.dumps([asdict(case), WIDTH, SAMPLES, AROUND, CLOSE, FINE])
    if not (marker.exists() and marker.read_text() == made):
        shutil.rmtree(folder, ignore_errors=True)
        take(case, mesh, folder)
        marker.write_text(made)
    if done.exists() and not judge:
        return dict(json.loads(done.read_text()))
    (folder / "asset" / VERDICT_FILE).unlink(missing_ok=True)
    size = float(mesh.extents.max()) if case.cloth else None
    settings = ReconstructSettings(surface=SURFACE, view_size=WIDTH, verdict_size=WIDTH, size=size)
    poses = folder / "transforms.json"
    poses.write_text(json.dumps(transforms(by_name(cameras(case)))))
    found: dict[str, Any] = {"refused": None, "verdict": None, "misses": [], "truth": None}
    try:
        asset = asset_from_photos(
            folder / "photos",
            folder / "asset",
            AssetJob(name="known", settings=settings),
            capture=CaptureSettings(board=BOARD, poses=poses),
            fit=FIT,
        )
    except InputError as error:
        found["refused"] = str(error).replace(str(folder), "")
    else:
        found |= {
            "verdict": asdict(asset.verdict),
            "misses": asset.verdict.misses(),
            "truth": truth_of(case, mesh, folder),
        }
    done.write_text(json.dumps(found, indent=1))
    return found


def rank(results: Sequence[Mapping[str, Any]], figure_name: str, truth: str) -> tuple[float, float, float, int]:
    """Return Spearman's correlation of estimated and true quality, its 95 % interval, and the number of cases."""
    pairs = [
        (found["verdict"][figure_name], found["truth"][truth])
        for found in results
        if found["truth"] is not None and found["verdict"][figure_name] is not None
    ]
    if len({predicted for predicted, _ in pairs}) < 3:
        return np.nan, np.nan, np.nan, len(pairs)
    predicted, true = np.array(pairs).T
    predicted, true = (-predicted if figure_name in MOST_OF_VERDICT else predicted), (-true if truth in MOST else true)

    def statistic(x: np.ndarray, y: np.ndarray) -> float:
        return float(spearmanr(x, y).statistic) if np.ptp(x) and np.ptp(y) else 0.0

    span = bootstrap(
        (predicted, true), statistic, paired=True, vectorized=False, n_resamples=RESAMPLES, method="percentile", rng=0
    ).confidence_interval
    return statistic(predicted, true), float(span.low), float(span.high), len(pairs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=[case.name for case in CASES], help="names of cases to run")
    parser.add_argument("--judge", action="store_true", help="repeat verdicts and comparisons")
    parser.add_argument("--done", action="store_true", help="only finished cases")
    args = parser.parse_args()
    ensure_variant()
    with recording("assets.verdicts", parser, args, ignore=("out", "judge", "done")):
        results = {}
        for case in CASES:
            folder = args.out / case.name.replace(" ", "_")
            wanted = (folder / "done.json").exists() if args.done else args.only is None or case.name in args.only
            if wanted:
                results[case.name] = measure(case, folder, args.judge)
                _tell(case.name, results[case.name])
        summarise(results)


def _tell(name: str, found: Mapping[str, Any]) -> None:
    """Print and record the figures of a case."""
    if found["truth"] is None:
        print(f"{name:26} refused: {found['refused']}", flush=True)
        figure("refused", "", "case", name, "verdict")
        return
    figure("missed" if found["misses"] else "passed", "", "case", name, "verdict")
    figure("good" if is_good(found["truth"]) else "bad", "", "case", name, "truth")
    shown = {f"{key} {value:.3f}" for key, value in found["truth"].items()}
    for key, value in found["truth"].items():
        figure(value, "", "case", name, "true", key)
    for key in dict.fromkeys(key for key, _ in STANDS_FOR):
        if found["verdict"][key] is not None:
            figure(found["verdict"][key], "", "case", name, key)
    print(f"{name:26} {'missed' if found['misses'] else 'passed'}; {', '.join(sorted(shown))}", file=sys.stdout)
    for sentence in found["misses"]:
        print(f"    {sentence}", flush=True)


def summarise(results: Mapping[str, Mapping[str, Any]]) -> None:
    """Print and record rank correlations, and the agreement of verdict and truth on the finished assets."""
    for name, truth in STANDS_FOR:
        value, low, high, count = rank(list(results.values()), name, truth)
        print(f"{name:12} for {truth:10} {value:6.2f}  [{low:.2f}, {high:.2f}] of {count}")
        for key, one in (("correlation", value), ("low", low), ("high", high), ("captures", count)):
            figure(one, "", "rank", name, truth, key)
    refused = [name for name, found in results.items() if found["truth"] is None]
    made = {name: found for name, found in results.items() if found["truth"] is not None}
    passed = {name for name, found in made.items() if not found["misses"]}
    good = {name for name, found in made.items() if is_good(found["truth"])}
    share = 1 - len(passed ^ good) / max(1, len(made))
    for what, value in (("assets", len(made)), ("passed", len(passed)), ("good", len(good)), ("agreement", share)):
        figure(value, "", what)
        print(f"{what}: {value:.3g}")
    for what, names in (
        ("refused", refused),
        ("false passes", [name for name in made if name in passed - good]),
        ("false misses", [name for name in made if name in good - passed]),
    ):
        figure(len(names), "", what)
        figure(", ".join(names) or "none", "", what, "named")
        print(f"{what}: {', '.join(names) or 'none'}")


if __name__ == "__main__":
    main()
