"""Shadow rays through splats: occlusion probability against transmittance, and choice of occluders."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.occluders.splat_occlusion import MIN_OCCLUDING_OPACITY, Caster, SplatOccluders
from mitsplat.renderer.rays.device_arrays import wrapped
from tests.renderer.test_light import floor, slab

LAMP = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 2.0}}


def transmittance(splats: Splats, origin: np.ndarray, direction: np.ndarray, reach: float) -> float:
    """Return the product of 1 - a G over the Gaussians whose peak lies on the ray segment."""
    start = splats.means - origin
    axes = Rotation.from_quat(splats.quats).as_matrix().transpose(0, 2, 1)
    o = -np.einsum("nij,nj->ni", axes, start) / splats.scales
    d = np.einsum("nij,j->ni", axes, direction) / splats.scales
    t = -(o * d).sum(axis=1) / (d * d).sum(axis=1)
    chance = splats.opacities * np.exp(-0.5 * ((o + t[:, None] * d) ** 2).sum(axis=1))
    return float(np.prod(1 - chance[(t > 0) & (t < reach) & (chance > MIN_OCCLUDING_OPACITY)]))


def pane(z: float, opacity: float, *, hole: float = 0.0, width: float = 0.1) -> Splats:
    """Return a sheet of flat Gaussians on a lattice with a round hole, opaque enough to count as closed."""
    x, y = np.meshgrid(np.arange(-width, width + 1e-9, 0.004), np.arange(-width, width + 1e-9, 0.004))
    keep = np.hypot(x, y).ravel() >= hole
    count = int(keep.sum())
    return Splats(
        means=np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])[keep].astype(np.float32),
        quats=np.tile(np.float32([0, 0, 0, 1]), (count, 1)),
        scales=np.tile(np.float32([0.004, 0.004, 0.0003]), (count, 1)),
        opacities=np.full(count, opacity, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def seen(shapes: dict[str, Any], *, height: float = 0.6, **options: Any) -> Layers:
    """Render the floor from below hanging shapes, straight down."""
    camera = Camera.look_at((0, 0, height), (0, 0, 0), up=(0, 1, 0), width=64, height=64, fov_x=20, near=0.001)
    integrator = make_integrator(occluders="splats", **options)
    scene = {"type": "scene", "floor": make_splats_shape(floor(), proxy=slab()), "lamp": LAMP, **shapes}
    return render_layers(integrator, mi.load_dict(scene), camera)


def test_chance_to_pass_is_the_product_of_transmittances() -> None:
    make_integrator()
    rng = np.random.default_rng(4)
    count, rays, keys = 120, 24, 6000
    splats = Splats(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=Rotation.random(count, rng=rng).as_quat().astype(np.float32),
        scales=np.exp(rng.uniform(-4, -1.2, (count, 3))).astype(np.float32),
        opacities=rng.uniform(0.02, 0.9, count).astype(np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )
    turn = np.eye(4)
    turn[:3, :3] = 0.5 * Rotation.from_euler("xyz", (20, 50, -70), degrees=True).as_matrix()
    turn[:3, 3] = 0.2, -0.1, 0.3
    occluders = SplatOccluders.build([Caster(splats, 3, turn)], sets=400)
    assert occluders is not None
    origin = rng.uniform(-0.3, 0.3, (rays, 3)) - [1.5, 0, 0]
    direction = rng.uniform(-0.3, 0.3, (rays, 3)) + turn[:3, 3] - origin
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    reach = np.full(rays, 5.0)
    ray = mi.Ray3f(
        mi.Point3f(*[wrapped(mi.Float, np.repeat(c, keys).astype(np.float32)) for c in origin.T]),
        mi.Vector3f(*[wrapped(mi.Float, np.repeat(c, keys).astype(np.float32)) for c in direction.T]),
    )
    ray.maxt = wrapped(mi.Float, np.repeat(reach, keys).astype(np.float32))
    key = wrapped(mi.UInt32, rng.integers(0, 2**32, rays * keys, dtype=np.uint32))
    passed = 1 - np.array(occluders.occluded(ray, mi.Float(0), key, mi.Bool(True))).reshape(rays, keys).mean(axis=1)
    placed = splats.transformed(turn)
    exact = np.array([transmittance(placed, *one) for one in zip(origin, direction, reach, strict=True)])
    assert exact.min() < 0.2 and exact.max() > 0.7
    # Noise of the number of sets, plus the approximation of solids with corners.
    noise = np.sqrt(exact * (1 - exact) / occluders.solids.sets)
    assert (np.abs(passed - exact) < 4 * noise + 0.02).all()
    assert abs((passed - exact).mean()) < 0.01


@pytest.mark.parametrize("opacities", [(0.1,), (0.1, 0.1), (0.2, 0.05)])
def test_layers_of_leaves_let_through_the_product(opacities: tuple[float, ...]) -> None:
    """The mean light under layers of many Gaussians equals the floor's mean of the product along vertical rays."""
    layers = [pane(1 + 0.1 * i, opacity) for i, opacity in enumerate(opacities)]
    shapes = {f"layer_{i}": make_splats_shape(layer, instance=1 + i) for i, layer in enumerate(layers)}
    light = seen(shapes, shadow_error=0, shadow_samples=64).light[8:-8, 8:-8, 0]
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-0.08, 0.08, (400, 2)), np.zeros(400)])
    whole = Splats.concatenate(layers)
    expected = np.mean([transmittance(whole, point, np.array([0.0, 0.0, 1.0]), np.inf) for point in ground])
    assert 0.02 < expected < 0.9
    assert light.mean() == pytest.approx(expected, abs=0.01)


def test_light_passes_a_hole_of_the_splats_that_the_mesh_lacks() -> None:
    plate = trimesh.creation.box(bounds=[[-0.1, -0.1, 0.699], [0.1, 0.1, 0.701]])
    shapes = {"plate": make_splats_shape(pane(0.7, 0.95, hole=0.04), proxy=plate, instance=1)}
    centres = (np.arange(64) + 0.5 - 32) / 64 * 2 * 0.6 * np.tan(np.radians(10))
    radius = np.hypot(*np.meshgrid(centres, centres))
    through = seen(shapes).light[..., 0]
    assert through[radius < 0.028].mean() > 0.99
    assert through[radius < 0.028].min() > 1 - 3 * 0.03  # target standard error: 0.03
    assert through[(radius > 0.052) & (radius < 0.09)].mean() < 0.02
    integrator = make_integrator()
    camera = Camera.look_at((0, 0, 0.6), (0, 0, 0), up=(0, 1, 0), width=64, height=64, fov_x=20, near=0.001)
    scene = {"type": "scene", "floor": make_splats_shape(floor(), proxy=slab()), "lamp": LAMP, **shapes}
    assert render_layers(integrator, mi.load_dict(scene), camera).light[radius < 0.09].max() < 0.01


def test_a_leaf_on_the_floor_casts_a_shadow_up_to_its_edge() -> None:
    """The floor is inside the ellipsoids of the leaf's Gaussians, but receives no light there."""
    leaf = pane(0.0004, 0.95, width=0.08)
    floor_below = Camera.look_at((0, 0, 0.0002), (0.05, 0, 0), up=(0, 0, 1), width=32, height=32, fov_x=60, near=1e-6)
    scene = {"type": "scene", "floor": make_splats_shape(floor(), proxy=slab()), "lamp": LAMP}
    scene["leaf"] = make_splats_shape(leaf, instance=1)
    below = render_layers(make_integrator(occluders="splats"), mi.load_dict(scene), floor_below)
    on_floor = below.instance[20:] == 0
    assert on_floor.mean() > 0.5
    assert below.light[20:][on_floor].max() < 0.05


def test_a_surface_is_not_shadowed_by_its_own_gaussians() -> None:
    """A sheet with Gaussians scattered by their thickness is as bright in slanting light as its flat mesh."""
    sheet = pane(0.05, 0.9)
    rng = np.random.default_rng(1)
    means = sheet.means + rng.normal(0, 0.0003, sheet.means.shape) * [0, 0, 1]
    rough = Splats(means, sheet.quats, sheet.scales, sheet.opacities, sheet.sh)
    plate = trimesh.creation.box(bounds=[[-0.1, -0.1, 0.045], [0.1, 0.1, 0.05]])
    shapes = {
        "sheet": make_splats_shape(rough, proxy=plate, instance=1),
        "lamp": {**LAMP, "direction": [1, 0, -0.6]},
    }
    layers = seen(shapes, bounce=False)
    inside = np.zeros((64, 64), bool)
    inside[8:-8, 8:-8] = True
    light = layers.light[..., 0][inside & (layers.instance == 1)]
    assert light.size > 1000
    assert light.min() > 0.98 * light.max()
    irradiance = LAMP["irradiance"]["value"] * 0.6 / np.hypot(1, 0.6)
    assert light.mean() == pytest.approx(irradiance / np.pi, rel=0.01)


def test_splats_too_faint_to_stop_a_ray_cast_no_shadow() -> None:
    light = seen({"haze": make_splats_shape(pane(0.7, 0.5 * MIN_OCCLUDING_OPACITY), instance=1)}).light
    assert (light == 1).all()


def test_unknown_occluders_are_refused() -> None:
    with pytest.raises(RuntimeError, match=r"InputError: .*'occluders' must be 'proxies' or 'splats'"):
        make_integrator(occluders="voxels")
