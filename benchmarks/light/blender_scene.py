"""Renders an exported scene with Blender Cycles; run by ``benchmarks.light.cycles`` in an environment with ``bpy``.

    python blender_scene.py FOLDER

FOLDER contains ``scene.json`` and the files that it names. The linear image (H, W, 3) is written to ``cycles.npy``.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix


def main(folder: Path) -> None:
    """Render the scene of a folder."""
    spec = json.loads((folder / "scene.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for number, part in enumerate(spec["parts"]):
        add_part(part, np.load(folder / f"part_{number}.npz"), folder)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0, 0, 0, 1)
    for light in spec["lights"]:
        if light["kind"] == "environment":
            set_environment(light, scene.world.node_tree, background)
        else:
            add_light(light)
    set_camera(spec["camera"], scene)
    render(scene, folder, spec["samples"], spec["bounces"], spec["threads"])


def add_part(part: Mapping[str, Any], arrays: Mapping[str, Any], folder: Path) -> None:
    """Add a mesh of separate triangles with the normals and the material of its file."""
    corners = arrays["triangles"].reshape(-1, 3)
    mesh = bpy.data.meshes.new(part["name"])
    mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 3).tolist())
    mesh.shade_smooth()
    mesh.normals_split_custom_set(arrays["normals"].reshape(-1, 3).tolist())
    if part["texture"]:
        layer = mesh.uv_layers.new(name="uv")
        layer.data.foreach_set("uv", arrays["uv"].ravel().astype(np.float32))
    else:
        colours = np.concatenate([arrays["colours"].reshape(-1, 3), np.ones((len(corners), 1))], axis=1)
        layer = mesh.color_attributes.new("colour", "FLOAT_COLOR", "CORNER")
        layer.data.foreach_set("color", colours.ravel().astype(np.float32))
    material = bpy.data.materials.new(part["name"])
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    if part["texture"]:
        colour = nodes.new("ShaderNodeTexImage")
        colour.image = bpy.data.images.load(str(folder / part["texture"]))
        source = colour.outputs["Color"]
    else:
        colour = nodes.new("ShaderNodeVertexColor")
        colour.layer_name = "colour"
        source = colour.outputs["Color"]
    if part["shiny"]:
        bsdf = nodes.new("ShaderNodeBsdfPrincipled")
        bsdf.distribution = "GGX"  # single scattering, as in Mitsuba
        bsdf.inputs["Metallic"].default_value = part["metallic"]
        bsdf.inputs["Roughness"].default_value = part["roughness"]
        bsdf.inputs["IOR"].default_value = (1 + part["reflectance"] ** 0.5) / (1 - part["reflectance"] ** 0.5)
        links.new(source, bsdf.inputs["Base Color"])
    else:
        bsdf = nodes.new("ShaderNodeBsdfDiffuse")
        links.new(source, bsdf.inputs["Color"])
    links.new(bsdf.outputs["BSDF"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(part["name"], mesh))


def set_environment(light: Mapping[str, Any], tree: Any, background: Any) -> None:
    """Set the world to a constant radiance or an equirectangular image."""
    background.inputs["Strength"].default_value = light["radiance"]
    if not light["image"]:
        background.inputs["Color"].default_value = (*light["colour"], 1)
        return
    image = tree.nodes.new("ShaderNodeTexEnvironment")
    image.image = bpy.data.images.load(light["image"])
    tree.links.new(image.outputs["Color"], background.inputs["Color"])


def add_light(light: Mapping[str, Any]) -> None:
    """Add an area light or a spot light."""
    if light["kind"] == "area":
        lamp = bpy.data.lights.new("area", "AREA")
        lamp.shape, (lamp.size, lamp.size_y) = "RECTANGLE", light["size"]
        lamp.energy = light["radiance"] * math.pi * light["size"][0] * light["size"][1]
    else:
        lamp = bpy.data.lights.new("spot", "POINT")
        lamp.shadow_soft_size = 0.0
        lamp.energy = 4 * math.pi * light["intensity"]
        limit_to_cone(lamp, math.radians(light["cone"]))
    lamp.color = light["colour"]
    item = bpy.data.objects.new("light", lamp)
    item.matrix_world = Matrix(light["world_from_light"])
    bpy.context.scene.collection.objects.link(item)


def limit_to_cone(lamp: Any, cone: float) -> None:
    """Restrict a point light to Mitsuba's spot: full intensity within 3/4 of the half angle, then linear to zero."""
    lamp.use_nodes = True
    nodes, links = lamp.node_tree.nodes, lamp.node_tree.links
    emission = nodes["Emission"]
    direction, axis = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeSeparateXYZ")
    links.new(direction.outputs["Normal"], axis.inputs[0])
    angle, share = nodes.new("ShaderNodeMath"), nodes.new("ShaderNodeMapRange")
    angle.operation, share.clamp = "ARCCOSINE", True
    links.new(axis.outputs["Z"], angle.inputs[0])
    links.new(angle.outputs[0], share.inputs["Value"])
    inner, outer = math.pi - 0.75 * cone, math.pi - cone  # the light emits along -z
    for name, value in (("From Min", outer), ("From Max", inner), ("To Min", 0.0), ("To Max", 1.0)):
        share.inputs[name].default_value = value
    links.new(share.outputs[0], emission.inputs["Strength"])


def set_camera(camera: Mapping[str, Any], scene: Any) -> None:
    """Set a pinhole camera and the size of the image."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = camera["fx"] * lens.sensor_width / camera["width"]
    lens.clip_start = 0.001
    item = bpy.data.objects.new("camera", lens)
    item.matrix_world = Matrix(camera["world_from_camera"]) @ Matrix.Diagonal((1, -1, -1, 1))
    scene.collection.objects.link(item)
    scene.camera = item
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    scene.render.resolution_percentage = 100


def render(scene: Any, folder: Path, samples: int, bounces: int, threads: int) -> None:
    """Render without denoiser, clamping and adaptive sampling, and write the linear image."""
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", samples, 1
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = bounces
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.render.film_transparent = True
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = str(folder / "cycles.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Linear Rec.709"
    pixels: Sequence[float] = image.pixels[:]
    width, height = image.size
    np.save(folder / "cycles.npy", np.array(pixels, dtype=np.float32).reshape(height, width, 4)[::-1, :, :3])


if __name__ == "__main__":
    main(Path(sys.argv[-1]))
