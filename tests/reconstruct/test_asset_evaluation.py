"""Rule by which reports call the mesh of an asset closed."""

from __future__ import annotations

import numpy as np
import trimesh

from mitsplat.reconstruct.asset_evaluation import is_closed_when_read


def test_reports_call_a_mesh_closed_as_checks_do() -> None:
    """Unwelded triangles and solids that touch are closed; a turned face makes a mesh open."""
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    soup = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    other = box.copy().apply_translation((0.05, 0.04, 0))
    turned = trimesh.Trimesh(box.vertices, [*box.faces[:-1], box.faces[-1, ::-1]], process=False)
    assert turned.is_watertight
    assert is_closed_when_read(soup)
    assert is_closed_when_read(trimesh.util.concatenate([box, other]))
    assert not is_closed_when_read(turned)
