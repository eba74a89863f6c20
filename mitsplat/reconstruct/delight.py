"""Colours of an object without the uneven light that it was photographed in.

What a matt surface sends out is its reflectance times the irradiance (Lambert 1760). Where the light that an object was
photographed in is known, Mitsuba traces the irradiance of each place of its mesh, with the shadows that it casts on
itself and on its table and the light that these throw back; colours divided by it are those that even light would have
given. A mesh that is coarse, light that was measured elsewhere, or gloss may make that worse, so that it is done only
where colours follow the irradiance, and follow each lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from pydantic import Field
from scipy.spatial import KDTree

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.images.colour import LUMINANCE, decode_srgb, encode_srgb
from mitsplat.reconstruct.segment_splats import visible_area
from mitsplat.renderer.path_tracing import trace_radiance
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene
from mitsplat.renderer.scene_emitters import emitter_dict
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightSpec
from mitsplat.storage.field_types import StrictModel
from mitsplat.storage.yaml_input import load_yaml

_REFLECTANCE = 0.5
"""Of the mesh, in light that it throws onto itself."""
_BOUNCES = 3
_SAMPLES = 256
_PROBE, _WIDE = 1e-3, 3.0
"""Edge of a cube by which light from below is measured, and half that of the table [m]."""
_TABLES = (0.02, 0.9)
"""Reflectance of tables."""
_STEP = 1e-3
"""From where a place is looked at, in diagonals of the mesh."""
_NEIGHBOURS, _ALIKE = 12, 16
"""Of which irradiance is averaged, and the power of the cosine between normals by which they count."""
_EVEN = 0.03
"""Standard deviation of the logarithm of irradiance below which light is even."""
FOLLOWS = 0.5
"""Slope of colours over irradiance, both logarithms, and share of a lamp's light that colours show, from which it helps
to divide."""
_STRONGEST = 4.0
"""Factor on colours up to which they are made brighter or darker."""
_NEAR = 0.02
"""Distance from the mesh from which a Gaussian is not of its surface, in its diagonals."""
_UNLIT = 0.02
"""Irradiance of places that nobody sees, such as a void's, in the median; they are left as they are."""
_DARKEST = 0.004
"""Linear luminance from which a colour counts."""


class CapturedLights(StrictModel):
    """A file of lights, as ``mitsplat lights`` writes it."""

    lights: list[LightSpec] = Field(min_length=1, description="Around the object, in the frame of its capture.")


@dataclass(frozen=True, eq=False)
class LightFile:
    """Lights that an object was photographed in.

    Attributes:
        path: Of the file.
        lights: Around the object, in the frame of its capture [m].
    """

    path: Path
    lights: tuple[LightSpec, ...]

    @classmethod
    def load(cls, path: Path) -> LightFile:
        """Read a file that ``mitsplat lights`` wrote.

        Raises:
            InputError: If it or an image that it names cannot be read.
        """
        found = cls(path, tuple(load_yaml(path, CapturedLights).lights))
        for file in found.files[1:]:
            if not file.is_file():
                raise InputError(f"{path}: there is no image {file}")
        return found

    @property
    def files(self) -> list[Path]:
        """It, and the images that it names."""
        named = (light.image for light in self.lights if isinstance(light, EnvironmentLight))
        return [self.path, *(self.path.parent / image for image in named if image is not None)]


@dataclass(frozen=True, eq=False)
class Delighting:
    """What came of it.

    Attributes:
        splats: With colours of even light, or as they were.
        kept: Whether the colours were changed.
        uneven: Standard deviation of the logarithm of irradiance over the surface.
        slope: Of the logarithm of colours over that of irradiance: 1 where light alone makes them differ.
        borne_out: Brightness of each lamp by the colours, relative to that by the file; those that hardly matter are
            left out.
        told: In words, a clause.
    """

    splats: Splats
    kept: bool
    uneven: float
    slope: float
    borne_out: tuple[float, ...]
    told: str


def delight(splats: Splats, mesh: trimesh.Trimesh, light: LightFile, *, table: bool = False) -> Delighting:
    """Divide an object's colours by the irradiance of where they are, where that makes them differ less.

    Args:
        splats: Of the object.
        mesh: Of it; both in the frame of the lights [m].
        light: That it was photographed in.
        table: Whether it stands on one in z = 0.
    """
    places, normals, away = DistanceSurface(mesh).nearest(splats.means.astype(np.float64))
    area, near = visible_area(splats), away < _NEAR * float(np.linalg.norm(mesh.extents))
    below = _table(light) if table else None
    traced = [
        trace_irradiance(mesh, places, normals, lights, light.path.parent, table=below)
        for lights in _apart(light.lights)
    ]
    other, alike = _neighbours(places, normals)
    each = np.stack([_smoothed(one, other, alike) for one in traced])
    whole = each.sum(axis=0)
    level = whole @ LUMINANCE
    lit = level > _UNLIT * np.median(level[near]) if near.any() else near
    colours = decode_srgb((0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(0, 1))
    seen = _smoothed(colours, other, alike * (area * near)[other]) @ LUMINANCE  # single Gaussians are of many colours
    own = lit & near & (seen > _DARKEST) & (area > 0)
    uneven, slope, borne_out = _follow(seen[own], each[:, own] @ LUMINANCE, area[own])

    def done(told: str, gain: Float64Array | None = None) -> Delighting:
        changed = splats if gain is None else _brightened(splats, gain)
        return Delighting(changed, gain is not None, uneven, slope, borne_out, told)

    if uneven < _EVEN:
        return done(f"its irradiance differs by {uneven:.1%}: colours are left as they are")
    if min(slope, *borne_out) < FOLLOWS:
        lamps = "".join(f", lamp {number} {value:.2f}" for number, value in enumerate(borne_out, start=1))
        return done(
            f"its irradiance differs by {uneven:.0%}, but colours do not follow it (slope {slope:.2f}{lamps}; "
            f"{FOLLOWS:g} or more is wanted) and are left as they are: was it measured where the object stood, in the "
            "capture's frame?"
        )
    mean = np.average(whole[own], axis=0, weights=area[own])
    gain = np.where(lit[:, None], mean / np.maximum(whole, 1e-12), 1.0)
    return done(
        f"its irradiance differed by {uneven:.0%}, and colours with it (slope {slope:.2f}): it is taken out of them",
        gain.clip(1 / _STRONGEST, _STRONGEST),
    )


def _apart(lights: Sequence[LightSpec]) -> list[list[LightSpec]]:
    """Each lamp by itself, and last what comes from all around."""
    groups, around = list[list[LightSpec]](), list[LightSpec]()
    for light in lights:
        if isinstance(light, EnvironmentLight):
            around.append(light)
        else:
            groups.append([light])
    return [*groups, around]


def _table(light: LightFile) -> Float64Array:
    """Reflectance (3,) of a table under lights, by what comes from below: it was photographed with them."""
    probe = trimesh.creation.box((_PROBE,) * 3)
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    above, below = trace_irradiance(probe, 0.5 * _PROBE * up, up, light.lights, light.path.parent, 16 * _SAMPLES)
    return np.asarray((below / np.maximum(above, 1e-12)).clip(*_TABLES))


def trace_irradiance(
    mesh: trimesh.Trimesh,
    places: Float64Array,
    normals: Float64Array,
    lights: Sequence[LightSpec],
    folder: Path | None = None,
    samples: int = _SAMPLES,
    *,
    table: Float64Array | None = None,
) -> Float64Array:
    """Irradiance (N, 3) of places on a mesh that is grey, in lights, with what it sends itself [W/m^2].

    Args:
        mesh: The only thing there [m].
        places: On it, (N, 3).
        normals: There, outward, (N, 3).
        lights: Around it.
        folder: That images of lights are in.
        samples: Paths for each place.
        table: Reflectance (3,) of a plane z = 0 below it, which hides what light comes from there; None: there is none.
    """
    ensure_variant()
    step = _STEP * float(np.linalg.norm(mesh.extents))
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_matt([_REFLECTANCE] * 3))
    contents: dict[str, Any] = {f"light_{number}": emitter_dict(light, folder) for number, light in enumerate(lights)}
    contents["object"] = plain_mesh(mesh, properties)
    if table is not None:
        pose = mi.ScalarTransform4f().translate([0, 0, -2 * step]).scale([_WIDE, _WIDE, 1])
        contents["table"] = {"type": "rectangle", "to_world": pose, "bsdf": _matt(table.tolist())}
    radiance, _ = trace_radiance(
        ray_scene(contents), places + step * normals, -normals, samples=samples, bounces=_BOUNCES, seed=0
    )
    return np.asarray(np.pi / _REFLECTANCE * radiance)


def _matt(reflectance: list[float]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}}


def _neighbours(places: Float64Array, normals: Float64Array) -> tuple[Int64Array, Float64Array]:
    """The nearest places to each (N, 3), itself among them, (N, K), and how far they face the same way, up to 1."""
    other = KDTree(places).query(places, k=min(_NEIGHBOURS, len(places)))[1].reshape(len(places), -1)
    return other, np.asarray(np.einsum("nkc,nc->nk", normals[other], normals).clip(0, 1) ** _ALIKE)


def _smoothed(values: Float64Array, other: Int64Array, share: Float64Array) -> Float64Array:
    """Values (N, 3) averaged over neighbours (N, K) by their shares (N, K)."""
    total = share.sum(axis=1, keepdims=True)
    return np.asarray((values[other] * share[..., None]).sum(axis=1) / np.maximum(total, 1e-30))


def _follow(seen: Float64Array, each: Float64Array, weight: Float64Array) -> tuple[float, float, tuple[float, ...]]:
    """How uneven irradiance is, how colours follow it, and how far they bear out each lamp.

    Args:
        seen: Luminance of colours, (N,).
        each: Irradiance by each light, that from all around last, (L, N).
        weight: Of the places, (N,).
    """
    if not len(seen):
        return 0.0, 0.0, ()
    weight = weight / weight.sum()
    whole = each.sum(axis=0)
    x, y = np.log(whole), np.log(seen)
    x, y = x - weight @ x, y - weight @ y
    variance = float(weight @ x**2)
    root = np.sqrt(weight)
    scale = float(weight @ seen) / float(weight @ whole)
    found = np.linalg.lstsq((each * root).T, seen * root, rcond=None)[0] / scale
    matters = np.sqrt((each - (each @ weight)[:, None]) ** 2 @ weight) > _EVEN * (weight @ whole)
    borne_out = tuple(found[:-1][matters[:-1]].tolist())
    return float(np.sqrt(variance)), float(weight @ (x * y)) / max(variance, 1e-12), borne_out


def _brightened(splats: Splats, gain: Float64Array) -> Splats:
    """The splats with linear colours times a gain (N, 3), and what depends on the direction with these."""
    before = (0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(1e-3, 1)
    after = encode_srgb((decode_srgb(before) * gain).clip(0, 1))
    sh = splats.sh * (after / before)[:, None]
    sh[:, 0] = (after - 0.5) / SH_C0
    return replace(splats, sh=sh.astype(np.float32))
