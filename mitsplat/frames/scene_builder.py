"""Mitsuba scenes of layouts: shapes of objects and surroundings, emitters, and the background picture.

The latest Mitsuba object of each name is reused as long as its frozen input is the same. Creation and upload can take
longer than a frame, and the integrator reuses data of shapes that are the same object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import ByteImage, Float64Array
from mitsplat.asset import Asset
from mitsplat.frames.background import background_picture
from mitsplat.frames.camera_response import BACKGROUND
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import device_array, make_splats_shape
from mitsplat.renderer.scene_emitters import MitsubaDict, emitter_dict, load_emitter
from mitsplat.renderer.textures import bitmap_texture, finished_mesh, material, texture_image
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import Belt
from mitsplat.scene.planning.frame_lights import expand_rooms
from mitsplat.scene.planning.layout_surroundings import MaterialDraw, draw_surroundings
from mitsplat.scene.planning.object_appearance import ObjectAppearance, draw_appearances
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightSpec
from mitsplat.scene.spec.shape_spec import Shape

Value = TypeVar("Value")

NO_SPLATS = Splats(*SplatArrays(*(np.empty(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), 0, (0, 1, 3)))))
"""Empty splats of a proxy that only receives and casts shadows."""


class SceneBuilder:
    """Builder of the Mitsuba scenes of one scene file. Objects that equal those of the last frame are reused.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._has_moving_lights = any(light.draw for light in expand_rooms(scene.spec))
        self._latest: dict[str, tuple[object, Any]] = {}

    def _reuse(self, name: str, key: object, make: Callable[[], Value]) -> Value:
        """Return the latest object of a name. If it was made for another key, it is made anew."""
        if name not in self._latest or self._latest[name][0] != key:
            self._latest[name] = key, make()
        value: Value = self._latest[name][1]
        return value

    def describe(
        self, layout: Layout, lights: tuple[LightSpec, ...], *, replaced_lights: bool = False, belt: Belt | None = None
    ) -> MitsubaDict:
        """Return Mitsuba's scene dictionary of a layout.

        Args:
            layout: The layout.
            lights: Lights of the frame.
            replaced_lights: True if the lights are not the scene's own. Such lights, and those with random draws, can
                move without recompilation of kernels.
            belt: Conveyor belt at the moment of the frame; its travel shifts its pattern.
        """
        return {
            "type": "scene",
            **self._surroundings(layout.index, belt),
            **self.objects(layout),
            **self.emitters(lights, movable=replaced_lights or self._has_moving_lights),
        }

    def objects(self, layout: Layout) -> dict[str, mi.Shape]:
        """Return the shapes of the objects of a layout by name."""
        return self._reuse("objects", layout, lambda: _object_shapes(self._scene, layout))

    def emitters(self, lights: tuple[LightSpec, ...], *, movable: bool) -> MitsubaDict:
        """Return the emitters of lights by name; movable ones can move without recompilation of kernels."""
        return {f"light_{number}": self._emitter(light, movable) for number, light in enumerate(lights)}

    def background(self, index: int, layout: int, camera: Camera) -> mi.Color3f | float:
        """Return the linear background picture of a frame on the device; a grey if the scene has no background."""
        drawn, size = draw_surroundings(self._scene.spec, index, layout).background, camera.size
        if drawn is None:
            return BACKGROUND
        path = self._scene.images[drawn.image]
        return self._reuse("background", (drawn, size), lambda: device_array(background_picture(drawn, path, *size)))

    def _surroundings(self, layout: int, belt: Belt | None) -> dict[str, mi.Shape]:
        """Return the shapes of the environment, and of visible shapes and proxies of the scene file."""
        scene, spec = self._scene, self._scene.spec
        surroundings, shapes = draw_surroundings(spec, layout * spec.output.views), {}
        environment = scene.environment_of(layout)
        if environment is not None:
            shapes["environment"] = self._reuse(
                "environment", environment, lambda: make_asset_shape(environment, np.eye(4), 0)
            )
        for placed in placed_shapes(scene, layout):
            name, shape = f"shape_{placed.number}", placed.shape
            if shape.visible:
                finish = surroundings.material_of(shape)
                shapes[name] = self._visible_shape(name, shape, placed.stated, finish, belt, placed.motion)
            elif shape.proxy:
                make = partial(make_splats_shape, NO_SPLATS, proxy=placed.mesh)
                shapes[name] = self._reuse(name, placed.motion.tobytes(), make)
        return shapes

    def _visible_shape(
        self,
        name: str,
        shape: Shape,
        mesh: trimesh.Trimesh,
        finish: MaterialDraw,
        belt: Belt | None,
        motion: Float64Array,
    ) -> mi.Shape:
        """Return a shape with its material; the pattern of a belt is shifted by the belt's travel."""
        image, bsdf = self._reuse(f"material of {name}", finish, lambda: _load_material(finish, self._scene.images))
        travel = belt.travel if belt is not None and shape.box == belt.box and image is not None else 0.0
        key = finish, travel, motion.tobytes()
        return self._reuse(name, key, lambda: finished_mesh(mesh, shape, finish, image, bsdf, travel, motion))

    def _emitter(self, light: LightSpec, movable: bool) -> mi.Emitter | mi.Shape:
        """Load the emitter of a light."""
        if not isinstance(light, EnvironmentLight) or light.image is None:
            return load_emitter(emitter_dict(light), movable=movable)
        description = emitter_dict(light.model_copy(update={"image": str(self._scene.images[light.image])}))
        emitter = self._reuse("environment map", description["filename"], lambda: mi.load_dict(description))
        state = mi.traverse(emitter)
        # As a literal constant, each new radiance would recompile the kernels.
        state["scale"], state["to_world"] = dr.opaque(mi.Float, description["scale"]), description["to_world"]
        state.update()
        return emitter


def _load_material(finish: MaterialDraw, images: Mapping[str, Path]) -> tuple[ByteImage | None, mi.BSDF]:
    """Load the pattern of a material, None for a uniform colour, and Mitsuba's material with that pattern."""
    image = texture_image(finish, images)
    return image, mi.load_dict(material(finish, None if image is None else bitmap_texture(image)))


def _object_shapes(scene: Scene, layout: Layout) -> dict[str, mi.Shape]:
    appearances = draw_appearances(scene, layout)
    return {
        f"instance_{instance.id}": make_asset_shape(
            scene.assets[instance.asset], instance.world_from_object, instance.id, appearances.get(instance.id)
        )
        for instance in layout.instances
    }


def make_asset_shape(
    asset: Asset, world_from_asset: Float64Array, instance: int, appearance: ObjectAppearance | None = None
) -> mi.Shape:
    """Create the shape plugin ``splats`` of an asset."""
    return make_splats_shape(
        asset.splats, world_from_asset, asset.mesh, **asset_properties(asset, instance, appearance)
    )


def asset_properties(asset: Asset, instance: int, appearance: ObjectAppearance | None = None) -> MitsubaDict:
    """Return the properties of the shape plugin ``splats`` for an asset; instance 0 is the environment."""
    gloss = {"roughness": float(asset.roughness), "specular": float(asset.specular) if instance else 0.0}
    drawn = appearance.properties() if appearance else {}
    if asset.splats.materials is not None:  # drawn values replace those of all materials
        drawn = {name: value for name, value in drawn.items() if gloss.get(name) != value}
        gloss = {}
    return {"instance": instance, "capture_light": asset.capture_light, **gloss, **drawn}
