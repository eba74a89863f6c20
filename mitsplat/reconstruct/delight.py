"""Colours of an object without the uneven light that it was photographed in.

What a matt surface sends out is its reflectance times the irradiance (Lambert 1760). Where the light that an object was
photographed in is known, Mitsuba traces the irradiance of each place of its mesh, with the shadows that it casts on
itself and the light that it throws there; colours divided by it are those that even light would have given. A mesh that
is coarse, light that was measured elsewhere, or gloss may make that worse, so that it is done only where colours follow
the irradiance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh
from pydantic import Field
from scipy.spatial import KDTree

from mitsplat.arrays import Float64Array
from mitsplat.colour import LUMINANCE, decode_srgb, encode_srgb
from mitsplat.errors import InputError
from mitsplat.mesh_distance import Surface
from mitsplat.plugins.device import plain_mesh, ray_scene
from mitsplat.reconstruct.segment_splats import visible_area
from mitsplat.render.emitters import emitter_dict
from mitsplat.render.path_tracing import trace_radiance
from mitsplat.spec.lights import EnvironmentLight, LightSpec
from mitsplat.spec_types import StrictModel
from mitsplat.spherical_harmonics import SH_C0
from mitsplat.splats import Splats
from mitsplat.variant import ensure_variant
from mitsplat.yaml_input import load_yaml

_REFLECTANCE = 0.5
"""Of the mesh, in light that it throws onto itself."""
_BOUNCES = 3
_SAMPLES = 256
_STEP = 1e-3
"""From where a place is looked at, in diagonals of the mesh."""
_NEIGHBOURS, _ALIKE = 12, 16
"""Of which irradiance is averaged, and the power of the cosine between normals by which they count."""
_EVEN = 0.03
"""Standard deviation of the logarithm of irradiance below which light is even."""
FOLLOWS = 0.5
"""Slope of colours over irradiance, both logarithms, from which to divide makes colours differ less."""
_STRONGEST = 4.0
"""Factor on colours up to which they are made brighter or darker."""
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
        told: In words, a clause.
    """

    splats: Splats
    kept: bool
    uneven: float
    slope: float
    told: str


def delight(splats: Splats, mesh: trimesh.Trimesh, light: LightFile) -> Delighting:
    """Divide an object's colours by the irradiance of where they are, where that makes them differ less.

    Args:
        splats: Of the object.
        mesh: Of it; both in the frame of the lights [m].
        light: That it was photographed in.
    """
    places, normals, _ = Surface(mesh).nearest(splats.means.astype(np.float64))
    traced = trace_irradiance(mesh, places, normals, light.lights, light.path.parent)
    irradiance = _smoothed(traced, places, normals)
    weight = visible_area(splats)
    colours = decode_srgb((0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(0, 1))
    bright = colours @ LUMINANCE > _DARKEST
    lit = irradiance @ LUMINANCE > 0
    uneven, slope = _follow(colours @ LUMINANCE, irradiance @ LUMINANCE, weight * (bright & lit))
    if uneven < _EVEN:
        told = f"its irradiance differs by {uneven:.1%}: colours are left as they are"
        return Delighting(splats, False, uneven, slope, told)
    if slope < FOLLOWS:
        told = (
            f"its irradiance differs by {uneven:.0%}, but colours do not follow it (slope {slope:.2f}, {FOLLOWS:g} or "
            "more is wanted) and are left as they are: was it measured where the object stood, in the capture's frame?"
        )
        return Delighting(splats, False, uneven, slope, told)
    mean = np.average(irradiance[lit], axis=0, weights=weight[lit])
    gain = np.where(lit[:, None], mean / np.maximum(irradiance, 1e-12), 1.0).clip(1 / _STRONGEST, _STRONGEST)
    told = f"its irradiance differed by {uneven:.0%}, and colours with it (slope {slope:.2f}): it is taken out of them"
    return Delighting(_brightened(splats, gain), True, uneven, slope, told)


def trace_irradiance(
    mesh: trimesh.Trimesh,
    places: Float64Array,
    normals: Float64Array,
    lights: Sequence[LightSpec],
    folder: Path | None = None,
    samples: int = _SAMPLES,
) -> Float64Array:
    """Irradiance (N, 3) of places on a mesh that is grey, in lights, with what it sends itself [W/m^2].

    Args:
        mesh: The only thing there [m].
        places: On it, (N, 3).
        normals: There, outward, (N, 3).
        lights: Around it.
        folder: That images of lights are in.
        samples: Paths for each place.
    """
    ensure_variant()
    properties = mi.Properties()
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": _REFLECTANCE}}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": grey})
    emitters = {f"light_{number}": emitter_dict(light, folder) for number, light in enumerate(lights)}
    scene = ray_scene({"object": plain_mesh(mesh, properties), **emitters})
    step = _STEP * float(np.linalg.norm(mesh.extents))
    radiance, _ = trace_radiance(scene, places + step * normals, -normals, samples=samples, bounces=_BOUNCES, seed=0)
    return np.asarray(np.pi / _REFLECTANCE * radiance)


def _smoothed(irradiance: Float64Array, places: Float64Array, normals: Float64Array) -> Float64Array:
    """Irradiance (N, 3) averaged over neighbours that face the same way: less noise of paths, and of normals."""
    other = KDTree(places).query(places, k=min(_NEIGHBOURS, len(places)))[1].reshape(len(places), -1)
    alike = np.einsum("nkc,nc->nk", normals[other], normals).clip(0, 1) ** _ALIKE
    return np.asarray((irradiance[other] * alike[..., None]).sum(axis=1) / alike.sum(axis=1, keepdims=True))


def _follow(luminance: Float64Array, irradiance: Float64Array, weight: Float64Array) -> tuple[float, float]:
    """Weighted standard deviation of the logarithm of irradiance (N,), and the slope of that of luminance over it."""
    own = weight > 0
    if not own.any():
        return 0.0, 0.0
    x, y, w = np.log(irradiance[own]), np.log(luminance[own]), weight[own] / weight[own].sum()
    x, y = x - w @ x, y - w @ y
    variance = float(w @ x**2)
    return float(np.sqrt(variance)), float(w @ (x * y)) / max(variance, 1e-12)


def _brightened(splats: Splats, gain: Float64Array) -> Splats:
    """The splats with linear colours times a gain (N, 3), and what depends on the direction with these."""
    before = (0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(1e-3, 1)
    after = encode_srgb((decode_srgb(before) * gain).clip(0, 1))
    sh = splats.sh * (after / before)[:, None]
    sh[:, 0] = (after - 0.5) / SH_C0
    return replace(splats, sh=sh.astype(np.float32))
