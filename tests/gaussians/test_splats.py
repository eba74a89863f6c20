"""Splats: validation, SH rotation, round trips through files, and malformed files."""

import gzip
import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path

import gaussforge
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from mitsplat.errors import InputError
from mitsplat.gaussians import splat_files
from mitsplat.gaussians.ply_files import decode_ply
from mitsplat.gaussians.spherical_harmonics import SH_C0, evaluate_sh, sh_basis, sh_rotation
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_converter import convert_apart

DATA = Path(__file__).parents[3] / "shared/data/splats"
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7])


def random_splats(count: int = 200, degree: int = 0, extent: float = 1.0) -> Splats:
    rng = np.random.default_rng(degree)
    return Splats(
        means=rng.uniform(-extent, extent, (count, 3)) * (1.0, 0.5, 0.25),  # unequal along x, y and z
        quats=rng.normal(size=(count, 4)),
        scales=extent * np.exp(rng.uniform(-5, -2, (count, 3))),
        opacities=rng.uniform(0.05, 0.95, count),
        sh=rng.uniform(-0.4, 0.4, (count, (degree + 1) ** 2, 3)),
    )


def directions(count: int = 100) -> np.ndarray:
    vectors = np.random.default_rng(1).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def covariances(splats: Splats) -> np.ndarray:
    axes = Rotation.from_quat(splats.quats).as_matrix() * splats.scales[:, None, :].astype(np.float64)
    return axes @ axes.transpose(0, 2, 1)


def pose(scale: float = 1.0, turn: Rotation = TURN, shift: tuple[float, float, float] = (1.0, -2.0, 0.5)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn.as_matrix()
    matrix[:3, 3] = shift
    return matrix


def encoded(splats: Splats, form: str, folder: Path) -> bytes:
    """Encode splats as a file of another program."""
    splats.save(folder / "source.ply")
    return bytes(gaussforge.GaussForge().convert((folder / "source.ply").read_bytes(), "ply", form)["data"])


def trained_ply(splats: Splats, order: str = "<", normals: bool = False, extra: bool = False) -> bytes:
    """Write the layout of save_ply of 3DGS, without mitsplat."""
    width = splats.sh.shape[1] - 1
    table = {name: splats.means[:, i] for i, name in enumerate("xyz")}
    if normals:
        table |= {name: np.zeros(len(splats)) for name in ("nx", "ny", "nz")}
    table |= {f"f_dc_{c}": splats.sh[:, 0, c] for c in range(3)}
    table |= {f"f_rest_{c * width + k}": splats.sh[:, 1 + k, c] for c in range(3) for k in range(width)}
    table["opacity"] = np.log(splats.opacities / (1 - splats.opacities))
    table |= {f"scale_{i}": np.log(splats.scales[:, i]) for i in range(3)}
    table |= {f"rot_{i}": splats.quats[:, j] for i, j in enumerate((3, 0, 1, 2))}
    kinds = dict.fromkeys(table, "f4")
    if extra:
        table = {"label": np.arange(len(splats)) % 7, **table}
        kinds = {"label": "u1", **kinds}
    words = {"f4": "float", "u1": "uchar"}
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "a": "ascii"}[order]
    properties = "".join(f"property {words[kind]} {name}\n" for name, kind in kinds.items())
    header = f"ply\nformat {form} 1.0\ncomment trained\nelement vertex {len(splats)}\n{properties}end_header\n".encode()
    if order == "a":
        return (
            header + "\n".join(" ".join(f"{v:.9g}" for v in row) for row in zip(*table.values(), strict=True)).encode()
        )
    rows = np.empty(len(splats), [(name, order + kind) for name, kind in kinds.items()])
    for name, column in table.items():
        rows[name] = column
    return header + rows.tobytes()


def assert_close(actual: Splats, expected: Splats, *, mean: float, log_scale: float, opacity: float, sh: float) -> None:
    """Assert that two splats have the same Gaussians in the same order.

    ``mean`` is relative to the extent; quaternions are equal up to sign.
    """
    extent = np.abs(expected.means).max()
    assert np.abs(actual.means - expected.means).max() <= mean * extent
    assert np.abs(np.log(actual.scales / expected.scales)).max() <= log_scale
    assert np.abs(actual.opacities - expected.opacities).max() <= opacity
    assert np.abs(actual.sh - expected.sh).max() <= sh
    assert np.abs(np.sum(actual.quats * expected.quats, axis=1)).min() > 1 - 1e-4


class TestRules:
    def test_arrays_are_frozen_contiguous_float32_copies(self):
        source = {f: np.asfortranarray(getattr(random_splats(), f), np.float64) for f in SplatArrays._fields}
        splats = Splats(**source)
        for name, given_array in source.items():
            array = getattr(splats, name)
            assert array.dtype == np.float32 and array.flags.c_contiguous and not np.shares_memory(array, given_array)
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0

    def test_quaternions_are_normalised_once(self):
        splats = replace(random_splats(), quats=3 * random_splats().quats)
        assert np.abs(np.linalg.norm(splats.quats, axis=1) - 1).max() < 1e-6
        assert np.array_equal(replace(splats).quats, splats.quats)

    @pytest.mark.parametrize(
        ("name", "value", "sentence"),
        [
            ("means", np.nan, r"means must be finite \(got nan at row 17\)"),
            ("means", 1e39, r"means must be finite \(got inf at row 17\)"),
            ("quats", 0.0, r"quats must be of non-zero length \(got 0 at row 17\)"),
            ("quats", np.inf, r"quats must be finite \(got inf at row 17\)"),
            ("scales", 0.0, r"scales must be finite and > 0 \(got 0 at row 17\)"),
            ("scales", -0.1, r"scales must be finite and > 0 \(got -0.1 at row 17\)"),
            ("scales", np.inf, r"scales must be finite and > 0 \(got inf at row 17\)"),
            ("opacities", 1.1, r"opacities must be in \[0, 1\] \(got 1.1 at row 17\)"),
            ("opacities", np.nan, r"opacities must be in \[0, 1\] \(got nan at row 17\)"),
            ("sh", np.inf, r"sh must be finite \(got inf at row 17\)"),
        ],
    )
    def test_values_out_of_range_are_refused_with_their_row(self, name, value, sentence):
        array = getattr(random_splats(), name).astype(np.float64)
        array[17] = value
        with pytest.raises(InputError, match=sentence):
            replace(random_splats(), **{name: array})

    @pytest.mark.parametrize("field", SplatArrays._fields)
    def test_arrays_of_wrong_shape_are_refused(self, field):
        with pytest.raises(InputError, match=f"^{field if field != 'means' else 'quats'} must have shape"):
            replace(random_splats(), **{field: getattr(random_splats(), field)[:-1]})
        with pytest.raises(InputError, match="sh must have shape"):
            replace(random_splats(), sh=np.zeros((200, 2, 3)))

    def test_a_cloud_without_gaussians_is_valid(self, tmp_path):
        empty = random_splats().select(slice(0))
        assert len(empty) == 0 and len(empty.transformed(pose())) == 0
        empty.save(tmp_path / "empty.ply")
        assert len(Splats.load(tmp_path / "empty.ply")) == 0
        with pytest.raises(ValueError, match="at least one"):
            _ = empty.bounds

    def test_select_takes_masks_indices_and_slices(self):
        splats = random_splats(degree=1)
        mask = splats.means[:, 0] > 0
        assert np.array_equal(splats.select(mask).sh, splats.sh[mask])
        assert np.array_equal(splats.select([5, 2]).quats, splats.quats[[5, 2]])
        assert np.array_equal(splats.select(mask).bounds, [splats.means[mask].min(0), splats.means[mask].max(0)])

    def test_concatenate_pads_to_the_highest_degree(self):
        low, high = random_splats(30, degree=1), random_splats(20, degree=3)
        both = Splats.concatenate([low, high])
        assert both.sh_degree == 3 and len(both) == 50
        colours = evaluate_sh(both.sh, directions(50))
        assert np.allclose(colours[:30], evaluate_sh(low.sh, directions(50)[:30]))
        assert np.allclose(colours[30:], evaluate_sh(high.sh, directions(50)[30:]))
        with pytest.raises(ValueError, match="at least one"):
            Splats.concatenate([])


class TestSphericalHarmonics:
    def test_the_basis_is_real_with_the_condon_shortley_phase(self):
        d = directions()
        theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
        expected = []
        for band in range(4):
            for order in range(-band, band + 1):
                value = sph_harm_y(band, abs(order), theta, phi)
                part = value.real if order >= 0 else value.imag
                expected.append(part * (1 if order == 0 else np.sqrt(2)))
        assert np.abs(sh_basis(d, 3) - np.stack(expected, axis=1)).max() < 1e-12

    def test_first_band_is_minus_y_z_minus_x(self):
        x, y, z = np.eye(3)
        constant = np.sqrt(3 / (4 * np.pi))
        assert np.allclose(sh_basis([y, z, x], 1)[:, 1:], constant * np.diag([-1, 1, -1]))

    @pytest.mark.parametrize("degree", range(4))
    def test_rotated_coefficients_give_the_rotated_function(self, degree):
        turn = sh_rotation(TURN.as_matrix(), degree)
        sh = np.random.default_rng(0).normal(size=(degree + 1) ** 2)
        d = directions()
        assert np.abs(sh_basis(TURN.apply(d), degree) @ turn @ sh - sh_basis(d, degree) @ sh).max() < 1e-12

    def test_rotation_matrices_are_orthogonal_and_compose(self):
        other = Rotation.from_rotvec([-2.0, 0.4, 0.1])
        a, b, ab = (sh_rotation(r.as_matrix(), 3) for r in (TURN, other, TURN * other))
        assert np.allclose(a @ b, ab, atol=1e-12)
        assert np.allclose(a @ a.T, np.eye(16), atol=1e-12)

    def test_colour_is_clamped_below_only(self):
        sh = np.array([[[-9.0, 0.0, 9.0]]])
        assert np.allclose(evaluate_sh(sh, [[0, 0, 1]]), [[0, 0.5, 0.5 + 9 * SH_C0]])


class TestTransformed:
    @pytest.mark.parametrize("degree", range(4))
    def test_colours_rotate_with_the_object(self, degree):
        splats = random_splats(100, degree)
        turned = splats.transformed(pose(scale=2.5))
        d = directions()
        assert np.abs(evaluate_sh(turned.sh, TURN.apply(d)) - evaluate_sh(splats.sh, d)).max() < 1e-5

    def test_shapes_move_with_the_object(self):
        splats = random_splats()
        moved = splats.transformed(pose(scale=0.3))
        linear = 0.3 * TURN.as_matrix()
        assert np.allclose(moved.means, splats.means @ linear.T + (1.0, -2.0, 0.5), atol=1e-6)
        assert np.allclose(covariances(moved), linear @ covariances(splats) @ linear.T, rtol=1e-5, atol=1e-9)

    def test_two_transformations_equal_their_product(self):
        splats, first, second = random_splats(degree=3), pose(2.0), pose(0.7, Rotation.from_rotvec([2, 0, -1]))
        stepwise, at_once = splats.transformed(first).transformed(second), splats.transformed(second @ first)
        assert_close(stepwise, at_once, mean=1e-6, log_scale=1e-6, opacity=0, sh=1e-6)
        assert_close(
            stepwise.transformed(np.linalg.inv(second @ first)), splats, mean=3e-6, log_scale=1e-6, opacity=0, sh=1e-6
        )

    @pytest.mark.parametrize(
        ("matrix", "sentence"),
        [
            (np.diag([1.0, 1.0, -1.0, 1.0]), "neither mirror nor flatten"),
            (np.diag([1.0, 1.0, 0.0, 1.0]), "neither mirror nor flatten"),
            (np.diag([1.0, 1.0, 2.0, 1.0]), "scale uniformly and not shear"),
            (np.eye(4) + 0.1 * np.eye(4, k=1), "scale uniformly and not shear|last row"),
            (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
            (np.full((4, 4), np.nan), "finite"),
            (np.eye(3), "4x4"),
        ],
    )
    def test_matrices_that_are_no_similarity_are_refused(self, matrix, sentence):
        with pytest.raises(ValueError, match=sentence):
            random_splats().transformed(matrix)


class TestFiles:
    @pytest.mark.parametrize("degree", range(4))
    @pytest.mark.parametrize("order", ["<", ">", "a"])
    def test_ply_files_of_3dgs_are_read(self, tmp_path, degree, order):
        splats = random_splats(20, degree)
        (tmp_path / "trained.ply").write_bytes(trained_ply(splats, order, normals=degree % 2 == 0, extra=degree == 3))
        assert_close(Splats.load(tmp_path / "trained.ply"), splats, mean=1e-7, log_scale=2e-6, opacity=1e-6, sh=1e-7)

    @pytest.mark.parametrize("degree", range(4))
    def test_ply_files_keep_all_values(self, tmp_path, degree):
        splats = random_splats(degree=degree)
        splats = replace(splats, opacities=np.r_[0.0, 1.0, 1e-30, 1 - 2.0**-24, splats.opacities[4:]])
        splats.save(tmp_path / "a.ply")
        loaded = Splats.load(tmp_path / "a.ply")
        assert_close(loaded, splats, mean=0, log_scale=1e-6, opacity=1e-7, sh=0)
        assert (
            loaded.opacities[0] == 0
            and loaded.opacities[1] == 1
            and loaded.opacities[2] == pytest.approx(1e-30, rel=1e-4)
        )
        assert np.isfinite(np.frombuffer((tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[2], "<f4")).all()

    def test_a_splat_file_is_read_byte_by_byte(self, tmp_path):
        # The last four bytes are a rotation by 180 degrees about x.
        row = struct.pack("<6f4B4B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 102, 128, 255, 128, 128)
        (tmp_path / "a.splat").write_bytes(row)
        splats = Splats.load(tmp_path / "a.splat")
        assert np.allclose(splats.means, [[1, 2, 3]]) and np.allclose(splats.scales, [[0.1, 0.2, 0.3]])
        assert np.allclose(evaluate_sh(splats.sh, [[0, 0, 1]]), [[1, 0, 0.2]], atol=1e-6)
        assert np.allclose(splats.opacities, 0.4) and np.allclose(splats.quats, [[1, 0, 0, 0]])
        splats.save(tmp_path / "b.splat")
        assert (tmp_path / "b.splat").read_bytes() == row

    def test_splat_files_keep_all_but_view_dependence(self, tmp_path):
        splats = random_splats(degree=2)
        splats.save(tmp_path / "a.splat")
        flat = replace(splats, sh=splats.sh[:, :1])
        # Colours and opacities: half a step of 1/255.
        assert_close(Splats.load(tmp_path / "a.splat"), flat, mean=0, log_scale=0, opacity=0.00197, sh=0.00197 / SH_C0)

    @pytest.mark.parametrize("extent", [0.01, 1.0, 3000.0])
    @pytest.mark.parametrize("degree", range(4))
    def test_spz_files_keep_values_within_their_quantisation(self, tmp_path, degree, extent):
        splats = replace(random_splats(degree=degree, extent=extent), scales=random_splats().scales)
        splats.save(tmp_path / "a.spz")
        # Positions: 23 bits, at least 2^-24 units; log scales: half of 1/16; SH: half of 1/8 and of 1/128.
        assert_close(
            Splats.load(tmp_path / "a.spz"),
            splats,
            mean=max(2.0**-22, 2.0**-23 / extent),
            log_scale=0.0313,
            opacity=0.00197,
            sh=0.0665,
        )
        again = (tmp_path / "a.spz").read_bytes()
        splats.save(tmp_path / "a.spz")
        assert (tmp_path / "a.spz").read_bytes() == again

    @pytest.mark.parametrize("degree", range(4))
    def test_spz_files_are_decoded_as_by_gaussforge(self, tmp_path, degree):
        random_splats(500, degree=degree).save(tmp_path / "a.spz")
        data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
        turns = slice(16 + 500 * 16, 16 + 500 * 20)  # rotations; all other bytes may be random
        kept, data[16:] = data[turns], np.random.default_rng(degree).bytes(len(data) - 16)
        data[turns] = kept
        (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data)))
        converted = decode_ply(convert_apart((tmp_path / "a.spz").read_bytes(), "spz", "ply"))
        for name, array in splat_files.read_splats(tmp_path / "a.spz")[0]._asdict().items():
            np.testing.assert_array_equal(array, getattr(converted, name), err_msg=name, strict=True)

    def test_spz_files_of_version_2_are_read(self, tmp_path):
        means, quats = np.float32([[0.5, -0.25, 2.0]]), np.float32([[0.5, -0.5, 0.5, 0.5]])
        positions = (means * 4096).astype("<i4").view(np.uint8).reshape(1, 3, 4)[..., :3].tobytes()
        turns = np.rint(127.5 * (quats[:, :3] + 1)).astype(np.uint8).tobytes()
        header = struct.pack("<4s2I4B", b"NGSP", 2, 1, 0, 12, 0, 0)
        (tmp_path / "a.spz").write_bytes(
            gzip.compress(header + positions + b"\xff" + bytes(3) + bytes([96] * 3) + turns)
        )
        loaded = Splats.load(tmp_path / "a.spz")
        np.testing.assert_array_equal(loaded.means, means)
        np.testing.assert_allclose(loaded.quats, quats, atol=0.01)
        np.testing.assert_allclose(loaded.scales, np.exp(-4), rtol=1e-6)

    @pytest.mark.parametrize("missing", [1, 9, 200])
    def test_truncated_spz_files_are_refused(self, tmp_path, missing):
        """Without its last nine bytes, the gzip stream still decodes to all Gaussians, but has no checksum."""
        random_splats(50).save(tmp_path / "a.spz")
        (tmp_path / "a.spz").write_bytes((tmp_path / "a.spz").read_bytes()[:-missing])
        with pytest.raises(InputError, match=r"a\.spz: not a complete spz file"):
            Splats.load(tmp_path / "a.spz")

    def test_spz_files_keep_opacities_zero_and_one(self, tmp_path):
        replace(random_splats(2), opacities=[0.0, 1.0]).save(tmp_path / "a.spz")
        assert Splats.load(tmp_path / "a.spz").opacities.tolist() == [0.0, 1.0]

    @pytest.mark.parametrize(
        ("form", "mean", "log_scale", "opacity", "sh"),
        [
            ("compressed.ply", 2e-3, 4e-3, 0.003, 0.0321),
            ("sog", 1e-4, 0.05, 0.004, 0.05),
        ],
    )
    def test_converted_formats_are_read_within_their_quantisation(self, tmp_path, form, mean, log_scale, opacity, sh):
        splats = random_splats(degree=3)
        source = splats
        if form == "compressed.ply":  # the writer swaps the axes of the higher bands
            swapped = splats.sh[:, 1:].transpose(0, 2, 1).reshape(-1, 15, 3)
            source = replace(splats, sh=np.concatenate([splats.sh[:, :1], swapped], axis=1))
        (tmp_path / f"a.{form}").write_bytes(encoded(source, form, tmp_path))
        loaded = Splats.load(tmp_path / f"a.{form}")
        assert len(loaded) == len(splats)
        loaded = loaded.select(cKDTree(loaded.means).query(splats.means)[1])  # SOG reorders Gaussians
        assert_close(loaded, splats, mean=mean, log_scale=log_scale, opacity=opacity, sh=sh)

    def test_units_scale_means_and_scales(self, tmp_path):
        random_splats().save(tmp_path / "a.ply")
        loaded = Splats.load(tmp_path / "a.ply", units=0.001)
        assert np.allclose(loaded.means, 0.001 * random_splats().means)
        assert np.allclose(loaded.scales, 0.001 * random_splats().scales)

    @pytest.mark.skipif(not DATA.is_dir(), reason="the shared test data is not here")
    @pytest.mark.parametrize(
        ("name", "count"), [("plant", 113648), ("academic_tarot_cards", 114865), ("torus_10k", 10000)]
    )
    def test_published_captures_are_read_with_their_counts(self, tmp_path, name, count):
        splats = Splats.load(DATA / f"{name}.splat")
        assert len(splats) == count and splats.sh_degree == 0
        assert np.ptp(splats.bounds, axis=0).max() == pytest.approx(1, abs=1e-3)
        splats.save(tmp_path / "again.splat")
        assert np.abs(Splats.load(tmp_path / "again.splat").sh - splats.sh).max() < 1e-6


def ply_header(count: int | str = 1, properties: str | None = None, form: str = "binary_little_endian") -> bytes:
    names = (properties or "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3").split()
    lines = "".join(f"property float {name}\n" for name in names)
    return f"ply\nformat {form} 1.0\nelement vertex {count}\n{lines}end_header\n".encode()


ROW = struct.pack("<14f", 0, 0, 0, 0, 0, 0, 0, -3, -3, -3, 1, 0, 0, 0)


class TestBadFiles:
    @pytest.mark.parametrize(
        ("name", "data", "sentence"),
        [
            ("a.ply", b"", "the file is empty"),
            ("a.splat", b"", "the file is empty"),
            ("a.png", b"x", "must be .ply, .*got suffix '.png'"),
            ("a.ply", b"solid cube", "must have a header"),
            ("a.ply", b"ply\n" + 70000 * b"x", "must have a header"),
            ("a.ply", ply_header(2) + ROW, r"states 2 Gaussians in at least 112 bytes \(got 56 bytes\)"),
            ("a.ply", ply_header(4_000_000_000) + ROW, "states 4000000000 Gaussians"),
            ("a.ply", ply_header(10**17) + ROW, "states 1"),
            ("a.ply", ply_header(4_000_000_000, form="ascii") + b"1 2 3", "states 4000000000 Gaussians"),
            ("a.ply", ply_header(1, form="ascii") + 4 * b" 1234567", r"14 numbers \(got 4 numbers\)"),
            ("a.ply", ply_header(1, form="ascii") + 14 * b"x ", "could not convert"),
            ("a.ply", ply_header(-1) + ROW, r"line 3 of the PLY header is not valid \(got 'element vertex -1'\)"),
            ("a.ply", ply_header(1, "x y z"), r"must have the vertex properties f_dc_0, .* \(missing\)"),
            ("a.ply", ply_header(0, "x x"), "more than once"),
            ("a.ply", ply_header().replace(b"float x", b"quad x") + ROW, "line 4 of the PLY header"),
            ("a.ply", ply_header().replace(b"float x", b"list uchar int x") + ROW, "list properties"),
            ("a.ply", ply_header().replace(b"vertex", b"face") + ROW, "must have a vertex element"),
            ("a.ply", ply_header().replace(b"rot_3\n", b"rot_3\nproperty float f_rest_0\n"), "f_rest must be numbered"),
            ("a.ply", ply_header() + b"\xff\xff\xff\xff" + ROW[4:], r"means must be finite \(got nan at row 0\)"),
            ("a.ply", ply_header() + ROW[:28] + struct.pack("<f", 1e3) + ROW[32:], r"scales .*\(got inf at row 0\)"),
            ("a.ply", ply_header() + ROW[:28] + struct.pack("<f", -1e3) + ROW[32:], r"scales .*\(got 0 at row 0\)"),
            ("a.ply", ply_header() + ROW[:40] + bytes(16), r"quats must be of non-zero length \(got 0 at row 0\)"),
            ("a.splat", bytes(31), r"32 bytes per Gaussian \(got 31 bytes\)"),
            ("a.splat", bytes(32), r"scales must be finite and > 0 \(got 0 at row 0\)"),
            ("a.spz", b"not gzip", "not a valid spz file"),
            ("a.ksplat", b"short", "not a valid ksplat file"),
            ("a.sog", b"not zip", "not a valid sog file"),
        ],
    )
    def test_a_damaged_file_is_refused_in_one_sentence_with_its_name(self, tmp_path, name, data, sentence):
        path = tmp_path / name
        path.write_bytes(data)
        tracemalloc.start()
        try:
            with pytest.raises(InputError, match=sentence) as error:
                Splats.load(path)
            assert tracemalloc.get_traced_memory()[1] < 2**22
        finally:
            tracemalloc.stop()
        assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)

    def test_a_missing_file_and_a_folder_are_refused(self, tmp_path):
        with pytest.raises(InputError, match=r"none\.ply: cannot be read \(No such file"):
            Splats.load(tmp_path / "none.ply")
        (tmp_path / "folder.ply").mkdir()
        with pytest.raises(InputError, match="must be a file"):
            Splats.load(tmp_path / "folder.ply")

    def test_a_crash_of_a_decoder_is_reported_in_one_sentence(self, tmp_path):
        data = bytearray(encoded(random_splats(), "ksplat", tmp_path))
        # Number of Gaussians in the first section, which gaussforge does not check.
        data[4096:4100] = struct.pack("<I", 4_000_000_000)
        with pytest.raises(InputError, match=r"not a valid ksplat file \(its decoder stopped with status -\d+\)"):
            convert_apart(bytes(data), "ksplat", "ply")
        (tmp_path / "a.ksplat").write_bytes(data)
        with pytest.raises(InputError, match=r"not a valid ksplat file \(a section extends beyond the file\)"):
            Splats.load(tmp_path / "a.ksplat")

    @pytest.mark.parametrize("name", ["a.obj", "a.compressed.ply", "a"])
    def test_formats_that_cannot_be_written_are_refused(self, tmp_path, name):
        with pytest.raises(InputError, match="can be written as"):
            random_splats().save(tmp_path / name)

    def test_a_failed_write_leaves_no_file(self, tmp_path):
        with pytest.raises(InputError, match="cannot be written"):
            random_splats().save(tmp_path / "none" / "a.ply")
        (tmp_path / "a.ply").mkdir()
        with pytest.raises(InputError, match="cannot be written"):
            random_splats().save(tmp_path / "a.ply")
        with pytest.raises(InputError, match="at least one Gaussian"):
            random_splats().select(slice(0)).save(tmp_path / "a.spz")
        assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]

    @settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(
        form=st.sampled_from(["ply", "splat"]),
        keep=st.floats(0, 1),
        changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4),
        tail=st.binary(max_size=40),
    )
    def test_random_damage_is_refused_or_gives_valid_splats(self, tmp_path, form, keep, changes, tail):
        random_splats(10, degree=1).save(tmp_path / f"a.{form}")
        data = bytearray((tmp_path / f"a.{form}").read_bytes())
        for place, value in changes:
            data[int(place * min(len(data), 900))] = value
        (tmp_path / f"b.{form}").write_bytes(data[: int(keep * len(data))] + tail)
        self.load_or_refuse(tmp_path / f"b.{form}")

    @pytest.mark.parametrize(
        "form",
        ["spz", "sog", *(pytest.param(form, marks=pytest.mark.extended) for form in ("compressed.ply", "ksplat"))],
    )
    def test_random_damage_of_converted_formats_is_refused_or_gives_valid_splats(self, tmp_path, form):
        whole, rng = encoded(random_splats(300, degree=1), form, tmp_path), np.random.default_rng(0)
        path = tmp_path / f"a.{form}"
        for _ in range(15):
            path.write_bytes(whole[: rng.integers(1, len(whole))])
            with pytest.raises(InputError):
                Splats.load(path)
            data = bytearray(whole)
            data[rng.integers(min(len(data), 6000))] = rng.integers(256)
            path.write_bytes(data)
            self.load_or_refuse(path)

    @staticmethod
    def load_or_refuse(path):
        try:
            Splats.load(path)
        except InputError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)
