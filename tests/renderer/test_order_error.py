"""Errors of the blending order: their estimate, and repeated tiles above the tolerance."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import spearmanr

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.images.colour import encode_srgb
from mitsplat.quality import PRESETS, PresetName, Quality
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers, render_splats
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_render import CAMERA, make_splats

WIDE = CAMERA.resized(96, 72)
RAY = Quality(tolerance=0.0, alpha_min=1e-4, transmittance_min=0.0)
CROWD = make_splats(600, 51, scales=(0.02, 0.3))


def display(layers: Layers) -> np.ndarray:
    """Return display-encoded colour, multiplied by alpha, as blended."""
    return encode_srgb(layers.rgb / np.maximum(layers.alpha, 1e-6)[..., None]) * layers.alpha[..., None]


def errors(quality: Quality) -> np.ndarray:
    """Return the largest error of each pixel's channels against the order along its ray, (H, W)."""
    exact = display(render_splats(CROWD, WIDE, quality=replace(quality, tolerance=0.0)))
    return np.abs(display(render_splats(CROWD, WIDE, quality=quality)) - exact).max(axis=-1)


def test_the_tolerance_is_kept_by_nearly_all_pixels() -> None:
    tile = errors(replace(RAY, tolerance=math.inf))
    assert (tile > 5e-3).mean() > 0.1
    for tolerance in (2e-3, 5e-3, 2e-2):
        found = errors(replace(RAY, tolerance=tolerance))
        assert (found > tolerance).mean() < 0.01
        assert np.sqrt(np.mean(found**2)) < tolerance / 2


def test_a_smaller_tolerance_walks_more_tiles_again(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsplat.renderer.splatting import march

    again: list[int] = []
    sort = march.sort_by_ray
    monkeypatch.setattr(march, "sort_by_ray", lambda lists, chosen, view: noted(sort(lists, chosen, view)))

    def noted(lists: Any) -> Any:
        again.append(dr.width(lists.tiles))
        return lists

    for tolerance in (0.05, 0.01, 1e-3, 1e-9):
        render_splats(CROWD, WIDE, quality=replace(RAY, tolerance=tolerance))
    assert 0 < again[0] < again[1] < again[2] < again[3] <= 12 * 18
    again.clear()
    for tolerance in (0.0, math.inf):
        render_splats(CROWD, WIDE, quality=replace(RAY, tolerance=tolerance))
    assert again == []


VIEWS = {
    "pinhole": {},
    "distorted": {"distortion": (-0.25, 0.08, 0.002, -0.001, -0.01)},
    "fisheye": {"distortion": (0.05, -0.02, 0.01, -0.003), "lens": "fisheye", "fx": 60.0, "fy": 58.0},
    "thin": {"aperture_radius": 0.05, "focus_distance": 2.0},
    "inside": {"world_from_camera": look_at_pose((0, 0, -0.2), (0, 0, 1))},
}
QUICK = (*((False, lens, 1) for lens in VIEWS), (True, "pinhole", 2), (True, "distorted", 2))
"""Quick cases with and without a mesh, by lens and samples."""


@pytest.mark.parametrize(
    ("mesh", "lens", "samples"),
    [
        pytest.param(mesh, lens, samples, marks=() if (mesh, lens, samples) in QUICK else pytest.mark.extended)
        for mesh in (False, True)
        for lens in VIEWS
        for samples in (1, 2)
    ],
)
def test_tolerance_zero_sorts_along_each_ray(lens: str, samples: int, mesh: bool) -> None:
    """Tolerance near zero repeats every tile with a late Gaussian: colours, depths and ids equal the exact order.

    Exceptions are pixels with two Gaussians at equal depth: kernels of a GPU round the same depth in several ways.
    """
    ensure_variant()
    camera = replace(WIDE, width=50, height=38, **VIEWS[lens])
    parts = [make_splats(250, seed, scales=(0.02, 0.25)) for seed in (61, 62, 63)]
    scene: dict[str, Any] = {
        f"part {number}": make_splats_shape(splats, instance=number) for number, splats in enumerate(parts)
    }
    if mesh:
        scene["card"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, 0.1]).rotate([1, 0, 0], 150).scale(0.4),
        }
    quality = replace(RAY, samples=samples, lens_rings=1)

    def shown(tolerance: float) -> Layers:
        integrator = make_integrator(quality=replace(quality, tolerance=tolerance), shadow="none")
        return render_layers(integrator, mi.load_dict({"type": "scene", **scene}), camera)

    exact, repaired = shown(0.0), shown(1e-9)
    ties = 0.001 if mi.variant() == "cuda_ad_rgb" else 0.0
    for name in ("rgb", "alpha", "captured", "depth"):
        other = ~np.isclose(getattr(repaired, name), getattr(exact, name), rtol=1e-7, atol=2e-5)
        assert other.reshape(*exact.instance.shape, -1).any(axis=2).mean() <= ties, name
    assert (repaired.instance == exact.instance).mean() > 0.999
    assert np.abs(shown(math.inf).captured - exact.captured).max() > 1e-3


def sheets(colour: Any) -> Splats:
    """Return round Gaussians in three wide, tilted layers, opaque together, whose colour is a function of x."""
    rng = np.random.default_rng(7)
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.5, 1.5, 60), np.linspace(-1.2, 1.2, 48)))
    layers = []
    for depth in (-0.04, 0.0, 0.04):
        n = len(x)
        places = np.column_stack([x, y, depth + 0.2 * x + rng.normal(0, 0.02, n)])
        layers.append(
            Splats(
                means=places,
                quats=np.tile([0.0, 0, 0, 1], (n, 1)),
                scales=np.full((n, 3), 0.06),
                opacities=np.full(n, 0.8),
                sh=np.repeat(colour(x)[:, None, None], 3, axis=2),
            )
        )
    return Splats.concatenate(layers)


@pytest.mark.parametrize("samples", [1, 2])
def test_tiles_of_different_orders_have_no_seams(monkeypatch: pytest.MonkeyPatch, samples: int) -> None:
    """Tiles of all three orders lie side by side: a uniform image stays uniform, and a ramp has no steps."""
    from mitsplat.renderer.splatting import march

    judged = march._exceeds_tolerance

    def judged_or_some(errors: list[Any], inside: list[Any], tolerance: Any) -> Any:
        """Add the black squares of a chequerboard of 12 x 18 tiles, and every other one of them a second time."""
        tile = dr.arange(mi.UInt32, dr.width(errors[0])) // (32 // len(errors))
        square = tile + tile // 12 if len(errors) > 1 else tile
        return judged(errors, inside, tolerance) | (square % 2 == 0)

    monkeypatch.setattr(march, "rows_together", lambda order: 4 if order == "tile" else 1)  # on every device
    monkeypatch.setattr(march, "_exceeds_tolerance", judged_or_some)
    quality = Quality(tolerance=1e-3, alpha_min=1e-4, transmittance_min=1e-5, samples=samples)
    even = render_splats(sheets(lambda x: np.full_like(x, 0.7)), WIDE, quality=quality)
    assert np.ptp(even.rgb / even.alpha[..., None]) < 1e-5
    ramp = display(render_splats(sheets(lambda x: 0.8 * x), WIDE, quality=quality))
    exact = display(render_splats(sheets(lambda x: 0.8 * x), WIDE, quality=replace(quality, tolerance=0.0)))
    steps = np.abs(np.diff(ramp - exact, axis=1)).max(axis=(0, 2))
    assert np.ptp(ramp) > 0.3
    assert steps[7::8].max() < 2e-3  # last column of a tile to first of the next


def test_the_error_of_one_swapped_pair_is_estimated_exactly() -> None:
    """Swapping two neighbours changes the colour by the product of their opacities times their difference."""
    ensure_variant()
    from mitsplat.renderer.splatting.blending import ERROR, blend, new_state

    colours, opacities = ((0.9, 0.2, 0.1), (0.3, 0.6, 0.4)), (0.6, 0.5)
    pixel = new_state(False, "estimated")
    for colour, opacity, z in zip(colours, opacities, (2.0, 1.0), strict=True):
        record = SimpleNamespace(colour=colour)
        pixel = blend(pixel, mi.Float(opacity), record, mi.Float(z), False, "estimated")
    assert np.array(pixel[ERROR]).item() == pytest.approx(0.6 * 0.5 * 0.6)


def test_the_colour_of_one_swapped_pair_is_corrected_exactly() -> None:
    """The colour equals that of the right order; a third Gaussian, late behind both, is blended in list order."""
    ensure_variant()
    from mitsplat.renderer.splatting.blending import BLUE, RED, blend, new_state

    met = [((0.9, 0.2, 0.1), 0.6, 2.0), ((0.3, 0.6, 0.4), 0.5, 1.0), ((0.1, 0.8, 0.5), 0.7, 3.0)]
    pixel = new_state(False, "corrected")
    for colour, opacity, z in met:
        record = SimpleNamespace(colour=colour)
        pixel = blend(pixel, mi.Float(opacity), record, mi.Float(z), False, "corrected")
    expected, transmittance = np.zeros(3), 1.0
    for colour, opacity, _ in sorted(met, key=lambda peak: peak[2]):
        expected += transmittance * opacity * np.array(colour)
        transmittance *= 1 - opacity
    assert np.array(pixel[RED : BLUE + 1]).ravel() == pytest.approx(expected, abs=1e-6)
    assert np.array(pixel[0]).item() == pytest.approx(transmittance)


def test_corrected_images_have_a_smaller_error_and_the_same_ids() -> None:
    plain = replace(PRESETS["fast"], correct_late_gaussians=False)
    layers, amended = (render_splats(CROWD, WIDE, quality=quality) for quality in (plain, PRESETS["fast"]))
    exact = display(render_splats(CROWD, WIDE, quality=replace(plain, tolerance=0.0)))
    before, after = (float(np.sqrt(np.mean((display(each) - exact) ** 2))) for each in (layers, amended))
    assert after < 0.8 * before
    for name in ("alpha", "depth", "instance"):
        np.testing.assert_array_equal(getattr(amended, name), getattr(layers, name))


def test_corrected_images_of_one_colour_keep_it() -> None:
    even = render_splats(sheets(lambda x: np.full_like(x, 0.7)), WIDE, quality="fast")
    assert np.ptp(even.rgb / even.alpha[..., None]) < 1e-5


def test_the_remaining_order_error_is_reported_with_the_image() -> None:
    """The largest error is within the tolerance, because worse tiles are repeated; the mean is approximate."""
    small, large = (render_splats(CROWD, WIDE, quality=replace(RAY, tolerance=t)).order_error for t in (5e-3, 0.1))
    assert small is not None and large is not None
    assert 0 < small["mean"] < small["largest"] <= 5e-3 < large["largest"] <= 0.1
    found = errors(replace(RAY, tolerance=0.1))
    assert found.mean() / 2 < large["mean"] < 2 * found.mean()
    assert render_splats(CROWD, WIDE, quality=RAY).order_error == {"largest": 0, "mean": 0}
    assert render_splats(CROWD, WIDE, quality=replace(RAY, tolerance=math.inf)).order_error is None


def test_reported_order_errors_equal_those_of_the_pixels() -> None:
    from mitsplat.renderer.splatting.march import largest_and_mean

    ensure_variant()
    values = np.random.default_rng(1).uniform(0, 0.02, 5000).astype(np.float32)
    largest, mean = largest_and_mean(mi.Float(values))
    assert largest[0] == values.max() and mean[0] == pytest.approx(values.mean(), rel=1e-4)
    assert largest_and_mean(mi.Float([3.0, 0.0]))[0][0] == 1


def test_balanced_pops_less_than_fast() -> None:
    """Measures frame-to-frame changes by the blending order alone while the camera rotates by a tenth of a degree."""

    def popping(preset: PresetName) -> float:
        quality = PRESETS[preset]
        cut_alike = replace(quality, tolerance=0.0)
        wrong = [
            display(render_splats(CROWD, camera, quality=quality))
            - display(render_splats(CROWD, camera, quality=cut_alike))
            for camera in TURNING
        ]
        return float(max(np.abs(after - before).max() for before, after in pairwise(wrong)))

    assert popping("balanced") < 0.5 * popping("fast")


def test_the_estimate_ranks_pixels_as_the_benchmark_records_it() -> None:
    from benchmarks.render.order_error import Picture

    ensure_variant()
    picture, quality = Picture(CROWD, WIDE), replace(PRESETS["balanced"], normalise_ended_rays=False)
    rgb, estimate = picture.estimate(quality)
    error = np.abs(rgb - picture.show(replace(quality, tolerance=0.0))).max(axis=-1)
    assert spearmanr(estimate[error > 1e-6], error[error > 1e-6]).statistic > 0.6


def turned(degrees: float) -> Camera:
    angle = math.radians(degrees)
    return replace(WIDE, world_from_camera=look_at_pose((3 * math.sin(angle), 0, -3 * math.cos(angle)), (0, 0, 0)))


TURNING = [turned(0.02 * step) for step in range(6)]


def test_tiles_sort_by_the_depth_at_the_visible_footprint() -> None:
    """The sort depth is at the mean of the product of two normal distributions.

    These are the footprint, and the distribution of the tile's pixels.
    """
    ensure_variant()
    from mitsplat.renderer.projection.records import GaussianRecord
    from mitsplat.renderer.splatting.tile_depths import depth_where_seen

    box, centre, depth = (0.10, 0.14, -0.02, 0.01), np.array([0.125, -0.012]), 2.0
    tilt = np.array([3.0, -2.0])  # E and F: depth falls and rises across the footprint
    spread = np.diag([(box[1] - box[0]) ** 2, (box[3] - box[2]) ** 2]) / 12
    for covariance in (np.array([[4e-5, 1e-5], [1e-5, 2e-5]]), np.array([[2e-3, -1e-3], [-1e-3, 1e-3]])):
        inverse = np.linalg.inv(covariance)
        scaled = inverse * 0.5 * math.log2(math.e)
        middle = np.array([sum(box[:2]) / 2, sum(box[2:]) / 2])
        mean = np.linalg.solve(inverse + np.linalg.inv(spread), inverse @ centre + np.linalg.inv(spread) @ middle)
        du, dv = mean - centre
        record = [*centre, scaled[0, 0], 2 * scaled[0, 1], scaled[1, 1], 0, 0, 0, 0, depth, *tilt, 0, 0, 0, 0]
        found = depth_where_seen(GaussianRecord(*map(mi.Float, record)), tuple(mi.Float(side) for side in box))
        expected = depth * (1 + (tilt @ (du, dv)) / 2) / (1 + tilt @ (du, dv))
        assert np.array(found).item() == pytest.approx(expected, rel=1e-5)
        assert abs(expected - depth) > 1e-4
