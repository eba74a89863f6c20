"""The renderer against its float64 twin and against closed forms."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mitsplat.errors import InputError, MissingResourceError
from mitsplat.frames.camera_response import tone_curve
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.quality import KERNELS, PRESETS, Quality
from mitsplat.renderer.layers import Layers, make_sensor, render_splats
from mitsplat.runtime.variant import ensure_variant
from tests.reference import render_reference

EXAMPLES = int(os.environ.get("MITSPLAT_EXAMPLES", "25"))
CAPTURES = Path(__file__).parents[3] / "shared/data/splats"
CAMERA = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=32, height=24, fov_x=50)


def make_splats(
    n: int, seed: int = 0, *, spread: float = 0.5, scales: tuple[float, float] = (0.02, 0.2), bands: int = 16
) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform(-spread, spread, (n, 3)),
        quats=Rotation.random(n, rng=rng).as_quat(),
        scales=np.exp(rng.uniform(*np.log(scales), (n, 3))),
        opacities=rng.uniform(0.05, 1.0, n),
        sh=np.concatenate([rng.uniform(-1, 1.5, (n, 1, 3)), rng.normal(0, 0.1, (n, bands - 1, 3))], axis=1),
    )


def one(
    scales: tuple[float, float, float], *, mean=(0.0, 0.0, 0.0), quat=(0.0, 0.0, 0.0, 1.0), opacity=1.0, count=1
) -> Splats:
    """Return identical Gaussians of display-encoded colour (0.2, 0.5, 0.8)."""
    colour = (np.array([0.2, 0.5, 0.8]) - 0.5) / SH_C0
    tile = lambda v: np.tile(np.asarray(v, dtype=np.float64), (count, 1))  # noqa: E731
    return Splats(tile(mean), tile(quat), tile(scales), np.full(count, opacity), tile(colour)[:, None, :])


def error(layers: Layers, splats: Splats, camera: Camera, quality: Quality = PRESETS["exact"]) -> float:
    """Return the largest difference of colour and alpha from the twin, with linear colour."""
    twin = render_reference(splats, camera, quality)
    alpha = np.maximum(twin.alpha, 1e-6)[..., None]
    linear = decode_srgb(twin.rgb / alpha) * twin.alpha[..., None]
    return float(max(np.abs(layers.rgb - linear).max(), np.abs(layers.alpha - twin.alpha).max()))


@pytest.mark.parametrize("seed", range(4))
def test_the_exact_preset_equals_the_slow_twin(seed: int) -> None:
    splats = make_splats(60, seed)
    assert error(render_splats(splats, CAMERA, quality="exact"), splats, CAMERA) < 1e-4


@pytest.mark.parametrize("preset", PRESETS)
def test_depth_of_a_thin_fog_is_the_weighted_mean(preset: str) -> None:
    splats = replace(make_splats(40, 13), opacities=np.random.default_rng(1).uniform(0.05, 0.3, 40))
    layers, twin = render_splats(splats, CAMERA, quality=preset), render_reference(splats, CAMERA)
    thin = (twin.alpha > 0.02) & (twin.alpha < 0.49)
    assert thin.sum() > 100
    tolerance = {"fast": 5e-2, "balanced": 2e-2, "exact": 5e-4}[preset]  # cut-offs, and the order of a tile
    np.testing.assert_allclose(layers.depth[thin], twin.depth[thin], rtol=tolerance)
    assert (layers.depth[twin.alpha == 0] == 0).all() and np.isfinite(layers.depth).all()


def test_tile_order_equals_the_twin_where_gaussians_do_not_overlap_in_depth() -> None:
    stack = Splats.concatenate(
        [one((0.1, 0.2, 0.01), mean=(0.0, 0.0, z), opacity=0.4) for z in np.linspace(-0.8, 0.8, 5)]
    )
    quality = Quality(alpha_min=1e-6, transmittance_min=0)
    assert error(render_splats(stack, CAMERA, quality=quality), stack, CAMERA) < 1e-4


def test_all_spherical_harmonic_bands_follow_the_twin_from_every_side() -> None:
    splats = make_splats(12, 5)
    for angle in (0.4, 2.0, 4.1):
        eye = 2 * np.array([np.cos(angle), np.sin(angle), 0.5])
        camera = Camera.look_at(eye, (0, 0, 0), width=24, height=24, fov_x=45)
        assert error(render_splats(splats, camera, quality="exact"), splats, camera) < 1e-4


@pytest.mark.parametrize("aspect", [10.0, 100.0, 1000.0])
@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0, 85.0, 90.0])
def test_a_flat_gaussian_is_blended_once(aspect: float, tilt: float) -> None:
    quat = Rotation.from_euler("x", tilt, degrees=True).as_quat()
    splats = one((0.3, 0.3, 0.3 / aspect), quat=quat, opacity=0.7)
    assert error(render_splats(splats, CAMERA, quality="exact"), splats, CAMERA) < 1e-4


@pytest.mark.parametrize("angle", [0.0, 17.0, 45.0, 90.0])
def test_a_needle_equals_the_slow_twin(angle: float) -> None:
    quat = Rotation.from_euler("zy", [angle, 20.0], degrees=True).as_quat()
    splats = one((0.5, 0.001, 0.001), quat=quat, opacity=0.9)
    assert error(render_splats(splats, CAMERA, quality="exact"), splats, CAMERA) < 1e-4


@pytest.mark.parametrize("response", ["perspective", "ewa"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_kernels_and_responses_follow_the_twin(response: str, kernel: str) -> None:
    splats = make_splats(40, 5, scales=(0.005, 0.2))
    quality = replace(PRESETS["exact"], response=response, kernel=kernel)
    assert error(render_splats(splats, CAMERA, quality=quality), splats, CAMERA, quality) < 1e-4


def test_small_gaussians_keep_their_light_at_any_position_in_a_pixel() -> None:
    """With ``mip``, the opacities of all pixels add up to about 2 pi sigma^2 o; point samples would flicker.

    Poisson's summation formula bounds the sum of a Gaussian's samples: 1 +- 2 exp(-2 pi^2 v) along each axis, with the
    widened variance v.
    """
    sigma, totals = 0.1, {"mip": [], "exact": []}  # px
    metres = 2.0 / CAMERA.fx
    for kernel, found in totals.items():
        quality = replace(PRESETS["exact"], kernel=kernel)
        for x, y in [(0.0, 0.0), (0.5, 0.5), (0.2, 0.4), (0.35, 0.1)]:
            splats = one((sigma * metres,) * 3, mean=(x * metres, y * metres, 0.0), opacity=0.9)
            found.append(float(render_splats(splats, CAMERA, quality=quality).alpha.sum()))
    truth = 2 * np.pi * sigma**2 * 0.9
    ripple = 2 * np.exp(-2 * np.pi**2 * (sigma**2 + KERNELS["mip"].variance))
    assert (1 - ripple) ** 2 * 0.99 < min(totals["mip"]) / truth < max(totals["mip"]) / truth < (1 + ripple) ** 2 * 1.01
    assert max(totals["exact"]) > 10 * truth and min(totals["exact"]) < 0.1 * truth


def test_kernel_of_a_distorted_lens_has_the_size_of_its_pixels() -> None:
    camera = replace(CAMERA, distortion=(-0.2, 0.05, 0.01, -0.02, 0.01))
    sensor = make_sensor(camera)
    from mitsplat.renderer.rays.sensors import view_of

    view = view_of(sensor)
    pixel = np.array([3.0, 20.0])
    u, v = camera.ray_slopes(pixel)[0]
    step = 1e-3
    right, left, down, up = camera.ray_slopes(pixel + step * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]))
    jacobian = np.stack([right - left, down - up], axis=1) / (2 * step)
    found = [c[0] for c in view.pixel_covariance(mi.Float(u), mi.Float(v), 0.25)]
    np.testing.assert_allclose(found, (0.25 * jacobian @ jacobian.T)[[0, 0, 1], [0, 1, 1]], rtol=1e-3)


@pytest.mark.parametrize("count", [20, 200])
@pytest.mark.parametrize("tolerance", [0.0, 1e-3, math.inf])
def test_coincident_layers_multiply_their_transmittances(count: int, tolerance: float) -> None:
    """K layers of opacity a at one place transmit (1 - a)^K of the light."""
    splats = one((50.0, 50.0, 0.001), opacity=0.01, count=count)
    quality = Quality(tolerance=tolerance, alpha_min=1e-6, transmittance_min=0)
    alpha = render_splats(splats, CAMERA, quality=quality).alpha
    assert alpha[12, 16] == pytest.approx(1 - 0.99**count, abs=1e-4)


@pytest.mark.parametrize("tolerance", [0.0, 1e-3, math.inf])
def test_an_ended_ray_has_the_colour_of_its_gaussians_only(tolerance: float) -> None:
    """Eleven layers of opacity 0.3 transmit less than 0.02; that rest is lost, or has the layers' colour."""
    quality = Quality(tolerance=tolerance, alpha_min=1e-6, transmittance_min=0.02)
    for count, left in ((5, 0.7**5), (30, 0.7**11)):
        splats = one((50.0, 50.0, 0.001), opacity=0.3, count=count)
        ended, extended = (
            render_splats(splats, CAMERA, quality=replace(quality, normalise_ended_rays=e)) for e in (False, True)
        )
        expected = 1 - left, 1 if count == 30 else 1 - left
        for layers, alpha in zip((ended, extended), expected, strict=True):
            assert layers.alpha[12, 16] == pytest.approx(alpha, abs=1e-4)
            colour = alpha * decode_srgb(np.array([0.2, 0.5, 0.8]))
            np.testing.assert_allclose(layers.rgb[12, 16], colour, atol=2e-4)


def test_powers_of_two_agree_with_numpy() -> None:
    ensure_variant()
    from mitsplat.renderer.splatting.response import exp2

    x = np.linspace(-126, 126, 200_001, dtype=np.float32)
    found, whole = (exp2(mi.Float(values)).numpy().astype(np.float64) for values in (x, np.arange(-126.0, 127.0)))
    tolerance = 1e-5 if mi.variant() == "cuda_ad_rgb" else 2e-7
    np.testing.assert_allclose(found, np.exp2(x.astype(np.float64)), rtol=tolerance)
    np.testing.assert_array_equal(whole, np.exp2(np.arange(-126.0, 127.0)))


def test_equal_depths_keep_their_order_when_others_come_between() -> None:
    """More coincident layers than one walk can hold, and small Gaussians in front that come later in the list."""
    layers = one((0.5, 0.5, 0.5), opacity=0.2, count=24)
    layers = replace(layers, sh=np.random.default_rng(3).uniform(-1, 1, layers.sh.shape))
    front = [one((0.02, 0.02, 0.02), mean=(0.0, 0.0, -0.1 - 0.02 * i), opacity=0.1) for i in range(5)]
    splats = Splats.concatenate([layers, *front])
    assert error(render_splats(splats, CAMERA, quality="exact"), splats, CAMERA) < 1e-4


@pytest.mark.parametrize("offset", [(0, 0, 0.0), (0, 0, 0.1), (0.05, 0.02, -0.05), (0.0, 0.1, 0.0)])
def test_camera_inside_a_gaussian_follows_the_twin(offset: tuple[float, float, float]) -> None:
    mean = np.array([0.0, 0.0, -2.0]) + offset
    splats = Splats.concatenate([one((0.5, 0.5, 0.5), mean=mean, opacity=0.6), make_splats(20, 9)])
    assert error(render_splats(splats, CAMERA, quality="exact"), splats, CAMERA) < 1e-4


def test_gaussian_that_straddles_the_camera_plane_follows_the_twin() -> None:
    quat = Rotation.from_euler("y", 70.0, degrees=True).as_quat()
    splats = one((2.0, 0.05, 0.3), mean=(0.8, 0.1, -2.1), quat=quat, opacity=0.8)
    twin = render_reference(splats, CAMERA)
    assert twin.alpha.max() > 0.1
    assert error(render_splats(splats, CAMERA, quality="exact"), splats, CAMERA) < 1e-4


def test_wide_lens_is_exact_in_the_corners() -> None:
    camera = Camera.look_at((0, 0, -1), (0, 0, 0), up=(0, -1, 0), width=40, height=30, fov_x=110)
    splats = make_splats(80, 11, spread=1.2)
    assert error(render_splats(splats, camera, quality="exact"), splats, camera) < 1e-4


LENSES = {
    "opencv": {"distortion": (-0.25, 0.08, 0.002, -0.001, -0.01)},
    "fisheye": {"distortion": (0.05, -0.02, 0.01, -0.003), "lens": "fisheye", "fx": 18.0, "fy": 17.0},
}


@pytest.mark.parametrize("lens", LENSES)
def test_each_lens_equals_the_slow_twin(lens: str) -> None:
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=40, height=30, fov_x=70)
    camera = replace(camera, **LENSES[lens])
    splats = make_splats(60, 13, spread=1.0 if lens == "opencv" else 2.0)
    assert error(render_splats(splats, camera, quality="exact"), splats, camera) < 2e-4


@pytest.mark.parametrize("lens", LENSES)
def test_an_undistorted_lens_image_equals_the_pinhole_image(lens: str) -> None:
    """Every pixel of the pinhole image is looked up at its position in the lens image according to OpenCV."""
    pinhole = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=48, height=36, fov_x=60)
    focal = {"fx": 8 * 48.0, "fy": 8 * 48.0}
    bent = replace(pinhole.resized(8 * 48, 8 * 36), **LENSES[lens] | focal)
    splats = make_splats(40, 17, scales=(0.1, 0.3), bands=1)
    splats = replace(splats, sh=np.full_like(splats.sh, 0.7))  # one colour: no edges where orders change
    x, y = np.meshgrid(np.arange(48) + 0.5, np.arange(36) + 0.5)
    rays = np.concatenate([pinhole.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1)), np.ones((48 * 36, 1))], axis=1)
    if lens == "fisheye":
        shown, _ = cv2.fisheye.projectPoints(
            rays[:, None], np.zeros(3), np.zeros(3), bent.intrinsics, np.array(bent.distortion)
        )
    else:
        shown, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), bent.intrinsics, np.array(bent.distortion))
    where = shown.reshape(36, 48, 2).astype(np.float32) - 0.5
    picture = render_splats(splats, bent, quality="exact").rgb
    undistorted = cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_CUBIC)
    inside = ((where > 2) & (where < (8 * 48 - 3, 8 * 36 - 3))).all(axis=2)
    assert inside.mean() > 0.5
    expected = render_splats(splats, pinhole, quality="exact").rgb
    assert np.abs(undistorted - expected)[inside].max() < 2e-3


@dataclass(frozen=True, eq=False)
class ThroughAPoint(Camera):
    """Camera at one point of a thin lens: its rays meet the rays of the centre in the plane of focus."""

    point: tuple[float, float] = (0.0, 0.0)

    def ray_slopes(self, pixels: npt.ArrayLike) -> np.ndarray:
        return super().ray_slopes(pixels) - np.array(self.point) / self.focus_distance


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_thin_lens_follows_the_twin_through_every_point_of_the_aperture(lens: str | None) -> None:
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=24, height=18, fov_x=70)
    options = {} if lens is None else LENSES[lens] | {"fx": 14.0, "fy": 14.0}
    camera = replace(camera, **options, aperture_radius=0.1, focus_distance=1.8)
    splats = make_splats(40, 13)
    quality = replace(PRESETS["exact"], lens_rings=1)
    views = make_sensor(camera).view().apertures(1)
    assert len(views) == 7
    rgb, alpha = [], []
    for view in views:
        point = (np.linalg.inv(camera.world_from_camera) @ view.world_from_camera)[:2, 3]
        pose = {"world_from_camera": view.world_from_camera, "point": tuple(point)}
        seen = render_reference(splats, ThroughAPoint(**vars(camera) | pose))
        rgb.append(decode_srgb(seen.rgb / np.maximum(seen.alpha, 1e-6)[..., None]) * seen.alpha[..., None])
        alpha.append(seen.alpha)
    layers = render_splats(splats, camera, quality=quality)
    np.testing.assert_allclose(layers.rgb, np.mean(rgb, axis=0), atol=2e-4)
    np.testing.assert_allclose(layers.alpha, np.mean(alpha, axis=0), atol=2e-4)
    pinhole = render_splats(splats, replace(camera, aperture_radius=0.0), quality=quality)
    assert np.array_equal(layers.depth, pinhole.depth) and np.array_equal(layers.instance, pinhole.instance)


@pytest.mark.parametrize("z", [0.8, 1.5, 4.0])
def test_thin_lens_blurs_by_its_circle_of_confusion(z: float) -> None:
    """A uniform disk of radius f a |1/F - 1/z| adds the variance radius^2 / 4 along each axis.

    A Gaussian is also blurred by its own depth: its mean of radius^2 is larger by (f a sigma / z^2)^2.
    """
    camera = Camera(96, 72, 150.0, 150.0, 48.0, 36.0, np.eye(4), aperture_radius=0.08, focus_distance=1.5)
    dot = one((0.01 * z,) * 3, mean=(0, 0, z), opacity=0.5)
    x = np.arange(96) + 0.5 - 48.0

    def variance(camera: Camera) -> float:
        alpha = render_splats(dot, camera, quality=replace(PRESETS["exact"], lens_rings=3)).alpha
        return float((alpha * x**2).sum() / alpha.sum())

    radius = 150.0 * 0.08 * np.hypot(1 / 1.5 - 1 / z, 0.01 / z)
    added = variance(camera) - variance(replace(camera, aperture_radius=0.0))
    assert added == pytest.approx(radius**2 / 4, rel=0.01, abs=1e-4)


def test_other_integrators_render_through_the_thin_lens() -> None:
    """A distant bright disk in Mitsuba's path tracer has the same blur size."""
    camera = Camera(64, 48, 100.0, 100.0, 32.0, 24.0, np.eye(4), aperture_radius=0.1, focus_distance=1.0)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    pose = mi.ScalarTransform4f().translate([0, 0, 4]).rotate([0, 1, 0], 180).scale(0.04)
    disk = {"type": "disk", "to_world": pose, "light": light}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "disk": disk})
    image = np.array(mi.render(scene, sensor=make_sensor(camera), spp=256, seed=1))[..., 0]
    x = np.arange(64) + 0.5 - 32.0
    variance = (image * x**2).sum() / image.sum()
    assert variance == pytest.approx((100 * 0.1 * 0.75) ** 2 / 4 + (100 * 0.04 / 4) ** 2 / 4 + 1 / 12, rel=0.02)


def test_gaussians_far_from_the_origin_keep_their_pixels() -> None:
    """The Gaussians are 10 km from the origin, on coordinates that float32 can represent."""
    near = make_splats(30, 15)
    shift = np.array([8192.0, -4096.0, 2048.0])
    grid = 2.0**-10
    means = np.round(near.means / grid) * grid
    near = Splats(means, near.quats, near.scales, near.opacities, near.sh)
    far = Splats(means + shift, near.quats, near.scales, near.opacities, near.sh)
    camera = Camera.look_at(np.array((0, 0, -2)) + shift, shift, up=(0, -1, 0), width=32, height=24, fov_x=50)
    expected = render_splats(near, CAMERA, quality="exact").rgb
    assert np.abs(render_splats(far, camera, quality="exact").rgb - expected).max() < 1e-4


def test_rotating_object_and_camera_together_does_not_change_the_image() -> None:
    splats = make_splats(60, 17)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turned = Camera(**{**vars(CAMERA), "world_from_camera": turn @ CAMERA.world_from_camera})
    a = render_splats(splats, CAMERA, quality="exact").rgb
    b = render_splats(splats.transformed(turn), turned, quality="exact").rgb
    assert np.abs(a - b).max() < 5e-5


def test_turning_the_camera_changes_no_ray() -> None:
    """No popping: while the camera rotates by 0.1 degrees a step, one line of sight has a constant colour.

    This holds at any position in the image and in its tile. The tile order does not have this property, because it
    depends
    on neighbouring pixels.
    """
    splats = make_splats(150, 31, scales=(0.1, 0.5), bands=1)
    sight = CAMERA.world_from_camera[:3, :3] @ (0.03, -0.02, 1.0)

    def changes(quality: Quality) -> float:
        seen = []
        for i in range(12):
            pose = CAMERA.world_from_camera.copy()
            pose[:3, :3] @= Rotation.from_euler("yx", (0.1 * i, -0.05 * i), degrees=True).as_matrix()
            u, v, depth = pose[:3, :3].T @ sight
            x, y = 12 + i % 5, 9 + i % 3
            shifted = {"cx": x + 0.5 - CAMERA.fx * u / depth, "cy": y + 0.5 - CAMERA.fy * v / depth}
            layers = render_splats(splats, replace(CAMERA, world_from_camera=pose, **shifted), quality=quality)
            seen.append(layers.rgb[y, x])
        return float(np.abs(np.array(seen) - seen[0]).max())

    assert changes(PRESETS["exact"]) < 1e-5
    tile = changes(replace(PRESETS["exact"], tolerance=math.inf))
    assert 1e-3 < tile < 0.2
    assert changes(replace(PRESETS["exact"], tolerance=5e-3)) < 5e-3


def test_one_gaussian_covers_the_whole_image() -> None:
    wide = one((5.0, 4.0, 0.5), mean=(0.5, 0.2, 1.0), opacity=0.9)
    layers = render_splats(wide, CAMERA, quality="exact")
    assert layers.alpha.min() > 0.5
    assert error(layers, wide, CAMERA) < 1e-4


def test_near_plane_cuts_where_the_peak_is_nearer() -> None:
    camera = replace(CAMERA, near=1.9)
    splats = make_splats(80, 21)
    layers = render_splats(splats, camera, quality="exact")
    assert error(layers, splats, camera) < 1e-4
    assert np.abs(layers.alpha - render_splats(splats, CAMERA, quality="exact").alpha).max() > 0.1
    assert layers.depth[layers.alpha > 0.01].min() > 1.9


@pytest.mark.parametrize("preset", PRESETS)
def test_harmonics_that_overshoot_below_black_are_clamped(preset: str) -> None:
    rng = np.random.default_rng(5)
    splats = replace(make_splats(60, 5), sh=rng.normal(0, 3, (60, 16, 3)))
    layers = render_splats(splats, CAMERA, quality=preset)
    assert layers.rgb.min() >= 0 and np.isfinite(layers.rgb).all()
    if preset == "exact":
        assert error(layers, splats, CAMERA) < 1e-3 * render_reference(splats, CAMERA).rgb.max() ** 2.4


def test_an_opaque_gaussian_hides_gaussians_behind_it() -> None:
    front, behind = one((500, 500, 0.01), mean=(0, 0, -0.5)), one((500, 500, 0.01), mean=(0, 0, 0.5))
    behind = Splats(behind.means, behind.quats, behind.scales, behind.opacities, behind.sh * -3)
    both = render_splats(Splats.concatenate([behind, front]), CAMERA)
    assert both.alpha[12, 16] == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(both.rgb[12, 16], decode_srgb(np.array([0.2, 0.5, 0.8])), atol=1e-3)
    assert both.depth[12, 16] == pytest.approx(1.5, abs=1e-3)


@pytest.mark.parametrize("preset", PRESETS)
def test_opacity_at_the_cut_off_and_below_is_not_seen(preset: str) -> None:
    cut = PRESETS[preset].alpha_min
    assert render_splats(one((0.3, 0.3, 0.3), opacity=cut), CAMERA, quality=preset).alpha.max() <= cut * (1 + 1e-5)
    assert render_splats(one((0.3, 0.3, 0.3), opacity=0.9 * cut), CAMERA, quality=preset).alpha.max() == 0.0
    assert render_splats(one((0.3, 0.3, 0.3), opacity=1.1 * cut), CAMERA, quality=preset).alpha.max() > cut


@pytest.mark.parametrize("size", [(1, 1), (401, 3), (9, 17)])
def test_images_of_odd_sizes_equal_the_slow_twin(size: tuple[int, int]) -> None:
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=size[0], height=size[1], fov_x=40)
    splats = make_splats(20, 19)
    layers = render_splats(splats, camera, quality="exact")
    assert layers.rgb.shape == (size[1], size[0], 3)
    assert error(layers, splats, camera) < 1e-4


def test_an_image_without_gaussians_is_black_and_empty() -> None:
    behind = one((0.1, 0.1, 0.1), mean=(0, 0, -5))
    for splats in (behind.select(np.zeros(1, bool)), behind):
        layers = render_splats(splats, CAMERA)
        assert not layers.rgb.any() and not layers.alpha.any() and not layers.depth.any() and not layers.instance.any()


@pytest.mark.parametrize("distortion", [(), (0.05, 0.0, 0.0, 0.0)])
def test_a_gaussian_reaching_the_camera_from_behind_a_wall_stays_hidden(distortion: tuple[float, ...]) -> None:
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 49), np.linspace(-0.9, 0.9, 37))
    wall = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    count = len(wall) + 1
    splats = Splats(
        means=np.vstack([wall, [0.3, 0.2, 2.4]]).astype(np.float32),
        quats=np.tile(np.array([0, 0, 0, 1], np.float32), (count, 1)),
        scales=np.vstack([np.tile([0.07, 0.07, 0.002], (count - 1, 1)), [0.9, 0.7, 0.8]]).astype(np.float32),
        opacities=np.full(count, 0.98, np.float32),
        sh=np.concatenate([np.full((count - 1, 1, 3), 1.2), np.full((1, 1, 3), -1.2)]).astype(np.float32),
    )
    camera = replace(CAMERA, world_from_camera=np.eye(4), distortion=distortion)
    fast, exact = (render_splats(splats, camera, quality=name).rgb for name in ("fast", "exact"))
    assert exact.min() > 0.66  # the dark Gaussian around the camera is hidden
    np.testing.assert_allclose(fast, exact, atol=0.02)


@pytest.mark.parametrize("samples", [1, 2])
def test_a_crowded_view_is_rendered_in_parts(monkeypatch: pytest.MonkeyPatch, samples: int) -> None:
    from mitsplat.renderer.splatting import march, pairs

    joined = []
    join = march.Image.joined
    monkeypatch.setattr(march.Image, "joined", lambda parts: joined.append(parts) or join(parts))
    splats = make_splats(300, 8)
    quality = replace(PRESETS["exact"], samples=samples)
    camera = replace(CAMERA, height=27)
    whole = render_splats(splats, camera, quality=quality)
    monkeypatch.setattr(pairs, "PAIRS_MAX", 1500)
    parts = render_splats(splats, camera, quality=quality)
    assert joined
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), atol=2e-6)
    monkeypatch.setattr(pairs, "PAIRS_MAX", 10)
    with pytest.raises(MissingResourceError, match="cover too much of the image"):
        render_splats(splats, camera, quality=quality)


def test_the_instance_is_the_one_with_the_largest_share() -> None:
    layers = render_splats(one((0.1, 0.1, 0.1)), CAMERA)
    assert layers.instance[12, 16] == 1
    assert layers.instance[0, 0] == 0


def test_denormal_scales_stay_finite() -> None:
    layers = render_splats(one((0.2, 1e-42, 0.2)), CAMERA)
    assert np.isfinite(layers.rgb).all() and np.isfinite(layers.depth).all()
    assert render_splats(one((1e-40, 1e-40, 1e-40)), CAMERA).alpha.max() <= 1.0


@pytest.mark.parametrize("preset", ["fast", "balanced", "exact"])
def test_needles_thinner_than_rounding_keep_their_brightness(preset: str) -> None:
    """Axes of 0.1 nm seen from 2 m: rounding used to give responses of arbitrary size, and NaN pixels."""
    splats = make_splats(400, 41)
    rng = np.random.default_rng(41)
    for longest in (-8.0, -0.5):
        scales = 10 ** np.column_stack([rng.uniform(-10, -8, (400, 2)), rng.uniform(-10, longest, 400)])
        layers = render_splats(replace(splats, scales=scales), CAMERA, quality=preset)
        assert np.isfinite(layers.rgb).all() and np.isfinite(layers.depth).all()
        assert layers.alpha.min() >= 0 and layers.alpha.max() <= 1
        assert layers.rgb.max() < 2


def test_samples_average_the_pixel() -> None:
    """4x4 samples of a small image equal the box-downsampled image of four times the size."""
    splats = make_splats(30, 21)
    fine = render_splats(splats, CAMERA.resized(128, 96), quality=Quality(alpha_min=1e-5, transmittance_min=1e-6))
    coarse = render_splats(splats, CAMERA, quality=Quality(samples=4, alpha_min=1e-5, transmittance_min=1e-6))
    boxed = fine.alpha.reshape(24, 4, 32, 4).mean(axis=(1, 3))
    assert np.abs(coarse.alpha - boxed).max() < 1e-4


def test_repeated_runs_and_any_number_of_threads_give_the_same_bytes() -> None:
    splats = make_splats(500, 23)
    first = render_splats(splats, CAMERA).rgb.tobytes()
    assert render_splats(splats, CAMERA).rgb.tobytes() == first
    threads = dr.thread_count()
    try:
        for count in (2, 5):
            dr.set_thread_count(count)
            assert render_splats(splats, CAMERA).rgb.tobytes() == first
    finally:
        dr.set_thread_count(threads)


def test_a_second_frame_compiles_no_new_kernel() -> None:
    """Another camera and other splats use the kernels of the first frame, not others from the disk cache."""

    def kernels(splats: Splats, camera: Camera) -> set[int]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            render_splats(splats, camera)
            return {k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT}

    first = kernels(make_splats(400, 27), CAMERA)  # crowded enough that both repeat tiles
    moved = Camera.look_at((0.3, 0.2, -1.9), (0.1, 0, 0), up=(0, -1, 0), width=32, height=24, fov_x=42)
    assert first
    assert kernels(make_splats(500, 28), moved) <= first


@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**31), st.floats(-4, 1), st.floats(0, 3), st.floats(20, 120), st.booleans())
def test_random_extremes_follow_the_twin(seed: int, size: float, stretch: float, fov: float, inside: bool) -> None:
    rng = np.random.default_rng(seed)
    splats = make_splats(12, seed, spread=1.0, scales=(10**size / 10**stretch, 10**size))
    eye = rng.uniform(-1, 1, 3) * (0.5 if inside else 3.0)
    camera = Camera.look_at(eye, rng.uniform(-0.2, 0.2, 3), width=13, height=9, fov_x=fov)
    assert error(render_splats(splats, camera, quality="exact"), splats, camera) < 3e-4


def test_unknown_quality_is_refused() -> None:
    with pytest.raises(InputError, match="balanced"):
        render_splats(make_splats(1), CAMERA, quality="best")
    assert set(PRESETS) == {"fast", "balanced", "exact"}
    assert tone_curve("neutral")[0] == 0


@pytest.mark.parametrize("name", [pytest.param("plant", marks=pytest.mark.extended), "academic_tarot_cards"])
def test_presets_are_close_to_exact_on_captures(name: str) -> None:
    file = CAPTURES / f"{name}.splat"
    if not file.exists():
        pytest.skip(f"no capture {file}")
    splats = Splats.load(file)
    centre = np.median(splats.means, axis=0)
    size = np.percentile(np.linalg.norm(splats.means - centre, axis=1), 80)
    eye = centre + 1.5 * size * np.array([0.3, -0.7, -1.2])
    camera = Camera.look_at(eye, centre, up=(0, -1, 0), width=640, height=480, fov_x=50)

    def shown(quality: str) -> np.ndarray:
        """Return display-encoded colour over black, the form in which captures are compared."""
        layers = render_splats(splats, camera, quality=quality)
        return encode_srgb(layers.rgb / np.maximum(layers.alpha, 1e-6)[..., None]) * layers.alpha[..., None]

    exact = shown("exact")
    assert exact.max() > 0.5
    for quality, least in (("fast", 40), ("balanced", 50)):
        assert -10 * np.log10(np.mean((shown(quality) - exact) ** 2)) >= least
