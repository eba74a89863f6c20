"""Colour profiles of photographs: colours are those of the profile, as sRGB."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from mitsplat.capture.lighting.brackets import read_photograph
from mitsplat.capture.photos import prepare_photos
from mitsplat.errors import InputError
from mitsplat.images.colour import decode_srgb, encode_srgb, in_srgb
from mitsplat.mesh_files.mesh_file import pixels_of

ADOBE_GAMMA = 2.19921875
"""Exponent of Adobe RGB (1998)."""
XYZ_OF_ADOBE = np.array([[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]])
XYZ_OF_SRGB = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
"""Columns: primaries for the white point D50, as ICC profiles state them."""


def fixed(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def profile_of(kind: bytes, entries: dict[bytes, bytes]) -> bytes:
    """Build an ICC profile of version 2 (ICC.1:2001-04) from its class, colour space and PCS, and its tags."""
    text = b"test\0"
    common = {
        b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67),
        b"cprt": b"text" + bytes(4) + text,
        b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1, 0.8249),
    }
    entries = common | entries
    start, table, data = 132 + 12 * len(entries), struct.pack(">I", len(entries)), b""
    for name, content in entries.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    head = struct.pack(">I4sI", start + len(data), b"lcms", 0x02100000) + kind + bytes(12) + b"acsp"
    return head.ljust(68, b"\0") + fixed(0.9642, 1, 0.8249) + bytes(48) + table + data


def curve(exponent: float) -> bytes:
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(exponent * 256))


def adobe_profile() -> bytes:
    """Build a profile with three primaries and a power."""
    entries = {}
    for number, channel in enumerate((b"r", b"g", b"b")):
        entries[channel + b"XYZ"] = b"XYZ " + bytes(4) + fixed(*XYZ_OF_ADOBE[:, number])
        entries[channel + b"TRC"] = curve(ADOBE_GAMMA)
    return profile_of(b"mntrRGB XYZ ", entries)


def ink_light(inks: np.ndarray) -> np.ndarray:
    """Return the linear sRGB of a print with inks (N, 4) that are 0 or 1."""
    passed = np.array([(0.05, 0.4, 0.8), (0.6, 0.04, 0.3), (0.9, 0.8, 0.06), (0.02, 0.02, 0.02)])
    return np.asarray(np.prod(1 - inks[:, :, None] * (1 - passed), axis=1))


def ink_profile() -> bytes:
    """Build a profile of a printer: the colours of all combinations of full inks, as Lab of 16 bits."""
    inks = np.array(list(np.ndindex(2, 2, 2, 2)), float)
    ratio = ink_light(inks) @ XYZ_OF_SRGB.T / (0.9642, 1, 0.8249)
    x, y, z = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29).T
    lab = np.column_stack([(116 * y - 16) / 100 * 0xFF00, (500 * (x - y) + 128) * 256, (200 * (y - z) + 128) * 256])
    ramp = struct.pack(">2H", 0, 65535)
    table = b"mft2" + bytes(4) + bytes([4, 3, 2, 0]) + fixed(1, 0, 0, 0, 1, 0, 0, 0, 1) + struct.pack(">2H", 2, 2)
    table += 4 * ramp + lab.round().astype(">u2").tobytes() + 3 * ramp
    return profile_of(b"prtrCMYKLab ", {b"A2B0": table, b"A2B1": table})


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


def test_printing_colours_are_those_of_their_profile() -> None:
    """Without the profile, cyan of a printer would be (0, 255, 255)."""
    inks = np.array(list(np.ndindex(2, 2, 2, 2)))
    image = Image.fromarray((255 * inks[None]).astype(np.uint8), "CMYK")
    image.info["icc_profile"] = ink_profile()
    found = in_srgb(image)
    assert found.mode == "RGB"
    np.testing.assert_allclose(np.asarray(found)[0].astype(float), 255 * encode_srgb(ink_light(inks)), atol=2)
    assert np.abs(np.asarray(image.convert("RGB")).astype(int) - np.asarray(found)).max() > 50


def test_grey_photos_take_the_curve_of_their_profile() -> None:
    image = Image.fromarray(np.arange(0, 256, 15, dtype=np.uint8)[None])
    image.info["icc_profile"] = profile_of(b"mntrGRAYXYZ ", {b"kTRC": curve(1.0)})
    np.testing.assert_allclose(
        np.asarray(in_srgb(image))[0, :, 1].astype(float), 255 * encode_srgb(np.asarray(image)[0] / 255), atol=2
    )


@pytest.mark.parametrize("profile", [None, b"damaged", adobe_profile()])
@pytest.mark.parametrize("name", ["a.jpg", "a.tif"])
def test_printing_colours_without_a_profile_are_refused(tmp_path: Path, name: str, profile: bytes | None) -> None:
    """A profile of RGB does not describe inks."""
    (tmp_path / "in").mkdir()
    noise = np.random.default_rng(0).integers(60, 200, (64, 64, 3), dtype=np.uint8)
    image = Image.fromarray(noise).convert("CMYK")
    image.save(tmp_path / "in" / name, icc_profile=profile)
    good, rejected = prepare_photos(tmp_path / "in", tmp_path / "out", max_size=1600)
    reason = "it cannot be read (its colours are CMYK without a readable profile: export it as RGB)"
    assert not good and rejected == {name: reason}
    with pytest.raises(InputError, match="CMYK"):
        read_photograph(tmp_path / "in" / name)
    with Image.open(tmp_path / "in" / name) as texture, pytest.raises(InputError, match="CMYK"):
        pixels_of(texture)


def test_printing_colours_of_photos_and_textures_are_converted(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    inks = np.random.default_rng(0).integers(0, 2, (8, 8, 4))
    image = Image.fromarray((255 * np.kron(inks, np.ones((16, 16, 1)))).astype(np.uint8), "CMYK")
    image.save(tmp_path / "in" / "a.tif", icc_profile=ink_profile())
    (copy,), rejected = prepare_photos(tmp_path / "in", tmp_path / "out", max_size=1600)
    expected = 255 * encode_srgb(ink_light(inks.reshape(-1, 4))).reshape(8, 8, 3)
    with Image.open(copy.file) as stored, Image.open(tmp_path / "in" / "a.tif") as texture:
        for pixels in (np.asarray(stored), pixels_of(texture)):
            np.testing.assert_allclose(pixels[8::16, 8::16].astype(float), expected, atol=2)
    assert not rejected


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
