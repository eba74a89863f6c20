"""Brightness of splats relative to the textures of their mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from mitsplat.bake.bake import BakeResult, BakeSettings, bake_asset
from mitsplat.bake.radiance import _sharpen_colours
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb
from mitsplat.scene.spec.light_spec import EnvironmentLight

NOISE = np.random.default_rng(0).random((64, 64))


def textured_box(pixels: np.ndarray, centre: float = 0.0, *, factor: float = 1.0) -> trimesh.Trimesh:
    """Build a box of 40 mm with a grey texture (H, W) on each side."""
    box = trimesh.creation.box((0.04, 0.04, 0.04), trimesh.transformations.translation_matrix((centre, 0, 0)))
    box.unmerge_vertices()
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], (12, 1))
    image = Image.fromarray(np.repeat(pixels[..., None], 3, axis=2).astype(np.uint8))
    colour = [factor, factor, factor, 1.0]
    material = PBRMaterial(baseColorTexture=image, baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=0.8)
    box.visual = TextureVisuals(uv=uv, material=material)
    return box


def bake(mesh: trimesh.Trimesh | trimesh.Scene, **options: Any) -> BakeResult:
    settings = BakeSettings(gaussians=1500, fit_steps=0, verify_views=1, proxy_faces=100)
    pieces = [trimesh.creation.box((0.04, 0.04, 0.04))]
    return bake_asset(mesh, name="box", settings=settings, pieces=pieces, **options)


@pytest.mark.parametrize("pixels", [255 * (NOISE < 0.1), 255 * (NOISE < 0.5), 250 - 250 * (NOISE < 0.1)])
def test_patterns_finer_than_gaussians_keep_their_mean_brightness(pixels: np.ndarray) -> None:
    """Specks of white on black are seen from afar by their mean radiance, not by their mean code value."""
    result = bake(textured_box(pixels))
    assert result.brightness == pytest.approx(1.0, abs=0.1)
    assert not any("times as bright" in warning for warning in result.warnings)


def test_patterns_under_lights_keep_their_mean_radiance() -> None:
    camera = Camera.look_at((0.2, 0.26, 0.18), (0, 0, 0), width=64, height=64, fov_x=25)
    lit = {"kind": "environment", "lights": [EnvironmentLight()]}
    (view,) = bake(textured_box(255 * (NOISE < 0.1)), cameras=[camera], **lit).views
    inside = view.cover > 0.999
    assert decode_srgb(view.splats)[inside].mean() == pytest.approx(decode_srgb(view.mesh)[inside].mean(), rel=0.1)


def test_brightness_that_differs_is_reported_for_each_part() -> None:
    """One dark part among bright ones does not hide in their mean, and nearly black ones are not reported."""
    grey = np.full((8, 8), 200)
    bodies = {
        "body": textured_box(grey),
        "knob": textured_box(grey, 0.1, factor=0.4),
        "foot": textured_box(np.full((8, 8), 12), 0.2, factor=0.4),
        "lid": textured_box(grey, 0.3),
    }
    warnings = bake(trimesh.Scene(bodies)).warnings
    assert len(warnings) == 1
    assert "the splats of part 'knob' are 0.4 times as bright as its texture in the file" in warnings[0]


def test_folds_do_not_darken_the_colours_of_a_crumpled_body() -> None:
    """Light that folds hold back is no property of the material: a star of deep folds is as bright as its texture."""
    ball = trimesh.creation.icosphere(3, 0.05)
    angle = np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0])
    depth = 0.5 + 0.5 * np.cos(9 * angle)
    vertices = ball.vertices * (0.35 + 0.65 * depth)[:, None]
    shades = np.linspace(140, 255, 64)[None, :, None] * np.array([0.62, 0.42, 0.28])
    image = Image.fromarray(np.rint(shades).repeat(4, axis=0).astype(np.uint8))
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.3)
    uv = np.column_stack([0.01 + 0.98 * depth, np.full(len(depth), 0.5)])
    star = trimesh.Trimesh(vertices, ball.faces, process=False, visual=TextureVisuals(uv=uv, material=material))
    settings = BakeSettings(gaussians=3000, fit_steps=0, verify_views=1)
    result = bake_asset(star, name="star", settings=settings, pieces=[star.convex_hull])
    assert result.brightness == pytest.approx(1.0, abs=0.05)
    assert result.warnings == ()


def test_blends_of_sharpened_colours_are_nearer_to_the_surface() -> None:
    """Slow twin of the blend, over all Gaussians. No colour is beyond those of its 16 nearest Gaussians."""
    surfels = place_surfels(trimesh.creation.box((0.04, 0.04, 0.04)), 1.0, 600, np.random.default_rng(0))
    target = np.sin(200 * surfels.points)[:, None]  # a period of 31 mm
    offset = surfels.points[:, None] - surfels.points
    local = np.einsum("nkj,kji->nki", offset, surfels.frames)[..., :2] / surfels.scales[:, :2]
    weight = np.exp(-0.5 * (local**2).sum(axis=2)) * (surfels.normals @ surfels.normals.T > 0.8)
    weight /= weight.sum(axis=1, keepdims=True)
    found = _sharpen_colours(surfels, target)
    before, after = (np.sqrt(np.mean((np.einsum("nk,kbc->nbc", weight, c) - target) ** 2)) for c in (target, found))
    assert after < 0.8 * before
    nearest = np.argsort(np.linalg.norm(offset, axis=2), axis=1)[:, :16]
    around = target[nearest]
    assert (found >= around.min(axis=1)).all() and (found <= around.max(axis=1)).all()
