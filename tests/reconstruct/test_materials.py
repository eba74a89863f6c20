"""Estimation of materials from photographs with known light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.errors import InputError
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.reconstruct.asset_evaluation import Verdict
from mitsplat.reconstruct.materials.capture_light import CaptureLight, require_light_frame
from mitsplat.reconstruct.materials.colour_fit import fit_colours
from mitsplat.reconstruct.materials.estimation import MaterialEstimate, MaterialRegion, estimate_materials
from mitsplat.reconstruct.materials.lit_surfaces import lit_surfaces
from mitsplat.reconstruct.materials.observations import Observations, View, observe
from mitsplat.reconstruct.materials.surface_light import LitMesh
from mitsplat.reconstruct.pipeline import asset_pipeline as pipeline
from mitsplat.reconstruct.reconstruct import AssetJob, Reconstruction, ReconstructSettings
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightDraw

LIGHT = CaptureLight(
    (
        AreaLight(position=(0.5, -0.3, 0.6), target=(0, 0, 0), size=(0.3, 0.3), radiance=12.0),
        AreaLight(position=(-0.5, 0.4, 0.5), target=(0, 0, 0), size=(0.2, 0.2), radiance=12.0),
        EnvironmentLight(radiance=0.3),
    )
)
GOLD, BLUE = np.array([0.8, 0.55, 0.2]), np.array([0.05, 0.1, 0.5])


def balls() -> dict[str, trimesh.Trimesh]:
    """Return a ball of metal and one of plastic that stand on z = 0."""
    found = {}
    for name, x in (("metal", -0.03), ("plastic", 0.03)):
        found[name] = trimesh.creation.icosphere(4, 0.025).apply_translation((x, 0, 0.025))
    return found


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Path-trace 12 photos of the balls on a grey table."""
    import mitsuba as mi

    from mitsplat.renderer.path_tracing import render_mesh
    from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene
    from mitsplat.renderer.scene_emitters import emitter_dict

    shapes: dict[str, Any] = {f"light{i}": emitter_dict(light) for i, light in enumerate(LIGHT.lights)}
    looks = {"metal": (GOLD, 1.0, 0.3), "plastic": (BLUE, 0.0, 0.5)}
    for name, mesh in balls().items():
        colour, metallic, roughness = looks[name]
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(
            {
                "type": "principled",
                "base_color": {"type": "rgb", "value": colour.tolist()},
                "metallic": metallic,
                "roughness": roughness,
            }
        )
        shapes[name] = plain_mesh(mesh, properties)
    objects = ray_scene({name: shapes[name] for name in looks})
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.2}}
    shapes["table"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.5), "bsdf": grey}
    scene, folder, photos = ray_scene(shapes), tmp_path_factory.mktemp("photos"), []
    for number in range(12):
        angle, height = 2 * np.pi * number / 12, (0.1, 0.2)[number % 2]
        eye = (0.25 * np.cos(angle), 0.25 * np.sin(angle), height)
        camera = Camera.look_at(eye, (0, 0, 0.02), width=72, height=48, fov_x=30)
        picture, _ = render_mesh(scene, camera, samples=16, bounces=3, seed=number)
        _, cover = render_mesh(objects, camera, samples=9, bounces=1)
        file, mask = folder / f"{number:02}.png", folder / f"{number:02}_mask.png"
        Image.fromarray(np.uint8(255 * np.clip(encode_srgb(picture), 0, 1) + 0.5)).save(file)
        Image.fromarray(np.uint8(255 * (cover > 0.5))).save(mask)
        photos.append(Photo(file.name, file, camera, mask))
    none = np.zeros((0, 3))
    return Capture(tuple(photos), none, none.astype(np.uint8), units="metre", up="z", table=True)


@pytest.fixture
def few_points() -> Iterator[None]:
    """Use fewer surface points, which is faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsplat.reconstruct.materials.estimation._POINTS", 500)
        patch.setattr("mitsplat.reconstruct.materials.estimation._FIT_POINTS", 300)
        yield


@pytest.mark.usefixtures("few_points")
def test_metal_and_plastic_are_recovered_with_their_parameters(photographed: Capture) -> None:
    mesh = trimesh.util.concatenate(list(balls().values()))
    found = estimate_materials(photographed, mesh, LIGHT)
    assert found.confidence > 0.3
    assert found.shortcoming() is None
    splats = place_surfels(mesh, 1.0, 300, np.random.default_rng(0)).splats(np.zeros((300, 4, 3)))
    splats = found.apply(splats)
    assert splats.materials is not None
    colours = np.maximum(0.5 + 0.28209479 * splats.sh[:, 0], 0)
    for side, colour, metallic, roughness in ((-1, GOLD, 1.0, 0.3), (1, BLUE, 0.0, 0.5)):
        own = (side * splats.means[:, 0] > 0.01) & (splats.means[:, 2] > 0.02)
        assert abs(np.median(splats.materials.metallic[own]) - metallic) < 0.2
        assert abs(np.median(splats.materials.roughness[own]) - roughness) < 0.1
        true = encode_srgb(colour)
        assert np.linalg.norm(np.median(colours[own], axis=0) - true) < 0.1 * np.linalg.norm(true)


@pytest.mark.usefixtures("few_points")
def test_wrong_lights_explain_the_photos_worse_than_captured_colours(photographed: Capture) -> None:
    mesh = trimesh.util.concatenate(list(balls().values()))
    other = CaptureLight((AreaLight(position=(-0.5, 0.3, 0.2), target=(0, 0, 0), size=(0.3, 0.3), radiance=20.0),))
    reason = estimate_materials(photographed, mesh, other).shortcoming()
    assert reason is not None and "reduce the error of captured colours" in reason


def test_the_table_outside_of_the_photos_reflects_light_on_the_object(photographed: Capture) -> None:
    """A small matt wall at the edge of the photos receives what a lambertian table reflects under the lights.

    The photographs show the table up to 0.08 m from the centre, and most of this light comes from further away.
    """
    mesh = trimesh.util.concatenate(list(balls().values()))
    surfaces = lit_surfaces(mesh, [View.of(photo, 640) for photo in photographed.photos], LIGHT, floor=0.0)
    walls = np.array([(0.1, 0.0, 0.03), (0.0, 0.1, 0.03), (-0.1, 0.0, 0.03), (0.0, -0.1, 0.03)])
    normals = walls * (10, 10, 0)
    received = np.array(surfaces.light(walls, normals).irradiance)[1]
    line = (np.arange(120) + 0.5) / 120 - 0.5
    x, y = np.meshgrid(line, line)
    table = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    lit = surfaces.light(table, np.tile([0.0, 0.0, 1.0], (len(table), 1)))
    radiance = 0.2 / np.pi * np.array(lit.arriving.y * lit.direction.z).reshape(len(table), -1).mean(axis=1)
    for wall, normal, found in zip(walls, normals, received, strict=True):
        to_table = table - wall
        distance = np.linalg.norm(to_table, axis=1)
        cosine = np.maximum(to_table @ normal, 0) / distance
        expected = np.sum(radiance * cosine * (wall[2] / distance) / distance**2) / len(table)
        assert found == pytest.approx(expected, rel=0.05)


def test_errors_of_the_same_factor_do_not_make_colours_darker() -> None:
    """The logarithms of the observations of a point are uniform around that of its radiance."""
    radiance = np.tile(0.5 * np.exp(np.linspace(-0.25, 0.25, 20))[:, None], (1, 3))
    clipped = np.zeros(radiance.shape, dtype=bool)
    seen = Observations(np.zeros(20, dtype=np.int64), radiance, np.tile([0.0, 0.0, 1.0], (20, 1)), clipped)
    fit = fit_colours(seen, (np.ones((20, 3)), np.zeros((20, 3))))
    np.testing.assert_allclose(fit.colours, 0.5, rtol=0.01)


def test_white_of_a_photo_that_was_darkened_is_a_lower_bound(tmp_path: Path) -> None:
    """A photo with twice the exposure shows white; its correction halves the values, also those of white."""
    sheet = trimesh.creation.box((0.2, 0.2, 0.01))
    Image.new("RGB", (80, 60), "white").save(tmp_path / "a.png")
    Image.new("L", (80, 60), 255).save(tmp_path / "mask.png")
    camera = Camera.look_at((0, 0, 0.2), (0, 0, 0), width=80, height=60, fov_x=40)
    photo = Photo("a.png", tmp_path / "a.png", camera, tmp_path / "mask.png", gain=(0.5, 0.5, 1.0))
    ensure_variant()
    surfaces = LitMesh(sheet, len(sheet.faces), LIGHT.scene(), [0.0, 0.0, 0.0])
    top = np.array([[0.0, 0.0, 0.005]])
    seen = observe(surfaces, top, np.array([[0.0, 0.0, 1.0]]), [View.of(photo, 80)], "object")
    assert seen.clipped.all() and len(seen.radiance) == 1
    np.testing.assert_allclose(seen.radiance, [[0.5, 0.5, 1.0]], atol=1e-3)
    fit = fit_colours(seen, (np.full((1, 3), 0.8), np.zeros((1, 3))), np.ones(3))
    assert fit.errors[0] == pytest.approx(np.log1p((0.2 / 0.1) ** 2) / 3, rel=0.3)  # only blue is too dark


def estimate(confidence: float, explained: float = 0.5) -> MaterialEstimate:
    """Return an estimate of one region with these figures."""
    region = MaterialRegion((0.5, 0.4, 0.2), 1.0, 0.3, confidence, 1.0)
    place = np.zeros(1, dtype=np.int64)
    return MaterialEstimate((region,), np.zeros((1, 3)), np.array([region.colour]), place, explained)


@pytest.mark.parametrize(
    ("confidence", "explained", "used"), [(0.05, 0.5, False), (0.5, 0.2, False), (0.5, -0.3, False), (0.5, 0.5, True)]
)
def test_captured_colours_are_kept_if_the_light_does_not_fit(
    monkeypatch: pytest.MonkeyPatch, photographed: Capture, confidence: float, explained: float, used: bool
) -> None:
    monkeypatch.setattr(pipeline, "estimate_materials", lambda *_: estimate(confidence, explained))
    mesh = balls()["metal"]
    surfels = place_surfels(mesh, 1.0, 100, np.random.default_rng(0))
    asset = Asset("ball", "ball", surfels.splats(np.zeros((len(surfels), 4, 3))), mesh)
    known = {"photos": 12, "rejected": 0, "units": "metre", "gaussians": 100, "faces": 9, "watertight": True}
    none = ("psnr", "psnr_object", "splat_iou", "mesh_iou", "offset", "spread", "lost", "scale_error")
    verdict = Verdict(**known, solid=True, **dict.fromkeys(none))
    before = Reconstruction(asset, verdict, [], None, None, None, np.eye(4))
    after = pipeline._with_estimated_materials(before, photographed, LIGHT, None)
    assert after.verdict.rows["Material 1"].startswith("base colour #bcaa7c, metallic 1.00, roughness 0.30")
    assert ("Materials" in after.verdict.rows) != used
    if used:
        materials = after.asset.splats.materials
        assert materials is not None
        np.testing.assert_allclose(materials.roughness, 0.3)
    else:
        assert after.asset.splats is asset.splats


def test_lights_are_for_objects_without_given_material_or_size() -> None:
    for wrong, message in (
        ({"kind": "environment"}, "materials are estimated for objects only"),
        ({"material": {"metallic": 1.0}}, "lights and a given material both define the materials"),
        ({"settings": ReconstructSettings(size=0.1)}, "lights need a capture in metres"),
    ):
        with pytest.raises(InputError, match=message):
            AssetJob("part", light=LIGHT, **wrong)  # type: ignore[arg-type]


def test_lights_need_a_metric_frame(photographed: Capture) -> None:
    require_light_frame(photographed)
    for wrong in ({"units": "unknown"}, {"up": "unknown"}):
        with pytest.raises(InputError, match="lights need a capture in metres with z up"):
            require_light_frame(replace(photographed, **wrong))  # type: ignore[arg-type]


@pytest.mark.usefixtures("files_tried")
def test_lights_of_a_file_are_fixed_and_their_images_lie_beside_it(tmp_path: Path) -> None:
    file = tmp_path / "lamps.yaml"
    file.write_text("lights:\n  - {kind: area, position: [0, 0, 1], target: [0, 0, 0], radiance: 5}\n")
    assert [light.kind for light in CaptureLight.load(file).lights] == ["area"]
    (tmp_path / "broken.exr").write_bytes(b"no image")
    for lines, message in (
        ("lights: [{kind: environment, image: broken.exr}]", "lamps.yaml: .*broken.exr: not a readable image"),
        ("lights: []", "must have 1 or more items"),
        ("lights: [{kind: environment, image: sky.exr}]", "lamps.yaml: .*sky.exr"),
        ("lights: [{kind: environment, image: ../sky.exr}]", "lamps.yaml: must be a file inside"),
        ("lights: [{kind: environment, draw: {radiance: [1, 2]}}]", "lights of photographs must be fixed"),
    ):
        file.write_text(lines)
        with pytest.raises(InputError, match=message):
            CaptureLight.load(file)


def test_the_hash_of_lights_contains_their_values(tmp_path: Path) -> None:
    bright = CaptureLight((EnvironmentLight(radiance=2.0),), tmp_path)
    assert bright.content() != CaptureLight((EnvironmentLight(radiance=1.0),), tmp_path).content()
    with pytest.raises(InputError, match="must be fixed"):
        CaptureLight((EnvironmentLight(draw=LightDraw(radiance=(1, 2))),))


def test_lights_of_a_capture_keep_their_order() -> None:
    """Mitsuba lists emitters that it loads from one dictionary in arbitrary order, and paths depend on the order."""
    lamps = [AreaLight(position=(0.2 * i, 0, 1), target=(0.2 * i, 0, 0), radiance=1.0) for i in range(8)]
    for _ in range(6):
        scene = CaptureLight(tuple(lamps)).scene()
        found = [float(np.ravel(emitter.get_shape().bbox().center())[0]) for emitter in scene.emitters()]
        np.testing.assert_allclose(found, 0.2 * np.arange(8), atol=1e-6)
