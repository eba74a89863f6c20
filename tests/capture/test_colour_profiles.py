"""Colour profiles of photographs: colours are those of the profile, as sRGB."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from mitsplat.capture.photos import prepare_photos
from mitsplat.images.colour import decode_srgb, encode_srgb, in_srgb

ADOBE_GAMMA = 2.19921875
"""Exponent of Adobe RGB (1998)."""
XYZ_OF_ADOBE = np.array([[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]])
XYZ_OF_SRGB = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
"""Columns: primaries for the white point D50, as ICC profiles state them."""


def adobe_profile() -> bytes:
    """Build an ICC profile of version 2 with three primaries and a power (ICC.1:2001-04)."""

    def fixed(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    text = b"test\0"
    named = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(ADOBE_GAMMA * 256))
    entries = {
        b"desc": named,
        b"cprt": b"text" + bytes(4) + text,
        b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1, 0.8249),
    }
    for number, channel in enumerate((b"r", b"g", b"b")):
        entries[channel + b"XYZ"] = b"XYZ " + bytes(4) + fixed(*XYZ_OF_ADOBE[:, number])
        entries[channel + b"TRC"] = curve
    start, table, data = 132 + 12 * len(entries), struct.pack(">I", len(entries)), b""
    for name, content in entries.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    head = struct.pack(">I4sI", start + len(data), b"lcms", 0x02100000) + b"mntrRGB XYZ " + bytes(12) + b"acsp"
    return head.ljust(68, b"\0") + fixed(0.9642, 1, 0.8249) + bytes(48) + table + data


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_colours_of_a_profile_become_srgb(mode: str) -> None:
    """Without the profile, saturated colours are too dull."""
    colours = np.array([[[180, 90, 60], [60, 140, 90], [128, 128, 128], [90, 90, 160]]], np.uint8)
    image = Image.fromarray(colours).convert(mode)
    if mode == "RGBA":
        image.putalpha(77)
    image.info["icc_profile"] = adobe_profile()
    linear = (colours / 255.0) ** ADOBE_GAMMA @ (np.linalg.inv(XYZ_OF_SRGB) @ XYZ_OF_ADOBE).T
    found = in_srgb(image)
    np.testing.assert_allclose(
        np.asarray(found.convert("RGB")).astype(float), 255 * encode_srgb(np.clip(linear, 0, 1)), atol=2
    )
    assert found.mode == mode and (mode == "RGB" or found.getchannel("A").getextrema() == (77, 77))
    assert np.abs(decode_srgb(colours / 255.0) - linear).max() > 0.03


def test_photos_with_the_profile_of_srgb_or_a_damaged_one_are_not_changed() -> None:
    image = Image.new("RGB", (8, 8), (200, 40, 30))
    for profile in (ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(), b"damaged", b""):
        image.info["icc_profile"] = profile
        assert in_srgb(image) is image


def test_photos_of_a_capture_are_copied_as_srgb(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    noise = np.random.default_rng(0).integers(60, 200, (64, 64, 3), dtype=np.uint8)
    image = Image.fromarray(np.kron(noise, np.ones((4, 4, 1), np.uint8)))
    image.save(tmp_path / "in" / "a.png", icc_profile=adobe_profile())
    image.save(tmp_path / "in" / "b.png")
    exif = Image.Exif()
    exif[271] = "maker"
    image.save(tmp_path / "in" / "c.jpg", icc_profile=adobe_profile(), exif=exif)
    (a, b, c), rejected = prepare_photos(tmp_path / "in", tmp_path / "out", max_size=1600)
    assert not rejected and b.file.read_bytes() == (tmp_path / "in" / "b.png").read_bytes()
    with Image.open(c.file) as copy:
        assert copy.getexif()[271] == "maker"
    image.info["icc_profile"] = adobe_profile()
    with Image.open(io.BytesIO(a.file.read_bytes())) as copy:
        np.testing.assert_array_equal(np.asarray(copy), np.asarray(in_srgb(image)))
