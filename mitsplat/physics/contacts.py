"""Newton's contacts for one model after another, by kernels that are generated once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from typing import Any

import newton
import numpy as np
import trimesh
import warp as wp
from newton.geometry import BroadPhaseSAP, NarrowPhase

_SPARE = 4  # room for models of more pairs than the first


def newton_hull(piece: trimesh.Trimesh) -> newton.Mesh:
    """A convex piece for Newton."""
    return newton.Mesh(piece.vertices, np.asarray(piece.faces).ravel(), maxhullvert=-1, compute_inertia=False)


class ContactFinder:
    """Makes collision pipelines that share the kernels of one narrow phase.

    Each narrow phase generates its own, which costs as much as a second of simulation. What they do depends on the
    shapes of the model that they are generated for; here on all that are given, so that no contact depends on the
    models before.

    Args:
        pieces: Convex pieces of all that may be simulated.
    """

    def __init__(self, pieces: Iterable[trimesh.Trimesh]) -> None:
        self._pieces = tuple(pieces)
        self._narrow_phase: NarrowPhase | None = None

    def pipeline(self, model: newton.Model, *, max_contacts: int) -> newton.CollisionPipeline:
        """A pipeline for a model of boxes and convex hulls. Pipelines share buffers, and must not run at once."""
        pairs = model.shape_count * (model.shape_count - 1) // 2
        if self._narrow_phase is None or self._narrow_phase.max_candidate_pairs < pairs:
            self._narrow_phase = _generate(self._pieces, _SPARE * pairs)
        narrow_phase = copy(self._narrow_phase)
        narrow_phase.shape_aabb_lower, narrow_phase.shape_aabb_upper = (
            wp.zeros(model.shape_count, dtype=wp.vec3, device=model.device) for _ in range(2)
        )
        narrow_phase.shape_voxel_resolution = None  # the model's
        worlds: Any = model.shape_world  # there is one of any finished model
        return newton.CollisionPipeline(
            model,
            broad_phase=BroadPhaseSAP(worlds, shape_flags=model.shape_flags, device=model.device),
            narrow_phase=narrow_phase,
            rigid_contact_max=max_contacts,
        )


def _generate(pieces: Sequence[trimesh.Trimesh], max_pairs: int) -> NarrowPhase:
    """A narrow phase for boxes and these hulls."""
    # Where a hull has many corners, those of all hulls are searched in another way.
    hull = newton_hull(max(pieces, key=lambda piece: len(piece.vertices)))
    builder = newton.ModelBuilder()
    builder.validate_inertia_detailed = True  # in Python, for the other way compiles a kernel
    builder.add_shape_box(-1)
    builder.add_shape_convex_hull(-1, mesh=hull)
    builder.add_shape_convex_hull(builder.add_body(), mesh=hull)
    model = builder.finalize(device="cpu")
    # Overflow is read from the solver's flags: the pipeline would print it at every step.
    pipeline = newton.CollisionPipeline(model, broad_phase="sap", shape_pairs_max=max_pairs, verify_buffers=False)
    return pipeline.narrow_phase
