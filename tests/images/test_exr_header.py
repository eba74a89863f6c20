"""Rejection of OpenEXR files whose header would occupy a reader for minutes."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from benchmarks.scale.attack.images import EXRS, exr
from mitsplat.errors import InputError
from mitsplat.fit.depth_priors import read_map
from mitsplat.images.exr_header import check_exr_header
from mitsplat.images.untrusted_images import check_images

pytestmark = pytest.mark.usefixtures("files_tried")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.exr"


@pytest.mark.parametrize("kind", [OpenEXR.scanlineimage, OpenEXR.tiledimage])
def test_valid_files_pass(path: Path, kind: int) -> None:
    pixels = {f"layer.{number}": np.zeros((8, 16), np.float32) for number in range(200)}
    header = {"type": kind, "tiles": OpenEXR.TileDescription()} if kind == OpenEXR.tiledimage else {"type": kind}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(path))
    check_exr_header(path)


def test_files_with_several_parts_pass(path: Path) -> None:
    parts = [OpenEXR.Part({}, {"Z": np.zeros((8, 16), np.float32)}, name) for name in "abc"]
    with OpenEXR.File(parts) as file:
        file.write(str(path))
    check_exr_header(path)


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        (EXRS["200,000 channels"](), r"channels must be listed in at most 65536 bytes \(got 4800001\)"),
        (exr({f"a{number}": ("int", bytes(4)) for number in range(3000)}), "must not hold more than 2000 attributes"),
        (EXRS["attribute of -1 bytes"](), "truncated or damaged"),
        (exr({})[:10], "names of at most 255 bytes"),
        (exr({"a" * 300: ("int", bytes(4))}), "names of at most 255 bytes"),
    ],
)
def test_long_and_damaged_headers_are_refused(path: Path, data: bytes, rule: str) -> None:
    path.write_bytes(data)
    begun = time.process_time()
    with pytest.raises(InputError, match=rf"a\.exr: .*{rule}"):
        check_exr_header(path)
    with pytest.raises(InputError, match=r"a\.exr: not a readable depth map"):
        read_map(path)
    assert time.process_time() - begun < 1


def test_images_of_lights_with_long_headers_are_refused(path: Path) -> None:
    path.write_bytes(EXRS["200,000 channels"]())
    (reason,) = check_images([path])
    assert reason is not None and "channels must be listed in at most 65536 bytes" in reason
