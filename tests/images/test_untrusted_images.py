"""Messages for images that Mitsuba cannot read."""

from __future__ import annotations

from pathlib import Path

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
