"""Path-traced images of the same frames from the textured meshes behind the splats: the expensive upper bound.

    python -m benchmarks.detector.meshes WORK SCENE [--hope ../shared/data/hope] [--frames 128] [--samples 64]
        [--device cuda]

SCENE is one of ``arms.yaml`` with the change ``meshes``. Layouts, appearances, lamps, cameras and their response are
those of the scene, and labels are those of its splats. Objects and their support are path-traced. The walls behind them
are from the splat renderer, because both use a constant sky as their light. Brightness and white balance of an image
match the splat image where no object is. WORK/data/SCENE gets the images and their labels.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

# isort: off
import mitsplat as ms  # which must be imported before Dr.Jit

import numpy as np
from scipy.spatial import KDTree

# isort: on
from benchmarks.detector.experiment import write_scene
from benchmarks.detector.material import wanted_assets
from mitsplat.asset import Asset
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.bake.part_shapes import part_shape
from mitsplat.frames.camera_response import develop
from mitsplat.frames.frame import Frame
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.renderer.path_tracing import render_mesh
from mitsplat.renderer.rays.device_arrays import ray_scene
from mitsplat.renderer.scene_emitters import emitter_dict
from mitsplat.scene.layout import Instance, Layout
from mitsplat.scene.planning.frame_plan import layout_index_of
from mitsplat.scene.planning.object_appearance import ObjectAppearance, draw_appearances
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import BACKDROP

LEAST = 500
"""Least number of object-free pixels to match an image's brightness."""


def main() -> None:
    """Render."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("scene")
    parser.add_argument("--hope", type=Path, default=Path("../shared/data/hope"))
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    ms.use_device(options.device)
    scene = ms.load_scene(write_scene(options.work, options.scene))
    traced = frames(scene, textured(options.hope), range(options.frames), options.samples)
    print(ms.write_frames(scene, options.work / "data" / options.scene, traced, overwrite=True))


def textured(hope: Path) -> dict[str, tuple[MeshPart, ...]]:
    """Return the source meshes of all assets, by name."""
    meshes = {one.name: one.mesh() for one in wanted_assets(hope)}
    return {name: read_model(mesh, up=up).parts for name, (mesh, up) in meshes.items()}


def frames(scene: Scene, parts: Mapping[str, tuple[MeshPart, ...]], indices: range, samples: int) -> Iterator[Frame]:
    """Yield frames of a scene with path-traced images, each with CPU seconds in ``seconds["path"]``."""
    with ms.Renderer(scene) as renderer:
        layout, objects = None, dict[str, Any]()
        for index in indices:
            if layout is None or layout.index != layout_index_of(scene, index):
                layout = ms.settle_layout(scene, layout_index_of(scene, index))
                objects = object_shapes(scene, layout, parts)
            frame, start = renderer.render(index, layout=layout), time.process_time()
            described = renderer.scene_builder.describe(layout, frame.plan.lights)
            room = {name: described[name] for name in described if _stands(scene, name)}
            room |= {f"light_{k}": emitter_dict(light) for k, light in enumerate(frame.plan.lights)}
            radiance, cover = render_mesh(
                ray_scene({**room, **objects}), frame.camera, samples=samples, bounces=6, seed=index
            )
            image = developed(frame, radiance, cover, scene)
            yield replace(frame, image=image, seconds={**frame.seconds, "path": time.process_time() - start})


def developed(frame: Frame, radiance: np.ndarray, cover: np.ndarray, scene: Scene) -> np.ndarray:
    """Develop an image by a frame's camera."""
    empty = (frame.instance == 0) & (cover == 1)
    if empty.sum() < LEAST:
        empty = cover == 1
    gain = np.median(frame.rgb[empty], axis=0) / np.maximum(np.median(radiance[empty], axis=0), 1e-6)
    linear = (gain * radiance + frame.rgb * (1 - cover[..., None])).astype(np.float32)
    return develop(linear, frame.plan.draws, scene.spec.composite, seed=frame.plan.seed)


def _stands(scene: Scene, name: str) -> bool:
    """Return True if a Mitsuba shape supports objects."""
    if not name.startswith("shape_"):
        return False
    shape = scene.spec.shapes[int(name.removeprefix("shape_"))]
    return shape.visible and not shape.name.startswith(BACKDROP)


def object_shapes(scene: Scene, layout: Layout, parts: Mapping[str, tuple[MeshPart, ...]]) -> dict[str, Any]:
    """Return Mitsuba shapes of all objects of a layout in their appearances."""
    looks = draw_appearances(scene, layout)
    shapes = {}
    for one in layout.instances:
        asset = scene.assets[one.asset]
        for number, part in enumerate(parts.get(asset.name) or (primitive(asset),)):
            shapes[f"object_{one.id}_{number}"] = part_shape(_placed(part, one, looks.get(one.id)))
    return shapes


def primitive(asset: Asset) -> MeshPart:
    """Return a primitive that no file holds, coloured by the nearest of its splats."""
    mesh = asset.mesh.subdivide_to_size(0.004)
    _, nearest = KDTree(asset.splats.means).query(mesh.vertices)
    colours = decode_srgb(np.clip(asset.splats.sh[nearest, 0] * SH_C0 + 0.5, 0, 1))
    return MeshPart(asset.name, mesh, colours[mesh.faces], None, 0.0, asset.roughness, True, asset.specular)


def _placed(part: MeshPart, instance: Instance, look: ObjectAppearance | None) -> MeshPart:
    mesh = part.mesh.copy()
    mesh.apply_transform(instance.world_from_object)
    if look is None:
        return replace(part, mesh=mesh)
    matrix = np.array(look.properties().get("colours", "1 0 0 0 1 0 0 0 1").split(), dtype=float).reshape(3, 3)
    part = replace(part, mesh=mesh, roughness=look.roughness, reflectance=look.specular, shiny=look.specular > 0)
    if part.texture is None:
        return replace(part, colours=np.clip(part.colours @ matrix.T, 0, 1))
    colours = encode_srgb(np.clip((decode_srgb(part.texture.pixels / 255.0) * part.factor) @ matrix.T, 0, 1))
    texture = replace(part.texture, pixels=np.rint(255 * colours).astype(np.uint8))
    return replace(part, texture=texture, factor=1.0)


if __name__ == "__main__":
    main()
