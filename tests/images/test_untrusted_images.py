"""Messages for images that Mitsuba cannot read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mitsplat.images.untrusted_images import check_images

pytestmark = pytest.mark.usefixtures("files_tried")


@pytest.mark.parametrize(
    ("name", "mode", "kind", "reason"),
    [
        ("a.jpg", "CMYK", "JPEG", "its colours are CMYK: export it as RGB"),
        (
            "a.png",
            "RGB",
            "WEBP",
            "it must be one of .exr, .hdr, .pfm, .png, .jpg, .jpeg, .bmp, .tga: export it as .png",
        ),
        ("a.jpg", "RGB", "JPEG", None),
        ("a.jpg", "L", "JPEG", None),
    ],
)
def test_images_in_other_colours_or_formats_are_named(
    tmp_path: Path, name: str, mode: str, kind: str, reason: str | None
) -> None:
    Image.new(mode, (8, 8)).save(tmp_path / name, kind)
    expected = None if reason is None else f"{tmp_path / name}: not a readable image ({reason})"
    assert check_images([tmp_path / name]) == [expected]


@pytest.mark.parametrize(("value", "got"), [(np.nan, "nan to nan"), (np.inf, "0.5 to inf"), (-0.25, "-0.25 to 0.5")])
def test_pixels_that_no_light_has_are_refused(tmp_path: Path, value: float, got: str) -> None:
    """Rendering with such an environment map failed, or took all memory."""
    pixels = np.full((8, 16, 3), 0.5, dtype=np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, bad in (("good.exr", None), ("bad.exr", value)):
        if bad is not None:
            pixels[2, 3, 1] = bad
        with OpenEXR.File(header, {"RGB": pixels}) as file:
            file.write(str(tmp_path / name))
    reason = f"its pixels must be finite and >= 0 (got {got}): replace them by 0"
    expected = [None, f"{tmp_path / 'bad.exr'}: not a readable image ({reason})"]
    assert check_images([tmp_path / "good.exr", tmp_path / "bad.exr"]) == expected
