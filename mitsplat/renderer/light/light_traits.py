"""Light parameters of splat shapes, by the shape that a pixel shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.gaussians.splat_materials import specular_of
from mitsplat.renderer.projection.clouds import Placement
from mitsplat.renderer.rays.device_arrays import wrapped


class _Row(NamedTuple):
    """Light parameters of a shape, see :class:`Traits`."""

    relit: bool
    roughness: float
    metallic: float
    specular: float
    captured: bool

    @classmethod
    def of(cls, shape: mi.Shape) -> _Row:
        """Return the parameters of a ``splats`` shape; means over its materials if it has any."""
        materials, gloss = shape.splats.materials, shape.gloss
        if materials is None:
            return cls(shape.relit, shape.roughness, 0.0, specular_of(shape.specular), True)
        return cls(
            relit=shape.relit,
            roughness=float(materials.roughness.mean()) if gloss.roughness is None else gloss.roughness,
            metallic=float(materials.metallic.mean()),
            specular=float(materials.specular.mean()) if gloss.specular is None else gloss.specular,
            captured=False,
        )


@dataclass(frozen=True, eq=False)
class Traits:
    """Table of the light parameters of shapes, read by :mod:`mitsplat.renderer.light.light`.

    Row i belongs to instance i. If the shapes of an instance differ, row i holds the parameters of the shape with the
    most splats. The other shapes have additional rows at the end of the table.

    Attributes:
        relit: True if the colours are base colours or were captured under uniform light, by row.
        roughness, metallic, specular: Parameters of :class:`mitsplat.renderer.materials.principled.SpecularLobe`, by
            row.
        captured: True if the colours were captured, by row.
        owner: Instance id, by row.
        placements: Placements of the scene with row numbers instead of instance ids; None if every instance has one
            row.
    """

    relit: mi.Bool
    roughness: mi.Float
    metallic: mi.Float
    specular: mi.Float
    captured: mi.Bool
    owner: mi.UInt32
    placements: tuple[Placement, ...] | None

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape], placements: Sequence[Placement]) -> Traits:
        """Build the table from ``splats`` shapes and their placements."""
        count = 1 + max([0, *(s.instance for s in shapes)])
        # Without captured surroundings, pixels of instance 0 show sparse splats of objects, which are relit.
        plain = _Row(relit=True, roughness=0.4, metallic=0.0, specular=0.0, captured=True)
        rows: dict[tuple[int, _Row], int] = {}
        values, owners, placed = [plain] * count, list(range(count)), [p.instance for p in placements]
        # A pixel never shows a shape without splats.
        order = [i for i in range(len(shapes)) if len(shapes[i].splats)]
        for i in sorted(order, key=lambda i: -len(shapes[i].splats)):
            shape = shapes[i]
            own = _Row.of(shape)
            key = shape.instance, own
            if key not in rows:
                if any(instance == shape.instance for instance, _ in rows):
                    rows[key] = len(values)
                    values.append(own)
                    owners.append(shape.instance)
                else:
                    rows[key] = shape.instance
                    values[shape.instance] = own
            placed[i] = rows[key]
        relit, roughness, metallic, specular, captured = zip(*values, strict=True)
        several = len(values) > count
        return cls(
            wrapped(mi.Bool, np.array(relit, bool)),
            wrapped(mi.Float, np.array(roughness, np.float32)),
            wrapped(mi.Float, np.array(metallic, np.float32)),
            wrapped(mi.Float, np.array(specular, np.float32)),
            wrapped(mi.Bool, np.array(captured, bool)),
            wrapped(mi.UInt32, np.array(owners, np.uint32)),
            tuple(replace(p, instance=row) for p, row in zip(placements, placed, strict=True)) if several else None,
        )

    def seen(self, row: mi.UInt32 | None, instance: mi.UInt32) -> mi.UInt32:
        """Return the row of every pixel that shows ``instance``, given the row with the largest share of the pixel."""
        if row is None:
            return instance
        return dr.select(dr.gather(mi.UInt32, self.owner, row) == instance, row, instance)
