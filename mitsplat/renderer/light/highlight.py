"""Highlights: mirrored light of emitters, by GGX microfacets.

The unoccluded reflection of a lobe is integrated over fixed directions, so that it has no noise. Shadow rays only
estimate the share of it that arrives (Heitz, Hill and McGuire 2018, "Combining Analytic Direct Illumination and
Stochastic Shadows"). Mirrored radiance differs much between adjacent pixels: estimated by rays alone, it would be noisy
or blurred by the filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.lit_surface import LitSurface

CAPTURED_SPECULAR = 0.08
"""Largest reflectance at which the mirror image of the light tent is replaced. Up to it, the image counts as part of
the captured colour and the scene's lights take its place. Metals reflect more; the rest of their captured colour
stays and represents other mirrored surroundings.
"""

MIN_ROUGHNESS = 0.15
"""Smallest roughness. On smoother surfaces the fixed directions would be visible as single spots."""


@dataclass(frozen=True, eq=False)
class Lobe:
    """Specular lobes towards the camera: GGX with height-correlated masking and Schlick's Fresnel term.

    See Walter et al. 2007, "Microfacet Models for Refraction", and Heitz 2014, "Understanding the Masking-Shadowing
    Function".

    Attributes:
        normal, to_camera: Unit vectors.
        alpha: Roughness of the distribution.
        specular: Reflectance at normal incidence.
    """

    normal: mi.Vector3f
    to_camera: mi.Vector3f
    alpha: mi.Float
    specular: mi.Float

    @classmethod
    def of(cls, surface: LitSurface) -> Lobe:
        """Return the lobes of visible points."""
        alpha = dr.square(dr.maximum(surface.roughness, MIN_ROUGHNESS))
        return cls(surface.normal, surface.to_camera, alpha, surface.specular)

    def reflectance(self, to_light: mi.Vector3f) -> mi.Float:
        """Return the radiance towards the camera per irradiance from unit vectors towards the light."""
        alpha2, cos_camera = dr.square(self.alpha), self._cos_camera()
        cos_light = dr.dot(self.normal, to_light)
        half = dr.normalize(to_light + self.to_camera)
        cos_half = dr.dot(self.normal, half)
        spread = dr.fma(cos_half * cos_half, alpha2 - 1, 1)
        distribution = alpha2 / (dr.pi * dr.square(spread))
        masking = cos_light * self._reach(cos_camera, alpha2) + cos_camera * self._reach(cos_light, alpha2)
        fresnel = self._fresnel(dr.dot(half, to_light))
        return dr.select(cos_light > 0, distribution * fresnel * 0.5 / dr.maximum(masking, 1e-6), 0)

    def sample(self, point: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """Sample a direction from a point of the unit square.

        Uses the distribution of visible normals (Heitz 2018, "Sampling the GGX Distribution of Visible Normals").

        Returns:
            Unit vector towards the light, and the mirrored share of the radiance from there.
        """
        frame, alpha2, cos_camera = mi.Frame3f(self.normal), dr.square(self.alpha), self._cos_camera()
        seen = frame.to_local(self.to_camera)
        seen = dr.normalize(mi.Vector3f(seen.x, seen.y, cos_camera))
        microfacets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)
        half = mi.Vector3f(microfacets.sample(seen, point)[0])
        cos_half = dr.dot(seen, half)
        direction = 2 * cos_half * half - seen
        cos_light = direction.z
        # G2 / G1, both of the camera's side.
        own, other = self._reach(cos_camera, alpha2), self._reach(cos_light, alpha2)
        masking = cos_light * (cos_camera + own) / dr.maximum(cos_light * own + cos_camera * other, 1e-6)
        return frame.to_world(direction), dr.select(cos_light > 0, self._fresnel(cos_half) * masking, 0)

    def _cos_camera(self) -> mi.Float:
        return dr.maximum(dr.dot(self.normal, self.to_camera), 1e-3)

    @staticmethod
    def _reach(cosine: mi.Float, alpha2: mi.Float) -> mi.Float:
        return dr.sqrt(dr.fma(cosine * cosine, 1 - alpha2, alpha2))

    def _fresnel(self, cosine: mi.Float) -> mi.Float:
        grazing = dr.power(dr.clip(1 - cosine, 0, 1), 5)
        return dr.select(self.specular > 0, dr.fma(1 - self.specular, grazing, self.specular), 0)


def mirrored_tent(surface: LitSurface) -> mi.Float:
    """Return the specular part of the captured colour: the lobe's reflectance under even light.

    The fit is that of Karis (2014, "Physically Based Shading on Mobile", Unreal Engine) without its rise beyond 60
    degrees. Colours with few SH bands do not contain this rise, and its removal would blacken silhouettes.
    """
    cosine = dr.maximum(dr.dot(surface.normal, surface.to_camera), 0.5)
    rough = surface.roughness
    x, y, z, w = 1 - rough, dr.fma(-0.0275, rough, 0.0425), dr.fma(-0.572, rough, 1.04), dr.fma(0.022, rough, -0.04)
    bend = dr.fma(dr.minimum(x * x, dr.exp2(-9.28 * cosine)), x, y)
    specular = dr.minimum(surface.specular, CAPTURED_SPECULAR)
    return dr.select(specular > 0, dr.maximum(specular * dr.fma(-1.04, bend, z) + dr.fma(1.04, bend, w), 0), 0)
