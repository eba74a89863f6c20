"""Built-in distractor objects: convex solids of random proportions with random materials, as splats.

A material has one base colour, or two in stripes, checks or spots in the object's own coordinates. It is plastic or
metal of any roughness.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.asset import Asset
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import Surfels, place_surfels

_KINDS = ("box", "cylinder", "sphere", "capsule", "cone")
_EXTENT = (0.025, 0.06)
"""Range of the longest extent [m]."""
_SURFELS = 1200
"""Number of Gaussians of the outer layer."""
_INNER_SCALE = 0.97
"""Size of the second layer, relative to the first."""


def make_primitives(streams: Iterable[np.random.Generator]) -> tuple[Asset, ...]:
    """Create one primitive per random stream. Kinds take turns; 15 primitives take one to two seconds."""
    return tuple(_make(number, rng) for number, rng in enumerate(streams))


def _make(number: int, rng: np.random.Generator) -> Asset:
    """Create the primitive of this number, in one or two colours."""
    kind = _KINDS[number % len(_KINDS)]
    mesh = _solid(kind, rng)
    mesh.apply_translation(-mesh.center_mass)
    mesh.apply_scale(rng.uniform(*_EXTENT) / mesh.extents.max())
    surfels = _add_inner_layer(place_surfels(mesh, 1.0, _SURFELS, rng))
    colours = [colorsys.hsv_to_rgb(rng.random(), rng.random(), rng.uniform(0.25, 0.95)) for _ in range(2)]
    second = _pattern(surfels.points / mesh.extents.max(), rng)
    is_metal = rng.random() < 0.3
    friction, roughness = float(rng.uniform(0.3, 0.7)), float(rng.uniform(0.1, 0.8))
    materials = SplatMaterials.uniform(len(surfels), metallic=float(is_metal), roughness=roughness, specular=0.5)
    splats = surfels.splats(rgb_to_sh(np.array(colours)[second.astype(int)][:, None]))
    return Asset(
        name=f"{kind}_{number}",
        class_name=kind,
        splats=replace(splats, materials=materials),
        mesh=mesh,
        pieces=(mesh,),
        friction=friction,
        roughness=roughness,
    )


def _solid(kind: str, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a closed, convex mesh of arbitrary size.

    Round solids are fine enough for silhouettes of some hundred pixels.
    """
    slim = rng.uniform(0.3, 1.0)
    if kind == "box":
        return trimesh.creation.box(extents=(1.0, slim, rng.uniform(0.2, 1.0)))
    if kind == "cylinder":
        return trimesh.creation.cylinder(radius=0.5, height=rng.uniform(0.3, 2.5), sections=32)
    if kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    if kind == "capsule":
        ends = trimesh.creation.icosphere(subdivisions=3, radius=0.5).vertices
        lift = np.array([0.0, 0.0, slim])
        return trimesh.convex.convex_hull(np.concatenate([ends - lift, ends + lift]))
    return trimesh.creation.cone(radius=0.5, height=0.5 + slim, sections=32)


def _add_inner_layer(surfels: Surfels) -> Surfels:
    """Add a second layer of surfels slightly inside, so that the far side is not visible through gaps.

    The second layer is rotated by 180 degrees about z, which maps every solid to itself. Its surfels therefore lie
    behind the gaps of the first layer.
    """
    turn = np.diag([-1.0, -1.0, 1.0])
    return replace(
        surfels,
        points=np.concatenate([surfels.points, _INNER_SCALE * surfels.points @ turn]),
        frames=np.concatenate([surfels.frames, turn @ surfels.frames]),
        scales=np.tile(surfels.scales, (2, 1)),
        faces=np.tile(surfels.faces, 2),
        barycentric=np.tile(surfels.barycentric, (2, 1)),
    )


def _pattern(points: Float64Array, rng: np.random.Generator) -> BoolArray:
    """Return a mask of the points (N, 3), on an object of size 1, that have the second colour."""
    style = rng.choice(["plain", "stripes", "checks", "spots"])
    turned = Rotation.random(rng=rng).apply(points) * rng.uniform(2.0, 5.0)
    if style == "plain":
        return np.zeros(len(points), dtype=bool)
    if style == "spots":
        distance, _ = KDTree(rng.uniform(-3.0, 3.0, (80, 3))).query(turned)
        return np.asarray(distance < 0.5)
    cells = np.floor(turned[:, :1] if style == "stripes" else turned).astype(int)
    return np.asarray(cells.sum(axis=1) % 2 == 1)
