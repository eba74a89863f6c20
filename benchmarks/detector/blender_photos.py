"""Renders the scenes of ``benchmarks.detector.cycles_photos`` with Blender Cycles, in an environment with ``bpy``.

    python -P blender_photos.py INPUTS PHOTOS PROCESSES THREADS K [DEVICE]

Process K of PROCESSES renders its share of the photographs that are missing: ``PHOTOS/scene_NNNN_VVVV.jpg``, and the
number of the part at every pixel centre in ``PHOTOS/.scene_NNNN_VVVV.npz``. DEVICE is CPU, the default, or a kind of
GPU that Cycles knows, such as CUDA.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix


def main(inputs: Path, photos: Path, processes: int, threads: int, process: int, device: str) -> None:
    """Render the share of a process."""
    views = [
        (path, view)
        for path in sorted(inputs.glob("scene_*.json"))
        for view in range(len(json.loads(path.read_text())["views"]))
    ]
    mine = views[process * len(views) // processes : (process + 1) * len(views) // processes]
    built = None
    for path, view in mine:
        target = photos / f"{path.stem}_{view:04d}.jpg"
        if target.exists():
            continue
        begun, used = time.time(), time.process_time()
        spec = json.loads(path.read_text())
        if built != path:
            build_scene(spec, inputs)
            use_device(device)
            built = path
        photograph(spec["views"][view], spec["samples"], target, threads)
        print(f"{target.stem}: {time.time() - begun:.1f} s, {time.process_time() - used:.1f} CPU s", file=sys.stderr)


def use_device(device: str) -> None:
    """Render on all GPUs of a kind, or on the CPU."""
    bpy.context.scene.cycles.device = "CPU" if device == "CPU" else "GPU"
    if device == "CPU":
        return
    preferences = bpy.context.preferences.addons["cycles"].preferences
    preferences.compute_device_type = device
    preferences.refresh_devices()
    for one in preferences.devices:
        one.use = one.type == device
    if not any(one.use for one in preferences.devices):
        raise SystemExit(f"Cycles finds no {device} device")


def build_scene(spec: Mapping[str, Any], inputs: Path) -> None:
    """Replace everything by the objects of a scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = spec["world"]
    for one in spec["objects"]:
        mesh = load_mesh(inputs / one["mesh"])
        mesh.materials.append(make_material(one["material"], inputs))
        item = bpy.data.objects.new(one["mesh"], mesh)
        item.matrix_world = Matrix(one["pose"])
        item.pass_index = one["index"]
        scene.collection.objects.link(item)


def load_mesh(path: Path) -> Any:
    """Return a mesh of separate triangles with the normals and texture coordinates of its file."""
    arrays = np.load(path)
    corners = arrays["triangles"].reshape(-1, 3)
    mesh = bpy.data.meshes.new(path.stem)
    mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 3).tolist())
    mesh.shade_smooth()
    mesh.normals_split_custom_set(arrays["normals"].reshape(-1, 3).tolist())
    if "uv" in arrays:
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", arrays["uv"].ravel())
    return mesh


class Nodes:
    """Builder of a material's node tree."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()

    def add(self, kind: str, inputs: Mapping[Any, Any] | None = None, **settings: Any) -> Any:
        """Add a node; inputs are values, or outputs of other nodes."""
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for key, value in settings.items():
            setattr(node, key, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def noise(self, place: Any, scale: float, detail: float = 4.0, stretch: tuple[float, ...] = ()) -> Any:
        """Return a noise of about 0.3 to 0.7, features of 1 / ``scale`` [m]."""
        where = self.stretched(place, stretch) if stretch else place
        return self.add("TexNoise", {"Vector": where, "Scale": scale, "Detail": detail}).outputs[0]

    def stretched(self, place: Any, stretch: tuple[float, ...]) -> Any:
        """Return coordinates with a factor along each axis."""
        return self.add("Mapping", {"Vector": place, "Scale": stretch}).outputs[0]

    def math(self, operation: str, a: Any, b: Any = 0.0) -> Any:
        """Combine two numbers."""
        return self.add("Math", {0: a, 1: b}, operation=operation).outputs[0]

    def ramp(self, value: Any, low: float, high: float, to_low: float = 0.0, to_high: float = 1.0) -> Any:
        """Map a value linearly from one interval to another, and clamp it."""
        inputs = {"Value": value, "From Min": low, "From Max": high, "To Min": to_low, "To Max": to_high}
        return self.add("MapRange", inputs, clamp=True).outputs[0]

    def mix(self, share: Any, a: Any, b: Any, blend: str = "MIX") -> Any:
        """Mix two colours."""
        return self.add("Mix", {0: share, 6: a, 7: b}, data_type="RGBA", blend_type=blend).outputs[2]


def make_material(spec: Mapping[str, Any], inputs: Path) -> Any:
    """Return an emitter, or a Principled BSDF with a pattern, uneven roughness, rounded edges, wear and dirt."""
    key = json.dumps(spec, sort_keys=True)
    if key in bpy.data.materials:
        return bpy.data.materials[key]
    nodes = Nodes(key[:60])
    if "emission" in spec:
        colour = nodes.add("Blackbody", {"Temperature": spec["temperature"]}).outputs[0]
        shader = nodes.add("Emission", {"Color": colour, "Strength": spec["emission"]})
        nodes.add("OutputMaterial", {"Surface": shader.outputs[0]})
        return nodes.material
    metallic, wear = spec["metallic"], spec.get("wear", 0.3)
    place = nodes.add("TexCoord").outputs["Object"]
    chance = nodes.add("ObjectInfo").outputs["Random"]
    place = nodes.add("VectorMath", {0: place, 1: nodes.math("MULTIPLY", chance, 7.0)}, operation="ADD").outputs[0]
    colour = (*spec["colour"], 1.0)
    second = (*spec.get("second", [0.6 * value for value in spec["colour"]]), 1.0)
    if "texture" in spec:
        image = nodes.add("TexImage", image=bpy.data.images.load(str(inputs / spec["texture"]), check_existing=True))
        base = image.outputs[0]
    else:
        base = nodes.mix(pattern_of(nodes, spec["pattern"], place), colour, second)
    # Stains and dust, in patches of about 2 cm, and differences between instances.
    stains = nodes.ramp(nodes.noise(place, 45.0, 3.0), 0.5, 0.7, 0.0, 0.55 * wear)
    dirt = (0.05, 0.04, 0.03, 1.0) if metallic else (0.22, 0.19, 0.16, 1.0)
    base = nodes.mix(stains, base, nodes.mix(0.6, base, dirt))
    shade = nodes.add("CombineColor", {k: nodes.ramp(chance, 0, 1, 0.82, 1.08) for k in range(3)}).outputs[0]
    base = nodes.mix(1.0, base, shade, "MULTIPLY")
    # Rounded edges reflect light, and are worn to bare metal or to a lighter colour.
    smooth = nodes.add("Bevel", {"Radius": 0.0004}, samples=4).outputs[0]
    face = nodes.add("NewGeometry").outputs["Normal"]
    edge = nodes.add("VectorMath", {0: smooth, 1: face}, operation="DOT_PRODUCT").outputs["Value"]
    rubbed = nodes.math(
        "ADD", nodes.math("SUBTRACT", 1.0, edge), nodes.ramp(nodes.noise(place, 150.0, 1.0), 0.4, 0.7, -0.08, 0.06)
    )
    rubbed = nodes.ramp(rubbed, 0.02, 0.1, 0.0, 0.7 * wear)
    bare = (0.56, 0.55, 0.53, 1.0) if metallic else (*(min(1.0, 1.5 * value + 0.05) for value in spec["colour"]), 1.0)
    if "texture" not in spec:
        base = nodes.mix(rubbed, base, bare)
    rough = spec["roughness"]
    uneven = nodes.ramp(nodes.noise(place, 70.0, 4.0), 0.3, 0.7, 0.75 * rough, min(1.0, 1.3 * rough))
    uneven = nodes.math("ADD", uneven, nodes.math("MULTIPLY", stains, 0.3))
    scratches = nodes.noise(place, 60.0, 4.0, (1.0, 18.0, 18.0)) if metallic else nodes.noise(place, 900.0, 1.0)
    normal = nodes.add(
        "Bump", {"Strength": 0.05 + 0.1 * wear, "Distance": 0.0004, "Height": scratches, "Normal": smooth}
    ).outputs[0]
    seen = nodes.add(
        "BsdfPrincipled", {"Base Color": base, "Metallic": metallic, "Roughness": uneven, "Normal": normal}
    )
    # Reflections and indirect light need no detail, which takes most of the time.
    far = nodes.add(
        "BsdfPrincipled",
        {"Base Color": image.outputs[0] if "texture" in spec else colour, "Metallic": metallic, "Roughness": rough},
    )
    direct = nodes.add("LightPath").outputs["Is Camera Ray"]
    shader = nodes.add("MixShader", {0: direct, 1: far.outputs[0], 2: seen.outputs[0]})
    nodes.add("OutputMaterial", {"Surface": shader.outputs[0]})
    return nodes.material


def pattern_of(nodes: Nodes, pattern: str, place: Any) -> Any:
    """Return the share of the second colour."""
    black, white = (0, 0, 0, 1), (1, 1, 1, 1)
    if pattern == "wood":
        bent = nodes.noise(place, 3.0, 3.0, (0.5, 4.0, 4.0))
        where, distortion = nodes.stretched(place, (0.4, 9.0, 9.0)), nodes.math("MULTIPLY", bent, 30.0)
        wave = {"Vector": where, "Scale": 2.0, "Distortion": distortion, "Detail": 3.0}
        rings = nodes.add("TexWave", wave, bands_direction="Y").outputs[0]
        fibres = nodes.ramp(nodes.noise(place, 60.0, 4.0, (0.06, 1, 1)), 0.3, 0.7, 0.3, 1.0)
        return nodes.math("MULTIPLY", rings, fibres)
    if pattern == "spangle":
        return nodes.ramp(
            nodes.add("TexVoronoi", {"Vector": place, "Scale": 90.0}).outputs["Color"], 0.0, 1.0, 0.0, 0.8
        )
    if pattern == "speckle":
        return nodes.ramp(nodes.noise(place, 260.0, 4.0), 0.5, 0.62)
    if pattern == "chips":
        return nodes.ramp(nodes.noise(place, 22.0, 6.0), 0.6, 0.615)
    if pattern == "grid":
        cells = {"Scale": 100.0, "Mortar Size": 0.04, "Brick Width": 1.0, "Row Height": 1.0}
        colours = {"Color1": black, "Color2": black, "Mortar": white}
        return nodes.add("TexBrick", {"Vector": place} | cells | colours, offset=0.0).outputs[0]
    if pattern == "checker":
        cells = {"Vector": place, "Color1": black, "Color2": white, "Scale": 45.0}
        return nodes.add("TexChecker", cells).outputs[0]
    if pattern == "weave":
        bands = [
            nodes.add("TexWave", {"Vector": place, "Scale": 120.0}, bands_direction=axis).outputs[0] for axis in "XY"
        ]
        return nodes.math("MULTIPLY", nodes.math("ADD", *bands), 0.3)
    if pattern == "cardboard":
        return nodes.math("MULTIPLY", nodes.ramp(nodes.noise(place, 30.0, 6.0, (0.2, 5, 1)), 0.35, 0.65), 0.35)
    if pattern == "print":
        # Rows of dark blocks, as text and symbols seen from afar.
        where = {"Vector": nodes.stretched(place, (0.35, 1, 1)), "Scale": 320.0}
        cells = nodes.add("TexVoronoi", where, distance="CHEBYCHEV").outputs["Color"]
        rows = nodes.ramp(
            nodes.add("TexWave", {"Vector": place, "Scale": 30.0}, bands_direction="Y").outputs[0], 0.5, 0.55
        )
        there = nodes.ramp(nodes.noise(place, 14.0, 1.0), 0.5, 0.51)
        return nodes.math("MULTIPLY", nodes.math("MULTIPLY", nodes.ramp(cells, 0.45, 0.5), rows), there)
    return nodes.math("MULTIPLY", nodes.ramp(nodes.noise(place, 25.0, 4.0), 0.3, 0.7), 0.25)


def photograph(view: Mapping[str, Any], samples: int, target: Path, threads: int) -> None:
    """Render the part at each pixel centre, then the photograph."""
    scene = bpy.context.scene
    render = scene.render
    render.engine = "CYCLES"
    render.threads_mode, render.threads = "FIXED", threads
    render.use_persistent_data = True
    render.resolution_x, render.resolution_y, render.resolution_percentage = view["width"], view["height"], 100
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    set_camera(view, scene)
    cycles = scene.cycles
    cycles.seed = view["seed"] % 2**20
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 5, 3, 4
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect, cycles.use_light_tree = 10.0, False
    cycles.use_adaptive_sampling, cycles.adaptive_threshold, cycles.adaptive_min_samples = True, 0.02, 16
    image = target.with_suffix(".exr")
    scene.camera.data.dof.use_dof = render.use_motion_blur = cycles.use_denoising = False
    cycles.samples, cycles.pixel_filter_type, cycles.filter_width = 1, "BOX", 0.01
    index = np.rint(rendered(scene, image, "IndexOB")[..., 0]).astype(np.uint8)
    np.savez_compressed(target.with_name(f".{target.stem}.npz"), index=index)

    scene.camera.data.dof.use_dof, render.use_motion_blur = True, view["shake"] is not None
    cycles.samples, cycles.pixel_filter_type, cycles.filter_width = samples, "BLACKMAN_HARRIS", 1.5
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    light = rendered(scene, image, "Image")[..., :3]
    image.unlink()
    develop(light, view, target)


def set_camera(view: Mapping[str, Any], scene: Any) -> None:
    """Set the lens, and the pose at frame 1; a shake moves linearly from frame 0 to 2 and exposes half of this."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", view["sensor"]
    lens.lens = view["fx"] * lens.sensor_width / view["width"]
    lens.clip_start = 0.01
    lens.dof.focus_distance, lens.dof.aperture_fstop = view["focus"], view["fstop"]
    item = bpy.data.objects.new("camera", lens)
    item.rotation_mode = "QUATERNION"
    scene.collection.objects.link(item)
    scene.camera = item
    flip = Matrix.Diagonal((1, -1, -1, 1))
    if view["shake"]:
        for frame, pose in zip((0, 2), view["shake"], strict=True):
            item.matrix_world = Matrix(pose) @ flip
            item.keyframe_insert("location", frame=frame)
            item.keyframe_insert("rotation_quaternion", frame=frame)
        for line in item.animation_data.action.fcurves:
            for key in line.keyframe_points:
                key.interpolation = "LINEAR"
        scene.render.motion_blur_shutter = 1.0
    else:
        item.matrix_world = Matrix(view["world_from_camera"]) @ flip
    scene.frame_set(1)


def rendered(scene: Any, path: Path, output: str) -> np.ndarray:
    """Render an output of the view layer; return the linear image (H, W, 4)."""
    scene.view_layers[0].use_pass_object_index = True
    scene.use_nodes = True
    tree = scene.node_tree
    tree.nodes.clear()
    layers, sink = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeComposite")
    tree.links.new(layers.outputs[output], sink.inputs["Image"])
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Linear Rec.709"
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def develop(light: np.ndarray, view: Mapping[str, Any], target: Path) -> None:
    """Expose for the middle of the image, balance its white, add vignetting, blur and noise, and save it as JPEG."""
    rng = np.random.default_rng(view["seed"])
    height, width = light.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    weight = np.exp(-(x**2 + y**2))
    # Partial adaptation to the colour of the light, as the grey-world rule.
    mean = (light * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
    light = light * (mean.mean() / np.maximum(mean, 1e-6)) ** (0.7 * view["adapted"]) * view["white_balance"]
    metered = float(np.exp((weight * np.log(light.mean(axis=2) + 1e-4)).sum() / weight.sum()))
    light = light * 0.18 / metered * 2 ** view["exposure"]
    light = light * (1 - view["vignette"] * (x**2 + y**2) / 2)[..., None]
    light = blurred(light, view["blur"])
    grain = blurred(rng.normal(size=light.shape), 0.6)
    grain *= view["noise"] / grain.std() * np.sqrt(3e-4 * light.clip(0, 4) + 1e-5)
    pixels = np.concatenate([np.maximum(light + grain, 0), np.ones((height, width, 1))], axis=2)
    scene = bpy.context.scene
    scene.view_settings.view_transform, scene.view_settings.look = view["tone"], view["look"]
    settings = scene.render.image_settings
    settings.file_format, settings.quality, settings.color_mode = "JPEG", view["quality"], "RGB"
    image = bpy.data.images.new("photo", width, height, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    image.pixels.foreach_set(pixels[::-1].ravel().astype(np.float32))
    unfinished = target.with_suffix(".part.jpg")
    image.save_render(str(unfinished), scene=scene)
    unfinished.rename(target)
    bpy.data.images.remove(image)


def blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image with a normal distribution of ``sigma`` [px]."""
    weights = np.exp(-0.5 * (np.arange(-3, 4) / sigma) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        edges = [(3, 3) if k == axis else (0, 0) for k in range(3)]
        padded = np.pad(image, edges, mode="edge")
        length = image.shape[axis]
        image = sum(w * padded.take(range(k, k + length), axis=axis) for k, w in enumerate(weights))
    return image


if __name__ == "__main__":
    count, cores, mine = (int(word) for word in sys.argv[3:6])
    main(Path(sys.argv[1]), Path(sys.argv[2]), count, cores, mine, sys.argv[6] if len(sys.argv) > 6 else "CPU")
