"""Splats seen by rays from visible meshes: the colour of the first stochastic solid on the ray.

The solids are those of :mod:`mitsplat.renderer.occluders.splat_occlusion`: a Gaussian stops a ray with a probability
equal to its opacity there. The expected colour of the first solid is the result of front-to-back blending.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.occluders.splat_occlusion import SETS, Caster, Solids
from mitsplat.renderer.projection.clouds import CloudSet, Placement
from mitsplat.renderer.projection.gaussian import evaluate_sh, rotation_axes, srgb_to_linear
from mitsplat.renderer.projection.records import AppearanceRow, Geometry
from mitsplat.renderer.projection.splat_appearance import appearance_rows, apply_appearance
from mitsplat.renderer.rays.device_arrays import wrapped

MOST_SOLIDS = 1_000_000
"""Approximate limit of the solids in all sets. Larger scenes have fewer sets, but at least two."""


class _MirrorRow:
    """Columns of a placement: rotation into the splats' frame row by row, relit flag, and footprint [m]."""

    ROTATION, RELIT, FOOTPRINT = slice(0, 9), 9, 10
    WIDTH = 16


@dataclass(frozen=True, eq=False)
class SplatHits:
    """Hits of rays on splats.

    Attributes:
        distance: Distance along the ray [m], infinite for a miss.
        colour: Linear captured colour (Color3f).
        normal: Normal of the Gaussian's flattest side, towards the ray's origin.
        relit: True if the colour was captured under uniform light.
        footprint: Distance from the surface within which its own splats cast no shadow [m].
    """

    distance: mi.Float
    colour: mi.Color3f
    normal: mi.Vector3f
    relit: mi.Bool
    footprint: mi.Float


@dataclass(frozen=True, eq=False)
class SplatMirror:
    """Splats of a scene for rays from any point.

    Attributes:
        solids: Stochastic solids that rays hit.
        clouds: Colours of the splats.
        gaussians: Placement and Gaussian number in the clouds for each triangle, two numbers per triangle.
        table: One ``_MirrorRow`` per placement.
        appearances: One :class:`AppearanceRow` per placement, padded to the same width; None if no placement has an
            appearance.
    """

    solids: Solids
    clouds: CloudSet
    gaussians: mi.UInt32
    table: mi.Float
    appearances: mi.Float | None = None

    @classmethod
    def build(
        cls, clouds: CloudSet | None, placements: Sequence[Placement], splats: Sequence[Splats], relit: Sequence[bool]
    ) -> SplatMirror | None:
        """Build the solids of the placements' splats; ``relit`` marks placements captured under uniform light."""
        total = sum(len(splats[p.cloud]) for p in placements)
        if clouds is None or not total:
            return None
        casters = [Caster(splats[p.cloud], p.instance, p.world_from_cloud) for p in placements]
        solids = Solids.build(casters, int(np.clip(MOST_SOLIDS // total, 2, SETS)))
        if solids is None:
            return None
        rows = np.zeros((len(placements), _MirrorRow.WIDTH), np.float32)
        firsts = np.array([clouds.first[p.cloud] for p in placements], np.uint32)
        for row, placement, anew, footprint in zip(rows, placements, relit, solids.footprints, strict=True):
            turn = placement.world_from_cloud[:3, :3]
            row[_MirrorRow.ROTATION] = (turn / np.cbrt(np.linalg.det(turn))).T.ravel()
            row[_MirrorRow.RELIT], row[_MirrorRow.FOOTPRINT] = anew, footprint
        caster, gaussian = solids.owners
        owners = np.stack([caster, firsts[caster] + gaussian], axis=1)
        appearances = None
        if any(p.appearance is not None for p in placements):
            padding = _MirrorRow.WIDTH - AppearanceRow.WIDTH
            looks = np.pad(appearance_rows([p.appearance for p in placements]), ((0, 0), (0, padding)))
            appearances = wrapped(mi.Float, looks)
        return cls(solids, clouds, wrapped(mi.UInt32, owners), wrapped(mi.Float, rows), appearances)

    def trace(self, ray: mi.Ray3f, key: mi.UInt32) -> SplatHits:
        """Trace rays against splats; the ``key`` of a ray selects its set of solids."""
        inside, start, met = self.solids.enter(ray, key, mi.Float(0))
        hit = self.solids.scene.ray_intersect_preliminary(inside, active=met)
        found = met & hit.is_valid()
        owner = dr.gather(mi.Point2u, self.gaussians, hit.prim_index, found)
        row = dr.gather(mi.ArrayXf, self.table, owner.x, found, shape=(_MirrorRow.WIDTH, dr.width(owner)))
        rotation = row[_MirrorRow.ROTATION]
        axes_of = [mi.Vector3f(*[rotation[3 * i + j] for j in range(3)]) for i in range(3)]
        own = mi.Vector3f(*[dr.dot(axis, ray.d) for axis in axes_of])
        stride = self.clouds.sh_stride
        packet = dr.gather(mi.ArrayXf, self.clouds.sh, owner.y, found, shape=(stride, dr.width(owner)))
        colour = evaluate_sh(own, lambda k: [packet[3 * k + i] for i in range(3)], self.clouds.sh_count)
        geometry = dr.gather(mi.ArrayXf, self.clouds.geometry, owner.y, found, shape=(Geometry.WIDTH, dr.width(owner)))
        if self.appearances is not None:
            looks = dr.gather(mi.ArrayXf, self.appearances, owner.x, found, shape=(_MirrorRow.WIDTH, dr.width(owner)))
            centre = mi.Vector3f(*geometry[Geometry.MEAN])
            colour = apply_appearance(colour, [*looks[: AppearanceRow.WIDTH]], centre)
        sigma = dr.gather(mi.Vector4f, self.clouds.scales, owner.y, found)
        axes = rotation_axes(geometry[Geometry.QUATERNION])
        thin_x, thin_y = (sigma.x < sigma.y) & (sigma.x < sigma.z), sigma.y < sigma.z
        side = dr.select(thin_x, axes[0], dr.select(thin_y, axes[1], axes[2]))
        side = dr.select(dr.dot(side, own) > 0, -side, side)
        return SplatHits(
            distance=dr.select(found, start + hit.t, dr.inf),
            colour=mi.Color3f(*[srgb_to_linear(c) for c in colour]),
            normal=axes_of[0] * side.x + axes_of[1] * side.y + axes_of[2] * side.z,
            relit=found & (row[_MirrorRow.RELIT] > 0),
            footprint=row[_MirrorRow.FOOTPRINT],
        )
