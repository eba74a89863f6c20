"""Poses of the nodes of a glTF file and of their instances (Khronos, *glTF 2.0*, 3.5)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.mesh_files.gltf_data import GltfData
from mitsplat.storage.files import JsonObject


def world_poses(data: GltfData) -> dict[int, Float64Array]:
    """Return the poses (4, 4) of all visible nodes of the scene, in depth-first order.

    Raises:
        ValueError: If a node has two parents.
    """
    document = data.document
    poses: dict[int, Float64Array] = {}
    nodes = document.get("nodes", [])
    if "scenes" in document:
        roots = data.entry("scenes", document.get("scene", 0)).get("nodes", [])
    else:
        inner = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in inner]
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    while pending:
        index, parent = pending.pop()
        node = data.entry("nodes", index)
        if index in poses:
            raise ValueError(f"node {index} has two parents")
        if not node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True):
            continue
        poses[index] = parent @ _local_pose(node)
        pending += [(child, poses[index]) for child in reversed(node.get("children", []))]
    return poses


def instance_poses(data: GltfData, node: JsonObject) -> list[Float64Array]:
    """Return the poses (4, 4) of the instances of a node, relative to it (``EXT_mesh_gpu_instancing``)."""
    stored = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
    if stored is None:
        return [np.eye(4)]
    given = {name.lower(): data.accessor(index) for name, index in stored["attributes"].items()}
    count = min(map(len, given.values()))
    return [_local_pose({name: values[k] for name, values in given.items()}) for k in range(count)]


def _local_pose(node: JsonObject) -> Float64Array:
    """Return the pose (4, 4) of a node relative to its parent."""
    if "matrix" in node:
        matrix = np.asarray(node["matrix"], dtype=np.float64).reshape(4, 4).T
        if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
            raise ValueError(
                f"the last row of the matrix of a node must be 0, 0, 0, 1 (got {matrix[3].tolist()}); is it "
                "stored row by row?"
            )
        return matrix
    turn = Rotation.from_quat(np.asarray(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)).as_matrix()
    linear = turn * np.asarray(node.get("scale", (1, 1, 1)), dtype=np.float64)
    return homogeneous_matrix(linear, node.get("translation", (0, 0, 0)))
