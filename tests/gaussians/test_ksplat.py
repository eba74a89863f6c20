"""``.ksplat`` files of all compression levels and SH degrees, written here by the format of GaussianSplats3D."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats

COUNT, BUCKET, BLOCK, RANGE = 300, 128, 5.0, 32767
FLOATS, SH = ("f4", "f2", "f2"), ("f4", "f2", "u1")


def gaussians(degree: int) -> Splats:
    rng = np.random.default_rng(degree)
    quats = rng.normal(size=(COUNT, 4))
    return Splats(
        means=rng.uniform(-1, 1, (COUNT, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-6, -3, (COUNT, 3))),
        opacities=rng.integers(1, 255, COUNT) / 255,
        sh=rng.uniform(-1, 1, (COUNT, (degree + 1) ** 2, 3)),
    )


def ksplat(splats: Splats, level: int) -> bytes:
    """Encode splats in buckets of consecutive Gaussians, the last of which is not full."""
    degree = int(np.sqrt(splats.sh.shape[1])) - 1
    full, rest = divmod(COUNT, BUCKET)
    buckets = np.minimum(np.arange(COUNT) // BUCKET, full)
    centres = np.array([splats.means[buckets == k].mean(axis=0) for k in range(full + 1)])
    means = splats.means.astype("<f4")
    if level:
        means = np.rint((means - centres[buckets]) / (BLOCK / 2 / RANGE) + RANGE).astype("<u2")
    bands = [splats.sh[:, a:b].transpose(0, 2, 1).reshape(COUNT, -1) for a, b in ((1, 4), (4, 9))][:degree]
    sh = np.hstack([np.zeros((COUNT, 0)), *bands])
    sh = np.rint((sh + 1.5) / 3 * 255) if level == 2 else sh
    colours = np.c_[splats.sh[:, 0] * 0.28209479 + 0.5, splats.opacities]
    columns = (
        means,
        splats.scales.astype(FLOATS[level]),
        splats.quats.astype(FLOATS[level]),
        np.rint(255 * colours).astype("u1"),
        sh.astype(SH[level]),
    )
    rows = b"".join(b"".join(column[k].tobytes() for column in columns) for k in range(COUNT))
    header, section = bytearray(4096), bytearray(1024)
    struct.pack_into("<BBxxIIIIH", header, 0, 0, 1, 1, 1, COUNT, COUNT, level)
    struct.pack_into("<2f", header, 36, -1.5, 1.5)
    values = (BUCKET, full + 1, BLOCK, 12, RANGE, 0, full, 1) if level else (0, 0, 0.0, 0, 0, 0, 0, 0)
    struct.pack_into("<IIIIfHxxIIIIH", section, 0, COUNT, COUNT, *values, degree)
    head = struct.pack("<I", rest) + centres.astype("<f4").tobytes() if level else b""
    return bytes(header + section) + head + rows


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_all_levels_and_degrees_are_read_within_their_quantisation(tmp_path: Path, level: int, degree: int) -> None:
    """Positions of level 1 and 2 are unsigned: those above the middle of their bucket must not wrap."""
    splats = gaussians(degree)
    (tmp_path / "a.ksplat").write_bytes(ksplat(splats, level))
    loaded = Splats.load(tmp_path / "a.ksplat")
    np.testing.assert_allclose(loaded.means, splats.means, atol=1e-4 if level else 1e-6)
    np.testing.assert_allclose(loaded.scales, splats.scales, rtol=1e-3 if level else 1e-6)
    np.testing.assert_allclose(loaded.opacities, splats.opacities, atol=1e-6)
    np.testing.assert_allclose(np.abs((loaded.quats * splats.quats).sum(axis=1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(loaded.sh[:, 0], splats.sh[:, 0], atol=0.51 / 255 / 0.282)
    np.testing.assert_allclose(loaded.sh[:, 1:], splats.sh[:, 1:], atol=(1e-6, 1e-3, 0.006)[level])


@pytest.mark.parametrize(
    ("place", "value", "sentence"),
    [
        (1, b"\0", r"must have version 0\.1 and compression level 0 to 2 \(got 0\.0 and 1\)"),
        (20, b"\3", r"\(got 0\.1 and 3\)"),
        (4, b"\xff", "the headers of its sections are incomplete"),
        (4096 + 40, b"\3", r"SH of degree 0 to 2 \(got 3\)"),
        (4096 + 32, b"\1", "the buckets of a section do not hold its Gaussians"),
        (16, b"\x2d", r"hold all 301 Gaussians of its header \(got 300\)"),
        (4096 + 4, b"\xff\xff", "a section extends beyond the file"),
    ],
)
def test_other_versions_and_damaged_headers_are_refused(
    tmp_path: Path, place: int, value: bytes, sentence: str
) -> None:
    data = bytearray(ksplat(gaussians(1), 1))
    data[place : place + len(value)] = value
    (tmp_path / "a.ksplat").write_bytes(data)
    with pytest.raises(InputError, match=sentence):
        Splats.load(tmp_path / "a.ksplat")
