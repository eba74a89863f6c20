"""Baking against closed forms: emitted radiance and surface positions are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import mitsplat
from mitsplat.asset import Asset
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.bake.bake_report import write_bake_report
from mitsplat.bake.mesh_parts import read_model
from mitsplat.bake.part_shapes import UNIFORM_LIGHT, bake_lights, mitsuba_scene
from mitsplat.errors import InputError
from mitsplat.gaussians.poisson_disks import poisson_subset
from mitsplat.gaussians.spherical_harmonics import evaluate_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_normals import CREASE_ANGLE, corner_normals
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.path_tracing import render_mesh, trace_radiance
from mitsplat.renderer.scene_emitters import emitter_dict
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight

FACE_COLOURS = np.array(
    [[230, 40, 40], [40, 200, 60], [50, 70, 220], [220, 200, 40], [40, 200, 210], [200, 60, 200]], dtype=np.uint8
)


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    ensure_variant()


def quick(**changes: object) -> BakeSettings:
    """Build bake settings small enough for a test, without fit and verification by default."""
    return BakeSettings(**{"gaussians": 700, "fit_steps": 0, "verify_views": 0, **changes})


def coloured_box() -> tuple[trimesh.Trimesh, np.ndarray]:
    """Build a box with one colour per side, and the colour index of every face."""
    box = trimesh.creation.box(extents=(0.04, 0.03, 0.02))
    axis = np.abs(box.face_normals).argmax(axis=1)
    side = 2 * axis + (box.face_normals[np.arange(12), axis] > 0)
    box.visual.face_colors = FACE_COLOURS[side]
    return box, side


def white(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.visual.face_colors = [255, 255, 255, 255]
    return mesh


def outward_colours(splats: Splats) -> np.ndarray:
    """Evaluate display-encoded colours along the surface normals, shape (N, 3)."""
    normals = Rotation.from_quat(splats.quats).as_matrix()[:, :, 2]
    return evaluate_sh(splats.sh, -normals)


def test_white_sphere_in_a_furnace_emits_radiance_one_in_all_directions() -> None:
    """A convex diffuse body of albedo 1 under uniform radiance 1 emits E / pi = 1 in every direction."""
    ball, furnace = white(trimesh.creation.icosphere(3, 0.02)), [EnvironmentLight(radiance=1.0)]
    splats = bake_asset(ball, name="ball", kind="environment", lights=furnace, settings=quick()).asset.splats
    assert splats.materials is None
    normals = Rotation.from_quat(splats.quats).as_matrix()[:, :, 2]
    for tilt in (0.0, 0.5, 1.0):
        aside = np.cross(normals, (0.3, 0.5, 0.8))
        towards = np.cos(tilt) * normals + np.sin(tilt) * aside / np.linalg.norm(aside, axis=1, keepdims=True)
        colours = evaluate_sh(splats.sh, -towards)
        assert colours.mean() == pytest.approx(1.0, abs=0.005)
        assert colours.std() < 0.03


def test_traced_radiance_of_a_lit_plane_is_albedo_times_irradiance_over_pi() -> None:
    """A small light of radiance L and area A, facing the plane at height h, gives E = L A / h^2 below it."""
    plane = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    plane.visual.face_colors = [255, 255, 255, 255]
    lamp = AreaLight(position=(0, 0, 2.0), target=(0, 0, 0), size=(0.1, 0.2), radiance=50.0)
    sky = EnvironmentLight(radiance=0.25)
    scene = mitsuba_scene(read_model(plane).parts, bake_lights([lamp, sky]))
    rays = np.tile([[0.0, 0.0, 0.5]], (64, 1)), np.tile([[0.0, 0.0, -1.0]], (64, 1))
    radiance, hit = trace_radiance(scene, *rays, samples=64, bounces=1, seed=1)
    assert hit.all()
    assert radiance.mean() == pytest.approx(50.0 * 0.02 / 2.0**2 / np.pi + 0.25, rel=0.01)


def test_every_side_of_a_box_keeps_its_colour() -> None:
    box, _ = coloured_box()
    splats = bake_asset(box, name="box", settings=quick(gaussians=1500)).asset.splats
    normals = Rotation.from_quat(splats.quats).as_matrix()[:, :, 2]
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (normals[np.arange(len(axis)), axis] > 0)
    colours = outward_colours(splats)
    for k, colour in enumerate(FACE_COLOURS):
        assert (side == k).sum() > 50
        np.testing.assert_allclose(np.median(colours[side == k], axis=0), colour / 255.0, atol=0.02)


def test_gaussians_lie_just_below_the_surface_with_their_short_axis_along_the_normal() -> None:
    splats = bake_asset(white(trimesh.creation.icosphere(4, 0.02)), name="ball", settings=quick()).asset.splats
    radius = np.linalg.norm(splats.means, axis=1)
    assert (radius < 0.02).all()
    assert (radius > 0.02 - 0.002 * 0.02 - 2.0 * splats.scales[:, 2]).all()
    normals = Rotation.from_quat(splats.quats).as_matrix()[:, :, 2]
    assert (np.einsum("nd,nd->n", normals, splats.means / radius[:, None]) > 0.99).all()
    assert (splats.scales[:, 2] < 0.3 * splats.scales[:, :2].min(axis=1)).all()


def test_surfels_cover_a_box_and_end_at_its_edges() -> None:
    half = np.array([0.02, 0.015, 0.01])
    box = trimesh.creation.box(extents=2.0 * half)
    surfels = place_surfels(box, 1.0, 3000, np.random.default_rng(0))
    assert len(surfels) == pytest.approx(3000, rel=0.15)
    spacing = np.sqrt(box.area / 3000)
    reach = 2.0 * surfels.scales[:, None, :2] * surfels.frames[:, :, :2]
    tips = np.concatenate([surfels.points[..., None] + reach, surfels.points[..., None] - reach])
    beyond = (np.abs(tips) - half[:, None]).max(axis=(1, 2)) / spacing
    assert beyond.max() < 0.8
    assert np.quantile(beyond, 0.9) < 0.35
    points, faces = trimesh.sample.sample_surface(box, 2000, seed=1)
    seen = 1.0 - transmittance(surfels, points, box.face_normals[faces])
    inner = (np.abs(np.abs(points) - half) > 0.5 * spacing).sum(axis=1) == 2
    assert seen[inner].mean() > 0.97
    assert np.quantile(seen[inner], 0.02) > 0.85


def transmittance(surfels: object, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Compute the transmittance of the surfels' discs along the normals at ``points``, for all pairs."""
    local = np.einsum("pnj,nji->pni", points[:, None] - surfels.points, surfels.frames)
    response = np.exp(-0.5 * ((local[..., :2] / surfels.scales[:, :2]) ** 2).sum(axis=2))
    response *= (normals @ surfels.normals.T > 0.7) & (np.abs(local[..., 2]) < 1e-4)
    return np.prod(1.0 - response, axis=1)


def test_poisson_subset_keeps_its_distance_and_is_maximal() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.random((4000, 2)), np.zeros(4000)])
    normals, radius = np.tile([0.0, 0.0, 1.0], (4000, 1)), np.full(4000, 0.05)
    kept = poisson_subset(points, normals, radius, rng)
    gaps = np.linalg.norm(points[:, None] - points[kept], axis=2)
    assert gaps.min(axis=1).max() <= 0.05
    among = np.linalg.norm(points[kept][:, None] - points[kept], axis=2) + 10.0 * np.eye(len(kept))
    assert among.min() > 0.05


def test_thin_sheet_keeps_surfels_on_both_sides() -> None:
    sheet = trimesh.creation.box(extents=(0.04, 0.04, 0.0004))
    surfels = place_surfels(sheet, 1.0, 1200, np.random.default_rng(0))
    up = surfels.normals[:, 2]
    assert (up > 0.9).sum() > 350
    assert (up < -0.9).sum() > 350


def test_repeated_faces_of_a_part_are_left_out_with_one_warning(tmp_path: Path) -> None:
    """A part that was exported twice: the second copy begins its faces at other corners."""
    box = trimesh.creation.box(extents=(0.05, 0.04, 0.03))
    faces = np.concatenate([box.faces, np.roll(box.faces, 1, axis=1)])
    trimesh.Trimesh(box.vertices, faces, process=False).export(tmp_path / "twice.stl")
    box.export(tmp_path / "once.stl")
    twice, once = (bake_asset(tmp_path / f"{name}.stl", name="box", settings=quick()) for name in ("twice", "once"))
    assert len(twice.warnings) == 1 and twice.warnings[0].startswith("12 faces of part "), twice.warnings
    assert np.array_equal(twice.asset.splats.means, once.asset.splats.means)
    assert twice.asset.mesh.is_volume and not once.warnings


def test_both_sides_of_a_sheet_are_kept() -> None:
    """Faces of opposite winding are no copies."""
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    (part,) = read_model(square).parts
    assert len(part.mesh.faces) == 4 and not part.warnings


def test_a_solid_inside_another_one_gets_no_gaussians() -> None:
    hidden, outer = trimesh.creation.icosphere(2, 0.005), trimesh.creation.box(extents=(0.03, 0.03, 0.03))
    nested = trimesh.Scene({"hidden": white(hidden), "outer": white(outer)})
    splats = bake_asset(nested, name="nested", settings=quick()).asset.splats
    assert np.abs(splats.means).max(axis=1).min() > 0.0145


def test_the_seed_determines_the_asset() -> None:
    box, _ = coloured_box()
    first, again, other = (
        bake_asset(box, name="box", settings=quick(gaussians=300, seed=seed)).asset.splats for seed in (3, 3, 4)
    )
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert len(first) != len(other) or not np.array_equal(first.means, other.means)


def test_baked_sphere_has_30_db_from_views_that_were_not_fitted() -> None:
    ball = trimesh.creation.icosphere(4, 0.02)
    ball.visual.face_colors = [190, 150, 90, 255]
    result = bake_asset(ball, name="ball", settings=quick(gaussians=3000, fit_steps=40, verify_views=2))
    assert "\n" not in repr(result) and "array" not in repr(result)
    assert result.psnr > 30.0
    assert result.psnr_object > 24.0


def test_splats_that_differ_from_the_mesh_are_reported(tmp_path: Path) -> None:
    """Forty Gaussians are too few for the sides of a coloured box."""
    box, _ = coloured_box()
    few, many = (
        bake_asset(box, name="box", settings=quick(gaussians=n, verify_views=2, fit_steps=40)) for n in (40, 5000)
    )
    assert few.psnr < 24 < many.psnr, (few.psnr, many.psnr)
    assert [f"PSNR of {few.psnr:.1f} dB on unseen views" in text for text in few.warnings] == [True]
    assert not many.warnings and "Nothing to note" in write_bake_report(tmp_path, many).read_text()


def test_texture_is_placed_by_its_coordinates(tmp_path: Path) -> None:
    """The lower half of the image (small v) is red, the upper half blue; v grows with y on the sheet."""
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    pixels = np.zeros((64, 64, 3), dtype=np.uint8)
    pixels[:32], pixels[32:] = (0, 0, 255), (255, 0, 0)
    sheet = trimesh.creation.box(extents=(0.04, 0.04, 0.01))
    corners = sheet.triangles.reshape(-1, 3)
    sheet = trimesh.Trimesh(corners, np.arange(36).reshape(-1, 3), process=False)
    material = PBRMaterial(baseColorTexture=Image.fromarray(pixels), roughnessFactor=1.0, metallicFactor=0.0)
    sheet.visual = TextureVisuals(uv=0.9 * corners[:, :2] / 0.04 + 0.5, material=material)
    sheet.export(tmp_path / "sheet.glb")
    for source in (sheet, tmp_path / "sheet.glb"):
        splats = bake_asset(source, name="sheet", up="z", settings=quick(gaussians=400)).asset.splats
        colours, y = outward_colours(splats), splats.means[:, 1]
        assert (colours[y < -0.004][:, 0] > colours[y < -0.004][:, 2]).all()
        assert (colours[y > 0.004][:, 2] > colours[y > 0.004][:, 0]).all()


def test_units_and_up_axis_apply_to_splats_and_mesh_alike() -> None:
    box = white(trimesh.creation.box(extents=(40.0, 20.0, 10.0)))
    asset = bake_asset(box, name="box", metres_per_unit=0.001, up="y", settings=quick(gaussians=300)).asset
    assert asset.mesh is not None
    np.testing.assert_allclose(asset.mesh.extents, (0.04, 0.01, 0.02), rtol=1e-6)
    np.testing.assert_allclose(np.ptp(asset.splats.bounds, axis=0), (0.04, 0.01, 0.02), atol=1e-3)


def test_kind_and_light_determine_pieces_and_capture_light(tmp_path: Path) -> None:
    box, _ = coloured_box()
    thing = bake_asset(box, name="thing", settings=quick(gaussians=200)).asset
    assert (thing.capture_light, len(thing.pieces)) == ("uniform", 1)
    place = bake_asset(
        box, name="place", kind="environment", lights=[EnvironmentLight()], settings=quick(gaussians=200)
    ).asset
    assert (place.capture_light, place.pieces, place.splats.materials) == ("scene", (), None)
    thing.save(tmp_path / "thing")
    loaded = Asset.load(tmp_path / "thing").splats
    assert loaded.materials is not None
    assert len(loaded) == len(thing.splats)
    np.testing.assert_array_equal(loaded.materials.specular, 0)  # face colours are matt


def test_normals_are_smooth_on_a_sphere_and_sharp_on_a_box() -> None:
    ball = trimesh.creation.icosphere(4, 1.0)
    (part,) = read_model(ball).parts
    np.testing.assert_allclose(corner_normals(part.mesh), part.mesh.triangles, atol=0.01)
    (part,) = read_model(trimesh.creation.box()).parts
    assert np.pi / 2 > CREASE_ANGLE
    np.testing.assert_allclose(
        corner_normals(part.mesh), np.repeat(part.mesh.face_normals[:, None], 3, axis=1), atol=1e-6
    )


@pytest.mark.parametrize("height", [0.004, 0.04])
@pytest.mark.parametrize("sections", [14, 24, 64])
def test_normals_of_a_cylinder_do_not_follow_the_diagonals_of_its_facets(sections: int, height: float) -> None:
    """The normal at a vertex of the lateral surface is radial, also if the facets are coarse."""
    tube = trimesh.creation.cylinder(0.01, height, sections=sections)
    lateral = np.abs(tube.face_normals[:, 2]) < 0.5
    radial = tube.triangles[lateral] * (100.0, 100.0, 0.0)
    np.testing.assert_allclose(corner_normals(tube)[lateral], radial, atol=1e-6)


@pytest.mark.parametrize("degrees", [10.0, 25.0])
def test_plane_faces_of_a_roof_keep_their_normals(degrees: float) -> None:
    rise = 0.03 * np.tan(np.radians(degrees / 2))
    outline = [(-0.03, 0), (0.03, 0), (0.03, 0.01), (0, 0.01 + rise), (-0.03, 0.01)]
    roof = trimesh.creation.extrude_polygon(shapely.Polygon(outline), 0.06)
    np.testing.assert_allclose(corner_normals(roof), np.repeat(roof.face_normals[:, None], 3, axis=1), atol=1e-6)


def test_a_wide_chamfer_does_not_bend_the_plane_beside_it() -> None:
    height = 0.01 + 0.008 * np.tan(np.radians(25))
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    rings = [np.c_[edge * corners, [z] * 4] for edge, z in ((0.03, 0), (0.03, 0.01), (0.022, height))]
    plate = trimesh.convex.convex_hull(np.concatenate(rings))
    sharp = np.repeat(plate.face_normals[:, None], 3, axis=1)
    np.testing.assert_allclose(corner_normals(plate), sharp, atol=1e-6)


def test_degenerate_triangles_get_normals() -> None:
    """CAD files have many degenerate triangles. A ray that hits one without a normal would give NaN and no splats."""
    corners = np.array([(0, 0, 0), (0.01, 0, 0), (0.005, 1e-13, 0), (0.005, 0, 0.01)])
    mesh = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)
    assert not mesh.face_normals[0].any()
    np.testing.assert_allclose(corner_normals(mesh)[0], [(0, 0, 1)] * 3, atol=1e-9)
    needle = trimesh.Trimesh([(0, 0, 0), (0, 0, 0), (0, 0, 0)], [(0, 1, 2)], process=False)
    np.testing.assert_allclose(np.linalg.norm(corner_normals(needle), axis=2), 1)


def not_finite() -> trimesh.Trimesh:
    mesh = trimesh.creation.box()
    vertices = np.array(mesh.vertices)
    vertices[0, 0] = np.nan
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"mesh": "missing.glb"}, "missing.glb: no such mesh file"),
        ({"mesh": trimesh.Trimesh()}, "at least one face"),
        ({"lights": []}, "at least one light"),
        ({"metres_per_unit": 0.0}, "metres_per_unit must be > 0 .got 0.0."),
        ({"mesh": trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])}, "faces that have an area"),
        ({"mesh": trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1e12]])}, "at most 1e.10 units .got 1e.12."),
        ({"mesh": not_finite()}, r"vertex positions must be finite .got \[nan, .* at vertex 0."),
        (
            {"mesh": trimesh.creation.box((31, 9, 4))},
            "0.001 to 5 m across .got 31 m .* --units 0.001 reads it in milli",
        ),
        (
            {"mesh": trimesh.creation.box((0.04, 0.01, 0.01)), "metres_per_unit": 0.001},
            r"got 4e-05 m at 0.001 metres per unit: --units 1 reads it in metres, and --any-size accepts the size",
        ),
        (
            {"mesh": trimesh.creation.box((40, 10, 10)), "metres_per_unit": 1e-6},
            r"got 4e-05 m at 1e-06 metres per unit: --units 0.001 reads it in millimetres, and",
        ),
        (
            {"mesh": trimesh.creation.box((40, 10, 10)), "metres_per_unit": 0.0254 * 10},
            r"got 10.2 m at 0.254 metres per unit: --units 0.000254 reads it at 0.0102 m, and",
        ),
        ({"mesh": trimesh.Trimesh(np.eye(3), [[0, 1, 2]])}, "an object must have a volume .got a flat mesh."),
        ({"density": 0.0}, "density must be a number > 0 .* .got 0."),
        ({"density": float("nan")}, "density must be a number > 0 .* .got nan."),
        ({"friction": -0.5}, "friction must be a number of at least 0 .got -0.5."),
        ({"up": "-y"}, "up must be y or z .got '-y'."),
        ({"kind": "part"}, "kind must be object or environment .got 'part'."),
    ],
)
def test_invalid_input_is_refused_in_one_sentence(arguments: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        bake_asset(**{"mesh": trimesh.creation.box(), "name": "x", "settings": quick(), **arguments})


@pytest.mark.parametrize(("field", "value"), [("gaussians", 0), ("gaussians", 10**9), ("proxy_faces", 0)])
def test_settings_out_of_range_are_refused(field: str, value: int) -> None:
    with pytest.raises(InputError, match=field):
        BakeSettings(**{field: value})


def test_damaged_mesh_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.glb").write_bytes(b"glTF\x02\x00\x00\x00 and no more")
    with pytest.raises(InputError, match=r"broken\.glb: not a mesh that can be read"):
        bake_asset(tmp_path / "broken.glb", name="x", settings=quick())


def test_large_object_bakes_with_any_size_and_reports_its_stages() -> None:
    told: list[tuple[int, int, str]] = []
    result = bake_asset(
        white(trimesh.creation.box((6.0, 4.0, 3.0))),
        name="container",
        any_size=True,
        settings=quick(gaussians=200, fit_steps=2),
        progress=lambda *step: told.append(step),
    )
    assert len(result.asset.splats) > 100
    assert [done for done, _, _ in told] == sorted(done for done, _, _ in told)
    assert told[-1] == (100, 100, "done")
    assert len({stage for _, _, stage in told}) == 5


def test_path_traced_image_equals_single_rays_through_its_pixels() -> None:
    """Slow reference: the camera model's rays are traced one by one. Radiance 1 on white gives no noise."""
    ball = white(trimesh.creation.icosphere(3, 0.02))
    scene = mitsuba_scene(read_model(ball).parts, UNIFORM_LIGHT)
    camera = Camera.look_at((0.05, -0.06, 0.04), (0, 0, 0), width=24, height=18, fov_x=40, near=0.01)
    picture, cover = render_mesh(scene, camera, samples=1, bounces=2)
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5)
    slopes = camera.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    directions = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ camera.world_from_camera[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile(camera.centre, (len(directions), 1))
    radiance, hit = trace_radiance(scene, origins, directions, samples=1, bounces=2, seed=0)
    assert 0.1 < cover.mean() < 0.9
    np.testing.assert_array_equal(cover.ravel() > 0, hit)
    np.testing.assert_allclose(picture.reshape(-1, 3)[hit], radiance[hit], atol=1e-3)


def test_noise_of_different_pixels_differs() -> None:
    """If all paths shared their random numbers, the mean of the image would be as noisy as one pixel."""
    cup = white(trimesh.creation.annulus(0.01, 0.02, 0.03))
    lamp = AreaLight(position=(0.05, 0.03, 0.2), target=(0, 0, 0), size=(0.1, 0.1), radiance=10.0)
    scene = mitsuba_scene(read_model(cup).parts, bake_lights([lamp]))
    camera = Camera.look_at((0.0, -0.04, 0.06), (0, 0, 0), width=48, height=48, fov_x=30, near=0.01)
    pictures = np.array([render_mesh(scene, camera, samples=1, bounces=3, seed=seed)[0] for seed in range(6)])
    inside = pictures.std(axis=0)[pictures.min(axis=0) > 0].mean()
    assert pictures.mean(axis=(1, 2, 3)).std() < 0.1 * inside


def test_encoding_equals_the_srgb_curve() -> None:
    np.testing.assert_allclose(encode_srgb([0.0, 0.0031308, 0.21404, 1.0]), [0.0, 0.04045, 0.5, 1.0], atol=1e-4)


def test_area_light_faces_its_target_even_from_straight_above() -> None:
    import mitsuba as mi

    for position in ((0.0, 0.0, 2.0), (1.0, 0.5, 1.0)):
        lamp = mi.load_dict(emitter_dict(AreaLight(position=position, target=(0, 0, 0), size=(0.4, 0.2))))
        sample = lamp.sample_position(0.0, mi.Point2f(0.5, 0.5))
        facing = -np.array(position) / np.linalg.norm(position)
        np.testing.assert_allclose(np.ravel(sample.n), facing, atol=1e-5)


def test_bake_asset_is_exported_by_the_package() -> None:
    assert mitsplat.bake_asset is bake_asset


def sheet(extent: float, height: float, texture: np.ndarray, *, steps: int = 1) -> trimesh.Trimesh:
    """Build a square open sheet with a texture and ``2 * steps**2`` faces."""
    line = np.linspace(0.0, 1.0, steps + 1)
    u, v = (a.ravel() for a in np.meshgrid(line, line))
    corner = (np.arange(steps)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    right, up = corner + 1, corner + steps + 1
    faces = np.vstack([np.stack([corner, right, up + 1], axis=1), np.stack([corner, up + 1, up], axis=1)])
    mesh = trimesh.Trimesh(
        np.stack([extent * (u - 0.5), extent * (v - 0.5), np.full_like(u, height)], axis=1), faces, process=False
    )
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(texture), roughnessFactor=1.0)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.stack([u, v], axis=1), material=material)
    return mesh


def test_proxy_keeps_a_textured_table_and_omits_a_label() -> None:
    texture = np.full((8, 8, 3), 200, np.uint8)
    table = sheet(1.0, 0.0, texture, steps=40)
    box = white(trimesh.creation.box(bounds=[[-0.05, -0.05, 0.0], [0.05, 0.05, 0.1]]))
    label = sheet(0.06, 0.1002, texture)
    ball = white(trimesh.creation.icosphere(4, 0.05).apply_translation((0.3, 0, 0.05)))
    scene = trimesh.Scene({"table": table, "box": box, "label": label, "ball": ball})
    proxy = bake_asset(scene, name="bench", kind="environment", settings=quick(proxy_faces=500)).asset.mesh
    assert proxy is not None
    assert len(proxy.faces) <= 500
    flat = (np.abs(proxy.triangles_center[:, 2]) < 1e-6) & (proxy.face_normals[:, 2] > 0.999)
    assert proxy.area_faces[flat].sum() == pytest.approx(1.0, rel=1e-6)
    assert proxy.vertices[proxy.vertices[:, 0] < 0.2, 2].max() == pytest.approx(0.1, abs=1e-6)  # without the ball


def test_picture_of_few_samples_is_no_darker_than_one_of_many() -> None:
    """With one path per ray and two emitters, noise must be averaged before encoding (Jensen's inequality)."""
    lights = [
        AreaLight(position=(0.3, 0.2, 0.8), size=(0.3, 0.3), radiance=14.0),
        AreaLight(position=(-0.6, 0.2, 0.8), size=(0.3, 0.3), radiance=7.0),
    ]
    table = white(trimesh.creation.box(bounds=[[-0.5, -0.5, -0.1], [0.5, 0.5, 0.0]]))
    scene = mitsuba_scene(read_model(table).parts, bake_lights(lights))
    camera = Camera.look_at((0, -0.3, 0.5), (0, 0, 0), width=40, height=30, fov_x=30)
    few, many = (render_mesh(scene, camera, samples=samples)[0].mean() for samples in (16, 1024))
    assert few == pytest.approx(many, rel=0.02)


def test_baked_lights_keep_their_order() -> None:
    """Mitsuba lists emitters that it loads from one dictionary in arbitrary order, and paths depend on the order."""
    lamps = [AreaLight(position=(0.2 * i, 0, 1), target=(0.2 * i, 0, 0), radiance=1.0) for i in range(8)]
    plane = read_model(trimesh.creation.box((1, 1, 0.1))).parts
    for _ in range(6):
        scene = mitsuba_scene(plane, bake_lights(lamps))
        found = [float(np.ravel(emitter.get_shape().bbox().center())[0]) for emitter in scene.emitters()]
        np.testing.assert_allclose(found, 0.2 * np.arange(8), atol=1e-6)
