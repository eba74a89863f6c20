"""Comparison of a capture's cameras with published ones: ``python -m benchmarks.assets.cameras CAPTURE POSES``.

POSES holds a 3x4 projection matrix per photo, ``<name of the photo>.txt``, in any frame and at any scale. The published
cameras are reconstructions too: the result is agreement, not an error relative to the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.record import figure, recording
from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.capture import Capture


def compare(capture: Path, poses: Path) -> None:
    found = Capture.load(capture)
    published = {path.stem: np.loadtxt(path) for path in sorted(poses.glob("*.txt"))}
    photos = [photo for photo in found.photos if Path(photo.name).stem in published]
    matrices = np.array([published[Path(photo.name).stem] for photo in photos])
    centres = -np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0]
    _, residuals = fit_similarity(np.array([photo.camera.centre for photo in photos]), centres)
    extent = np.ptp(centres, axis=0)
    errors = 100 * np.linalg.norm(residuals, axis=1)
    print(f"{len(photos)} of {len(published)} published photos registered, {len(found.rejected)} rejected")
    figure(len(photos), "", "registered")
    figure(len(published), "", "published")
    figure(len(found.rejected), "", "rejected")
    for name, scale in (("longest edge", extent.max()), ("diagonal", np.linalg.norm(extent))):
        values = errors / scale
        rms = np.sqrt(np.mean(values**2))
        for what, value in {"rms": rms, "median": np.median(values), "largest": values.max()}.items():
            figure(value, "%", name, what)
        print(
            f"centres, % of the {name} of their box: rms {rms:.3f}, median "
            f"{np.median(values):.3f}, largest {values.max():.3f} ({photos[int(values.argmax())].name})"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("poses", type=Path)
    options = parser.parse_args()
    with recording("assets.cameras", parser, options, ignore=("poses",)):
        compare(options.capture, options.poses)


if __name__ == "__main__":
    main()
