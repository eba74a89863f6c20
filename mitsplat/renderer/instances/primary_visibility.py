"""What rays show: splats, what of visible meshes is seen through and beside them, and emitters behind both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.meshes.visible_meshes import Behind, SeenLights
from mitsplat.renderer.splatting.gaussian import srgb_to_linear
from mitsplat.renderer.splatting.march import Image

NO_SPLAT = 1 << 16
"""What keys of meshes and emitters start from, above all ids of instances."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What some rays show, before light.

    Attributes:
        colour: Linear, as captured, multiplied by the opacity ``cover`` of splats and plainly diffuse meshes (Color3f).
        alpha: Opacity of all.
        veil: Opacity of the splats.
        cover: Opacity of what light is traced at.
        solid: Whether a mesh is behind the splats.
        plain: Whether that is plainly diffuse.
        front: Whether a mesh or an emitter is seen rather than splats.
        glow: Radiance of emitters behind (Color3f), in the picture's scale.
        key: The same where rays show the same thing: instance, or mesh.
    """

    colour: Any
    alpha: Any
    veil: Any
    cover: Any
    solid: Any
    plain: Any
    front: Any
    glow: Any
    key: Any

    @classmethod
    def of(cls, splat: Image, behind: Behind | None, lamps: SeenLights | None, z_max: Any | None, scale: Any) -> Shown:
        """What rays show of splats, meshes and emitters, of which the last are seen up to the depths ``z_max``.

        ``scale`` is what radiance is multiplied by in the picture (Color3f).
        """
        covered = dr.maximum(splat.alpha, 1e-6)
        colour = mi.Color3f(*[srgb_to_linear(c / covered) * splat.alpha for c in splat.rgb])
        alpha, key = splat.alpha, mi.UInt32(splat.instance)
        solid, plain, front, glow = mi.Bool(False), mi.Bool(False), mi.Bool(False), mi.Color3f(0)
        shape = mi.UInt32(0)
        if behind:
            solid = behind.valid & (behind.depth <= z_max)
            plain = solid & behind.plain
            colour += dr.select(plain, behind.reflectance * (1 - splat.alpha), 0)
            alpha = dr.select(solid, 1, alpha)
            shape = dr.select(solid, dr.reinterpret_array(mi.UInt32, behind.hit.shape), 0)
        if lamps:
            alpha = dr.select(solid | lamps.everywhere | (lamps.depth < dr.inf), 1, alpha)
            glow = dr.select(solid, 0, lamps.radiance * scale * (1 - splat.alpha))
        if z_max is not None:
            front = (z_max < dr.inf) & (splat.centre_alpha < 0.5)
            key = dr.select(front, shape + NO_SPLAT, key)
        cover = dr.select(plain, 1, splat.alpha)
        return cls(colour, alpha, splat.alpha, cover, solid, plain, front, glow, key)

    def lit(self, light: Any, highlight: Any, radiance: Any | None) -> tuple[Any, Any]:
        """Linear colour in light, and as captured (Color3f), of rays whose meshes send ``radiance``, if any does."""
        glow = self.glow
        if radiance is not None:
            glow = dr.select(self.solid & ~self.plain, radiance * (1 - self.veil), glow)
        return dr.maximum(self.colour * light + highlight * self.cover, 0) + glow, self.colour + glow
