"""How the splats of a pixel are lit, by the shape that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.splatting.projection import Placement


@dataclass(frozen=True, eq=False)
class Traits:
    """Rows of what :mod:`mitsplat.renderer.light.light` needs to know of shapes.

    Row i is that of instance i; where the shapes of an instance differ, that of the one with the most splats, and the
    others have rows of their own behind.

    Attributes:
        relit: Whether colours were captured under uniform light, by row.
        roughness, specular: Of the highlight, by row.
        owner: Instance, by row.
        placements: Those of the scene with rows in place of instances; None if every instance has but one row.
    """

    relit: Any
    roughness: Any
    specular: Any
    owner: Any
    placements: tuple[Placement, ...] | None

    @classmethod
    def of(cls, shapes: Sequence[Any], placements: Sequence[Placement]) -> Traits:
        """The traits of ``splats`` shapes, placed so."""
        count = 1 + max([0, *(s.instance for s in shapes)])
        plain = False, 0.4, 0.0
        rows: dict[tuple[int, Any], int] = {}
        values, owners, placed = [plain] * count, list(range(count)), [p.instance for p in placements]
        # A shape without splats is never what a pixel shows.
        order = [i for i in range(len(shapes)) if len(shapes[i].splats)]
        for i in sorted(order, key=lambda i: -len(shapes[i].splats)):
            shape = shapes[i]
            own = shape.capture_light == "uniform", shape.roughness, shape.specular
            key = shape.instance, own
            if key not in rows:
                first = not any(instance == shape.instance for instance, _ in rows)
                rows[key] = shape.instance if first else len(values)
                values[rows[key] : rows[key] + 1] = [own]
                owners[rows[key] : rows[key] + 1] = [shape.instance]
            placed[i] = rows[key]
        relit, roughness, specular = zip(*values, strict=True)
        several = len(values) > count
        return cls(
            wrapped(mi.Bool, np.array(relit, bool)),
            wrapped(mi.Float, np.array(roughness, np.float32)),
            wrapped(mi.Float, np.array(specular, np.float32)),
            wrapped(mi.UInt32, np.array(owners, np.uint32)),
            tuple(replace(p, instance=row) for p, row in zip(placements, placed, strict=True)) if several else None,
        )

    def seen(self, row: Any | None, instance: Any) -> Any:
        """Row of every pixel that shows ``instance``, given the row with the largest share of it."""
        if row is None:
            return instance
        return dr.select(dr.gather(mi.UInt32, self.owner, row) == instance, row, instance)
