"""PLY files of splats whose values or elements contradict the format, and early compressed files."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from tests.gaussians.test_splats import random_splats


def rewrite(path: Path, more: dict[str, tuple[str, np.ndarray]], *, elements: str = "", tail: bytes = b"") -> None:
    """Write splats of degree 0 with some columns replaced or added, of other types, and elements after the vertices."""
    splats = random_splats(200, degree=0)
    splats.save(path)
    head, _, rows = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    table = dict(zip(names, np.frombuffer(rows, "<f4").reshape(200, -1).T, strict=True))
    columns = {name: ("float", column) for name, column in table.items()} | more
    kinds = {"float": "<f4", "uchar": "u1"}
    packed = np.empty(200, [(name, kinds[kind]) for name, (kind, _) in columns.items()])
    for name, (_, column) in columns.items():
        packed[name] = column
    lines = "".join(f"property {kind} {name}\n" for name, (kind, _) in columns.items())
    start = "ply\nformat binary_little_endian 1.0\nelement vertex 200\n"
    path.write_bytes(f"{start}{lines}{elements}end_header\n".encode() + packed.tobytes() + tail)


@pytest.mark.parametrize(("kind", "top"), [("uchar", 255), ("float", 255), ("float", 100)])
def test_whole_numbers_are_no_logits(tmp_path: Path, kind: str, top: int) -> None:
    """Opacities from 0 to 255 made all Gaussians opaque by half or more."""
    values = np.rint(top * random_splats(200, degree=0).opacities)
    rewrite(tmp_path / "a.ply", {"opacity": (kind, values)})
    with pytest.raises(InputError, match=r"a\.ply: opacity of a PLY file must be logits \(got whole numbers from \d+"):
        Splats.load(tmp_path / "a.ply")


@pytest.mark.parametrize(("wrong", "kind"), [(False, "uchar"), (False, "float"), (True, "uchar"), (True, "float")])
def test_colours_that_contradict_the_coefficients_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, wrong: bool, kind: str
) -> None:
    """Programs that paint or segment splats may change these columns only."""
    colours = np.clip(0.5 + SH_C0 * random_splats(200, degree=0).sh[:, 0], 0, 1)
    shown = 1 - colours if wrong else colours
    shown = np.rint(255 * shown) if kind == "uchar" else shown
    rewrite(
        tmp_path / "a.ply", dict(zip(("red", "green", "blue"), ((kind, shown[:, k]) for k in range(3)), strict=True))
    )
    with caplog.at_level(logging.WARNING):
        Splats.load(tmp_path / "a.ply")
    text = "its columns red, green, blue differ from its coefficients f_dc_0 to f_dc_2, which are used"
    assert caplog.messages == ([f"{tmp_path / 'a.ply'}: {text}"] if wrong else [])


def test_colours_in_place_of_coefficients_are_refused_with_a_remedy(tmp_path: Path) -> None:
    rewrite(tmp_path / "a.ply", {name: ("uchar", np.zeros(200)) for name in ("red", "green", "blue")})
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"f_dc_", b"g_dc_"))
    with pytest.raises(InputError, match=r"f_dc_2 \(missing\): export coefficients in place of red, green, blue"):
        Splats.load(tmp_path / "a.ply")


@pytest.mark.parametrize("linear", [0, 1])
def test_linear_colours_are_refused(tmp_path: Path, linear: int) -> None:
    """SHARP states the colour space of its coefficients in an element after the vertices."""
    elements = "element frame 2\nproperty int frame\nelement color_space 1\nproperty uchar color_space\n"
    rewrite(tmp_path / "a.ply", {}, elements=elements, tail=bytes(8) + bytes([linear]))
    if not linear:
        assert len(Splats.load(tmp_path / "a.ply")) == 200
        return
    with pytest.raises(InputError, match=r"a\.ply: its colours must be sRGB \(its element color_space is 1, linear\)"):
        Splats.load(tmp_path / "a.ply")


@pytest.mark.parametrize("has_ranges", [False, True])
def test_compressed_files_with_and_without_ranges_of_colours_are_read(tmp_path: Path, has_ranges: bool) -> None:
    """Early files of PlayCanvas have no ranges of colours. One Gaussian: all ranges but that of colours are points."""
    low, log_scale, high = (0.5, -0.25, 2.0), (-3.0, -4.0, -5.0), (0.6, -0.25, 2.5)
    chunk = [*low, *high, *log_scale, *log_scale, *((0.0, 0.0, 0.0, 0.5, 0.5, 0.5) if has_ranges else ())]
    names = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_{colour}" for end in ("min", "max") for colour in "rgb"] if has_ranges else []
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {name}" for name in names)]
    lines += ["element vertex 1", *(f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color"))]
    turned = 512 << 20 | 512 << 10 | 512  # the identity: the first component, w, is the largest
    row = np.array([2047 << 21 | 0 << 11 | 2047, turned, 0, 255 << 24 | 51 << 16 | 0 << 8 | 204], "<u4")
    data = "\n".join([*lines, "end_header", ""]).encode() + np.array(chunk, "<f4").tobytes() + row.tobytes()
    (tmp_path / "a.compressed.ply").write_bytes(data)
    splats = Splats.load(tmp_path / "a.compressed.ply")
    np.testing.assert_allclose(splats.means, [[0.6, -0.25, 2.5]], atol=1e-6)
    np.testing.assert_allclose(np.log(splats.scales), [log_scale], atol=1e-5)
    expected = np.array([1.0, 0.2, 0.0]) * (0.5 if has_ranges else 1.0)
    np.testing.assert_allclose(0.5 + SH_C0 * splats.sh[:, 0], [expected], atol=1e-5)
    assert splats.opacities == pytest.approx(0.8, abs=1e-5)
    np.testing.assert_allclose(np.abs(splats.quats), [[0, 0, 0, 1]], atol=2e-3)


@pytest.mark.parametrize("column", ["x", "opacity", "f_dc_1"])
def test_rows_of_nan_are_refused_with_a_remedy(tmp_path: Path, column: str) -> None:
    values = np.linspace(-1, 1, 200)
    values[7] = np.nan
    rewrite(tmp_path / "a.ply", {column: ("float", values)})
    with pytest.raises(InputError, match=r"a\.ply: .*\(got nan at row 7\): remove such Gaussians, as SuperSplat"):
        Splats.load(tmp_path / "a.ply")
