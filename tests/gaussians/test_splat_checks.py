"""PLY files of splats whose values or elements contradict the format, and early compressed files."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from tests.gaussians.test_splats import encoded, random_splats


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


@pytest.mark.parametrize("logits", [[4], [0, 110], [0, 1, 2, 3]])
def test_few_whole_logits_are_read(tmp_path: Path, logits: list[int]) -> None:
    """Splats of a program often have one opacity, and files store opacities of 0.5 and 1 as 0 and 110."""
    values = np.resize(logits, 200)
    rewrite(tmp_path / "a.ply", {"opacity": ("float", values)})
    np.testing.assert_allclose(Splats.load(tmp_path / "a.ply").opacities, 1 / (1 + np.exp(-values)), rtol=1e-6)


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


def write_text(
    path: Path, change: Callable[[list[str]], list[str]], before: str = "", first: tuple[str, ...] = ()
) -> Splats:
    """Write splats as text with changed rows; return them."""
    splats = random_splats(120, degree=0)
    splats.save(path)
    head, _, rows = path.read_bytes().partition(b"end_header\n")
    head = head.replace(b"binary_little_endian", b"ascii").replace(
        b"element vertex", before.encode() + b"element vertex"
    )
    values = np.frombuffer(rows, "<f4").reshape(120, -1)
    lines = [*first, *change([" ".join(f"{value:.9g}" for value in row) for row in values])]
    path.write_bytes(head + b"end_header\n" + "\n".join(lines).encode())
    return splats


def test_text_rows_after_other_elements_are_read(tmp_path: Path) -> None:
    before = "element face 2\nproperty list uchar int vertex_indices\n"
    splats = write_text(tmp_path / "a.ply", lambda rows: rows, before, ("3 0 1 2", "4 0 1 2 3"))
    np.testing.assert_allclose(Splats.load(tmp_path / "a.ply").means, splats.means, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda row: row + " 7", r"row 0 of the vertices must have 17 numbers \(got 18 numbers\)"),
        (lambda row: row.rpartition(" ")[0], r"row 0 of the vertices must have 17 numbers \(got 16 numbers\)"),
        (lambda row: row.replace(".", ","), r"vertices must be numbers with a decimal point \(could not convert '"),
    ],
)
def test_text_rows_of_another_form_are_refused(tmp_path: Path, change: Callable[[str], str], sentence: str) -> None:
    """One more number in each row moved all values to other columns."""
    write_text(tmp_path / "a.ply", lambda rows: [change(row) for row in rows])
    with pytest.raises(InputError, match=rf"a\.ply: {sentence}"):
        Splats.load(tmp_path / "a.ply")


@pytest.mark.parametrize("form", ["text", "binary"])
def test_rows_beyond_the_stated_number_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture, form: str) -> None:
    if form == "text":
        write_text(tmp_path / "a.ply", lambda rows: rows)
    else:
        random_splats(120, degree=0).save(tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"vertex 120", b"vertex 118"))
    assert len(Splats.load(tmp_path / "a.ply")) == 118
    assert caplog.messages == [
        f"{tmp_path / 'a.ply'}: 2 rows after the 118 Gaussians that its header states are not used"
    ]


@pytest.mark.parametrize("thickness", [-1e10, -np.inf, -100.0])
def test_a_third_scale_of_zero_makes_flat_gaussians(tmp_path: Path, thickness: float) -> None:
    rewrite(tmp_path / "a.ply", {"scale_2": ("float", np.full(200, thickness))})
    splats = random_splats(200, degree=0)
    loaded = Splats.load(tmp_path / "a.ply").scales
    np.testing.assert_allclose(loaded[:, :2], splats.scales[:, :2], rtol=1e-5)
    np.testing.assert_allclose(loaded[:, 2], 0.01 * splats.scales[:, :2].min(axis=1), rtol=1e-5)


def test_a_constant_third_scale_that_is_large_is_refused(tmp_path: Path) -> None:
    """It would be a thickness of one unit."""
    rewrite(tmp_path / "a.ply", {"scale_2": ("float", np.zeros(200))})
    with pytest.raises(
        InputError, match=r"a\.ply: scale_2 .*\(got 0 for all\): if the Gaussians are flat \(2DGS\), remove"
    ):
        Splats.load(tmp_path / "a.ply")


def test_linear_scales_of_a_large_cloud_are_refused(tmp_path: Path) -> None:
    """The median size is plausible there, but that of the largest Gaussian is not."""
    rng = np.random.default_rng(0)
    means = {axis: ("float", rng.uniform(-100, 100, 200)) for axis in "xyz"}
    scales = {f"scale_{k}": ("float", np.exp(rng.normal(0, 1, 200)) + 0.1) for k in range(3)}
    rewrite(tmp_path / "a.ply", means | scales)
    with pytest.raises(InputError, match=r"a\.ply: scale_0 to scale_2 of a PLY file must be logarithms"):
        Splats.load(tmp_path / "a.ply")


def test_coefficients_that_look_like_colours_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    values = np.random.default_rng(0).uniform(0, 1, (3, 200))
    rewrite(tmp_path / "a.ply", {f"f_dc_{k}": ("float", values[k]) for k in range(3)})
    Splats.load(tmp_path / "a.ply")
    (message,) = caplog.messages
    assert "its coefficients f_dc_0 to f_dc_2 lie in 0 to 1" in message


@pytest.mark.parametrize("suffix", [".ply", ".splat"])
def test_positions_that_32_bits_cannot_hold_are_refused(tmp_path: Path, suffix: str) -> None:
    """Coordinates of a map had steps of half a metre, so that all splats were in a few planes."""
    splats = random_splats(200, degree=0)
    replace(splats, means=splats.means + np.float32([5e5, 5e6, 100])).save(tmp_path / f"a{suffix}")
    with pytest.raises(
        InputError, match=r"positions must be near the origin \(got up to 5e\+06, .* steps of 0\.5, for"
    ):
        Splats.load(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (b"element chunk 2", b"element chunk 1", r"a chunk for every 256 of their 300 Gaussians \(got 1 chunks\)"),
        (b"element sh 300", b"element sh 299", r"element sh must have a row for each of the 300 Gaussians \(got 299\)"),
    ],
)
def test_compressed_files_that_contradict_themselves_are_refused(
    tmp_path: Path, old: bytes, new: bytes, sentence: str
) -> None:
    data = encoded(random_splats(300, degree=1), "compressed.ply", tmp_path)
    assert old in data
    (tmp_path / "a.compressed.ply").write_bytes(data.replace(old, new))
    with pytest.raises(InputError, match=sentence):
        Splats.load(tmp_path / "a.compressed.ply")
