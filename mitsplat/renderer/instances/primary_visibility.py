"""Primary visibility of rays: splats, visible meshes behind and between them, and emitters behind both."""

from __future__ import annotations

from dataclasses import dataclass

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
        covered = dr.maximum(splat.alpha, 1e-6)
        colour = mi.Color3f(*[srgb_to_linear(c / covered) * splat.alpha for c in splat.rgb])
        alpha, key = splat.alpha, mi.UInt32(splat.instance)
        solid, diffuse, front, emission = mi.Bool(False), mi.Bool(False), mi.Bool(False), mi.Color3f(0)
        shape = mi.UInt32(0)
        if behind:
            solid = behind.valid & (behind.depth <= z_max)
            diffuse = solid & behind.diffuse
            colour += dr.select(diffuse, behind.reflectance * (1 - splat.alpha), 0)
            alpha = dr.select(solid, 1, alpha)
            shape = dr.select(solid, dr.reinterpret_array(mi.UInt32, behind.hit.shape), 0)
        if emitters:
            alpha = dr.select(solid | emitters.everywhere | (emitters.depth < dr.inf), 1, alpha)
            emission = dr.select(solid, 0, emitters.radiance * scale * (1 - splat.alpha))
        if z_max is not None:
            front = (z_max < dr.inf) & (splat.centre_alpha < 0.5)
            key = dr.select(front, shape + NO_SPLAT, key)
        cover = dr.select(diffuse, 1, splat.alpha)
        return cls(colour, alpha, splat.alpha, cover, solid, diffuse, front, emission, key)

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
