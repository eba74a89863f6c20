"""Slow, readable computation of the traced light of a scene of boxes, in float64 and without noise.

The quantities are those of :mod:`mitsplat.renderer.light.light`. All integrals are sums over fixed directions, and
every ray is tested against every box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Box:
    """Axis-aligned box; ``dynamic`` boxes are absent from captured colours."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    dynamic: bool = False

    def entry(self, origin: Array, directions: Array) -> Array:
        """Return the distance (N,) at which rays enter the box, infinite for a miss (slab method)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = ((np.array(side) - origin) / directions for side in (self.low, self.high))
        near, far = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        return np.where((far > np.maximum(near, 1e-6)) & (near > -1e-9), np.maximum(near, 0.0), np.inf)


@dataclass(frozen=True)
class Lamp:
    """Square area light of uniform radiance that faces ``target``, with ``count`` squared sample points."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    edge: float
    radiance: float
    count: int = 24

    def samples(self) -> tuple[Array, Array, float]:
        """Return points (N, 3) [m], unit normal, and area per point [m^2]."""
        normal = np.subtract(self.target, self.position)
        normal = normal / np.linalg.norm(normal)
        across = np.cross(UP, normal) / np.linalg.norm(np.cross(UP, normal))
        steps = self.edge * ((np.arange(self.count) + 0.5) / self.count - 0.5)
        u, v = (part.ravel()[:, None] for part in np.meshgrid(steps, steps))
        points = np.array(self.position) + u * across + v * np.cross(normal, across)
        return points, normal, (self.edge / self.count) ** 2


@dataclass(frozen=True)
class Light:
    """Light factor and highlight of one point."""

    factor: float
    highlight: float


@dataclass(frozen=True)
class BoxScene:
    """Boxes under a lamp and a sky of uniform radiance.

    ``grey`` is the linear colour of the captured boxes, and ``white`` the irradiance of display white.
    """

    boxes: Sequence[Box]
    lamp: Lamp
    sky: float
    grey: float
    white: float

    def captured(self, point: Array) -> Light:
        """Return the ratio of irradiance with all boxes to that with static boxes, at a horizontal surface."""
        return Light(self._irradiance(point, self.boxes) / self._irradiance(point, self._static), 0.0)

    def relit(self, point: Array, to_camera: Array, roughness: float = 0.4, specular: float = 0.0) -> Light:
        """Return the light of a uniformly captured horizontal surface."""
        direct = self._irradiance(point, self.boxes) / self.white
        towards, light = self._arriving(point, self.boxes)
        mirrored = float(light @ ggx(to_camera, towards, roughness, specular))
        highlight = np.pi / self.white * mirrored - direct * tent(to_camera[2], roughness, specular)
        return Light(direct + self._bounce(point), highlight if specular else 0.0)

    @property
    def _static(self) -> list[Box]:
        return [box for box in self.boxes if not box.dynamic]

    def _irradiance(self, point: Array, boxes: Sequence[Box]) -> float:
        """Return E = integral of V(w) L(w) max(0, n.w) dw."""
        return float(self._arriving(point, boxes)[1].sum())

    def _arriving(self, point: Array, boxes: Sequence[Box]) -> tuple[Array, Array]:
        """Return unit vectors (N, 3) towards light, and the irradiance (N,) that arrives from each."""
        places, normal, area = self.lamp.samples()
        way = places - point
        distance = np.linalg.norm(way, axis=1)
        to_lamp, to_sky = way / distance[:, None], hemisphere()
        light = self.lamp.radiance * area * np.maximum(-to_lamp @ normal, 0) * np.maximum(to_lamp @ UP, 0) / distance**2
        sky = np.full(len(to_sky), self.sky * np.pi / len(to_sky))
        visible = free(point, to_lamp, distance, boxes), free(point, to_sky, np.full(len(to_sky), np.inf), boxes)
        return np.concatenate([to_lamp, to_sky]), np.concatenate([light * visible[0], sky * visible[1]])

    def _bounce(self, point: Array) -> float:
        """Return the captured colour that a cosine-weighted hemisphere of rays hits, 0 behind dynamic boxes."""
        towards = hemisphere()
        static = np.min([box.entry(point, towards) for box in self._static], axis=0)
        dynamic = np.min([box.entry(point, towards) for box in self.boxes if box.dynamic], axis=0)
        return self.grey * float(np.mean((static < np.inf) & (dynamic > static)))


def free(point: Array, towards: Array, distance: Array, boxes: Sequence[Box]) -> npt.NDArray[np.bool_]:
    """Return True for rays that no box occludes before ``distance``."""
    return np.all([box.entry(point, towards) >= distance for box in boxes], axis=0)


def hemisphere(rings: int = 32) -> Array:
    """Return unit vectors with equal shares of the irradiance of an even sky (Malley's method on a grid)."""
    ring, sector = (part.ravel() for part in np.meshgrid(np.arange(rings), np.arange(2 * rings)))
    radius, angle = np.sqrt((ring + 0.5) / rings), np.pi * (sector + 0.5) / rings
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)


def ggx(to_camera: Array, to_light: Array, roughness: float, specular: float) -> Array:
    """Return the GGX BRDF D F G / (4 cos cos) of a horizontal surface for directions (N, 3) to light.

    The masking is height-correlated (Walter et al. 2007, Heitz 2014).
    """
    alpha2 = max(roughness, 0.15) ** 4
    half = to_light + to_camera
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cos_camera, cos_light, cos_half = to_camera @ UP, to_light @ UP, half @ UP
    distribution = alpha2 / (np.pi * (cos_half**2 * (alpha2 - 1) + 1) ** 2)
    fresnel = specular + (1 - specular) * (1 - (half * to_light).sum(axis=1)) ** 5
    smith_camera, smith_light = (np.sqrt(alpha2 + (1 - alpha2) * cosine**2) for cosine in (cos_camera, cos_light))
    masking = 2 * cos_light * cos_camera / (cos_light * smith_camera + cos_camera * smith_light)
    return np.asarray(distribution * fresnel * masking / (4 * cos_light * cos_camera))


def tent(cosine: float, roughness: float, specular: float) -> float:
    """Return the mirrored share of uniform light (fit of Karis 2014, "Physically Based Shading on Mobile").

    At most 8 % of the captured colour is replaced.
    """
    specular = min(specular, 0.08)
    scale, bias = np.array([-1, -0.0275, -0.572, 0.022]) * roughness + np.array([1, 0.0425, 1.04, -0.04]), 1.04
    bend = min(scale[0] ** 2, 2 ** (-9.28 * max(cosine, 0.5))) * scale[0] + scale[1]
    return float(specular * (scale[2] - bias * bend) + scale[3] + bias * bend)
