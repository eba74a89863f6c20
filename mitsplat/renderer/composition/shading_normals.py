"""Shading normals of pixels, from the splats that they show.

The normals of normal maps are finer than the triangles of a proxy mesh. They are blended in a pass of their own, for
the tiles that show an object with such normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.quality import Quality
from mitsplat.renderer.composition.parameter_pass import ParameterPass, parameter_cloud
from mitsplat.renderer.materials.proxy_materials import shortest_axes
from mitsplat.renderer.occluders.proxies import Hit
from mitsplat.renderer.projection.clouds import Cloud, CloudSet, Placement, merge_clouds
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH, CameraView
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.rays.tile_subset import TileSubset
from mitsplat.renderer.splatting.march import Image

SAME_DEPTH = 0.01
"""Relative difference of depth up to which a pixel shows the splats that have these normals."""

SAME_SURFACE = 0.95
"""Minimum cosine between the proxy's normal and the mean direction of the splats of a pixel. Below it, the pixel shows
splats of both sides of an edge, and their mean normal would be that of a chamfer.
"""


@dataclass(frozen=True, eq=False)
class NormalMappedShapes:
    """Splats with shading normals on the device, with world-space normals in place of colours.

    Attributes:
        clouds: The splats, a cloud per placement.
        surfaces: The same splats with the normals of their discs.
        placements: Their poses.
        present: True for instances that have shading normals, by instance id.
    """

    clouds: CloudSet
    surfaces: CloudSet
    placements: tuple[Placement, ...]
    present: mi.Bool

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape], placements: Sequence[Placement]) -> NormalMappedShapes | None:
        """Collect the ``splats`` shapes, with their placements, that have shading normals; return None if none."""
        clouds: list[Cloud] = []
        surfaces: list[Cloud] = []
        placed: list[Placement] = []
        for shape, placement in zip(shapes, placements, strict=True):
            materials = shape.splats.materials
            if materials is not None and materials.normals is not None:
                placed.append(replace(placement, cloud=len(clouds), appearance=None))
                clouds.append(_normal_cloud(shape.splats, materials.normals, placement.world_from_cloud))
                outward = _disc_normals(shape.splats, materials.normals)
                surfaces.append(_normal_cloud(shape.splats, outward, placement.world_from_cloud))
        if not clouds:
            return None
        present = np.zeros(1 + max(shape.instance for shape in shapes), bool)
        present[[placement.instance for placement in placed]] = True
        return cls(merge_clouds(clouds), merge_clouds(surfaces), tuple(placed), wrapped(mi.Bool, present))

    def normals(self, view: CameraView, quality: Quality, seen: Image, hit: Hit, z_max: mi.Float | None) -> mi.Vector3f:
        """Return unit shading normals in world space of the pixels of an image.

        They are zero where the image shows other splats, and at edges of the object.

        Args:
            view: Camera.
            quality: Settings of the splats.
            seen: Image of all splats.
            hit: First hits on the proxies.
            z_max: Depths [m] behind which splats are hidden; None without such depths.
        """
        result = dr.zeros(mi.Vector3f, view.width * view.height)
        subset = self._tiles(view, seen.instance)
        if subset.count == 0:
            return result
        found, flat = (
            ParameterPass.of(clouds, self.placements, view, quality, subset, z_max)
            for clouds in (self.clouds, self.surfaces)
        )
        image, pixel, inside = found.image, found.pixel, found.inside
        normal, outward = (_decoded(one.image) for one in (found, flat))
        depth = dr.gather(mi.Float, seen.depth, pixel, inside)
        instance, met = (dr.gather(mi.UInt32, each.instance, pixel, inside) for each in (seen, hit))
        shown = found.covered & dr.gather(mi.Bool, self.present, instance, inside)
        shown &= dr.abs(image.depth - depth) < SAME_DEPTH * depth
        proxy = dr.select(instance == met, dr.gather(mi.Normal3f, hit.normal, pixel, inside), dr.normalize(outward))
        shown &= dr.dot(outward, proxy) > SAME_SURFACE
        normal = dr.select(dr.squared_norm(normal) > 0.01, dr.normalize(normal), 0)
        dr.eval(normal, shown)
        dr.scatter(result, normal, pixel, shown, mode=dr.ReduceMode.Permute)
        dr.eval(result)
        return result

    def _tiles(self, view: CameraView, instance: mi.UInt32) -> TileSubset:
        """Return the tiles with pixels of these shapes."""
        tiles = dr.zeros(mi.Bool, view.tiles_x * view.tiles_y)
        pixel = dr.arange(mi.UInt32, view.width * view.height)
        row = pixel // view.width
        tile = row // TILE_HEIGHT * view.tiles_x + (pixel - row * view.width) // TILE_WIDTH
        dr.scatter(tiles, mi.Bool(True), tile, dr.gather(mi.Bool, self.present, instance))
        dr.eval(tiles)
        return TileSubset.of(tiles, view)


def _decoded(image: Image) -> mi.Vector3f:
    """Return the mean normals of pixels of clouds by :func:`_normal_cloud`."""
    return 2 * mi.Vector3f(*image.rgb) / dr.maximum(image.alpha, 1e-6) - 1


def _disc_normals(splats: Splats, normals: Float32Array) -> Float32Array:
    """Return the shortest axes (N, 3) of splats on the side of their shading normals."""
    _, across = shortest_axes(splats)
    side = np.where(np.einsum("nd,nd->n", across, normals) < 0, -1.0, 1.0)
    return (side[:, None] * across).astype(np.float32)


def _normal_cloud(splats: Splats, normals: Float32Array, world_from_cloud: Float64Array) -> Cloud:
    """Upload splats with the normals of a placement, mapped from [-1, 1] to [0, 1]."""
    turn = world_from_cloud[:3, :3] / np.cbrt(np.linalg.det(world_from_cloud[:3, :3]))
    return parameter_cloud(splats, 0.5 + 0.5 * normals.astype(np.float64) @ turn.T)
