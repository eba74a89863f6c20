"""Materials of pixels at borders between metal and plastic of one object, from the splats that the pixels show.

Elsewhere, a pixel takes its material from the proxy mesh below it. At a border, splats reach over the edge of the mesh,
so that a pixel could show the colour of steel with the material of rubber: a white dot. The borders are therefore
rendered again, with material parameters in place of colours.

A pixel that shows several materials with metalness m, roughness r and luminance l of the base colour, in shares w,
reflects diffuse light in proportion to sum w (1 - m) l, and tinted light in proportion to sum w m l. Its metalness is
therefore sum w m l / sum w l. The roughness is weighted likewise. The luminance of the pixel is sum w l: splats blend
display-encoded colours, which would draw a dark line between bright steel and dark rubber.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.images.colour import LUMINANCE, decode_srgb
from mitsplat.quality import Quality
from mitsplat.renderer.composition.parameter_pass import ParameterPass, parameter_cloud
from mitsplat.renderer.materials.proxy_materials import SURFACE_OPACITY, GlossChange
from mitsplat.renderer.occluders.proxies import Hit
from mitsplat.renderer.projection.clouds import Cloud, CloudSet, Placement, merge_clouds
from mitsplat.renderer.projection.splat_appearance import SplatAppearance, changed_colours
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH, CameraView
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.rays.tile_subset import TileSubset

DIFFERENT = 0.1
"""Difference of metalness between two materials that have a border."""

REACH = 2
"""Distance [px] from a border of the proxy at which splats of the other material are expected."""

LEAST_LUMINANCE = 0.02
"""Smallest luminance of a Gaussian's base colour in these means."""

FROM_PROXY = -1.0
"""Value of pixels that take their material from the proxy."""


@dataclass(frozen=True, eq=False)
class MixedObjects:
    """Splats with several materials on the device, with metalness, luminance and roughness in place of colours.

    Attributes:
        clouds: The splats.
        placements: Their poses.
        mixed: True for instances with several materials, by instance id.
    """

    clouds: CloudSet
    placements: tuple[Placement, ...]
    mixed: mi.Bool

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape], placements: Sequence[Placement]) -> MixedObjects | None:
        """Collect the ``splats`` shapes, with their placements, that have several materials; return None if none."""
        own = [
            (shape, placement)
            for shape, placement in zip(shapes, placements, strict=True)
            if shape.instance and shape.proxy is not None and _is_mixed(shape.splats)
        ]
        if not own:
            return None
        looks = [(shape.splats, shape.gloss, shape.appearance) for shape, _ in own]
        keys = list(dict.fromkeys(looks))
        placed = [
            replace(placement, cloud=keys.index(look), appearance=None)
            for look, (_, placement) in zip(looks, own, strict=True)
        ]
        mixed = np.zeros(1 + max(shape.instance for shape in shapes), bool)
        mixed[[placement.instance for placement in placed]] = True
        return cls(merge_clouds([_parameter_cloud(*key) for key in keys]), tuple(placed), wrapped(mi.Bool, mixed))

    def materials(
        self, view: CameraView, quality: Quality, hit: Hit, instance: mi.UInt32, z_max: mi.Float | None
    ) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return metalness, roughness and luminance of the pixels at borders, :data:`FROM_PROXY` elsewhere.

        Args:
            view: The camera.
            quality: Order, cut-offs and kernel of the splats.
            hit: First proxy hits of the pixels.
            instance: Visible instances of the pixels.
            z_max: Depth along z [m] of the nearest visible surface; splats behind it are not visible.
        """
        pixels = view.width * view.height
        parameters = [dr.full(mi.Float, FROM_PROXY, pixels) for _ in range(3)]
        subset = self._borders(view, hit, instance)
        if subset.count == 0:
            return parameters[0], parameters[1], parameters[2]
        found = ParameterPass.of(self.clouds, self.placements, view, quality, subset, z_max)
        image, pixel, inside = found.image, found.pixel, found.inside
        metal, luminance, rough = image.rgb
        mixed = dr.gather(mi.Bool, self.mixed, dr.gather(mi.UInt32, instance, pixel, inside), inside)
        shown = found.covered & mixed & (luminance > 0)
        shares = metal / luminance, rough / luminance, luminance / image.alpha
        for values, share in zip(parameters, shares, strict=True):
            value = dr.clip(share, 0, 1)
            dr.eval(value)
            dr.scatter(values, value, pixel, shown, mode=dr.ReduceMode.Permute)
        dr.eval(parameters)
        return parameters[0], parameters[1], parameters[2]

    def _borders(self, view: CameraView, hit: Hit, instance: mi.UInt32) -> TileSubset:
        """Return the tiles near borders between materials of one visible instance."""
        tiles = dr.zeros(mi.Bool, view.tiles_x * view.tiles_y)
        pixel = dr.compress((hit.instance == instance) & dr.gather(mi.Bool, self.mixed, instance))
        if dr.width(pixel) == 0:
            return TileSubset.of(tiles, view)
        x, y = mi.Int32(pixel % view.width), mi.Int32(pixel // view.width)
        number, metallic = dr.gather(mi.UInt32, hit.instance, pixel), dr.gather(mi.Float, hit.metallic, pixel)
        border = mi.Bool(False)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            inside = (x + dx >= 0) & (x + dx < view.width) & (y + dy >= 0) & (y + dy < view.height)
            other = mi.UInt32((y + dy) * view.width + x + dx)
            same = inside & (dr.gather(mi.UInt32, hit.instance, other, inside) == number)
            border |= same & (dr.abs(dr.gather(mi.Float, hit.metallic, other, same) - metallic) > DIFFERENT)
        dr.eval(x, y, border)
        for dx, dy in np.ndindex(2, 2):
            near_x = dr.clip(x + REACH * (2 * dx - 1), 0, view.width - 1)
            near_y = dr.clip(y + REACH * (2 * dy - 1), 0, view.height - 1)
            tile = mi.UInt32(near_y // TILE_HEIGHT * view.tiles_x + near_x // TILE_WIDTH)
            dr.scatter(tiles, mi.Bool(True), tile, border)
        dr.eval(tiles)
        return TileSubset.of(tiles, view)


@lru_cache(maxsize=64)
def _is_mixed(splats: Splats) -> bool:
    """Return True if the opaque Gaussians have several metalnesses."""
    if splats.materials is None:
        return False
    metallic = splats.materials.metallic[splats.opacities > SURFACE_OPACITY]
    return len(metallic) > 0 and float(np.ptp(metallic)) > DIFFERENT


@lru_cache(maxsize=16)
def _parameter_cloud(splats: Splats, gloss: GlossChange, appearance: SplatAppearance | None) -> Cloud:
    """Upload splats with metalness, luminance and roughness, each times the luminance, in place of colours."""
    materials = splats.materials or SplatMaterials.uniform(len(splats))
    base = decode_srgb(changed_colours(0.5 + SH_C0 * splats.sh[:, 0], appearance, splats.means))
    luminance = np.maximum(np.clip(base, 0, 1) @ LUMINANCE, LEAST_LUMINANCE)
    roughness = materials.roughness if gloss.roughness is None else np.full(len(splats), gloss.roughness)
    values = luminance[:, None] * np.stack([materials.metallic, np.ones(len(splats)), roughness], axis=1)
    return parameter_cloud(splats, values)
