"""Primary visibility of rays: splats, visible meshes behind and between them, and emitters behind both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.meshes.visible_meshes import MeshHits, VisibleEmitters
from mitsplat.renderer.projection.gaussian import srgb_to_linear
from mitsplat.renderer.splatting.march import Image

NO_SPLAT = 1 << 16
"""First key of meshes and emitters, above all instance ids."""


@dataclass(frozen=True, eq=False)
class PrimaryVisibility:
    """Primary visibility of rays, without light.

    Attributes:
        colour: Linear captured colour, multiplied by ``cover`` (Color3f).
        alpha: Total opacity.
        splat_alpha: Opacity of the splats.
        cover: Opacity of the surfaces that light is traced at: splats and purely diffuse meshes.
        solid: True if a mesh is behind the splats.
        diffuse: True if that mesh is purely diffuse.
        front: True if the pixel shows a mesh or an emitter instead of splats.
        emission: Radiance of emitters behind (Color3f), in the picture's scale.
        mesh: Key of the mesh or emitter behind the splats; 0 if there is none.
        key: Equal for rays that show the same instance or the same mesh.
    """

    colour: mi.Color3f
    alpha: mi.Float
    splat_alpha: mi.Float
    cover: mi.Float
    solid: mi.Bool
    diffuse: mi.Bool
    front: mi.Bool
    emission: mi.Color3f
    mesh: mi.UInt32
    key: mi.UInt32

    @classmethod
    def of(
        cls,
        splat: Image,
        behind: MeshHits | None,
        emitters: VisibleEmitters | None,
        z_max: mi.Float | None,
        scale: mi.Color3f,
    ) -> PrimaryVisibility:
        """Combine splats, meshes and emitters.

        ``z_max`` is the depth along z [m] of the nearest mesh or emitter, behind which nothing is visible. ``scale`` is
        the factor from radiance to the picture's scale (Color3f).
        """
        colour = _linear(splat.rgb, splat.alpha)
        alpha, key = splat.alpha, mi.UInt32(splat.instance)
        solid, diffuse, front, emission = mi.Bool(False), mi.Bool(False), mi.Bool(False), mi.Color3f(0)
        mesh = mi.UInt32(0)
        if behind:
            solid = behind.valid & (behind.depth <= z_max)
            diffuse = solid & behind.diffuse
            colour += dr.select(diffuse, behind.reflectance * (1 - splat.alpha), 0)
            alpha = dr.select(solid, 1, alpha)
            mesh = dr.select(solid, dr.reinterpret_array(mi.UInt32, behind.hit.shape), 0)
        if emitters:
            alpha = dr.select(solid | emitters.everywhere | (emitters.depth < dr.inf), 1, alpha)
            emission = dr.select(solid, 0, emitters.radiance * scale * (1 - splat.alpha))
        if z_max is not None:
            front = (z_max < dr.inf) & (splat.centre_alpha < 0.5)
            mesh = dr.select(z_max < dr.inf, mesh + NO_SPLAT, 0)
            key = dr.select(front, mesh, key)
        cover = dr.select(diffuse, 1, splat.alpha)
        return cls(colour, alpha, splat.alpha, cover, solid, diffuse, front, emission, mesh, key)

    def with_luminance(self, luminance: mi.Float) -> PrimaryVisibility:
        """Return this visibility with another luminance of the splats, where ``luminance`` is positive.

        Pixels that also show a mesh are not changed.
        """
        own = mi.luminance(self.colour)
        changed = (luminance > 0) & (own > 0) & ~self.solid
        return replace(self, colour=dr.select(changed, luminance * self.splat_alpha / own, 1) * self.colour)

    def shares(self, splat: Image, own: list[mi.Float], surface: mi.UInt32) -> tuple[mi.Color3f, mi.Float]:
        """Return the shares of ``colour`` (Color3f) and of ``cover`` (Float) that one surface has.

        Args:
            splat: Splats along the rays.
            own: Opacity, red, green and blue of the splats of an instance, as parts of those of ``splat``.
            surface: Key of the surface, a mesh or that instance.
        """
        opacity, *encoded = own
        others = [dr.maximum(a - b, 0) for a, b in zip(splat.rgb, encoded, strict=True)]
        here, beside = _linear(encoded, opacity), _linear(others, splat.alpha - opacity)
        mesh = self.colour - _linear(splat.rgb, splat.alpha)
        total = here + beside + mesh
        on_mesh, same = surface >= NO_SPLAT, surface == self.mesh
        here = dr.select(on_mesh, dr.select(same, mesh, 0), here)
        cover = dr.select(on_mesh, dr.select(same, self.cover - splat.alpha, 0), opacity)
        return mi.Color3f(*[_share(h, t) for h, t in zip(here, total, strict=True)]), _share(cover, self.cover)

    def lit(
        self, light: mi.Color3f, highlight: mi.Color3f, radiance: mi.Color3f | None
    ) -> tuple[mi.Color3f, mi.Color3f]:
        """Return linear colours (Color3f) with light and as captured.

        ``radiance`` is that of meshes that are not purely diffuse, or None.
        """
        emission = self.emission
        if radiance is not None:
            emission = dr.select(self.solid & ~self.diffuse, radiance * (1 - self.splat_alpha), emission)
        return dr.maximum(self.colour * light + highlight * self.cover, 0) + emission, self.colour + emission


def _linear(encoded: list[mi.Float], opacity: mi.Float) -> mi.Color3f:
    """Return linear colours (Color3f) multiplied by ``opacity``, given display-encoded ones multiplied by it."""
    covered = dr.maximum(opacity, 1e-6)
    return mi.Color3f(*[srgb_to_linear(c / covered) * opacity for c in encoded])


def _share(part: mi.Float, total: mi.Float) -> mi.Float:
    """Return a part over the total, from 0 to 1."""
    return dr.select(total > 0, dr.clip(part / total, 0, 1), 1)
