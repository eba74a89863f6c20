"""Photos of two lenses in one folder: their focal lengths are found without EXIF data."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.capture import Capture
from mitsplat.geometry.camera import Camera
from tests.cli.typed import run

SPLIT = """
import json, sys
from mitsplat.capture.sfm_worker import zlib
from mitsplat.capture.lens_separation import split_lengths
found = [split_lengths(*case) for case in json.load(sys.stdin)]
print(json.dumps([one.tolist() for one in found]))
"""


def split(*cases: tuple[list[float], list[int]]) -> list[list[bool]]:
    """Split focal lengths with counts of points, in a process that may import pycolmap."""
    done = subprocess.run(
        [sys.executable, "-c", SPLIT], input=json.dumps(cases), capture_output=True, text=True, check=True
    )
    found: list[list[bool]] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_two_groups_of_focal_lengths_are_split() -> None:
    two = [100, 101, 99, 112, 110, 111]
    assert split((two, [99] * 6)) == [[False] * 3 + [True] * 3]
    weak = [*two, 60, 170]  # few points determine no focal length
    assert split((weak, [99] * 6 + [40, 40])) == [[False] * 3 + [True] * 3 + [False, True]]
    assert split((two[:5], [99] * 5)) == [[False] * 5]  # two photos of the second lens
    assert split(([100, 100.1, 99.9, 103, 103.1, 103.2], [99] * 6)) == [[False] * 6]  # 3 % may be focusing
    assert split(([100.0] * 8, [99] * 8)) == [[False] * 8]
    assert split((np.geomspace(100, 200, 30).tolist(), [99] * 30)) == [[False] * 30]  # a zoom that changes steadily


def test_focal_lengths_of_one_lens_are_not_split() -> None:
    """Standard deviations of 1 to 10 %, of normal and heavy-tailed errors."""
    rng = np.random.default_rng(0)
    cases = []
    for number in range(900):
        count, spread = int(rng.integers(6, 60)), float(rng.uniform(0.01, 0.1))
        errors = rng.normal(size=count) if number % 2 else rng.standard_t(3, size=count)
        cases.append(((700 * np.exp(spread * errors)).tolist(), [99] * count))
    assert sum(map(any, split(*cases))) <= 9


@pytest.mark.parametrize(
    ("case", "lengths", "largest"),
    [
        ({"offset": (25, 20), "ratio": 1}, [1000], 0.03),
        ({"offset": (0, 0), "ratio": 1.1}, [1000, 1100], 0.002),
    ],
    ids=["principal point off the centre", "two lenses"],
)
def test_photos_from_above_with_an_offset_principal_point_are_of_one_lens(
    case: dict[str, object], lengths: list[float], largest: float, tmp_path: Path
) -> None:
    """The offset makes the lengths of photos from above longer; a lens of their own places them off by 8 %."""
    command = [sys.executable, "-m", "tests.capture.simulated_matches", str(tmp_path), json.dumps(case)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["photos"] == 20
    assert found["lengths"] == pytest.approx(lengths, rel=0.02)
    assert found["error"] < largest


@pytest.mark.slow
def test_photos_of_two_lenses_in_one_folder_get_their_own_intrinsics(
    photos: tuple[Path, dict[str, Camera]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every second photo is enlarged 1.3 times, as by a longer lens.

    With common intrinsics, all photos are accepted, and their cameras are off by 11 to 16 % of their distance.
    """
    given, truth = photos
    (tmp_path / "photos").mkdir()
    zooms = {name: (1.0, 1.3)[number % 2] for number, name in enumerate(truth)}
    for name, zoom in zooms.items():
        with Image.open(given / name) as image:
            margins = [side * (1 - 1 / zoom) / 2 for side in image.size]
            box = (*margins, *(side - margin for side, margin in zip(image.size, margins, strict=True)))
            image.resize(image.size, Image.Resampling.LANCZOS, box=box).save(tmp_path / "photos" / name)
    out = tmp_path / "out"
    assert run("capture", tmp_path / "photos", "-o", out, "--square", 0.035, "--kind", "environment") == 0
    capture = Capture.load(out)
    assert len(capture.photos) == len(truth)
    lengths = {zoom: {photo.camera.fx for photo in capture.photos if zooms[photo.name] == zoom} for zoom in (1.0, 1.3)}
    ((short,), (long,)) = lengths.values()
    true = truth["photo00.png"].fx
    assert (short / true, long / true) == pytest.approx((1, 1.3), rel=0.01)
    count = len(truth) // 2
    assert f"focal lengths: {short:.0f} px in {count} photos and {long:.0f} px in {count} photos" in (
        capsys.readouterr().out
    )
    found = np.array([photo.camera.centre for photo in capture.photos])
    _, residuals = fit_similarity(found, np.array([truth[photo.name].centre for photo in capture.photos]))
    assert np.linalg.norm(residuals, axis=1).max() < 0.01 * 0.26
