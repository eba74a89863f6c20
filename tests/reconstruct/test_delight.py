"""Colours freed of light: irradiance by closed forms, and a ball of known reflectance under lamps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.lighting.panorama import unit_vector, write_exr
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.reconstruct.asset_evaluation import Verdict
from mitsplat.reconstruct.asset_pipeline import AssetJob, delight_asset
from mitsplat.reconstruct.delight import MIN_SLOPE, LightFile, delight, trace_irradiance
from mitsplat.reconstruct.reconstruct import Reconstruction
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightSpec

RADIUS = 0.05
SKY = 0.5


def ball(detail: int = 4) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(detail, RADIUS)


def lamp(azimuth: float, colour: tuple[float, float, float] = (1, 1, 1)) -> AreaLight:
    """0.2 m wide, in 1.5 m."""
    position = tuple((1.5 * unit_vector(azimuth, 40)).tolist())
    return AreaLight(kind="area", position=position, target=(0, 0, 0), size=(0.2, 0.2), radiance=60, colour=colour)


def lights(azimuth: float, **more: tuple[float, float, float]) -> tuple[LightSpec, ...]:
    return lamp(azimuth, **more), EnvironmentLight(kind="environment", radiance=SKY)


def lambert(normals: Float64Array, azimuth: float) -> Float64Array:
    """Irradiance of a small ball: that of a constant sky, and ``L A cos / d^2`` of a small lamp that faces it."""
    facing = (normals @ unit_vector(azimuth, 40)).clip(0, None)
    return np.asarray(np.pi * SKY + 60 * 0.2**2 / 1.5**2 * facing)


class TestIrradiance:
    def test_a_ball_under_a_lamp(self) -> None:
        mesh = ball(5)
        normals = np.asarray(mesh.vertices) / RADIUS
        found = trace_irradiance(mesh, np.asarray(mesh.vertices), normals, lights(30))
        true = lambert(normals, 30)
        np.testing.assert_allclose(found, found[:, :1].repeat(3, axis=1), rtol=1e-5)
        assert np.abs(found[:, 0] / true - 1).mean() < 0.01
        assert np.abs(found[:, 0] / true - 1).max() < 0.06  # at the terminator, where facets end

    def test_inside_of_a_box_that_is_half_open(self) -> None:
        """On the middle of the floor of a deep black pit a sky is seen through the opening alone; a grey one adds."""
        pit = trimesh.creation.box((0.2, 0.2, 0.1))
        pit.update_faces(np.asarray(pit.face_normals[:, 2] < 0.5))  # no lid
        sky = (EnvironmentLight(kind="environment", radiance=1.0),)
        spot, up = np.array([[0.0, 0.0, -0.05]]), np.array([[0.0, 0.0, 1.0]])
        found = trace_irradiance(pit, spot, up, sky, samples=4096)[0, 0]
        # Configuration factor of a rectangle, a quarter of which is 0.1 x 0.1 in a height of 0.1 (Howell, B-4).
        ratio = 1 / np.sqrt(2)
        seen = 4 * (1 / (2 * np.pi)) * 2 * ratio * np.arctan(ratio)
        assert np.pi * seen < found < np.pi * (seen + (1 - seen) * 0.5)


def painted(azimuth: float | None, contrast: float = 0.3, seed: int = 0) -> tuple[Splats, Float64Array]:
    """Splats of a mottled ball as photographed under lights, and their linear reflectance (N, 3)."""
    rng = np.random.default_rng(seed)
    surfels = place_surfels(ball(), 1.0, 3000, rng)
    bare = surfels.splats(np.zeros((len(surfels), 1, 3)))
    reflectance = rng.uniform(0.5 - contrast, 0.5 + contrast, (len(bare), 3))
    normals = bare.means / np.linalg.norm(bare.means, axis=1, keepdims=True)
    light = np.ones(len(bare)) if azimuth is None else lambert(normals.astype(np.float64), azimuth)
    colours = encode_srgb(reflectance * (light / light.max())[:, None])
    return replace(bare, sh=((colours - 0.5) / SH_C0)[:, None].astype(np.float32)), reflectance


def unlike(splats: Splats, reflectance: Float64Array) -> float:
    """Standard deviation of the logarithm of colours over reflectance, which no factor changes."""
    colours = decode_srgb((0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(1e-3, 1))
    return float(np.log(colours / reflectance).std(axis=0).mean())


def file_of(folder: Path, *given: LightSpec) -> LightFile:
    return LightFile(folder / "lights.yaml", given)


class TestDelight:
    def test_reflectance_is_left(self, tmp_path: Path) -> None:
        splats, reflectance = painted(30)
        done = delight(splats, ball(), file_of(tmp_path, *lights(30)))
        assert done.kept and done.told.endswith("it was removed from colours")
        assert done.slope == pytest.approx(1, abs=0.15)
        assert unlike(splats, reflectance) > 0.15 and unlike(done.splats, reflectance) < 0.02
        assert np.abs(done.splats.means - splats.means).max() == 0

    def test_the_colour_of_a_lamp_goes(self, tmp_path: Path) -> None:
        splats, reflectance = painted(30)
        warm = delight(splats, ball(), file_of(tmp_path, *lights(30, colour=(1.3, 1.0, 0.6)))).splats
        ratio = np.log(decode_srgb((0.5 + SH_C0 * warm.sh[:, 0].astype(np.float64)).clip(1e-3, 1)) / reflectance)
        facing = splats.means @ unit_vector(30, 40) > 0.8 * RADIUS
        behind = splats.means @ unit_vector(30, 40) < 0
        shift = ratio[facing].mean(axis=0) - ratio[behind].mean(axis=0)
        assert shift[0] < -0.05 and abs(shift[1]) < 0.03 and shift[2] > 0.05

    def test_light_from_the_other_side_is_refused(self, tmp_path: Path) -> None:
        splats, _ = painted(30)
        done = delight(splats, ball(), file_of(tmp_path, *lights(210)))
        assert not done.kept and done.slope < MIN_SLOPE and done.splats is splats
        assert "colours do not follow it" in done.told

    def test_an_object_that_was_evenly_lit_stays(self, tmp_path: Path) -> None:
        splats, _ = painted(None)
        assert not delight(splats, ball(), file_of(tmp_path, *lights(30))).kept
        done = delight(splats, ball(), file_of(tmp_path, EnvironmentLight(kind="environment", radiance=1.0)))
        assert not done.kept and done.uneven < 0.03 and "unchanged" in done.told


class TestJob:
    def test_an_environment_keeps_its_light(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="light can be removed only from the colours of objects"):
            AssetJob(name="cell", kind="environment", delight=tmp_path / "l.yaml")

    def test_an_asset_that_is_turned_and_scaled_is_lit_as_its_capture_lies(self, tmp_path: Path) -> None:
        """A size turns the asset until its box lies along the axes; lights stay in the capture's frame."""
        splats, reflectance = painted(30)
        turn = trimesh.transformations.rotation_matrix(2.0, (0, 0, 1)) @ np.diag([0.5, 0.5, 0.5, 1.0])
        asset = Asset(
            name="ball", class_name="ball", splats=splats.transformed(turn), mesh=ball().apply_transform(turn)
        )
        verdict = Verdict(
            photos=9, rejected=0, psnr=30.0, psnr_object=30.0, splat_iou=1.0, mesh_iou=1.0, offset=0.0, spread=0.0,
            lost=0.0, scale_error=None, units="metre", gaussians=len(splats), faces=len(ball().faces),
            watertight=True, solid=True,
        )  # fmt: skip
        made = Reconstruction(asset, verdict, [], None, None, None, turn)
        done = delight_asset(made, file_of(tmp_path, *lights(30)), False, None)
        assert done.record["light"]["kept"] and "it was removed from colours" in done.verdict.rows["Light"]
        assert unlike(done.asset.splats, reflectance) < 0.03


class TestFile:
    def test_it_is_read_with_its_image(self, tmp_path: Path) -> None:
        (tmp_path / "l.yaml").write_text(
            "lights:\n  - {kind: area, position: [0, 0, 1], target: [0, 0, 0], size: [1, 1], radiance: 5}\n"
            '  - {kind: environment, image: "rest.exr"}\n'
        )
        with pytest.raises(InputError, match=r"l\.yaml: the image .*rest\.exr does not exist"):
            LightFile.load(tmp_path / "l.yaml")
        write_exr(tmp_path / "rest.exr", np.ones((8, 16, 3), np.float32))
        assert LightFile.load(tmp_path / "l.yaml").files == [tmp_path / "l.yaml", tmp_path / "rest.exr"]

    @pytest.mark.parametrize(
        ("text", "rule"),
        [("lights: []\n", "at least 1"), ("lamps: []\n", "lamps"), ("lights:\n  - {kind: sun}\n", "kind")],
    )
    def test_one_that_is_none(self, tmp_path: Path, text: str, rule: str) -> None:
        (tmp_path / "l.yaml").write_text(text)
        with pytest.raises(InputError, match=rule):
            LightFile.load(tmp_path / "l.yaml")
