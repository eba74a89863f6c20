"""Removal of objects from a table in a photographed room, against photos of the room without them.

    python -m benchmarks.assets.removal OUT [--samples 96]

OUT is the folder of ``python -m benchmarks.assets.room OUT``, with its photos, cameras and fit. Held-out photos are
traced again without the objects. Where they differ by more than noise, they are compared with the environment before
and after the removal. Parts of the table that no photo shows are unknown, above all printed patterns. The figures state
the reduction of the error and have no threshold. ``OUT/removed`` stores pictures: the room with the objects, without
them, and the environment without them.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.assets.clutter import exposures
from benchmarks.assets.judged import tell_wanted
from benchmarks.assets.photographing import by_name, photograph
from benchmarks.assets.room import room, things, walk
from benchmarks.record import figure, recording
from mitsplat.arrays import Float32Array
from mitsplat.capture.capture import Capture
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE, show_held_out
from mitsplat.reconstruct.pipeline.asset_pipeline import make_asset
from mitsplat.reconstruct.reconstruct import AssetJob
from mitsplat.storage.files import write_text

WANTED = {"things removed": len(things())}
_DIFFERENT = 0.08
"""Difference of two traced photos at an object or its shadow, well above their noise."""
_CLEAR = 0.25
"""Elevation from which an object is picked, as a sine: nothing stands before it."""


def picks(capture: Capture, truth: dict[str, Camera]) -> list[str]:
    """Return a pixel on each object, in the photo that shows the most of it."""
    found = []
    for mesh, (x, y), _, _ in things():
        top, best = np.array([x, y, float(mesh.extents[2])]), (np.inf, "")
        for photo in capture.photos:
            camera = truth[photo.name]
            ((u, v),), (depth,) = camera.project(top[None])
            towards = camera.centre - top
            if depth > 0 and towards[2] > _CLEAR * np.linalg.norm(towards):
                away = float(np.hypot(u - camera.width / 2, v - camera.height / 2))
                best = min(best, (away, f"{photo.name}:{u:.0f},{v:.0f}"))
        found.append(best[1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int, default=96)
    args = parser.parse_args()
    with recording("assets.removal", parser, args, ignore=("out",)):
        missed = measure(args)
    sys.exit(missed > 0)


def measure(args: argparse.Namespace) -> int:
    """Print and record the figures; return the number of missed thresholds."""
    capture = Capture.load(args.out / "cell" / "capture")
    views = walk(*json.loads((args.out / "photos.json").read_text())[:2])
    truth = by_name(views)
    chosen = [photo for photo in capture.held_out if truth[photo.name].centre[1] < 0.2]
    gains = exposures(len(views))
    numbers = [list(truth).index(photo.name) for photo in chosen]
    folder, made = args.out / "removed", {}
    traced = folder / "photos.json"
    if not (traced.exists() and json.loads(traced.read_text()) == [args.samples, numbers]):
        shutil.rmtree(folder, ignore_errors=True)
    empty = {name: thing for name, thing in room().items() if not name.startswith("thing")}
    for what, scene in (("with", room()), ("without", empty)):
        if not traced.exists():
            cameras = [truth[photo.name] for photo in chosen]
            photograph(scene, cameras, folder / what, samples=args.samples, noise=0.0, gains=gains[numbers])
        files = sorted((folder / what).iterdir())
        made[what] = [replace(photo, file=file) for photo, file in zip(chosen, files, strict=True)]
    write_text(traced, json.dumps([args.samples, numbers]))
    spots = picks(capture, truth)
    job = AssetJob(name="room", kind="environment", remove=tuple(spots))
    (args.out / "cleared" / VERDICT_FILE).unlink(missing_ok=True)  # run again with the current code
    done = make_asset(capture, args.out / "cell" / "fit", args.out / "cleared", job)
    for what, text in done.verdict.rows.items():
        print(f"  {what}: {text}", file=sys.stderr)
    record = json.loads((args.out / "cleared" / VERDICT_FILE).read_text())
    inverse = np.linalg.inv(np.array(record["asset_from_capture"]))
    after = show_held_out(
        Splats.load(args.out / "cleared" / "splats.ply").transformed(inverse), None, made["without"], 800
    )
    before = show_held_out(Splats.load(args.out / "cell" / "fit" / "splats.ply"), None, made["with"], 800)
    errors: dict[str, list[Float32Array]] = {"before": [], "after": [], "with": [], "beside": []}
    for photo, old, new in zip(chosen, before, after, strict=True):
        changed = np.abs(old.photo - new.photo).max(axis=2) > _DIFFERENT
        errors["before"].append((old.render - new.photo)[changed])
        errors["after"].append((new.render - new.photo)[changed])
        errors["with"].append((old.render - old.photo)[changed])
        errors["beside"].append((new.render - new.photo)[~changed])
        picture = np.concatenate([old.photo, new.photo, new.picture], axis=1)
        Image.fromarray(np.rint(255 * picture.clip(0, 1)).astype(np.uint8)).save(folder / photo.name)
    level = {name: psnr_of(float((np.concatenate(parts) ** 2).mean())) for name, parts in errors.items()}
    others = {
        "filled in, m2": float(sum(thing["filled"] for thing in record["removed_objects"])),
        "PSNR where things were, dB": level["after"],
        "PSNR where things were, not removed, dB": level["before"],
        "PSNR of the things in photos with them, dB": level["with"],
        "PSNR beside them, dB": level["beside"],
    }
    for name, value in others.items():
        figure(value, "", name)
        print(f"{name:45} {value:8.3f}")
    return tell_wanted({"things removed": len(record["removed_objects"])}, WANTED, set(WANTED))


if __name__ == "__main__":
    main()
