"""Brightness of splats relative to the textures of their mesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from mitsplat.bake.bake import BakeSettings, bake_asset


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
