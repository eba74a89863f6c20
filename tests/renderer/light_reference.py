"""Slow, readable computation of the traced light of a scene of boxes, in float64 and without noise.

The quantities are those of :mod:`mitsplat.renderer.light.light`. All integrals are sums over fixed directions, and
every ray is tested against every box.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])

CELL = 0.05
"""Edge of the cells [m] in which the light that a surface reflects is constant."""


@dataclass(frozen=True)
class Box:
    """Axis-aligned box.

    A ``dynamic`` box is absent from captured colours. It reflects the share ``albedo`` of the light of emitters, and if
    it is not a ``mesh`` also that of other boxes.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    dynamic: bool = False
    albedo: float = 0.0
    mesh: bool = False

    def entry(self, origin: Array, directions: Array) -> Array:
        """Return the distance (N,) at which rays enter the box, infinite for a miss (slab method)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = ((np.array(side) - origin) / directions for side in (self.low, self.high))
        near, far = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        return np.where((far > np.maximum(near, 1e-6)) & (near > -1e-9), np.maximum(near, 0.0), np.inf)

    def normals(self, points: Array) -> Array:
        """Return the outward unit normals (N, 3) of points on the box."""
        distance = np.abs(np.concatenate([points - self.low, points - self.high], axis=1))
        return np.concatenate([-np.eye(3), np.eye(3)])[distance.argmin(axis=1)]


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

    boxes: tuple[Box, ...]
    lamp: Lamp
    sky: float
    grey: float
    white: float

    @property
    def before(self) -> BoxScene:
        """The scene without dynamic boxes."""
        return replace(self, boxes=tuple(box for box in self.boxes if not box.dynamic))

    def shadowed(self, point: Array) -> float:
        """Return the ratio of irradiance with all boxes to that with static boxes, at a horizontal surface."""
        return self._irradiance(point) / self.before._irradiance(point)

    def captured(self, point: Array) -> float:
        """Return the ratio of direct and reflected irradiance with all boxes to that with static boxes."""
        with_objects, without = (
            scene._irradiance(point) + self.white * scene._bounce(point) for scene in (self, self.before)
        )
        return with_objects / without

    def relit(
        self, point: Array, to_camera: Array, roughness: float = 1.0, metallic: float = 0.0, specular: float = 0.0
    ) -> Light:
        """Return the light of a horizontal surface of a material.

        The factor is that of the base colour. The highlight is the reflected light without it.
        """
        diffuse = self._irradiance(point) / self.white + self._bounce(point)
        if not (metallic or specular):
            return Light(diffuse, 0.0)
        diffuse *= (1 - metallic) * diffuse_albedo(to_camera, roughness)
        emitted, reflected = self._arriving(point), self._reflecting(point)
        towards = np.concatenate([emitted[0], reflected[0]])
        light = np.concatenate([emitted[1] * np.pi / self.white, reflected[1]])
        lobe, cos_half = specular_lobe(to_camera, towards, roughness)
        schlick = (1 - cos_half) ** 5
        dielectric = fresnel(cos_half, 0.08 * specular) if specular else 0.0
        tinted = light @ (lobe * metallic * (1 - schlick))
        colourless = light @ (lobe * (metallic * schlick + (1 - metallic) * dielectric))
        return Light(diffuse + float(tinted), float(colourless))

    def _reflecting(self, point: Array) -> tuple[Array, Array]:
        """Return unit vectors (N, 3) towards boxes, and pi times their light (N,) per cosine-weighted area."""
        towards = hemisphere(128)
        return towards, self._colours(point, towards) * np.pi / len(towards)

    def _colours(self, point: Array, towards: Array, bounces: int = 2, *, dynamic_only: bool = False) -> Array:
        """Return the colours (N,) of boxes along rays, 0 for other rays, on paths of ``bounces`` dynamic boxes."""
        entries = np.array([box.entry(point, towards) for box in self.boxes])
        colours, nearest = np.zeros(len(towards)), entries.argmin(axis=0)
        for number, box in enumerate(self.boxes):
            hit = (nearest == number) & (entries[number] < np.inf)
            if not hit.any() or not (box.albedo if box.dynamic else not dynamic_only):
                continue
            places = point + towards[hit] * entries[number][hit, None]
            normals = box.normals(places)
            centres = (np.floor(places / CELL + 1e-6) + 0.5) * CELL
            places = np.where(np.abs(normals) > 0.5, places.round(6), centres)
            cells, cell = np.unique(np.concatenate([places, normals], axis=1), axis=0, return_inverse=True)
            values = [self._colour_of_cell(box, tuple(row), bounces) for row in cells.tolist()]
            colours[hit] = np.array(values)[cell.ravel()]
        return colours

    @cache  # noqa: B019 - few scenes per module
    def _colour_of_cell(self, box: Box, cell: tuple[float, ...], bounces: int) -> float:
        """Return the colour of a box at a cell, given the position and the normal of the cell."""
        normal, few = np.array(cell[3:]), replace(self, lamp=replace(self.lamp, count=6))
        point = np.array(cell[:3]) + 1e-4 * normal
        if not box.dynamic:
            kept = self.grey * few._share_left(point, normal)
            return kept + (few._reflected_onto_captured(point, normal) if bounces > 1 else 0.0)
        light = few._irradiance(point, normal, rings=16) / self.white
        if bounces > 1 and not box.mesh:
            light += float(np.mean(self._colours(point, turned(hemisphere(12), normal), bounces - 1)))
        return box.albedo * light

    def _share_left(self, point: Array, normal: Array) -> float:
        """Return the share of light that dynamic boxes leave at a point of a captured box.

        Lamps behind captured boxes do not count. Where captured boxes hide the sky, dynamic boxes block the light of
        these boxes, at most that of the sky.
        """
        places, facing, area = self.lamp.samples()
        way = places - point
        distance = np.linalg.norm(way, axis=1)
        to_lamp, to_sky = way / distance[:, None], turned(hemisphere(16), normal)
        lamp = self.lamp.radiance * area * np.maximum(-to_lamp @ facing, 0) * np.maximum(to_lamp @ normal, 0)
        lamp /= distance**2
        sky = np.full(len(to_sky), self.sky * np.pi / len(to_sky))
        static, dynamic = self._entries(point, to_lamp)
        lost = lamp[(dynamic < distance) & (static >= distance)].sum()
        static, dynamic = self._entries(point, to_sky)
        of_boxes = min(self.grey * self.white / (np.pi * self.sky), 1.0)
        lost += (sky * np.where(static < np.inf, of_boxes, 1.0))[dynamic < static].sum()
        return float(1 - lost / (lamp.sum() + sky.sum()))

    def _reflected_onto_captured(self, point: Array, normal: Array) -> float:
        """Return the light that dynamic boxes reflect onto a captured box, times its albedo.

        The captured colour is the albedo times the irradiance of the emitters over white.
        """
        towards = turned(hemisphere(16), normal)
        light = self._colours(point, towards, dynamic_only=True).mean()
        open_place = replace(self, boxes=())._irradiance(point, normal, rings=16)
        return float(light) * min(self.grey * self.white / open_place, 1.0)

    def _entries(self, point: Array, towards: Array) -> tuple[Array, Array]:
        """Return the distances (N,) at which rays enter static and dynamic boxes."""
        entries = {box: box.entry(point, towards) for box in self.boxes}
        kinds = ([entry for box, entry in entries.items() if box.dynamic is kind] for kind in (False, True))
        static, dynamic = (np.min([np.full(len(towards), np.inf), *kind], axis=0) for kind in kinds)
        return static, dynamic

    def _irradiance(self, point: Array, normal: Array = UP, rings: int = 64) -> float:
        """Return E = integral of V(w) L(w) max(0, n.w) dw."""
        return float(self._arriving(point, normal, rings)[1].sum())

    def _arriving(self, point: Array, normal: Array = UP, rings: int = 128) -> tuple[Array, Array]:
        """Return unit vectors (N, 3) towards light, and the irradiance (N,) that arrives from each."""
        places, facing, area = self.lamp.samples()
        way = places - point
        distance = np.linalg.norm(way, axis=1)
        to_lamp, to_sky = way / distance[:, None], turned(hemisphere(rings), normal)
        light = self.lamp.radiance * area * np.maximum(-to_lamp @ facing, 0) * np.maximum(to_lamp @ normal, 0)
        light /= distance**2
        sky = np.full(len(to_sky), self.sky * np.pi / len(to_sky))
        far = np.full(len(to_sky), np.inf)
        visible = free(point, to_lamp, distance, self.boxes), free(point, to_sky, far, self.boxes)
        return np.concatenate([to_lamp, to_sky]), np.concatenate([light * visible[0], sky * visible[1]])

    def _bounce(self, point: Array) -> float:
        """Return the mean colour that a cosine-weighted hemisphere of rays hits."""
        return float(np.mean(self._colours(point, hemisphere())))


def free(point: Array, towards: Array, distance: Array, boxes: tuple[Box, ...]) -> npt.NDArray[np.bool_]:
    """Return True for rays that no box occludes before ``distance``."""
    return np.all([box.entry(point, towards) >= distance for box in boxes], axis=0)


def hemisphere(rings: int = 32) -> Array:
    """Return unit vectors with equal shares of the irradiance of an even sky (Malley's method on a grid)."""
    ring, sector = (part.ravel() for part in np.meshgrid(np.arange(rings), np.arange(2 * rings)))
    radius, angle = np.sqrt((ring + 0.5) / rings), np.pi * (sector + 0.5) / rings
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)


def turned(directions: Array, normal: Array) -> Array:
    """Return directions (N, 3) about +z as directions about a unit vector along an axis."""
    side = np.roll(np.abs(normal), 1)
    return directions @ np.stack([side, np.cross(normal, side), normal])


def specular_lobe(to_camera: Array, to_light: Array, roughness: float) -> tuple[Array, Array]:
    """Return D G / (4 cos cos) of GGX on a horizontal surface, and the cosine of the half vector (Walter et al. 2007).

    The masking is the product of both sides, as in Mitsuba's ``principled``. Directions ``to_light`` are (N, 3).
    """
    alpha2 = roughness**4
    half = to_light + to_camera
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cos_camera, cos_light, cos_half = to_camera @ UP, np.maximum(to_light @ UP, 1e-9), half @ UP
    distribution = alpha2 / (np.pi * (cos_half**2 * (alpha2 - 1) + 1) ** 2)
    masks = [2 / (1 + np.sqrt(1 + alpha2 * (1 / cosine**2 - 1))) for cosine in (cos_camera, cos_light)]
    return distribution * masks[0] * masks[1] / (4 * cos_camera * cos_light), (half * to_camera).sum(axis=1)


def diffuse_albedo(to_camera: Array, roughness: float) -> float:
    """Return the albedo of the diffuse lobe of Burley 2012 on a horizontal white surface under uniform light."""
    towards = hemisphere()
    schlick_camera, schlick_light = (1 - to_camera @ UP) ** 5, (1 - towards @ UP) ** 5
    retro = roughness * (1 + towards @ to_camera)
    base = (1 - schlick_camera / 2) * (1 - schlick_light / 2)
    both = schlick_camera + schlick_light + schlick_camera * schlick_light * (retro - 1)
    return float(np.mean(base + retro * both))


def fresnel(cosine: Array, normal_reflectance: float) -> Array:
    """Return the reflectance of a dielectric for unpolarised light (Fresnel's equations)."""
    root = np.sqrt(normal_reflectance)
    eta = (1 + root) / (1 - root)
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    s, p = (cosine - eta * inside) / (cosine + eta * inside), (eta * cosine - inside) / (eta * cosine + inside)
    return np.asarray(0.5 * (s**2 + p**2))
