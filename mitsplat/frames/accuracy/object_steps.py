"""Scenes whose objects are rendered in other ways, for the chart of speed and accuracy."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.frames.scene_builder import SceneBuilder
from mitsplat.renderer.materials.proxy_materials import MaterialColumns, part_materials
from mitsplat.renderer.occluders.proxies import Occluder, world_corners
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.scene.layout import Layout
from mitsplat.scene.scene import Scene


def without_materials(scene: Scene) -> Scene:
    """Return a scene whose objects show their base colours as captured colours."""
    captured = [replace(asset, splats=replace(asset.splats, materials=None)) for asset in scene.assets]
    return replace(scene, assets=tuple(captured))


class MeshSceneBuilder(SceneBuilder):
    """Builder of scenes whose objects are visible meshes: their proxies with the BSDF ``principled``."""

    def objects(self, layout: Layout) -> dict[str, mi.Shape]:
        """Return the meshes of the objects of a layout by name."""
        splats = super().objects(layout)
        return self._reuse("meshes", layout, lambda: {name: path_traced_mesh(one) for name, one in splats.items()})


def path_traced_mesh(shape: mi.Shape) -> mi.Mesh:
    """Return the proxy of a shape ``splats`` as a visible mesh with the materials of its Gaussians.

    ``principled`` has one specular value for all triangles, the mean over their corners.
    """
    part = Occluder(
        shape.proxy, shape.instance, True, shape.world_from_splats, shape.splats, shape.appearance, shape.gloss
    ).part
    values, (corners, normals) = part_materials(part), world_corners(part)
    bsdf = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
        "metallic": {"type": "mesh_attribute", "name": "vertex_metallic"},
        "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
        "specular": float(values[:, MaterialColumns.SPECULAR].mean()),
    }
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(f"object_{part.instance}", len(corners), len(corners) // 3, properties, has_vertex_normals=True)
    for name, columns in (
        ("color", MaterialColumns.COLOUR),
        ("metallic", MaterialColumns.METALLIC),
        ("roughness", MaterialColumns.ROUGHNESS),
    ):
        column = values[:, columns].reshape(len(values), -1)
        mesh.add_attribute(f"vertex_{name}", column.shape[1], column.ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = wrapped(mi.Float, corners.astype(np.float32))
    parameters["vertex_normals"] = wrapped(mi.Float, normals.astype(np.float32))
    parameters["faces"] = dr.arange(mi.UInt32, len(corners))
    parameters.update()
    return mesh
