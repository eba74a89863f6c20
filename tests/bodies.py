"""Helpers of physics tests: poses, and extents of placed meshes."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

STEPPERS = ("warp", "mujoco")


def pose_at(position: ArrayLike, rotation: Rotation | None = None) -> NDArray[np.float64]:
    """Build a rigid transform, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation.as_matrix()
    return pose


def lowest(mesh: trimesh.Trimesh, pose: NDArray[np.float64]) -> float:
    """Return the height of a placed mesh's lowest vertex [m]."""
    return float((mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min())
