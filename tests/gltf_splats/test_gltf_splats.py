"""Gaussian splats in glTF: files that the tests write by the standard, and round trips."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0, sh_basis
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import Z_UP_FROM_Y_UP
from mitsplat.gltf_splats.splat_reading import read_gltf_splats
from mitsplat.gltf_splats.splat_writing import write_gltf_splats
from mitsplat.images.colour import encode_srgb
from mitsplat.importing.splat_import import FROM_GLTF_AXES
from mitsplat.importing.upright import axis_vector
from mitsplat.mesh_files.mesh_reading import read_mesh_file
from mitsplat.renderer.layers import render_splats
from tests.cli.typed import run
from tests.conftest import box_asset
from tests.mesh_files.glb import Glb

EXTENSION = "KHR_gaussian_splatting"


def random_splats(degree: int = 3, count: int = 40) -> Splats:
    rng = np.random.default_rng(degree)
    return Splats(
        means=rng.uniform(-0.1, 0.1, (count, 3)),
        quats=Rotation.random(count, rng=rng).as_quat(),
        scales=rng.uniform(0.001, 0.02, (count, 3)),
        opacities=rng.uniform(0, 1, count),
        sh=rng.uniform(-0.5, 0.5, (count, (degree + 1) ** 2, 3)),
    )


def covariances(splats: Splats) -> np.ndarray:
    axes = Rotation.from_quat(splats.quats).as_matrix() * splats.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def one_splat(
    glb: Glb, sh: np.ndarray, *, scales: tuple[float, float, float] = (0.3, 0.2, 0.1), **properties: Any
) -> int:
    """Add a mesh with a Gaussian at (1, 2, 3) that is long in x, whose colour has the coefficients (K, 3)."""
    values = {
        "POSITION": (1.0, 2.0, 3.0),
        f"{EXTENSION}:ROTATION": (0.0, 0.0, 0.0, 1.0),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": (0.75,),
    }
    attributes = {name: glb.accessor(np.array([value], np.float32)) for name, value in values.items()}
    names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
    attributes |= {name: glb.accessor(row[None].astype(np.float32)) for name, row in zip(names, sh, strict=False)}
    stored = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **properties}
    return glb.mesh(attributes, mode=0, extensions={EXTENSION: stored})


def test_attributes_and_poses_of_nodes_follow_the_standard(tmp_path: Path) -> None:
    """Scales and opacity are activated, y points up, and colours turn with their node."""
    glb, sh = Glb(), np.random.default_rng(1).uniform(-0.2, 0.2, (16, 3))
    mesh = one_splat(glb, sh)
    turn = Rotation.from_euler("z", 90, degrees=True)  # the long axis becomes vertical
    nodes = [
        {"children": [1], "scale": [2, 2, 2]},
        {"mesh": mesh, "translation": [0, 0, 10], "rotation": turn.as_quat().tolist()},
        {"mesh": mesh},
    ]
    splats = read_gltf_splats(glb.save(tmp_path / "a.glb", nodes=nodes, scenes=[{"nodes": [0, 2]}], scene=0))
    np.testing.assert_allclose(splats.means, [(-4, -26, 2), (1, -3, 2)], atol=1e-5)
    np.testing.assert_allclose(splats.opacities, 0.75)
    # In the axes x, y, z of mitsplat, the second Gaussian has the scales of x, z, y of the file.
    np.testing.assert_allclose(np.diag(covariances(splats)[1]), np.square([0.3, 0.1, 0.2]), rtol=1e-5)
    np.testing.assert_allclose(np.diag(covariances(splats)[0]), np.square([0.4, 0.2, 0.6]), rtol=1e-5)
    directions = Rotation.random(5, rng=np.random.default_rng(2)).as_matrix()[:, 0]
    in_file = np.stack([directions[:, 0], directions[:, 2], -directions[:, 1]], axis=1)
    found = sh_basis(directions, 3) @ splats.sh.astype(np.float64)
    np.testing.assert_allclose(found[1], sh_basis(in_file, 3) @ sh, atol=1e-5)
    np.testing.assert_allclose(found[0], sh_basis(turn.inv().apply(in_file), 3) @ sh, atol=1e-5)


def test_a_given_up_axis_is_an_axis_of_the_file() -> None:
    for axis, read in FROM_GLTF_AXES.items():
        np.testing.assert_array_equal(Z_UP_FROM_Y_UP[:3, :3] @ axis_vector(axis), axis_vector(read))


def test_linear_colours_are_encoded(tmp_path: Path) -> None:
    glb = Glb()
    mesh = one_splat(glb, (np.array([[0.2, 0.5, 0.9]]) - 0.5) / SH_C0, colorSpace="lin_rec709_display")
    splats = read_gltf_splats(glb.save(tmp_path / "a.glb", nodes=[{"mesh": mesh}], scenes=[{"nodes": [0]}], scene=0))
    np.testing.assert_allclose(0.5 + SH_C0 * splats.sh[0, 0], encode_srgb(np.array([0.2, 0.5, 0.9])), atol=1e-4)


def test_logarithms_of_scales_of_earlier_drafts_are_recognised_by_their_sign(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for scales, expected in (((0.3, 0.0, 0.1), (0.3, 0.1, 3e-7)), ((-1.0, 0.5, -3.0), np.exp([-1.0, -3.0, 0.5]))):
        glb = Glb()
        mesh = one_splat(glb, np.zeros((1, 3)), scales=scales)
        caplog.clear()
        found = read_gltf_splats(glb.save(tmp_path / "a.glb", nodes=[{"mesh": mesh}], scenes=[{"nodes": [0]}], scene=0))
        # In the axes x, y, z of mitsplat, the Gaussian has the scales of x, z, y of the file.
        np.testing.assert_allclose(np.sqrt(np.diag(covariances(found)[0])), expected, rtol=1e-3)
        warned = "not read: negative scales; they are taken for the logarithms of earlier drafts" in caplog.text
        assert warned == (min(scales) < 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_written_file_is_read_unchanged(tmp_path: Path, degree: int) -> None:
    splats = random_splats(degree)
    write_gltf_splats(splats, tmp_path / "a.glb", name="a")
    found = read_gltf_splats(tmp_path / "a.glb")
    np.testing.assert_allclose(found.means, splats.means, atol=1e-7)
    np.testing.assert_allclose(covariances(found), covariances(splats), atol=1e-9)
    np.testing.assert_array_equal(found.opacities, splats.opacities)
    np.testing.assert_allclose(found.sh, splats.sh, atol=1e-6)


def test_a_compressed_file_is_read_within_the_steps_of_spz(tmp_path: Path) -> None:
    splats = random_splats()
    write_gltf_splats(splats, tmp_path / "a.glb", name="a", spz=True)
    found = read_gltf_splats(tmp_path / "a.glb")
    np.testing.assert_allclose(found.means, splats.means, atol=1e-6)
    np.testing.assert_allclose(found.opacities, splats.opacities, atol=0.003)
    np.testing.assert_allclose(found.scales, splats.scales, rtol=0.033)
    np.testing.assert_allclose(found.sh, splats.sh, atol=0.12)
    # SPZ data have x right and z back; those of glTF are x left and z front.
    write_gltf_splats(splats, tmp_path / "b.glb", name="a")
    assert (tmp_path / "a.glb").stat().st_size < (tmp_path / "b.glb").stat().st_size / 2


def test_axes_of_compressed_splats_follow_the_bounds_of_their_positions(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Some programs store the axes of glTF in SPZ data, and require an extension of materials."""
    splats = random_splats()
    write_gltf_splats(splats, tmp_path / "a.glb", name="a", spz=True)
    content = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    document = json.loads(content[20 : 20 + length])
    accessor = document["accessors"][0]
    low, high = np.array(accessor["min"]), np.array(accessor["max"])
    bounds = np.sort([low * (-1, 1, -1), high * (-1, 1, -1)], axis=0)  # without a turn by 180 degrees
    accessor["min"], accessor["max"] = bounds.tolist()
    document["extensionsRequired"].append("KHR_materials_unlit")

    def save(path: Path) -> Path:
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        rest = content[20 + length :]
        header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
        path.write_bytes(header + text + rest)
        return path

    found, turned = read_gltf_splats(tmp_path / "a.glb"), read_gltf_splats(save(tmp_path / "b.glb"))
    np.testing.assert_allclose(turned.means, found.means * (-1, -1, 1), atol=1e-7)
    np.testing.assert_allclose(covariances(turned), covariances(found) * np.outer((-1, -1, 1), (-1, -1, 1)), atol=1e-7)
    assert "b.glb: not read: the axes of SPZ" in caplog.text
    assert "a.glb" not in caplog.text
    accessor["min"], accessor["max"] = [-1.0] * 3, [1.0] * 3
    np.testing.assert_array_equal(read_gltf_splats(save(tmp_path / "c.glb")).means, found.means)
    assert "c.glb: not read: the bounds of positions, which contradict the SPZ data" in caplog.text


def test_files_that_cannot_be_read_are_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    path, colour = tmp_path / "a.glb", np.zeros((1, 3))

    def error_of(glb: Glb, **more: Any) -> str:
        with pytest.raises(InputError) as raised:
            read_gltf_splats(glb.save(path, **{**scene, **more}))
        assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)
        return str(raised.value)

    good, flat, partial, mirrored = Glb(), Glb(), Glb(), [{"mesh": 0, "scale": [-1, 1, 1]}]
    one_splat(good, colour)
    for listed in ("extensionsRequired", "extensionsUsed"):
        with pytest.raises(InputError, match="it has Gaussian splats, which `mitsplat import` reads"):
            read_mesh_file(good.save(path, **{**scene, listed: [EXTENSION]}))
    assert "requires extensions that are not supported: export it without X" in error_of(good, extensionsRequired=["X"])
    assert "node 0: a transform must neither mirror nor flatten" in error_of(good, nodes=mirrored)
    flat.mesh({"POSITION": flat.accessor(np.zeros((3, 3), np.float32))})
    assert "it has no Gaussian splats (KHR_gaussian_splatting)" in error_of(flat)
    one_splat(partial, np.zeros((3, 3)))
    assert f"must have the attribute {EXTENSION}:SH_DEGREE_1_COEF_2 (missing)" in error_of(partial)
    path.write_text(json.dumps({"asset": {"version": "1.0"}}))
    with pytest.raises(InputError, match="only version 2 of glTF"):
        read_gltf_splats(path)


def test_a_small_file_of_many_gaussians_is_refused(files_tried: None, tmp_path: Path) -> None:
    """Accessors without data are zeros, of which any number can be stated."""
    huge = Glb()
    one_splat(huge, np.zeros((1, 3)))
    for accessor in huge.document["accessors"]:
        accessor |= {"count": 1 << 31}
        del accessor["bufferView"]
    path = huge.save(tmp_path / "a.glb", nodes=[{"mesh": 0}], scenes=[{"nodes": [0]}], scene=0)
    with pytest.raises(InputError, match="takes more memory than its file size justifies"):
        read_gltf_splats(path)


def test_the_command_exports_the_splats_of_an_asset_and_lists_what_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asset = box_asset("nut")
    asset.save(tmp_path / "nut")
    assert run("export", tmp_path / "nut", "-o", tmp_path / "a.glb") == 0
    assert "not exported: mesh, convex pieces, mass, friction and class" in capsys.readouterr().out
    found = read_gltf_splats(tmp_path / "a.glb")
    np.testing.assert_allclose(found.means, asset.splats.means, atol=1e-7)
    for words, sentence in (
        (("a.xml", "--spz"), "--spz applies to .glb files"),
        (("a.glb",), "--out must be a new file"),
    ):
        assert run("export", tmp_path / "nut", "-o", tmp_path / words[0], *words[1:]) == 2
        assert sentence in capsys.readouterr().err


def test_renders_of_a_round_trip_agree(tmp_path: Path) -> None:
    """The splats of a shipped asset are unchanged to 55 dB, and to 40 dB after compression by SPZ."""
    splats = Asset.load("scenes/assets/hex_nut_m16").splats
    splats = Splats(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    centre, size = splats.bounds.mean(axis=0), float(np.ptp(splats.means, axis=0).max())
    camera = Camera.look_at(centre + size * np.array([1.0, 1.5, 1.2]), centre, width=96, height=96, fov_x=40.0)
    before = render_splats(splats, camera).rgb
    for spz, least in ((False, 55.0), (True, 40.0)):
        path = tmp_path / f"{spz}.glb"
        write_gltf_splats(splats, path, name="nut", spz=spz)
        error = np.mean((render_splats(read_gltf_splats(path), camera).rgb - before) ** 2)
        assert -10 * np.log10(max(float(error), 1e-20)) > least
