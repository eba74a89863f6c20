"""Newton collision pipelines that share one set of generated kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from functools import cached_property
from typing import Any

import newton
import numpy as np
import trimesh
import warp as wp
from newton.geometry import BroadPhaseSAP, NarrowPhase

_PAIR_CAPACITY_FACTOR = 4  # capacity factor for models with more pairs than the first


def newton_hull(piece: trimesh.Trimesh) -> newton.Mesh:
    """Convert a convex piece to a Newton mesh."""
    return newton.Mesh(piece.vertices, np.asarray(piece.faces).ravel(), maxhullvert=-1, compute_inertia=False)


class ContactFinder:
    """Factory of collision pipelines that share the kernels of one narrow phase.

    Each narrow phase generates its own kernels, which costs as much time as a second of simulation. The kernels depend
    on the shapes of the model for which they are generated. This class generates them for all given pieces, so that
    contacts do not depend on earlier models.

    Args:
        pieces: Function that returns the convex pieces of all objects that may be simulated. It is called for the first
            pipeline, and again if it was interrupted.
    """

    def __init__(self, pieces: Callable[[], Iterable[trimesh.Trimesh]]) -> None:
        self._pieces = pieces
        self._narrow_phase: NarrowPhase | None = None

    @cached_property
    def _largest(self) -> newton.Mesh:
        """The hull of most vertices. With many vertices, the support search changes for all hulls: it decides."""
        return newton_hull(max(self._pieces(), key=lambda piece: len(piece.vertices)))

    def pipeline(self, model: newton.Model, *, max_contacts: int) -> newton.CollisionPipeline:
        """Return a pipeline for a model of boxes and convex hulls.

        Pipelines share buffers and must not run concurrently.
        """
        pairs = model.shape_count * (model.shape_count - 1) // 2
        if self._narrow_phase is None or self._narrow_phase.max_candidate_pairs < pairs:
            self._narrow_phase = _generate(self._largest, _PAIR_CAPACITY_FACTOR * pairs)
        narrow_phase = copy(self._narrow_phase)
        narrow_phase.shape_aabb_lower, narrow_phase.shape_aabb_upper = (
            wp.zeros(model.shape_count, dtype=wp.vec3, device=model.device) for _ in range(2)
        )
        narrow_phase.shape_voxel_resolution = None  # of the model
        worlds: Any = model.shape_world  # every finished model has this array
        return newton.CollisionPipeline(
            model,
            broad_phase=BroadPhaseSAP(worlds, shape_flags=model.shape_flags, device=model.device),
            narrow_phase=narrow_phase,
            rigid_contact_max=max_contacts,
        )


def _generate(hull: newton.Mesh, max_pairs: int) -> NarrowPhase:
    """Generate a narrow phase for boxes, and for hulls of at most as many vertices as this one."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1)
    builder.add_shape_convex_hull(-1, mesh=hull)
    builder.add_shape_convex_hull(builder.add_body(), mesh=hull)
    model = builder.finalize(device="cpu", skip_validation_inertia=True)  # it is not simulated
    # Overflow is read from the solver's flags, because the pipeline would print it at every step.
    pipeline = newton.CollisionPipeline(model, broad_phase="sap", shape_pairs_max=max_pairs, verify_buffers=False)
    return pipeline.narrow_phase
