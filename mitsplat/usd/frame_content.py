"""Content of one frame of a scene, or of one asset, for simulators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh import prepare_mesh
from mitsplat.images.colour import decode_srgb
from mitsplat.physics.bodies import Body, Collider, make_body, make_collider
from mitsplat.physics.settle import settle_layout, warp_settings
from mitsplat.progress import discard_note
from mitsplat.renderer.textures import texture_image
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.conveyor import layout_at_view
from mitsplat.scene.planning.frame_plan import FramePlan, layout_index_of, plan_frame
from mitsplat.scene.planning.layout_surroundings import LayoutSurroundings, draw_surroundings
from mitsplat.scene.planning.object_appearance import draw_appearances
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LightSpec
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.walls import ENCLOSURE


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """Object of a frame.

    Attributes:
        id: Instance id, from 1.
        asset: Index into the assets of the frame.
        pose: Rigid transform ``world_from_object`` [m], shape (4, 4).
        labelled: True if its class is a label.
    """

    id: int
    asset: int
    pose: Float64Array
    labelled: bool


@dataclass(frozen=True, eq=False)
class StaticShape:
    """Static shape of a frame.

    Attributes:
        name: Name in the scene file.
        mesh: Surface in world space [m].
        collider: Its collider, or None.
        colour: Mean linear colour, or None if the shape is not visible.
        proxy: True if rays of light are traced against it although it is not visible.
    """

    name: str
    mesh: trimesh.Trimesh
    collider: Collider | None
    colour: tuple[float, float, float] | None
    proxy: bool


@dataclass(frozen=True, eq=False)
class FrameContent:
    """Content of a frame for simulators.

    Attributes:
        name: Name of the scene.
        assets: Assets of the objects with their rigid bodies, by index.
        objects: Objects at rest.
        environment: Environment, or None.
        ground: Collider of the environment, or None if it does not collide.
        shapes: Static shapes.
        camera: Camera of the frame, or None.
        lights: Lights of the frame.
        notes: What is not exported, one sentence each.
    """

    name: str
    assets: dict[int, tuple[Asset, Body]]
    objects: tuple[PlacedObject, ...] = ()
    environment: Asset | None = None
    ground: Collider | None = None
    shapes: tuple[StaticShape, ...] = ()
    camera: Camera | None = None
    lights: tuple[LightSpec, ...] = ()
    notes: tuple[str, ...] = ()


def frame_content(scene: Scene, index: int) -> FrameContent:
    """Return the content of frame ``index`` of a scene: objects at rest, colliders, camera and lights.

    Raises:
        InputError: If there is no such frame, or its layout does not settle.
    """
    number = layout_index_of(scene, index)
    layout = layout_at_view(scene, settle_layout(scene, number), index % scene.spec.output.views)
    plan = plan_frame(scene, index, layout)
    environment = scene.environment_of(number)
    with warp_settings():
        used = sorted({instance.asset for instance in layout.instances})
        assets = {asset: (scene.assets[asset], make_body(scene.assets[asset], discard_note)) for asset in used}
        shapes = tuple(_static_shapes(scene, plan))
        ground = None
        if environment is not None and environment.mesh is not None and scene.spec.environment_collides:
            mesh = prepare_mesh(environment.mesh, f"asset {environment.name!r}", solid=False)
            ground = make_collider(environment, mesh, discard_note)
    return FrameContent(
        name=scene.spec.name,
        assets=assets,
        objects=tuple(
            PlacedObject(one.id, one.asset, one.world_from_object, one.class_index is not None)
            for one in layout.instances
        ),
        environment=environment,
        ground=ground,
        shapes=shapes,
        camera=plan.camera,
        lights=plan.lights,
        notes=tuple(_losses(scene, plan, bool(draw_appearances(scene, layout)))),
    )


def _static_shapes(scene: Scene, plan: FramePlan) -> list[StaticShape]:
    """Return the shapes of the scene file without the walls of enclosures, at which no object rests."""
    surroundings, found = draw_surroundings(scene.spec, plan.index), []
    for placed in placed_shapes(scene, plan.layout):
        shape = placed.shape
        if shape.name.startswith(ENCLOSURE):
            continue
        collider = None
        if shape.collider:
            collider = make_collider(shape, prepare_mesh(placed.stated, f"shape {shape.name!r}"), discard_note)
            if shape.is_jittered:
                collider = collider.moved(placed.motion)
        colour = _mean_colour(scene, shape, surroundings) if shape.visible else None
        found.append(StaticShape(shape.name, placed.mesh, collider, colour, shape.proxy))
    return found


def _mean_colour(scene: Scene, shape: Shape, surroundings: LayoutSurroundings) -> tuple[float, float, float]:
    """Return the mean linear colour of a visible shape's material."""
    drawn = surroundings.material_of(shape)
    if drawn.image is not None:
        ensure_variant()  # Mitsuba reads the image
    image = texture_image(drawn, scene.images)
    colours = np.array(drawn.colours[:1]) if image is None else image.reshape(-1, 3) / 255.0
    red, green, blue = decode_srgb(colours).mean(axis=0).tolist()
    return red, green, blue


def _losses(scene: Scene, plan: FramePlan, drawn: bool) -> Sequence[str]:
    """Return what neither USD nor MJCF can hold of a frame."""
    found = []
    if not plan.camera.is_pinhole:
        found.append("the lens distortion of the camera")
    if any(shape.name.startswith(ENCLOSURE) for shape in scene.spec.shapes):
        found.append("the invisible walls of enclosures")
    if drawn:
        found.append("the drawn appearance of objects (hue, wear); objects have the appearance of their assets")
    if any(shape.visible and shape.materials for shape in scene.spec.shapes):
        found.append("patterns of shapes; a shape has the mean colour of its pattern")
    if scene.spec.background is not None:
        found.append("the background image")
    if scene.spec.conveyor is not None:
        found.append("the motion of the conveyor")
    return found
