"""Specular lobe and diffuse albedo of Mitsuba's BSDF ``principled``.

The lobe is that of GGX microfacets with the Fresnel terms of metals and dielectrics.

Reflected light is linear in the base colour c. With the density D of microfacets, masking G, the half vector h and the
camera's direction v,

    f cos = D G / (4 n.v) F,   F = c metallic (1 - S) + metallic S + (1 - metallic) F_dielectric,   S = (1 - v.h)^5

so that it is a tinted part, which c multiplies, and a colourless part. Both parts are sampled and filtered without the
texture of the surface (Burley 2012, "Physically Based Shading at Disney"; Walter et al. 2007, "Microfacet Models for
Refraction").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitsplat.gaussians.splat_materials import MAX_SPECULAR

MIN_ALPHA = 0.001
"""Smallest GGX parameter alpha, as in ``principled``."""

MIN_COSINE = 1e-3
"""Smallest cosine between normal and camera: interpolated normals may point away from the camera."""

LOBE_LATTICE = (21, 13)
"""Number of points and generator of the lattice that integrates a lobe."""

TYPICAL_COLOUR = 0.6
"""Base colour for which the error of reflected light is estimated."""


def lattice_point(i: mi.UInt32, lattice: tuple[int, int]) -> mi.Point2f:
    """Return point ``i`` of a centred rank-1 lattice in the unit square."""
    count, generator = lattice
    return mi.Point2f((mi.Float(i) + 0.5) / count, (mi.Float(i * generator % count) + 0.5) / count)


@dataclass(frozen=True, eq=False)
class Fresnel:
    """Fresnel terms: reflectance = ``tint`` * base colour + ``white``."""

    tint: mi.Float
    white: mi.Float


@dataclass(frozen=True, eq=False)
class SpecularLobe:
    """Specular lobes of visible points towards the camera.

    Attributes:
        frame: Shading frame.
        view: Unit vector towards the camera in the shading frame.
        alpha: GGX parameters along the axes x and y of the frame.
        metallic: Metalness.
        specular: Reflectance of the dielectric at normal incidence over 0.08.
    """

    frame: mi.Frame3f
    view: mi.Vector3f
    alpha: mi.Vector2f
    metallic: mi.Float
    specular: mi.Float

    @classmethod
    def of(
        cls,
        normal: mi.Vector3f,
        to_camera: mi.Vector3f,
        roughness: mi.Float,
        metallic: mi.Float,
        specular: mi.Float,
        bend: mi.Vector3f | None = None,
    ) -> SpecularLobe:
        """Return the lobes of points with unit ``normal`` and unit vector ``to_camera``.

        ``bend`` is a tangent in whose direction the squared GGX parameter is larger by the squared length.
        """
        frame = mi.Frame3f(mi.Normal3f(normal))
        alpha = mi.Vector2f(dr.maximum(dr.square(roughness), MIN_ALPHA))
        if bend is not None:
            length2 = dr.squared_norm(bend)
            along = dr.select(length2 > 0, dr.normalize(bend), frame.s)
            frame = mi.Frame3f(along, dr.cross(normal, along), normal)
            alpha.x = dr.sqrt(dr.square(alpha.x) + length2)
        view = frame.to_local(to_camera)
        view.z = dr.maximum(view.z, MIN_COSINE)
        return cls(frame, dr.normalize(view), alpha, metallic, specular)

    @property
    def blur(self) -> mi.Float:
        """GGX parameter of the isotropic lobe that covers the same solid angle."""
        return dr.sqrt(self.alpha.x * self.alpha.y)

    def evaluate(self, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return D G / (4 n.v), its sampling density, and v.h for unit vectors towards the light."""
        light = self.frame.to_local(direction)
        half = dr.normalize(light + self.view)
        cos_half = dr.dot(half, self.view)
        above = (light.z > 0) & (cos_half > 0)
        scaled = dr.square(half.x / self.alpha.x) + dr.square(half.y / self.alpha.y) + dr.square(half.z)
        distribution = 1 / (dr.pi * self.alpha.x * self.alpha.y * dr.square(scaled))
        density = dr.select(above, distribution * self._unmasked(self.view) / (4 * self.view.z), 0)
        return density * self._unmasked(light), density, cos_half

    def sample(self, point: mi.Point2f) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Sample a direction by the visible normals from a point of the unit square.

        See Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps".

        Returns:
            Unit vector towards the light, D G / (4 n.v) over its density, and v.h.
        """
        stretch = mi.Vector3f(self.alpha.x, self.alpha.y, 1)
        view = dr.normalize(self.view * stretch)
        z = dr.fma(1 - point.y, 1 + view.z, -view.z)
        radius = dr.safe_sqrt(1 - dr.square(z))
        sine, cosine = dr.sincos(2 * dr.pi * point.x)
        cap = mi.Vector3f(radius * cosine, radius * sine, z) + view
        half = dr.normalize(mi.Vector3f(cap.x, cap.y, dr.maximum(cap.z, 1e-6)) * stretch)
        cos_half = dr.dot(self.view, half)
        light = 2 * cos_half * half - self.view
        return self.frame.to_world(light), dr.select(light.z > 0, self._unmasked(light), 0), cos_half

    def fresnel(self, cos_half: mi.Float) -> Fresnel:
        """Return the Fresnel terms for v.h."""
        grazing = dr.power(dr.clip(1 - cos_half, 0, 1), 5)
        root = dr.sqrt(MAX_SPECULAR * self.specular)
        dielectric = dr.select(self.specular > 0, mi.fresnel(cos_half, (1 + root) / (1 - root))[0], 0)
        return Fresnel(self.metallic * (1 - grazing), dr.lerp(dielectric, grazing, self.metallic))

    def _unmasked(self, direction: mi.Vector3f) -> mi.Float:
        """Return Smith's share of microfacets that ``direction`` (in the frame) reaches."""
        slope2 = dr.square(direction.x * self.alpha.x) + dr.square(direction.y * self.alpha.y)
        slope2 /= dr.maximum(dr.square(direction.z), 1e-12)
        return dr.select(direction.z > 0, 2 / (1 + dr.sqrt(slope2 + 1)), 0)


def typical_brightness(tinted: mi.Color3f, colourless: mi.Color3f) -> mi.Float:
    """Return the mean over channels of reflected light for :data:`TYPICAL_COLOUR`."""
    return dr.sum(tinted * TYPICAL_COLOUR + colourless) / 3


def power_weight(own: mi.Float, other: mi.Float) -> mi.Float:
    """Return the weight of a sample by the power heuristic for two densities (Veach 1997, section 9.2.4)."""
    return dr.select(own > 0, dr.rcp(1 + dr.square(other / own)), 0)


def diffuse_reflectance(cos_light: mi.Float, cos_camera: mi.Float, cos_half: mi.Float, roughness: mi.Float) -> mi.Float:
    """Return pi times the diffuse lobe of ``principled`` for a base colour of 1 (Burley 2012, section 5.3).

    Args:
        cos_light: Cosine between the normal and the direction to the light.
        cos_camera: Cosine n.v between the normal and the direction to the camera.
        cos_half: Cosine v.h between the half vector and the direction to the camera.
        roughness: Roughness of the surface.
    """
    to_light, to_camera = (dr.power(dr.clip(1 - cosine, 0, 1), 5) for cosine in (cos_light, cos_camera))
    retro = 2 * roughness * dr.square(cos_half)
    base = (1 - to_light / 2) * (1 - to_camera / 2)
    return base + retro * (to_light + to_camera + to_light * to_camera * (retro - 1))


def diffuse_albedo(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """Return the albedo of the diffuse lobe of ``principled`` for a base colour of 1, given the cosine n.v.

    The retroreflection term is evaluated at the mean directions of the terms that it multiplies. Under uniform light,
    the error is below 0.02 (Burley 2012, section 5.3).
    """
    grazing, mean = dr.power(dr.clip(1 - cosine, 0, 1), 5), 1 / 21  # cosine-weighted mean of Schlick's term
    retro, grazing_retro = roughness * dr.fma(2 / 3, cosine, 1), roughness * dr.fma(1 / 4, cosine, 1)
    base = (1 - grazing / 2) * (1 - mean / 2)
    return base + retro * grazing + grazing_retro * mean * (1 + grazing * (grazing_retro - 1))


def mirrored_uniform(lobe: SpecularLobe) -> mi.Float:
    """Return the reflectance of the dielectric under uniform light, which captured colours contain.

    Beyond 60 degrees, it is that at 60 degrees. Colours with few SH bands do not contain its rise there, and the
    removal of this rise would blacken silhouettes.
    """
    cosine = dr.maximum(lobe.view.z, 0.5)
    steep = replace(lobe, view=mi.Vector3f(dr.safe_sqrt(1 - dr.square(cosine)), 0, cosine))

    def add(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        _, weight, cos_half = steep.sample(lattice_point(i, LOBE_LATTICE))
        return i + 1, total + weight * steep.fresnel(cos_half).white

    rounds = dr.opaque(mi.UInt32, LOBE_LATTICE[0])
    state = dr.zeros(mi.UInt32, dr.width(cosine)), dr.zeros(mi.Float, dr.width(cosine))
    _, total = dr.while_loop(state, lambda i, _: i < rounds, add, label="mirrored uniform light")
    return dr.select(lobe.specular > 0, total / LOBE_LATTICE[0], 0)
