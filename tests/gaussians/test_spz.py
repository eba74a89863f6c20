"""``.spz`` files of versions 1 to 3, written here by the format of Niantic, and headers that contradict their data."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats

COUNT = 50


def spz(version: int, degree: int, *, stated: int = COUNT, bits: int = 12, flags: int = 0, tail: bytes = b"") -> bytes:
    """Encode random Gaussians whose rotation is about x, of which all versions store the same number of bits."""
    rng = np.random.default_rng(degree)
    means = rng.uniform(-1, 1, (COUNT, 3))
    steps = np.rint(means * (1 << bits)).astype("<i4").view(np.uint8).reshape(COUNT, 3, 4)[..., :3]
    positions = means.astype("<f2").tobytes() if version == 1 else steps.tobytes()
    turns = bytes([166, 127, 127]) * COUNT if version < 3 else struct.pack("<I", 3 << 30 | 221 << 20) * COUNT
    rest = rng.integers(0, 256, 3 * COUNT * ((degree + 1) ** 2 - 1)).astype(np.uint8).tobytes()
    others = rng.integers(90, 200, (7, COUNT)).astype(np.uint8).tobytes()
    header = struct.pack("<4s2I4B", b"NGSP", version, stated, degree, bits, flags, 0)
    return gzip.compress(header + positions + others + turns + rest + tail)


@pytest.mark.parametrize("degree", range(4))
def test_versions_1_to_3_hold_the_same_splats(tmp_path: Path, degree: int) -> None:
    loaded = []
    for version in (1, 2, 3):
        (tmp_path / "a.spz").write_bytes(spz(version, degree))
        loaded.append(Splats.load(tmp_path / "a.spz"))
    for splats in loaded[1:]:
        np.testing.assert_allclose(splats.means, loaded[0].means, atol=1e-3)
        np.testing.assert_allclose(np.abs((splats.quats * loaded[0].quats).sum(axis=1)), 1, atol=1e-3)
        for name in ("scales", "opacities", "sh"):
            np.testing.assert_allclose(getattr(splats, name), getattr(loaded[0], name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize(("stated", "tail"), [(COUNT - 1, b""), (COUNT + 1, b""), (COUNT, b"abc")])
def test_data_of_another_length_than_stated_are_refused(tmp_path: Path, version: int, stated: int, tail: bytes) -> None:
    """All arrays follow each other, so one Gaussian too few gave wrong sizes, colours and rotations to all others."""
    (tmp_path / "a.spz").write_bytes(spz(version, 1, stated=stated, tail=tail))
    with pytest.raises(InputError, match=rf"a\.spz: {stated} Gaussians of SH degree 1, .* must take \d+ bytes \(got "):
        Splats.load(tmp_path / "a.spz")


@pytest.mark.parametrize("version", [1, 2, 3])
def test_extensions_after_the_gaussians_are_skipped(tmp_path: Path, version: int) -> None:
    (tmp_path / "a.spz").write_bytes(spz(version, 1))
    (tmp_path / "b.spz").write_bytes(spz(version, 1, flags=2, tail=bytes(20)))
    plain, extended = (Splats.load(tmp_path / name) for name in ("a.spz", "b.spz"))
    np.testing.assert_array_equal(plain.means, extended.means)
    np.testing.assert_array_equal(plain.sh, extended.sh)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"version": 4, "degree": 1}, "SPZ files of version 4 are not supported: convert them to version 3"),
        ({"version": 0, "degree": 1}, "SPZ files of version 0 are not supported"),
        ({"version": 3, "degree": 4}, r"SPZ files must have SH of degree 0 to 3 \(got 4\)"),
        ({"version": 3, "degree": 1, "stated": 0}, r"an SPZ file must hold at least one Gaussian \(got 0\)"),
    ],
)
def test_other_headers_are_refused(tmp_path: Path, arguments: dict[str, int], sentence: str) -> None:
    (tmp_path / "a.spz").write_bytes(spz(**arguments))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=rf"a\.spz: {sentence}"):
        Splats.load(tmp_path / "a.spz")


@pytest.mark.parametrize(
    ("name", "start", "kind"),
    [
        ("a.splat", b"ply\n", ".ply"),
        ("a.spz", b"ply\r\n", ".ply"),
        ("a.ply", b"PK\3\4", ".sog"),
        ("a.sog", b"glTF", ".glb"),
    ],
)
def test_files_with_the_suffix_of_another_format_are_named(tmp_path: Path, name: str, start: bytes, kind: str) -> None:
    (tmp_path / name).write_bytes(start.ljust(64, b"x"))
    with pytest.raises(InputError, match=rf"{name}: a {name[1:]} file must not begin as a {kind} file: rename it"):
        Splats.load(tmp_path / name)
