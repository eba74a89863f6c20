"""Removal of uneven capture light from the colours of an object.

The radiance of a matt surface is its reflectance times the irradiance (Lambert 1760). If the lights of the capture are
known, Mitsuba traces the irradiance at each point of the mesh. This includes self-shadowing, the table and indirect
light. Colours divided by the irradiance are those under even light. A coarse mesh, lights that were measured elsewhere,
or gloss can make the result worse. The division is therefore applied only if the colours correlate with the irradiance,
in total and for each lamp.
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
"""Reflectance of the mesh in the computation of indirect light."""
_BOUNCES = 3
_SAMPLES = 256
_PROBE_EDGE, _TABLE_HALF_EDGE = 1e-3, 3.0
"""Edge of the cube that measures light from below, and half the edge of the table [m]."""
_TABLE_REFLECTANCES = (0.02, 0.9)
"""Range of the reflectance of tables."""
_RAY_OFFSET = 1e-3
"""Distance of the ray origin from the surface, in diagonals of the mesh."""
_NEIGHBOURS, _NORMAL_POWER = 12, 16
"""Number of neighbours over which irradiance is averaged, and the power of the cosine between normals as their weight.
"""
_EVEN_DEVIATION = 0.03
"""Standard deviation of the logarithm of irradiance below which light counts as even."""
MIN_SLOPE = 0.5
"""Least log-log slope of colours over irradiance, and least relative brightness of each lamp, for the division."""
_MAX_GAIN = 4.0
"""Largest factor by which colours are changed."""
_MAX_SURFACE_DISTANCE = 0.02
"""Largest distance of surface Gaussians from the mesh, in its diagonals."""
_MIN_IRRADIANCE = 0.02
"""Irradiance, relative to the median, below which colours stay unchanged; such points lie for example in cavities."""
_MIN_LUMINANCE = 0.004
"""Least linear luminance of colours in the statistics."""


class CapturedLights(StrictModel):
    """Content of a light file of ``mitsplat lights``."""

    lights: list[LightSpec] = Field(min_length=1, description="Around the object, in the frame of its capture.")


@dataclass(frozen=True, eq=False)
class LightFile:
    """Lights of a capture.

    Attributes:
        path: Path of the file.
        lights: Lights around the object, in the frame of its capture [m].
    """

    path: Path
    lights: tuple[LightSpec, ...]

    @classmethod
    def load(cls, path: Path) -> LightFile:
        """Read a light file of ``mitsplat lights``.

        Raises:
            InputError: If the file or one of its images cannot be read.
        """
        found = cls(path, tuple(load_yaml(path, CapturedLights).lights))
        for file in found.files[1:]:
            if not file.is_file():
                raise InputError(f"{path}: the image {file} does not exist")
        return found

    @property
    def files(self) -> list[Path]:
        """The light file and its images."""
        named = (light.image for light in self.lights if isinstance(light, EnvironmentLight))
        return [self.path, *(self.path.parent / image for image in named if image is not None)]


@dataclass(frozen=True, eq=False)
class Delighting:
    """Result of the removal of light.

    Attributes:
        splats: Splats with the colours under even light, or unchanged.
        kept: True if the colours were changed.
        uneven: Standard deviation of the logarithm of irradiance over the surface.
        slope: Slope of the logarithm of colours over that of irradiance; 1 if light is the only cause of differences.
        borne_out: Brightness of each lamp estimated from the colours, relative to the file, without lamps of little
            effect.
        told: Summary as a clause.
    """

    splats: Splats
    kept: bool
    uneven: float
    slope: float
    borne_out: tuple[float, ...]
    told: str


def delight(splats: Splats, mesh: trimesh.Trimesh, light: LightFile, *, table: bool = False) -> Delighting:
    """Divide an object's colours by the local irradiance, if the colours follow the irradiance.

    Args:
        splats: Splats of the object.
        mesh: Mesh of the object; both in the frame of the lights [m].
        light: Lights of the capture.
        table: True if the object stands on a table in z = 0.
    """
    places, normals, away = DistanceSurface(mesh).nearest(splats.means.astype(np.float64))
    area, near = visible_area(splats), away < _MAX_SURFACE_DISTANCE * float(np.linalg.norm(mesh.extents))
    below = _table_reflectance(light) if table else None
    traced = [
        trace_irradiance(mesh, places, normals, lights, light.path.parent, table=below)
        for lights in _light_groups(light.lights)
    ]
    other, alike = _neighbours(places, normals)
    each = np.stack([_smoothed(one, other, alike) for one in traced])
    total_irradiance = each.sum(axis=0)
    level = total_irradiance @ LUMINANCE
    lit = level > _MIN_IRRADIANCE * np.median(level[near]) if near.any() else near
    colours = decode_srgb((0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(0, 1))
    seen = _smoothed(colours, other, alike * (area * near)[other]) @ LUMINANCE  # single Gaussians vary in colour
    own = lit & near & (seen > _MIN_LUMINANCE) & (area > 0)
    uneven, slope, borne_out = _irradiance_statistics(seen[own], each[:, own] @ LUMINANCE, area[own])

    def done(told: str, gain: Float64Array | None = None) -> Delighting:
        changed = splats if gain is None else _apply_gain(splats, gain)
        return Delighting(changed, gain is not None, uneven, slope, borne_out, told)

    if uneven < _EVEN_DEVIATION:
        return done(f"irradiance varies by {uneven:.1%}: colours are unchanged")
    if min(slope, *borne_out) < MIN_SLOPE:
        lamps = "".join(f", lamp {number} {value:.2f}" for number, value in enumerate(borne_out, start=1))
        return done(
            f"irradiance varies by {uneven:.0%}, but colours do not follow it (slope {slope:.2f}{lamps}; "
            f"at least {MIN_SLOPE:g} is required) and are unchanged: were the lights measured at the position of "
            "the object, in the capture's frame?"
        )
    mean = np.average(total_irradiance[own], axis=0, weights=area[own])
    gain = np.where(lit[:, None], mean / np.maximum(total_irradiance, 1e-12), 1.0)
    return done(
        f"irradiance varied by {uneven:.0%}, and colours with it (slope {slope:.2f}): it was removed from colours",
        gain.clip(1 / _MAX_GAIN, _MAX_GAIN),
    )


def _light_groups(lights: Sequence[LightSpec]) -> list[list[LightSpec]]:
    """Return each lamp as its own group, and the environment lights as the last group."""
    groups, around = list[list[LightSpec]](), list[LightSpec]()
    for light in lights:
        if isinstance(light, EnvironmentLight):
            around.append(light)
        else:
            groups.append([light])
    return [*groups, around]


def _table_reflectance(light: LightFile) -> Float64Array:
    """Estimate the reflectance (3,) of the table as the ratio of irradiance from below to irradiance from above.

    The lights were photographed with the table, so their lower half contains its radiance.
    """
    probe = trimesh.creation.box((_PROBE_EDGE,) * 3)
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    above, below = trace_irradiance(probe, 0.5 * _PROBE_EDGE * up, up, light.lights, light.path.parent, 16 * _SAMPLES)
    return np.asarray((below / np.maximum(above, 1e-12)).clip(*_TABLE_REFLECTANCES))


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
    """Trace the irradiance (N, 3) at points on a grey mesh under lights, including indirect light [W/m^2].

    Args:
        mesh: The object, alone in the scene [m].
        places: Points on the mesh, (N, 3).
        normals: Outward normals at these points, (N, 3).
        lights: Lights around the object.
        folder: Folder of the images of lights.
        samples: Paths per point.
        table: Reflectance (3,) of a plane z = 0 below the object, which blocks light from below; None without a table.
    """
    ensure_variant()
    step = _RAY_OFFSET * float(np.linalg.norm(mesh.extents))
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_diffuse_bsdf([_REFLECTANCE] * 3))
    contents: dict[str, Any] = {f"light_{number}": emitter_dict(light, folder) for number, light in enumerate(lights)}
    contents["object"] = plain_mesh(mesh, properties)
    if table is not None:
        pose = mi.ScalarTransform4f().translate([0, 0, -2 * step]).scale([_TABLE_HALF_EDGE, _TABLE_HALF_EDGE, 1])
        contents["table"] = {"type": "rectangle", "to_world": pose, "bsdf": _diffuse_bsdf(table.tolist())}
    radiance, _ = trace_radiance(
        ray_scene(contents), places + step * normals, -normals, samples=samples, bounces=_BOUNCES, seed=0
    )
    return np.asarray(np.pi / _REFLECTANCE * radiance)


def _diffuse_bsdf(reflectance: list[float]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}}


def _neighbours(places: Float64Array, normals: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the indices (N, K) of the nearest points, including the point itself, and their weights.

    A weight is a power of the cosine between the normals.
    """
    other = KDTree(places).query(places, k=min(_NEIGHBOURS, len(places)))[1].reshape(len(places), -1)
    return other, np.asarray(np.einsum("nkc,nc->nk", normals[other], normals).clip(0, 1) ** _NORMAL_POWER)


def _smoothed(values: Float64Array, other: Int64Array, share: Float64Array) -> Float64Array:
    """Return the weighted average of values (N, 3) over neighbours (N, K) with weights (N, K)."""
    total = share.sum(axis=1, keepdims=True)
    return np.asarray((values[other] * share[..., None]).sum(axis=1) / np.maximum(total, 1e-30))


def _irradiance_statistics(
    seen: Float64Array, each: Float64Array, weight: Float64Array
) -> tuple[float, float, tuple[float, ...]]:
    """Return the unevenness of irradiance, the slope of colours over it, and the relative brightness of each lamp.

    Args:
        seen: Luminance of colours, (N,).
        each: Irradiance of each light, environment last, (L, N).
        weight: Weights of the points, (N,).
    """
    if not len(seen):
        return 0.0, 0.0, ()
    weight = weight / weight.sum()
    total_irradiance = each.sum(axis=0)
    x, y = np.log(total_irradiance), np.log(seen)
    x, y = x - weight @ x, y - weight @ y
    variance = float(weight @ x**2)
    root = np.sqrt(weight)
    scale = float(weight @ seen) / float(weight @ total_irradiance)
    found = np.linalg.lstsq((each * root).T, seen * root, rcond=None)[0] / scale
    matters = np.sqrt((each - (each @ weight)[:, None]) ** 2 @ weight) > _EVEN_DEVIATION * (weight @ total_irradiance)
    borne_out = tuple(found[:-1][matters[:-1]].tolist())
    return float(np.sqrt(variance)), float(weight @ (x * y)) / max(variance, 1e-12), borne_out


def _apply_gain(splats: Splats, gain: Float64Array) -> Splats:
    """Multiply linear colours by a gain (N, 3); higher SH bands scale with the display-encoded colour."""
    before = (0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).clip(1e-3, 1)
    after = encode_srgb((decode_srgb(before) * gain).clip(0, 1))
    sh = splats.sh * (after / before)[:, None]
    sh[:, 0] = (after - 0.5) / SH_C0
    return replace(splats, sh=sh.astype(np.float32))
