"""Material parameters of Gaussians."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera


def _splats(materials: SplatMaterials | None) -> Splats:
    quats = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    return Splats(np.eye(3), quats, np.full((3, 3), 0.1), np.ones(3), np.zeros((3, 1, 3)), materials)


def _three() -> SplatMaterials:
    return SplatMaterials(np.array([0, 0.5, 1]), np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.4, 0.3]), np.eye(3))


def test_selected_splats_keep_their_materials() -> None:
    chosen = _splats(_three()).select([2, 0]).materials
    assert chosen is not None
    np.testing.assert_array_equal(chosen.metallic, [1, 0])
    np.testing.assert_array_equal(chosen.roughness, np.float32([0.3, 0.1]))
    np.testing.assert_array_equal(chosen.normals, np.eye(3)[[2, 0]])


def test_transformed_splats_have_rotated_normals() -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * Rotation.from_euler("z", 90, degrees=True).as_matrix()
    moved = _splats(_three()).transformed(matrix).materials
    assert moved is not None
    np.testing.assert_allclose(moved.normals, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(moved.specular, _three().specular)


@pytest.mark.parametrize(("metallic", "roughness", "encoded"), [(0.0, 0.5, 0.5), (0.0, 0.5, 0.9), (1.0, 0.2, 0.5)])
def test_objects_keep_their_captured_colours_under_uniform_light_if_they_get_a_material(
    metallic: float, roughness: float, encoded: float
) -> None:
    """The picture of a ball with a material is that of the captured ball.

    Rough metal is darker, because ``principled`` has no multiple scattering.
    """
    import mitsuba as mi

    from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers

    mesh = trimesh.creation.icosphere(3, 0.02)
    surfels = place_surfels(mesh, 1.0, 1500, np.random.default_rng(0))
    captured = surfels.splats(np.full((len(surfels), 1, 3), (encoded - 0.5) / SH_C0))
    camera = Camera.look_at((0, -0.2, 0.05), (0, 0, 0), width=64, height=64, fov_x=14)
    pictures = []
    for splats in (captured, captured.with_material(metallic=metallic, roughness=roughness)):
        shapes = {"ball": make_splats_shape(splats, None, mesh, instance=1), "light": {"type": "constant"}}
        layers = render_layers(
            make_integrator(white=np.pi, hide_emitters=True), mi.load_dict({"type": "scene", **shapes}), camera
        )
        pictures.append(layers.rgb[24:40, 24:40].mean())
    assert pictures[1] == pytest.approx(pictures[0], rel=0.02)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("metallic", [0, 0.5, 1.5], r"metallic must be in \[0, 1\] \(got 1.5 at row 2\)"),
        ("roughness", [np.nan, 0.5, 1], r"roughness must be in \[0, 1\] \(got nan at row 0\)"),
        ("specular", [0, 0.5], r"specular must have shape \(3,\) \(got \(2,\)\)"),
        ("normals", 2 * np.eye(3), r"normals must have length 1 \(got 2 at row 0\)"),
    ],
)
def test_values_outside_of_their_range_are_refused(name: str, values: object, message: str) -> None:
    arrays = {f: getattr(_three(), f) for f in ("metallic", "roughness", "specular", "normals")}
    with pytest.raises(InputError, match=message):
        SplatMaterials(**arrays | {name: np.array(values)})


def test_materials_need_one_row_per_gaussian() -> None:
    with pytest.raises(InputError, match=r"materials must have 3 rows, one per Gaussian \(got 2\)"):
        _splats(SplatMaterials.uniform(2))
