"""Materials of proxy surfaces at ray hits."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.composition.scene_contents import ContentsReader
from mitsplat.renderer.layers import make_integrator, make_splats_shape
from mitsplat.renderer.materials.proxy_materials import corner_materials, material_triangles
from mitsplat.renderer.occluders.proxies import Occluder, Proxies, TraceScene, _own_corners
from mitsplat.renderer.projection.splat_appearance import SplatAppearance

BOX = trimesh.creation.box(extents=(1, 1, 1))
RAY_ENDS = np.array([[0.3, 0.2, 3.0], [3.0, 0.2, 0.3], [0.2, -3.0, -0.3], [5.0, 5.0, 5.0]])
"""Origins of rays onto the top, the right and the front of the box, and of a ray that misses it."""


def six_sides(metal: bool) -> Splats:
    """Return Gaussians on a box whose colour, metallic, roughness and specular depend on the side."""
    points, scales, colours, parameters = [], [], [], []
    u, v = (part.ravel() for part in np.meshgrid(*[np.linspace(-0.49, 0.49, 20)] * 2))
    for side in range(6):
        axis, end = side // 2, side % 2 - 0.5
        points.append(np.insert(np.stack([u, v], axis=1), axis, end, axis=1))
        scales.append(np.full((len(u), 3), np.where(np.arange(3) == axis, 0.001, 0.03)))
        colours.append(np.full((len(u), 3), [0.1 * side, 0.5, 1.0 - 0.1 * side]))
        parameters.append(np.full((len(u), 3), [side / 5, 0.2 + 0.1 * side, 1 - side / 5]))
    count, encoded = 6 * len(u), encode_srgb(np.concatenate(colours))
    return Splats(
        np.concatenate(points),
        np.tile([0, 0, 0, 1.0], (count, 1)),
        np.concatenate(scales),
        np.full(count, 0.99),
        ((encoded - 0.5) / SH_C0)[:, None],
        materials=SplatMaterials(*np.concatenate(parameters).T) if metal else None,
    )


def rays() -> mi.Ray3f:
    ends = np.array([[0.3, 0.2, 0.5], [0.5, 0.2, 0.3], [0.2, -0.5, -0.3], [5.0, 5.0, 6.0]])
    way = ends - RAY_ENDS
    return mi.Ray3f(mi.Point3f(RAY_ENDS.T), mi.Vector3f((way / np.linalg.norm(way, axis=1)[:, None]).T))


def test_hits_have_the_material_of_their_side_of_an_edge() -> None:
    make_integrator()
    proxies = Proxies([Occluder(BOX, 1, dynamic=True, splats=six_sides(metal=True))])
    hit, static = proxies.nearest(rays())
    sides = np.array([5, 1, 2])
    np.testing.assert_allclose(hit.metallic, [*sides / 5, 0], atol=1e-6)
    np.testing.assert_allclose(hit.roughness, [*(0.2 + 0.1 * sides), 1], atol=1e-6)
    np.testing.assert_allclose(hit.specular, [*(1 - sides / 5), 0], atol=1e-6)
    assert np.array(static.metallic) == 0
    assert proxies.dynamic is not None
    si = proxies.dynamic.scene.ray_intersect_preliminary(rays())
    colour = np.array(proxies.dynamic.surface_at(si.prim_index, si.prim_uv, si.is_valid()).colour)[:, :3]
    np.testing.assert_allclose(colour, [0.1 * sides, np.full(3, 0.5), 1 - 0.1 * sides], atol=1e-5)


def test_roughness_of_a_placement_replaces_that_of_all_its_materials() -> None:
    make_integrator()
    own = 0.2 + 0.1 * np.array([5, 1, 2])
    for changed, expected in (({}, own), ({"roughness": 0.45}, 0.45)):
        shape = make_splats_shape(six_sides(metal=True), proxy=BOX, instance=1, **changed)
        scene = mi.load_dict({"type": "scene", "box": shape})
        hit, _ = ContentsReader().read(scene, splat_shadows=False).proxies.nearest(rays())
        np.testing.assert_allclose(np.array(hit.roughness)[:3], expected, atol=1e-6)
        np.testing.assert_allclose(np.array(hit.metallic)[:3], np.array([5, 1, 2]) / 5, atol=1e-6)


def test_captured_splats_are_diffuse_with_the_colours_of_their_placement() -> None:
    make_integrator()
    swap = SplatAppearance((0, 0, 1, 0, 1, 0, 1, 0, 0), wear=0, seed=0, size=1)
    proxies = Proxies([Occluder(BOX, 1, dynamic=True, splats=six_sides(metal=False), appearance=swap)])
    hit, _ = proxies.nearest(rays())
    for values, expected in ((hit.metallic, 0), (hit.roughness, 1), (hit.specular, 0)):
        assert (np.array(values) == expected).all()
    assert proxies.dynamic is not None
    si = proxies.dynamic.scene.ray_intersect_preliminary(rays())
    colour = np.array(proxies.dynamic.surface_at(si.prim_index, si.prim_uv, si.is_valid()).colour)[:, 0]
    np.testing.assert_allclose(colour, [0.5, 0.5, 0.5], atol=1e-5)


def test_corners_of_a_coarse_mesh_have_the_mean_colour_of_many_gaussians() -> None:
    """Each corner of a box of 12 triangles takes the mean of a chequered pattern, not the colour of one square."""
    chequered = six_sides(metal=False)
    number = np.arange(len(chequered))
    colours = encode_srgb(np.where((number + number // 20) % 2, 0.8, 0.2))
    sh = np.repeat((colours - 0.5)[:, None, None] / SH_C0, 3, axis=2)
    chequered = Splats(chequered.means, chequered.quats, chequered.scales, chequered.opacities, sh)
    assert np.abs(corner_materials(BOX, chequered)[:, :3] - 0.5).max() < 0.06


def test_sides_of_a_thin_sheet_keep_their_materials() -> None:
    """The Gaussians of the painted upper side are as near to the bare lower side as to each other."""
    sheet = trimesh.creation.box((0.3, 0.2, 0.0005))
    surfels = place_surfels(sheet, 1.0, 3000, np.random.default_rng(0))
    is_top = surfels.normals[:, 2] > 0.5
    splats = surfels.splats(np.where(is_top, -1.0, 1.0)[:, None, None] * np.ones((1, 1, 3)))
    metal = SplatMaterials(np.where(is_top, 0.0, 1.0), np.where(is_top, 0.6, 0.3), np.where(is_top, 0.5, 0.0))
    splats = replace(splats, materials=metal)
    triangles = material_triangles(sheet, splats)
    assert triangles is not None
    corners = corner_materials(sheet, splats).reshape(len(triangles.face), 3, -1)
    for normal, metallic in ((1, 0.0), (-1, 1.0)):
        side = normal * sheet.face_normals[triangles.face, 2] > 0.5
        inner = np.abs(triangles.interpolate(sheet.triangles)[side][..., :2]).max(axis=(1, 2)) < 0.08
        np.testing.assert_allclose(corners[side][inner][..., 3], metallic, atol=0.01)


def test_triangles_divided_between_materials_keep_smooth_unit_normals() -> None:
    ball = trimesh.creation.icosphere(2, 0.1)
    surfels = place_surfels(ball, 1.0, 3000, np.random.default_rng(0))
    upper = np.float32(surfels.points[:, 2] > 0)
    splats = replace(surfels.splats(np.zeros((len(upper), 1, 3))), materials=SplatMaterials(upper, upper, upper))
    corners, normals = _own_corners(ball, splats)
    assert len(corners) > 3 * len(ball.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    outward = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    assert (normals * outward).sum(axis=1).min() > np.cos(np.radians(5))


def test_surfaces_without_splats_reflect_nothing() -> None:
    make_integrator()
    proxies = Proxies([Occluder(BOX, 1, dynamic=True)])
    assert proxies.dynamic is not None
    si = proxies.dynamic.scene.ray_intersect_preliminary(rays())
    surface = proxies.dynamic.surface_at(si.prim_index, si.prim_uv, si.is_valid())
    assert np.array(surface.colour).max() == 0


def many_rays_in_sphere() -> tuple[TraceScene, mi.Ray3f, int]:
    """Return a sphere, four rays per triangle from its centre, and their number."""
    make_integrator()
    sphere = trimesh.creation.icosphere(2)
    surface = Proxies([Occluder(sphere, 1, dynamic=True)]).dynamic
    assert surface is not None
    count = 4 * len(sphere.faces)
    towards = np.random.default_rng(0).normal(size=(3, count)).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(0), dr.normalize(mi.Vector3f(towards)))
    dr.eval(ray)
    return surface, ray, count


def test_many_rays_hit_the_same_triangles_as_few() -> None:
    """Reflected light is traced in a second scene if there are many rays, with the same hits inside of triangles."""
    surface, ray, _ = many_rays_in_sphere()
    many, few = surface.intersect(ray), surface.scene.ray_intersect_preliminary(ray)
    assert "_open_edged" in vars(surface)
    assert np.array_equal(np.array(many.prim_index), np.array(few.prim_index))
    assert np.allclose(np.array(many.t), np.array(few.t), rtol=1e-5)


@pytest.mark.parametrize("in_loop", [False, True])
def test_many_shadow_rays_are_occluded_as_few_are(in_loop: bool) -> None:
    """Many shadow rays are traced in the second scene, also in loops; the sphere occludes those that cross it."""
    surface, ray, count = many_rays_in_sphere()
    ray.maxt = dr.select(dr.arange(mi.UInt32, count) % 2 == 0, mi.Float(0.9), 1.1)  # facets are 0.98 to 1 away
    dr.eval(ray)

    def occluded() -> mi.Bool:
        return surface.occluded(ray, mi.UInt32(0), mi.UInt32(0), mi.Bool(True), watertight=False)

    if in_loop:
        state = dr.zeros(mi.UInt32, count), dr.zeros(mi.Bool, count)
        _, found = dr.while_loop(state, lambda i, _: i < 1, lambda i, _: (i + 1, occluded()), label="rays")
    else:
        found = occluded()
    assert "_open_edged" in vars(surface)
    assert np.array_equal(np.array(found), np.arange(count) % 2 == 1)
