"""Borders between metal and dark plastic of one object: colour and material of a pixel belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.composition import material_borders
from mitsplat.renderer.composition.scene_contents import ContentsReader
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.materials.proxy_materials import corner_materials, material_triangles
from mitsplat.renderer.projection import splat_appearance
from mitsplat.renderer.projection.splat_appearance import DIRT

STEEL, RUBBER = (0.6, 0.6, 0.6), (0.02, 0.02, 0.02)
STEP, SPACING = 0.05, 0.04


def _step_mesh() -> trimesh.Trimesh:
    """Return two slabs with a common vertical face, of triangles that are long across the step at x = 0."""
    y = np.linspace(-1, 1, 81)
    profile = np.array([(-1, -0.3), (1, -0.3), (1, 0), (0, 0), (0, STEP), (-1, STEP)])
    rows = np.stack([np.insert(profile, 1, value, axis=1) for value in y])
    count = len(profile)
    faces = []
    for row in range(len(y) - 1):
        for i in range(count):
            a, b = row * count + i, row * count + (i + 1) % count
            faces += [(a, b + count, b), (a, a + count, b + count)]
    return trimesh.Trimesh(rows.reshape(-1, 3), faces, process=False)


def _step_splats(rubber: tuple[float, float, float] = RUBBER) -> Splats:
    """Return flat Gaussians on both tops: steel for x < 0, rubber of a linear colour for x > 0."""
    along = np.arange(SPACING / 2, 1, SPACING)
    x, y = (part.ravel() for part in np.meshgrid(np.concatenate([-along, along]), np.concatenate([-along, along])))
    metal = x < 0
    count = len(x)
    colours = encode_srgb(np.where(metal[:, None], STEEL, rubber))
    return Splats(
        np.stack([x, y, np.where(metal, STEP, 0.0)], axis=1),
        np.tile([0, 0, 0, 1.0], (count, 1)),
        np.tile([0.8 * SPACING, 0.8 * SPACING, 0.02 * SPACING], (count, 1)),
        np.full(count, 0.98),
        ((colours - 0.5) / SH_C0)[:, None],
        materials=SplatMaterials(metal.astype(float), np.where(metal, 0.3, 0.6), np.full(count, 0.5)),
    )


def _rendered(
    splats: Splats | None = None, target: tuple[float, float, float] = (0, 0, 0), **properties: object
) -> Layers:
    """Return the layers of the step, or of other splats on it, seen in even light from above and the side of steel.

    ``properties`` are those of the shape ``splats``.
    """
    shape = make_splats_shape(splats or _step_splats(), proxy=_step_mesh(), instance=1, **properties)
    light = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    scene = mi.load_dict({"type": "scene", "object": shape, "light": light})
    camera = Camera.look_at((-1.2, 0, 2.6), target, width=96, height=64, fov_x=24)
    return render_layers(make_integrator(white=float(np.pi), hide_emitters=True), scene, camera)


def test_corners_of_long_triangles_have_the_material_of_their_side_of_a_step() -> None:
    mesh, splats = _step_mesh(), _step_splats()
    divided = material_triangles(mesh, splats)
    faces = np.arange(len(mesh.faces)) if divided is None else divided.face
    metallic = corner_materials(mesh, splats)[:, 3].reshape(-1, 3)
    upward, steel = mesh.face_normals[faces, 2] > 0.9, mesh.triangles_center[faces, 0] < 0
    assert metallic[upward & steel].min() > 0.98
    assert metallic[upward & ~steel].max() < 0.02


def test_a_border_of_steel_and_rubber_is_not_brighter_than_steel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where splats of steel reach over an edge of the proxy, they keep the material of steel.

    In even light of radiance 1, steel reflects about 0.6 and rubber about 0.06. White rubber would reflect 0.6 as well,
    so that the metalness is compared instead: pixels as bright as steel are metal.
    """
    layers = _rendered()
    captured, highlight = layers.captured.mean(axis=2), layers.highlight.mean(axis=2)
    bright, dark = captured > 0.3, (captured < 0.05) & (layers.alpha > 0.9)
    # Colourless light of rubber is at least its reflectance of 0.04; that of steel is the small Fresnel edge.
    steel, rubber = np.median(highlight[bright]), np.median(highlight[dark])
    assert rubber > 2 * steel
    assert highlight[bright].max() < 0.5 * (steel + rubber)
    monkeypatch.setattr(material_borders, "DIFFERENT", 2.0)
    assert _rendered().highlight.mean(axis=2)[bright].max() > 0.5 * (steel + rubber)


def test_the_luminance_of_a_border_is_the_linear_mean_of_its_materials() -> None:
    """White and black splats show the share of steel in each pixel."""
    splats = _step_splats()
    white = np.where(splats.means[:, :1] < 0, 1.0, 0.0).repeat(3, axis=1)
    shares = replace(splats, sh=(((white - 0.5) / SH_C0)[:, None]).astype(np.float32), materials=None)
    layers, counted = _rendered(), _rendered(shares)
    share = encode_srgb(counted.captured.mean(axis=2))
    border = (share > 0.1) & (share < 0.9) & (layers.alpha > 0.999)
    expected = share * STEEL[0] + (1 - share) * RUBBER[0]
    assert np.count_nonzero(border) > 20
    assert layers.captured.mean(axis=2)[border] == pytest.approx(expected[border], rel=0.05)


@pytest.mark.parametrize(
    ("properties", "factors"),
    [
        ({"colours": "0.8 0 0 0 0.9 0 0 0 1"}, (0.8, 0.9, 1.0)),
        ({"wear": 0.5, "colours": "0.9 0 0 0 0.9 0 0 0 0.9"}, [0.9 * (1 - 0.5 * (1 - dirt)) for dirt in DIRT]),
    ],
    ids=["colours", "dirt"],
)
def test_an_appearance_changes_borders_like_the_materials_beside_them(
    properties: dict[str, object], factors: Sequence[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splat_appearance, "CLEAN", -2.0)  # dirt has its full thickness everywhere
    monkeypatch.setattr(splat_appearance, "COVERED", -1.0)
    plain, changed = _rendered(_step_splats((0.2, 0.2, 0.2))), _rendered(_step_splats((0.2, 0.2, 0.2)), **properties)
    shown = plain.alpha > 0.999
    assert changed.captured[shown] == pytest.approx(plain.captured[shown] * factors, rel=0.02)


def test_an_object_of_several_materials_may_be_outside_of_the_image() -> None:
    assert _rendered(target=(9, 0, 2.6)).alpha.max() == 0


def test_objects_of_one_material_have_no_borders() -> None:
    splats = _step_splats()
    plain = replace(splats, materials=SplatMaterials.uniform(len(splats), metallic=1.0))
    shape = make_splats_shape(plain, proxy=_step_mesh(), instance=1)
    scene = mi.load_dict({"type": "scene", "object": shape})
    assert ContentsReader().read(scene, splat_shadows=False).mixed is None
