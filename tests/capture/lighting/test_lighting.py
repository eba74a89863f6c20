"""Captured light against closed forms, a mirror ball under a known sky, and a path-traced room with known lights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from pydantic import TypeAdapter
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.capture.lighting import (
    BallView,
    LightEstimate,
    LightSettings,
    estimate_light,
    panorama,
    read_ball,
    write_light,
)
from mitsplat.capture.lighting.brackets import merge_exposures, read_photograph
from mitsplat.capture.lighting.estimate import light_lines
from mitsplat.capture.lighting.lamps import Lamp, rectangle_axes, rectangle_irradiance
from mitsplat.capture.lighting.mirror_ball import find_ball, unwrap_ball
from mitsplat.capture.lighting.panorama import directions, level_irradiance, level_weights, solid_angles, unit_vector
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import LUMINANCE, decode_srgb, encode_srgb
from mitsplat.renderer.scene_emitters import emitter_dict, y_up_to_z_up
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightSpec
from tests.capture.lighting import room
from tests.cli.typed import run
from tests.conftest import WriteScene

HEIGHT, WIDTH = 256, 512
ASIDE = (0.012, -0.01, 0.006)
"""Offset from the ball of the point that an off-axis camera looks at [m]."""


def between(a: Float64Array, b: Float64Array) -> float:
    """Compute the angle between two unit vectors [degrees]."""
    return float(np.degrees(2 * np.arcsin(min(1.0, 0.5 * float(np.linalg.norm(np.subtract(a, b)))))))


def painted(*discs: tuple[float, float, float, Any], rest: Any = 0.2, turn: float = 0.0) -> Float32Array:
    """Draw a sky of one radiance with discs that have antialiased edges.

    A disc has azimuth, elevation and angular radius [degrees], and a radiance.
    """
    sky = np.broadcast_to(np.float32(rest), (HEIGHT, WIDTH, 3))
    sight = directions(HEIGHT, WIDTH, turn)
    for azimuth, elevation, radius, radiance in discs:
        inside = radius - np.degrees(np.arccos(np.clip(sight @ np.float32(unit_vector(azimuth, elevation)), -1, 1)))
        share = np.clip(0.5 + inside * HEIGHT / 180, 0, 1)[..., None]
        sky = (1 - share) * sky + share * np.float32(radiance)
    return sky


def estimated(sky: Float32Array, **settings: Any) -> LightEstimate:
    return estimate_light(sky, LightSettings(**settings))


class TestPanoramas:
    def test_weights_sum_to_the_sphere_and_to_closed_form_irradiance(self) -> None:
        assert solid_angles(16, 32).sum() * 32 == pytest.approx(4 * np.pi)
        assert level_weights(16, 32).sum() * 32 == pytest.approx(np.pi)
        assert level_weights(15, 30).sum() * 30 == pytest.approx(np.pi)  # the horizon lies inside a row
        sky = directions(64, 128)[..., 2:].clip(0).repeat(3, axis=2)  # L = cos(theta): E = 2 pi / 3
        np.testing.assert_allclose(level_irradiance(sky), 2 * np.pi / 3, rtol=1e-3)

    @pytest.mark.parametrize("turn", [0.0, 130.0])
    def test_directions_agree_with_those_of_the_renderer(self, tmp_path: Path, turn: float) -> None:
        sky = np.zeros((32, 64, 3), np.float32)
        sky[7, 50] = 1.0
        panorama.write_radiance(tmp_path / "sky.exr", sky)
        emitter = mi.load_dict(emitter_dict(EnvironmentLight(image="sky.exr", rotate_z=turn), tmp_path))
        sight = directions(128, 256).reshape(-1, 3)
        seen = dr.zeros(mi.SurfaceInteraction3f, len(sight))
        seen.wi = -mi.Vector3f(sight.T)
        mean = np.array(emitter.eval(seen))[0] @ sight
        assert between(mean / np.linalg.norm(mean), directions(32, 64, turn)[7, 50]) < 2.0  # a pixel is 5.6 degrees

    def test_a_rotated_panorama_has_rotated_directions(self) -> None:
        """Radiance that is linear in the direction, v d, becomes (R v) d."""
        linear, turn = np.array([0.3, -0.5, 0.8]), Rotation.from_euler("zyx", [100, 25, -40], degrees=True)
        sky = (2 + directions(128, 256) @ linear)[..., None].repeat(3, axis=2).astype(np.float32)
        error = np.abs(panorama.rotated(sky, turn.as_matrix())[..., 1] - 2 - directions(128, 256) @ turn.apply(linear))
        inner = np.abs((directions(128, 256) @ turn.as_matrix())[..., 2]) < 0.98  # without the poles
        assert inner.mean() > 0.95 and error[inner].max() < 1e-3  # half a row is 0.012 rad

    @pytest.mark.parametrize(("azimuth", "elevation"), [(20.0, 30.0), (200.0, -50.0), (359.0, 5.0)])
    def test_angles_are_those_of_the_direction(self, azimuth: float, elevation: float) -> None:
        assert panorama.angles(unit_vector(azimuth, elevation)) == pytest.approx((azimuth, elevation))

    def test_negative_radiance_is_read_as_none(self, tmp_path: Path) -> None:
        sky = np.full((4, 8, 3), 0.25, np.float32)
        sky[1, 2] = -1.0
        panorama.write_radiance(tmp_path / "sky.exr", sky)
        np.testing.assert_array_equal(panorama.read_panorama(tmp_path / "sky.exr"), np.maximum(sky, 0))


class TestLamps:
    @pytest.mark.parametrize(
        ("azimuth", "elevation", "radius", "turn"),
        [
            (30, 40, 6, 0),
            (90, 25, 5, 0),  # across the seam
            (90 - 77, 25, 5, -77),  # the same disc in a rotated panorama
            (0, 90, 8, 0),  # at the pole
            (200, 87, 6, 0),  # around the pole
            (300, 15, 2, 0),
        ],
    )
    def test_a_disc_has_the_irradiance_of_its_closed_form(
        self, azimuth: float, elevation: float, radius: float, turn: float
    ) -> None:
        """A disc of angular radius r and elevation e has the irradiance pi L sin(r)^2 sin(e)."""
        bright, rest = np.array([30.0, 20.0, 10.0]), np.array([0.2, 0.25, 0.3])
        sky = painted((azimuth, elevation, radius, bright), rest=rest, turn=turn)
        found = estimated(sky, rotate_z=turn)
        (lamp,) = found.lamps
        assert between(lamp.direction, unit_vector(azimuth, elevation)) < 0.15
        r = np.radians(radius)
        expected = np.pi * np.sin(r) ** 2 * np.sin(np.radians(elevation)) * (bright - rest)
        np.testing.assert_allclose(lamp.irradiance, expected, rtol=0.02)
        np.testing.assert_allclose(found.ambient, np.pi * rest, rtol=0.01)
        assert lamp.extents[0] * lamp.extents[1] == pytest.approx(np.pi * np.tan(r) ** 2, rel=0.12)
        assert lamp.extents[0] == pytest.approx(lamp.extents[1], rel=0.05)
        np.testing.assert_allclose(lamp.radiance, bright - rest, rtol=0.12)
        np.testing.assert_allclose(lamp.colour, (bright - rest) / ((bright - rest) @ LUMINANCE), rtol=0.01)

    @pytest.mark.parametrize(("azimuth", "elevation"), [(40, 45), (90, 30), (200, 80)])
    def test_a_rectangle_of_60_degrees_is_found_with_its_size(self, azimuth: float, elevation: float) -> None:
        """At an extent of 60 degrees, areas near the edges are larger in the panorama than in the plane."""
        direction, extents = unit_vector(azimuth, elevation), np.array([1.15, 0.8])
        sight = directions(HEIGHT, WIDTH)
        plane = np.abs(sight @ rectangle_axes(direction).T / np.maximum(sight @ direction, 1e-3)[..., None])
        sky = np.where((plane < extents / 2).all(axis=2)[..., None], np.float32(20), np.float32(0.2)).repeat(3, axis=2)
        (lamp,) = estimated(sky).lamps
        assert between(lamp.direction, direction) < 0.5
        np.testing.assert_allclose(lamp.extents, extents, rtol=0.015)
        np.testing.assert_allclose(lamp.radiance, 19.8, rtol=0.03)

    def test_several_lamps_are_sorted_by_their_irradiance(self) -> None:
        discs = ((20, 50, 4, 20.0), (140, 30, 8, 5.0), (250, 60, 6, 20.0), (330, 20, 1, 10.0), (0, -40, 9, 40.0))
        sky = painted(*discs)
        found = estimated(sky)
        order = [2, 0, 1]  # the fourth has 1 % of the light, the last is below the horizon
        for lamp, index in zip(found.lamps, order, strict=True):
            assert between(lamp.direction, unit_vector(*discs[index][:2])) < 0.2
        assert [found.share(lamp.irradiance) for lamp in found.lamps] == sorted(
            (found.share(lamp.irradiance) for lamp in found.lamps), reverse=True
        )
        two = estimated(sky, lamps=2)
        assert [lamp.angles for lamp in two.lamps] == [lamp.angles for lamp in found.lamps[:2]]
        none = estimated(sky, lamps=0)
        assert none.lamps == [] and (none.rest == sky).all()

    @pytest.mark.parametrize(("gap", "lamps"), [(2.5, 1), (5.0, 2)])
    @pytest.mark.parametrize("azimuth", [10.0, 90.0])
    def test_lamps_closer_than_a_gap_are_one_lamp(self, gap: float, lamps: int, azimuth: float) -> None:
        tilt = 4.0 + gap / 2
        tubes = painted((azimuth, 30 - tilt, 4, 20.0), (azimuth, 30 + tilt, 4, 20.0))
        found = estimated(tubes)
        assert len(found.lamps) == lamps
        if lamps == 1:
            width, height = found.lamps[0].angular_size
            assert height > 1.8 * width and between(found.lamps[0].direction, unit_vector(azimuth, 30)) < 0.5

    def test_skies_without_lamps_give_none(self) -> None:
        height = directions(HEIGHT, WIDTH)[..., 2:].repeat(3, axis=2)
        overcast = (1 + 2 * height.clip(0)) / 3  # CIE 1955
        assert estimated(overcast).lamps == []
        windows = np.where((height > 0.2) & (height < 0.4), 30.0, 1.0).astype(np.float32)
        assert estimated(windows).lamps == []  # full circle

    def test_lamps_and_ambient_light_keep_the_irradiance(self) -> None:
        random = np.random.default_rng(5)
        for _ in range(6):
            discs = [
                (random.uniform(0, 360), random.uniform(-10, 90), random.uniform(1, 15), random.uniform(0, 30, 3))
                for _ in range(8)
            ]
            sky = painted(*discs) * random.uniform(0.5, 1.5, (HEIGHT, WIDTH, 1)).astype(np.float32)
            found = estimated(sky)
            assert found.lamps
            lamps = sum(lamp.radiance * rectangle_irradiance(lamp.direction, lamp.extents) for lamp in found.lamps)
            np.testing.assert_allclose(lamps + found.ambient, level_irradiance(sky), rtol=1e-4)
            assert all((lamp.radiance >= 0).all() for lamp in found.lamps)

    def test_a_bright_floor_counts_by_its_solid_angle(self) -> None:
        """Below -60 degrees are 6.7 % of the sphere but 17 % of the rows, whose mean would hide the lamp."""
        sky = painted((40, 40, 6, 1.1), (0, -90, 30, 0.9))
        (lamp,) = estimated(sky).lamps
        assert between(lamp.direction, unit_vector(40, 40)) < 1.0

    @pytest.mark.parametrize("elevation", [90.0, 89.7, 40.0])
    def test_the_axes_of_a_lamp_are_those_of_the_written_light(self, elevation: float) -> None:
        direction = unit_vector(70.0, elevation)
        light = AreaLight(position=tuple(3 * direction), target=(0.0, 0.0, 0.0), size=(2.0, 4.0), radiance=1.0)
        to_world = np.array(emitter_dict(light)["to_world"].matrix)[:3, :2]  # of a square from -1 to 1
        np.testing.assert_allclose(np.abs(rectangle_axes(direction) @ to_world), np.diag([1.0, 2.0]), atol=1e-4)

    def test_the_angular_size_is_seen_from_the_captured_point(self) -> None:
        none = np.zeros((4, 8), bool)
        lamp = Lamp(unit_vector(0, 40), (2.0, 1.0), np.ones(3), np.ones(3), none)
        assert lamp.angular_size == pytest.approx((90.0, 2 * np.degrees(np.arctan(0.5))))

    @pytest.mark.parametrize("azimuth", [0.0, 77.0])
    @pytest.mark.parametrize(("elevation", "extents"), [(90, (0.3, 0.6)), (50, (0.5, 0.2)), (20, (0.2, 0.3))])
    def test_a_rectangle_has_the_irradiance_of_lamberts_formula(
        self, azimuth: float, elevation: float, extents: tuple[float, float]
    ) -> None:
        direction = unit_vector(azimuth, elevation)
        sides = 0.5 * np.array(extents)[:, None] * rectangle_axes(direction)
        corners = np.array([direction + a * sides[0] + b * sides[1] for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
        assert rectangle_irradiance(direction, extents) == pytest.approx(room.lambert_irradiance(corners), rel=1e-4)


class TestLines:
    @pytest.mark.parametrize("rest", ["image", "constant"])
    def test_written_lines_give_a_scene_the_light_of_the_panorama(
        self, tmp_path: Path, write_scene: WriteScene, scene_data: Any, rest: Any
    ) -> None:
        """Read by the loader of scene files, the lines give a table the irradiance of the panorama."""
        sky = painted((10, 60, 6, (20.0, 15.0, 10.0)), (100, 20, 9, (4.0, 5.0, 6.0)), rest=(0.2, 0.2, 0.25), turn=40)
        around = (0.2, -0.1, 0.3)
        found = estimated(sky, rest=rest, rotate_z=40.0, distance=2.0, around=around)
        write_light(found, tmp_path / "cell, one.yaml")
        lines = YAML(typ="safe").load(tmp_path / "cell, one.yaml")
        scene = load_scene(write_scene(scene_data | lines))
        *areas, environment = scene.spec.lights
        assert len(areas) == 2
        sent = np.zeros(3)
        for area, expected in zip(areas, ((10, 60), (100, 20)), strict=True):
            away = np.subtract(area.position, around)
            assert area.target == around and np.linalg.norm(away) == pytest.approx(2.0, rel=1e-3)
            direction = away / np.linalg.norm(away)
            assert between(direction, unit_vector(*expected)) < 0.2
            extents = (area.size[0] / 2.0, area.size[1] / 2.0)
            sent += area.radiance * np.array(area.colour) * rectangle_irradiance(direction, extents)
        if rest == "constant":
            assert environment.image is None
            sent += np.pi * environment.radiance * np.array(environment.colour)
        else:
            assert environment.rotate_z == 40.0
            sent += level_irradiance(panorama.read_radiance(scene.images[environment.image]))
        np.testing.assert_allclose(sent, level_irradiance(sky), rtol=1e-3)

    def test_black_surroundings_of_lamps_add_no_light(self) -> None:
        found = estimated(painted((10, 60, 6, 20.0), rest=0.0), rest="constant")
        lines = YAML(typ="safe").load(light_lines(found, "rest.exr"))
        assert [light["kind"] for light in lines["lights"]] == ["area"]

    def test_a_stated_irradiance_scales_all_lights(self) -> None:
        sky = painted((10, 60, 6, 20.0))
        found = estimated(sky, irradiance=2.0)
        assert found.irradiance @ LUMINANCE == pytest.approx(2.0, rel=1e-4)
        assert found.share(found.ambient) == pytest.approx(estimated(sky).share(estimated(sky).ambient), rel=1e-4)


class TestBrackets:
    curve = staticmethod(lambda linear: encode_srgb(linear) ** 2 * (3 - 2 * encode_srgb(linear)))

    def shot(self, radiance: Float64Array, times: list[float]) -> list[Any]:
        random = np.random.default_rng(1)
        return [
            np.rint(255 * self.curve(np.clip(radiance * t + random.normal(0, 2e-3, radiance.shape), 0, 1))).astype(
                np.uint8
            )
            for t in times
        ]

    def test_three_exposures_recover_the_response_curve(self) -> None:
        radiance = np.geomspace(0.02, 25, 120 * 120).reshape(120, 120, 1) * np.array([1.0, 0.9, 0.7])
        times = [2.0, 0.25, 0.03]
        shown, clipped = merge_exposures(self.shot(radiance, times), times)
        ratio = shown / radiance
        ratio /= np.median(ratio)
        lit = radiance > 0.05
        assert np.percentile(ratio[lit], [2, 98]) == pytest.approx([1, 1], abs=0.12)
        assert np.abs(np.median(ratio, axis=(0, 1)) - 1).max() < 0.03  # no tint
        assert not clipped.any()
        # Radiance that only the shortest exposure does not clip is correct.
        assert ratio[radiance > 10].mean() == pytest.approx(1, abs=0.06)

    def test_pixels_clipped_in_the_shortest_exposure_are_a_lower_bound(self) -> None:
        levels = np.full((8, 8, 3), 255, np.uint8)
        shown, clipped = merge_exposures([levels, levels], [0.5, 0.02])
        assert clipped.all() and shown == pytest.approx(1 / 0.02)
        (single, _) = merge_exposures([np.full((8, 8, 3), 100, np.uint8)], [1.0])
        assert single == pytest.approx(float(decode_srgb(100 / 255)), rel=1e-6)

    def test_exposure_and_orientation_are_read_from_exif(self, tmp_path: Path) -> None:
        image = Image.new("RGB", (300, 200))
        exif = image.getexif()
        exif.get_ifd(0x8769).update({0x829A: 0.02, 0x829D: 4.0, 0x8827: 400, 0xA405: 50})
        exif[0x0112] = 6  # rotated by 90 degrees
        image.save(tmp_path / "a.jpg", exif=exif)
        found = read_photograph(tmp_path / "a.jpg")
        assert found.pixels.shape == (300, 200, 3)
        assert found.exposure == pytest.approx(0.02 * 4 / 16)
        assert found.focal == pytest.approx(50 / 43.2666 * np.hypot(300, 200), rel=1e-4)


def seen_ball(width: int) -> tuple[float, float, float]:
    """Return position and radius of the room's ball in a square image of a camera that looks at :data:`ASIDE`."""
    eye = room.CENTRE + room.AWAY * unit_vector(room.AZIMUTH, room.ELEVATION)
    camera = Camera.look_at(eye, room.CENTRE + ASIDE, width=width, height=width, fov_x=room.FOV)
    x, y = camera.project(room.CENTRE)[0][0].tolist()
    return x, y, camera.fx * float(np.tan(np.arcsin(room.RADIUS / room.AWAY)))


@pytest.fixture(scope="module")
def mirrored() -> tuple[Float32Array, Float32Array]:
    """Return a smooth sky and an image of its reflection in an off-axis ball."""
    sight = directions(128, 256)
    sky = np.stack([1 + np.sin(3 * sight[..., i] + 2 * sight[..., (i + 1) % 3]) for i in range(3)], axis=-1)
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32)), "to_world": y_up_to_z_up(0)}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "thing": room.ball(type="conductor", material="none"),
        "sky": emitter,
    }
    return sky.astype(np.float32), room.render(scene, (240, 240), 16, aside=ASIDE)


class TestBall:
    """Mirror ball under a distant sky, as the geometry assumes."""

    def test_an_unwrapped_ball_equals_its_panorama(self, mirrored: Any) -> None:
        sky, image = mirrored
        ball = seen_ball(240)
        focal = 120 / np.tan(np.radians(room.FOV) / 2)
        nothing = np.zeros(image.shape[:2], bool)
        true = (
            np.asarray(
                Image.fromarray(np.rint(60 * sky).astype(np.uint8)).resize((1024, 512), Image.Resampling.BILINEAR)
            )
            / 60
        )

        def error(focal: float | None, turn: float) -> float:
            found = unwrap_ball(image, ball, focal, room.AZIMUTH + turn, room.ELEVATION, nothing)
            seen = directions(512, 1024) @ unit_vector(room.AZIMUTH + 180, -room.ELEVATION) < np.cos(
                np.radians(found.blind + 2)
            )
            return float(np.abs(found.radiance - true)[seen].mean())

        assert error(focal, 0) < 0.015
        assert error(None, 0) > 3 * error(focal, 0)  # the model of parallel rays is less accurate
        assert error(focal, 3) > 2 * error(focal, 0)  # an error of 3 degrees is detectable

    def test_the_blind_spot_has_the_angle_of_its_closed_form(self, mirrored: Any) -> None:
        """sin(a) = radius / distance, plus a rim of 1.5 px. For 80 px and parallel rays this is 11 degrees."""
        image = np.zeros((200, 200, 3), np.float32)
        nothing = np.zeros((200, 200), bool)
        found = unwrap_ball(image, (100.0, 100.0, 80.0), None, 0.0, 0.0, nothing)
        rim = np.degrees(np.pi - 2 * np.arcsin(1 - 1.5 / 80))
        assert found.blind == pytest.approx(rim, abs=0.2)

    def test_a_ball_before_clutter_is_found(self, mirrored: Any) -> None:
        _, image = mirrored
        clutter = np.random.default_rng(2).uniform(0, 255, (16, 16, 3)).astype(np.uint8)
        behind = np.asarray(Image.fromarray(clutter).resize((240, 240), Image.Resampling.NEAREST))
        x, y, radius = seen_ball(240)
        columns, rows = np.meshgrid(np.arange(240) + 0.5, np.arange(240) + 0.5)
        disc = np.clip(0.5 + radius - np.hypot(columns - x, rows - y), 0, 1)[..., None]
        shown = np.rint(255 * encode_srgb(image / 2).clip(0, 1)).astype(np.uint8)
        picture = np.rint(disc * shown + (1 - disc) * behind).astype(np.uint8)
        found = find_ball(picture)
        # At half the radius, the tolerance is 2 degrees of reflected direction.
        assert found == pytest.approx((x, y, radius), abs=0.02 * radius)
        # The ball is less visible in the other exposures.
        assert find_ball(picture // 64, picture, np.full_like(picture, 255)) == found
        assert find_ball(behind) is None
        assert find_ball(np.full((240, 240, 3), 90, np.uint8)) is None


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    image = room.render(room.room(room.ball(type="conductor", material="none")), room.SIZE, 48)
    return room.photographs(tmp_path_factory.mktemp("shots"), image, [0.01, 0.05, 0.25, 1.2])


@pytest.fixture(scope="module")
def direct() -> list[Float64Array]:
    """Compute the irradiance at the ball's position on a horizontal plane by each light, in closed form."""
    return [room.lambert_irradiance(lamp.corners) * np.array(lamp.radiance) for lamp in room.LAMPS]


@pytest.fixture(scope="module")
def whole() -> Float64Array:
    """Compute the irradiance at the ball's position on a horizontal plane by all light."""
    return level_irradiance(room.true_panorama(128, 48))


@pytest.fixture(scope="module")
def found(shots: list[Path]) -> LightEstimate:
    reading = read_ball(shots, BallView(room.AZIMUTH, room.ELEVATION))
    assert reading.warnings == []
    assert reading.ball == pytest.approx(seen_ball_in_the_middle(), abs=1.0)
    return estimate_light(reading.panorama.radiance, LightSettings(irradiance=np.pi))


class TestRoom:
    """Path-traced room, photographed in 8-bit exposures with noise and a tone curve."""

    def test_lamps_are_found_within_3_degrees(self, found: LightEstimate) -> None:
        """Reflection at 3 cm from the ball's centre shifts a light at 1.9 m by one degree."""
        assert len(found.lamps) == len(room.LAMPS)
        for lamp, true in zip(found.lamps, room.LAMPS, strict=True):
            assert between(lamp.direction, true.direction) < 3.0

    def test_lamps_have_their_area_within_15_percent_and_their_colour(self, found: LightEstimate) -> None:
        for lamp, true in zip(found.lamps, room.LAMPS, strict=True):
            flat = true.corners / (true.corners @ true.direction)[:, None]
            area = 0.5 * np.linalg.norm(np.cross(flat[2] - flat[0], flat[3] - flat[1]))
            assert lamp.extents[0] * lamp.extents[1] == pytest.approx(area, rel=0.15)
            np.testing.assert_allclose(lamp.colour, np.array(true.radiance) / (true.radiance @ LUMINANCE), atol=0.06)

    def test_lamps_and_ambient_light_have_their_shares_within_10_percent(
        self, found: LightEstimate, direct: list[Float64Array], whole: Float64Array
    ) -> None:
        ambient = 1 - float(sum(direct) @ LUMINANCE / (whole @ LUMINANCE))
        assert 0.25 < ambient < 0.4
        assert found.share(found.ambient) == pytest.approx(ambient, rel=0.1)
        for lamp, true in zip(found.lamps, direct, strict=True):
            assert found.share(lamp.irradiance) == pytest.approx(float(true @ LUMINANCE / (whole @ LUMINANCE)), rel=0.1)
        np.testing.assert_allclose(found.irradiance / np.pi, whole / (whole @ LUMINANCE), rtol=0.05)

    def test_a_matt_ball_under_the_estimated_light_looks_as_in_the_room(
        self, found: LightEstimate, whole: Float64Array, tmp_path: Path
    ) -> None:
        """A matt ball is lit by the room and by the written lights. Rotated lights give a visible difference."""
        matt = room.ball(type="diffuse", reflectance={"type": "rgb", "value": 0.5})

        def shaded(scene: dict[str, Any]) -> Float32Array:
            """Return the middle of the ball, whose radius is 17 px, in 6 x 6 patches."""
            return room.render(scene, (60, 60), 64)[18:42, 18:42].reshape(6, 4, 6, 4, 3).mean(axis=(1, 3))

        true = shaded(room.room(matt)) * (np.pi / (whole @ LUMINANCE))

        def error(turn: float) -> float:
            write_light(found, tmp_path / "cell.yaml")
            lights = load_lights(tmp_path / "cell.yaml")
            scene = {"type": "scene", "integrator": {"type": "direct"}, "thing": matt}
            for number, light in enumerate(lights):
                scene[f"light_{number}"] = emitter_dict(turned(light, turn, room.CENTRE), tmp_path)
            return float(np.abs(shaded(scene) - true).mean() / true.mean())

        assert error(0) < 0.05
        assert error(15) > 2 * error(0)

    def test_a_single_exposure_warns_that_clipped_lamps_are_a_bound(self, shots: list[Path]) -> None:
        reading = read_ball(shots[2:3], BallView(room.AZIMUTH, room.ELEVATION))
        assert reading.warnings[0].startswith("1 exposure: the response of sRGB is assumed")
        assert "is white (from 250 of 255) in the shortest exposure" in reading.warnings[1]
        single = estimate_light(reading.panorama.radiance, LightSettings())
        assert between(single.lamps[0].direction, room.LAMPS[0].direction) < 15

    def test_the_reflectivity_of_the_ball_is_divided_out(self, shots: list[Path]) -> None:
        ball = BallView(room.AZIMUTH, room.ELEVATION, ball=seen_ball_in_the_middle())
        whole = read_ball(shots, ball).panorama.radiance
        tinted = read_ball(shots, replace(ball, reflectivity=(1.0, 0.8, 0.25))).panorama.radiance
        np.testing.assert_allclose(tinted * np.float32([1, 0.8, 0.25]), whole, rtol=1e-5)

    def test_the_lights_command_writes_lights_and_panorama(
        self, shots: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        camera = ("--camera", room.AZIMUTH, room.ELEVATION)
        assert run("lights", *shots, *camera, "-o", tmp_path / "cell.yaml") == 0
        out = capsys.readouterr().out
        assert out.startswith("ball: 135 90 ") and "warning" not in out
        assert len([line for line in out.splitlines() if line.endswith("%") and "°" in line]) == 2
        written = ["cell.png", "cell.yaml", "cell_panorama.exr", "cell_rest.exr"]
        assert sorted(path.name for path in tmp_path.iterdir()) == written
        with Image.open(tmp_path / "cell.png") as picture:
            assert picture.size == (512 * 270 // 180 + 1024, 512)
        lines = (tmp_path / "cell.yaml").read_text()
        assert lines.startswith("# Captured light: 3.142 W/m^2 on a horizontal plane")


def seen_ball_in_the_middle() -> tuple[float, float, float]:
    width, height = room.SIZE
    focal = 0.5 * width / np.tan(np.radians(room.FOV) / 2)
    return 0.5 * width, 0.5 * height, focal * np.tan(np.arcsin(room.RADIUS / room.AWAY))


def load_lights(path: Path) -> list[LightSpec]:
    adapter = TypeAdapter(list[LightSpec])
    return adapter.validate_python(YAML(typ="safe").load(path)["lights"], strict=False)


def turned(light: LightSpec, degrees: float, around: Float64Array) -> LightSpec:
    """Rotate a light about the vertical, and move it from the origin to a position."""
    if isinstance(light, EnvironmentLight):
        return light.model_copy(update={"rotate_z": light.rotate_z + degrees})
    assert isinstance(light, AreaLight)
    position = Rotation.from_euler("z", degrees, degrees=True).apply(light.position) + around
    return light.model_copy(update={"position": tuple(position), "target": tuple(around)})


class TestInput:
    """Invalid input, refused in one sentence."""

    CAMERA = ("--camera", 0, 10)

    @pytest.fixture
    def folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.chdir(tmp_path)
        grey = np.full((60, 120, 3), 90, np.uint8)
        Image.fromarray(grey).save("grey.png")
        Image.fromarray(grey[:, :100]).save("small.png")
        Path("broken.jpg").write_bytes(b"no image")
        sky = np.ones((8, 16, 3), np.float32)
        panorama.write_radiance(Path("square.exr"), sky[:, :8])
        panorama.write_radiance(Path("dark.exr"), 0 * sky)
        sky[3, 5] = np.nan
        panorama.write_radiance(Path("nan.exr"), sky)
        return tmp_path

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["grey.png"], "grey.png: must be the only input and an HDR panorama, .exr, .hdr, .pfm; for"),
            (["nan.exr", "nan.exr"], "nan.exr: must be the only input and an HDR panorama"),
            (["square.exr"], "square.exr: a panorama must be twice as wide as high (got 8 x 8 px)"),
            (["nan.exr"], "nan.exr: radiance must be finite (got nan at pixel 5, 3, and 1 such pixels)"),
            (["dark.exr"], "dark.exr: a panorama must have light above the horizon (got none)"),
            (["no.exr"], "no.exr: cannot be read (No such file or directory)"),
            (["no.png", *CAMERA], "no.png: no such file"),
            (["broken.jpg", *CAMERA], "broken.jpg: not a readable photograph"),
            (["grey.png", *CAMERA], "grey.png: no ball was detected: give --ball X Y RADIUS"),
            (
                ["grey.png", *CAMERA, "--ball", 20, 30, 25],
                "grey.png: the ball must be completely visible in the photograph, 120 x 60 px (got radius 25 around",
            ),
            (
                ["grey.png", "small.png", *CAMERA],
                "small.png: photographs must have equal sizes, 120 x 60 px as grey.png (got 100 x 60)",
            ),
            (
                ["grey.png", "grey.png", *CAMERA],
                "grey.png: EXIF has no exposure time: give --exposures",
            ),
            (
                ["grey.png", "grey.png", *CAMERA, "--exposures", "1,1"],
                "grey.png: the exposures of the photographs must differ (got 1, 1)",
            ),
            (["grey.png", *CAMERA, "--exposures", "1,2"], "--exposures must have one value per photograph, 1 (got 2)"),
            (["grey.png", *CAMERA, "--exposures", "1/0"], "--exposures must be times such as 1/60,1/8,1 (got 1/0)"),
            (["grey.png", "grey.png", *CAMERA, "--exposures", "1,-2"], "exposures must be finite and > 0 (got 1, -2)"),
            (["nan.exr", "grey.png", *CAMERA], "grey.png: an HDR photograph must be the only input (got 2)"),
            (
                ["nan.exr", *CAMERA, "--exposures", "1"],
                "nan.exr: --exposures applies to 8-bit photographs, not to an HDR",
            ),
            (
                ["grey.png", "--camera", 0, 90],
                "--camera must be an azimuth and an elevation between -90 and 90 (got 0 90)",
            ),
            (["grey.png", *CAMERA, "--fov-x", 180], "--fov-x must be between 0 and 180 degrees (got 180)"),
            (["grey.png", *CAMERA, "--reflectivity", 0, 1, 1], "--reflectivity must be above 0 and at most 1"),
            (["grey.png", *CAMERA, "--ball", 5, 5, 0], "--ball must have a radius > 0"),
            (["grey.png", *CAMERA, "--ball", 60, 30, 9], "grey.png: the ball's radius must be 20 px or more (got 9)"),
            (
                ["nan.exr", "--fov-x", 30],
                "--ball, --fov-x, --exposures and --reflectivity apply to photographs of a mirror",
            ),
            (
                ["grey.png", *CAMERA, "--rotate-z", 5],
                "--rotate-z applies to panoramas; for a mirror ball, use --camera (got 5)",
            ),
            (["nan.exr", "--distance", 0], "--distance must be > 0 and at most 1e+06 (got 0)"),
            (["nan.exr", "--irradiance", -1], "--irradiance must be > 0 and at most 1e+06 (got -1)"),
            (["nan.exr", "--irradiance", 1e39], "--irradiance must be > 0 and at most 1e+06 (got 1e+39)"),
            (["nan.exr", "--lamps", -1], "--lamps must be >= 0 (got -1)"),
            (["nan.exr", "--rotate-z", "nan"], "--around and --rotate-z must be finite"),
        ],
    )
    def test_invalid_input_is_refused_in_one_sentence(
        self,
        folder: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        words: Any,
        sentence: str,
    ) -> None:
        # The image check runs in a process that takes seconds and is tested with scenes. Here all files except the
        # missing one are valid.
        if words[0] != "no.exr":
            monkeypatch.setattr(panorama, "check_images", lambda paths: [None] * len(paths))
        assert run("lights", *words, "-o", "out.yaml") == 2
        assert capsys.readouterr().err.startswith(f"mitsplat: {sentence}")
        assert not list(folder.glob("out*"))

    def test_an_output_that_is_not_yaml_is_refused(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert run("lights", "dark.exr", "-o", "out.txt") == 2
        assert capsys.readouterr().err == "mitsplat: --out must end in .yaml or .yml (got out.txt)\n"
