"""Depth sensors against closed forms: error spread, occlusion from the second camera, flying pixels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.frames.depth_sensor import (
    SPEED_OF_LIGHT,
    measure_depth,
    occluded_in_second_camera,
    simulate_stereo,
    simulate_time_of_flight,
)
from mitsplat.geometry.camera import Camera
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.spec.image_spec import StereoSensor, TimeOfFlightSensor
from tests.conftest import WriteScene

FOCAL = 400.0
PLAIN = np.full((96, 128, 3), 128, dtype=np.uint8)
CAMERA = Camera.look_at((0, 0, 0), (0, 1, 0), width=128, height=96, fov_x=30)


def stereo(depth: Any, picture: Any = PLAIN, seed: int = 0, **values: Any) -> Any:
    sensor = StereoSensor(**values)
    return simulate_stereo(np.asarray(depth, dtype=np.float64), FOCAL, sensor, np.random.default_rng(seed), picture)


def flight(depth: Any, reflectance: float = 1.0, normal: Any = None, **values: Any) -> Any:
    normal = np.zeros((96, 128, 3), dtype=np.float32) if normal is None else normal
    given = np.full((96, 128), reflectance), normal
    return simulate_time_of_flight(depth, CAMERA, TimeOfFlightSensor(**values), np.random.default_rng(0), *given)


class TestStereo:
    @pytest.mark.parametrize("away", [0.5, 1.0, 2.0])
    def test_errors_grow_with_the_square_of_distance(self, away: float) -> None:
        """Disparity of a wall has variance noise^2 + step^2 / 12 (Sheppard), to first order in the depth error."""
        noise, step, baseline = 0.2, 0.25, 0.055
        found = stereo(np.full((96, 128), away), noise=noise, step=step, baseline=baseline)[:, 50:]
        expected = away**2 / (FOCAL * baseline) * np.sqrt(noise**2 + step**2 / 12)
        error = FOCAL * baseline / found - FOCAL * baseline / away
        assert error.std() == pytest.approx(np.sqrt(noise**2 + step**2 / 12), rel=0.03)
        assert found.std() == pytest.approx(expected, rel=0.05)
        assert error.mean() == pytest.approx(0, abs=4 * error.std() / np.sqrt(error.size))

    def test_disparities_are_whole_steps(self) -> None:
        found = stereo(np.full((96, 128), 1.3), step=0.5)
        steps = FOCAL * 0.055 / found[found > 0] / 0.5
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-4)
        assert len(np.unique(np.rint(steps))) in (2, 3)

    def test_pixels_hidden_from_the_second_camera_have_no_depth(self) -> None:
        """A box hides a strip of wall to its left, as wide as the difference of disparities, and the left border."""
        near, far = FOCAL * 0.1 / 20, FOCAL * 0.1 / 6  # disparities: 20 and 6 px
        depth = np.full((96, 128), far)
        depth[20:70, 60:90] = near
        found = stereo(depth, baseline=0.1, noise=0, shift=0, step=1)
        holes = found == 0
        expected = np.zeros_like(holes)
        expected[:, :6] = True
        expected[20:70, 60 - (20 - 6) : 60] = True
        np.testing.assert_array_equal(holes, expected)
        np.testing.assert_allclose(found[~holes], depth[~holes], rtol=1e-6)

    def test_the_wall_behind_a_thin_bar_has_depth(self) -> None:
        """The bar hides a strip of its own width, offset by the difference of the disparities."""
        disparity = np.full((4, 60), 3.0)
        disparity[:, 40:42] = 15.0
        hidden = occluded_in_second_camera(disparity)
        assert np.flatnonzero(hidden[0]).tolist() == [0, 1, 2, 28, 29]

    def test_every_pixel_of_a_slope_has_depth(self) -> None:
        """Disparities that grow to the right by up to 0.4 px per pixel cause no self-occlusion."""
        for slope in (-3.0, -0.9, 0.2, 0.4):
            disparity = 60 + slope * (np.arange(40) - 20.0)
            assert not occluded_in_second_camera(np.tile(np.pad(disparity, (140, 0)), (3, 1)))[:, 141:].any()

    def test_processing_by_scan_lines_gives_the_same_depth(self) -> None:
        """Slow twin: compares every pixel with every other pixel of its row."""
        rng = np.random.default_rng(3)
        disparity = np.repeat(rng.uniform(0, 12, (6, 10)), 5, axis=1)
        disparity[rng.random(disparity.shape) < 0.1] = 0
        place = np.arange(50) - disparity
        for row in range(6):
            for x in range(50):
                own = np.rint(place[row, x])
                covering = [
                    other
                    for other in range(50)
                    if disparity[row, other] > disparity[row, x] + 1
                    and own in (np.floor(place[row, other]), np.ceil(place[row, other]))
                ]
                assert occluded_in_second_camera(disparity)[row, x] == (own < 0 or bool(covering)), (row, x)

    def test_plain_surfaces_have_no_depth_without_a_pattern(self) -> None:
        picture = PLAIN.copy()
        picture[:, 64:] = np.where(np.indices((96, 64)).sum(0)[..., None] % 2, 100, 150)
        found = stereo(np.full((96, 128), 1.0), picture, contrast=0.05, shift=0)
        assert not found[:, :59].any() and (found[:, 70:] > 0).all()
        assert (stereo(np.full((96, 128), 1.0), picture)[:, 40:] > 0).all()

    def test_pixels_out_of_range_or_without_depth_have_none(self) -> None:
        depth = np.full((96, 128), 0.5)
        depth[:40], depth[40:50] = 3.0, 0.0
        found = stereo(depth, range=(0.2, 2.0), shift=0)
        assert not found[:50].any() and (found[50:, 50:] > 0).all()


class TestTimeOfFlight:
    @pytest.mark.parametrize(("away", "reflectance", "ambient"), [(1.0, 1.0, 0.0), (2.0, 0.5, 0.0), (1.5, 0.3, 2.0)])
    def test_errors_follow_the_returned_light(self, away: float, reflectance: float, ambient: float) -> None:
        """Pixels near the optical axis, where distance along the ray and depth differ by at most a per cent."""
        found = flight(np.full((96, 128), away), reflectance, noise=0.001, ambient=ambient)[38:58, 50:78]
        signal = reflectance / away**2
        expected = 0.001 * np.sqrt(signal + ambient) / signal
        assert found.std() == pytest.approx(expected, rel=0.1)
        assert found.mean() == pytest.approx(away, abs=4 * expected / np.sqrt(found.size))

    def test_an_inclined_surface_returns_less_light(self) -> None:
        normal = np.zeros((96, 128, 3), dtype=np.float32)
        normal[:] = (0, -0.5, np.sqrt(0.75))  # 60 degrees from the axis, tilted in y
        facing, turned = (flight(np.full((96, 128), 1.0), normal=n, noise=0.001)[38:58, 50:78] for n in (None, normal))
        assert turned.std() / facing.std() == pytest.approx(np.sqrt(2), rel=0.1)

    def test_pixels_at_an_edge_mix_both_depths(self) -> None:
        """The phasors of both surfaces add up, weighted by the Gaussian's share of each.

        Pixels away from the edge do not change.
        """
        depth = np.full((96, 128), 1.0)
        depth[:, 64:] = 1.5
        found = flight(depth, reflectance=0.4, noise=0, blur=1.0)
        taps = np.exp(-0.5 * np.arange(-4, 5) ** 2)
        for beyond in range(4):  # pixels 63, 62, ... and the weight of the Gaussian beyond the edge
            share = taps[5 + beyond :].sum() / taps.sum()
            wave = (1 - share) * np.exp(8e7j * np.pi / SPEED_OF_LIGHT) + share / 2.25 * np.exp(
                12e7j * np.pi / SPEED_OF_LIGHT
            )
            assert found[48, 63 - beyond] == pytest.approx(np.angle(wave) * SPEED_OF_LIGHT / 8e7 / np.pi, abs=2e-3)
        assert 1.05 < found[48, 63] < found[48, 64] < 1.45
        np.testing.assert_allclose(found[:, :58], 1.0, atol=2e-3)  # ray lengths differ as well
        np.testing.assert_allclose(found[:, 70:], 1.5, atol=2e-3)
        sharp = flight(depth, noise=0, blur=0)
        np.testing.assert_allclose(sharp, depth, atol=1e-5)

    def test_distances_wrap_at_the_modulation_length(self) -> None:
        longest = SPEED_OF_LIGHT / 2e8  # modulation of 100 MHz
        found = flight(np.full((96, 128), longest + 0.4), noise=0, blur=0, modulation=100)
        assert found[48, 64] == pytest.approx(0.4, abs=1e-3)

    def test_dark_and_empty_pixels_are_not_measured(self) -> None:
        depth = np.full((96, 128), 2.0)
        depth[:, 64:] = 0
        assert not flight(depth, reflectance=0.02, min_signal=0.006, blur=0).any()
        found = flight(depth, reflectance=0.03, min_signal=0.006, blur=0, noise=0)
        assert (found[40:56, 50:64] > 0).all() and not found[:, 64:].any()


@pytest.mark.parametrize("sensor", [StereoSensor(), TimeOfFlightSensor()])
def test_the_seed_of_the_frame_determines_the_noise(sensor: Any) -> None:
    depth = np.tile(np.linspace(0.8, 1.2, 128, dtype=np.float32), (96, 1))
    layers = SimpleNamespace(captured=np.full((96, 128, 3), 0.5), normal=np.zeros((96, 128, 3)))
    plan = SimpleNamespace(seed=5)
    frame: Any = SimpleNamespace(depth=depth, plan=plan, camera=CAMERA, image=PLAIN, layers=layers)
    one, again = measure_depth(frame, sensor), measure_depth(frame, sensor)
    frame.plan.seed = 6
    np.testing.assert_array_equal(one, again)
    assert (one != measure_depth(frame, sensor)).mean() > 0.3
    assert one.dtype == np.float32


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"output": {"formats": ["depth-sensor"]}}, "output.formats: depth-sensor needs the key depth_sensor"),
        ({"depth_sensor": {"kind": "stereo", "baseline": 0}}, "baseline: must be > 0"),
        ({"depth_sensor": {"kind": "stereo", "range": [2, 1]}}, r"range: must be \[low, high\]"),
        ({"depth_sensor": {"kind": "laser"}}, "depth_sensor"),
        (
            {
                "depth_sensor": {"kind": "stereo"},
                "camera": {
                    "kind": "orbit",
                    "target": [0, 0, 0],
                    "radius": 1,
                    "height": 1,
                    "intrinsics": {"fov_x": 40, "distortion": [0.1, 0, 0, 0]},
                },
            },
            "depth_sensor: stereo needs a camera without lens distortion",
        ),
        (
            {
                "depth_sensor": {"kind": "stereo"},
                "camera": {
                    "kind": "orbit",
                    "target": [0, 0, 0],
                    "radius": 1,
                    "height": 1,
                    "intrinsics": {"fx": 80, "lens": "fisheye", "distortion": [0, 0, 0, 0]},
                },
            },
            "depth_sensor: stereo needs a camera without lens distortion",
        ),
    ],
)
def test_invalid_sensors_are_refused(
    scene_data: dict[str, Any], write_scene: WriteScene, change: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        load_scene(write_scene(scene_data | change))


def test_a_stereo_sensor_refuses_a_distorted_camera_of_a_frame_made_in_python() -> None:
    camera = Camera(128, 96, FOCAL, FOCAL, 64.0, 48.0, np.eye(4), distortion=(-0.1, 0.0, 0.0, 0.0))
    frame = SimpleNamespace(index=3, camera=camera, plan=SimpleNamespace(seed=0), depth=np.ones((96, 128)), image=PLAIN)
    with pytest.raises(InputError, match=r"^frame 3: a stereo depth_sensor must have a camera without lens distortion"):
        measure_depth(frame, StereoSensor())  # type: ignore[arg-type]
