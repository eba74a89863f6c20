"""Double-sided sheets: both sides get Gaussians with the material, each in front of those of the other side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from mitsplat.asset import Asset
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.mesh_file import UNKNOWN_MATERIAL, FilePart, MeshFile

RADIUS, HEIGHT = 0.03, 0.08


def bake_cup(*, double_sided: bool) -> Asset:
    """Bake an orange open cup whose wall and base have no thickness."""
    cup = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=32)
    cup.update_faces(cup.face_normals[:, 2] < 0.9)
    material = PBRMaterial(
        baseColorFactor=[204, 89, 13, 255], metallicFactor=0.0, roughnessFactor=1.0, doubleSided=double_sided
    )
    cup = trimesh.Trimesh(cup.vertices, cup.faces, process=False, visual=TextureVisuals(material=material))
    settings = BakeSettings(gaussians=3000, fit_steps=0, verify_views=0)
    return bake_asset(cup, name="cup", kind="environment", settings=settings).asset


@pytest.fixture(scope="module")
def cup() -> Asset:
    return bake_cup(double_sided=True)


def wall(asset: Asset) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances [m] of the Gaussians of the wall from its axis, and the radial parts of their normals."""
    means = asset.splats.means
    normals = Rotation.from_quat(asset.splats.quats).as_matrix()[:, :, 2]
    radial = means[:, :2] / np.linalg.norm(means[:, :2], axis=1, keepdims=True)
    cosine = np.einsum("nd,nd->n", normals[:, :2], radial)
    rows = (np.abs(cosine) > 0.9) & (np.abs(means[:, 2]) < 0.4 * HEIGHT)
    return np.linalg.norm(means[rows, :2], axis=1), cosine[rows]


def test_both_sides_of_a_double_sided_sheet_get_gaussians(cup: Asset) -> None:
    radius, cosine = wall(cup)
    assert (cosine > 0).mean() == pytest.approx(0.5, abs=0.05)
    assert np.median(radius[cosine > 0]) > np.median(radius[cosine < 0])
    assert np.abs(radius - RADIUS * np.cos(np.pi / 64)).max() < 0.01 * RADIUS


def test_both_sides_have_the_material(cup: Asset) -> None:
    colours = 0.5 + SH_C0 * cup.splats.sh[:, 0]
    np.testing.assert_allclose(
        colours, np.tile(encode_srgb(np.array([204, 89, 13]) / 255), (len(colours), 1)), atol=1e-3
    )


def test_the_back_of_a_single_sided_sheet_gets_none() -> None:
    _, cosine = wall(bake_cup(double_sided=False))
    assert (cosine > 0).all()


@pytest.mark.parametrize("double_sided", [False, True])
def test_backs_that_stay_empty_are_reported(double_sided: bool) -> None:
    """Rays through the open end of a box without a lid meet the backs of its walls."""
    box = trimesh.creation.box((2, 1, 1))
    part = FilePart("box", box.vertices, box.faces[box.face_normals[:, 2] < 0.5], np.eye(4), UNKNOWN_MATERIAL)
    file = MeshFile((replace(part, double_sided=double_sided),))
    settings = BakeSettings(gaussians=300, fit_steps=0, verify_views=0)
    (warning, *_) = (*bake_asset(file, name="box", settings=settings).warnings, "")
    assert warning.endswith("state doubleSided in a glTF file") is not double_sided
