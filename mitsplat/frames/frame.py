"""Rendering and labelling of one frame of a scene."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.arrays import ByteImage, Float32Array, Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.frames.background import background_picture
from mitsplat.frames.camera_response import BACKGROUND, develop_layers, light_layers
from mitsplat.frames.flow import motions_of, optical_flow, swept_by
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb
from mitsplat.images.masks import Silhouette
from mitsplat.labels.labels import Labels, Truth, label_instances
from mitsplat.labels.overlay import draw_labels
from mitsplat.physics.settle import settle_layout
from mitsplat.quality import Quality, resolve_quality
from mitsplat.renderer.layers import (
    Layers,
    device_array,
    host_array,
    make_integrator,
    make_splats_shape,
    render_layers,
    render_silhouettes,
)
from mitsplat.renderer.lazy_value import LazyValue
from mitsplat.renderer.rays.device_arrays import plain_mesh
from mitsplat.renderer.scene_emitters import emitter_dict, movable
from mitsplat.renderer.textures import bitmap_texture, finished_mesh, material, texture_image
from mitsplat.runtime.variant import ensure_variant, one_at_a_time
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import Belt, carried_instances, layout_at_view
from mitsplat.scene.planning.frame_lights import expand_rooms
from mitsplat.scene.planning.frame_plan import FramePlan, layout_of, plan_frame
from mitsplat.scene.planning.layout_surroundings import (
    BackgroundDraw,
    LayoutSurroundings,
    MaterialDraw,
    draw_surroundings,
    drawn_environment,
)
from mitsplat.scene.planning.object_appearance import ObjectAppearance, draw_appearances
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightEntry, LightSpec
from mitsplat.scene.walls import backdrop_distance

KEPT_LAYOUTS = 4
"""Number of settled layouts that a renderer caches for further views."""

NOTHING = Splats(*(np.empty(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), 0, (0, 1, 3))))
"""Empty splats of a proxy that only receives and casts shadows."""

NOWHERE = LayoutSurroundings()
"""Surroundings of a scene without drawn surroundings."""


@dataclass(frozen=True, eq=False)
class Frame(LazyValue):
    """A labelled picture of H x W pixels with all its inputs. Notebooks display it as an image.

    Layers and the linear picture stay on the device; they are copied to the host at the first access.

    Attributes:
        plan: Camera, lights and random draws.
        layout: Resting poses of the objects.
        layers: Output layers of the integrator.
        rgb: Linear picture before the camera's development, (H, W, 3) float32.
        image: Display-encoded picture, (H, W, 3) uint8.
        labels: Labels of the visible instances.
        seconds: Host time per stage [s]. Device work of one stage may still run during the next stages.
        order_error: Estimated error of the display-encoded colours due to the blending order, before lighting:
            ``largest`` and ``mean``. None if the quality does not estimate it.
        appearances: Drawn appearance of objects, by instance id.
        next_layout: Layout of the next image, None if the objects do not move.
    """

    plan: FramePlan
    layout: Layout
    layers: Layers = field(repr=False)
    rgb: Float32Array
    image: npt.NDArray[np.uint8]
    labels: Labels
    seconds: Mapping[str, float]
    order_error: Mapping[str, float] | None = None
    appearances: Mapping[int, ObjectAppearance] = field(default_factory=dict)
    next_layout: Layout | None = None

    @property
    def index(self) -> int:
        """Index of the frame in its scene."""
        return self.plan.index

    @property
    def camera(self) -> Camera:
        """Camera of the image."""
        return self.plan.camera

    @property
    def draws(self) -> Mapping[str, float]:
        """Random values by name."""
        return self.plan.draws

    @property
    def depth(self) -> Float32Array:
        """Depth along the optical axis [m], 0 for no surface, (H, W)."""
        return self.layers.depth

    @property
    def instance(self) -> npt.NDArray[np.uint16]:
        """Instance id per pixel from the splats, 0 for the environment, (H, W)."""
        return self.layers.instance

    @property
    def proxy_instance(self) -> npt.NDArray[np.uint16]:
        """Instance id per pixel from the proxy meshes, 0 for the environment, (H, W)."""
        return self.layers.proxy_instance

    @property
    def normal(self) -> Float32Array:
        """World-space normal of the proxies, (H, W, 3)."""
        return self.layers.normal

    @property
    def light(self) -> Float32Array:
        """Factor of light and shadow on the linear colour, (H, W, 3)."""
        return self.layers.light

    @property
    def flow(self) -> Float32Array | None:
        """Motion of every pixel to the next image [px], (H, W, 2); None without a next image.

        Both components are 1e10 where the flow is unknown, see :func:`mitsplat.frames.flow.optical_flow`.
        """
        if self.plan.next_camera is None:
            return None
        motions = {} if self.next_layout is None else motions_of(self.layout, self.next_layout)
        belt = self.plan.belt
        ids = self.instance if motions or belt is not None else None
        return optical_flow(self.depth, self.camera, self.plan.next_camera, ids, motions, belt)

    def _repr_png_(self) -> bytes:
        """Return a PNG of the image beside the image with drawn labels."""
        sheet = np.hstack([self.image, draw_labels(self.image, self.labels)])
        _, data = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
        return bytes(data)


def render_frame(
    scene: Scene,
    index: int,
    *,
    quality: str | Quality | None = None,
    layout: Layout | None = None,
    camera: Camera | None = None,
    lights: Sequence[LightEntry] | None = None,
    next_layout: Layout | None = None,
    next_camera: Camera | None = None,
) -> Frame:
    """Render and label one frame with a :class:`Renderer` that is cached for the scene's next frames.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
        index: Frame index, below ``scene.num_frames``.
        quality: Preset of the splat renderer, refined by the scene file's ``rendering``, or a complete `Quality`. By
            default, the preset of the scene file.
        layout: Settled layout of the frame, or a custom one (:meth:`mitsplat.Layout.from_poses`). By default, the
            layout is settled here.
        camera: Camera in place of the scene's.
        lights: Lights in place of the scene's, as in a scene file: models, or mappings of keys to values.
        next_layout: Layout of the next image, for the flow. By default, the objects do not move.
        next_camera: Camera of the next image. By default, the scene's next view of the layout; or ``camera``, if it is
            given and objects move.

    Raises:
        InputError: If the index is out of range, the layout cannot be settled, or the lights break a rule.
    """
    layout_of(scene, index)  # check the index before costly work
    ensure_variant()
    return _cached_renderer(scene, quality, str(mi.variant())).render(
        index, layout=layout, camera=camera, lights=lights, next_layout=next_layout, next_camera=next_camera
    )


@one_at_a_time
@lru_cache(maxsize=2)
def _cached_renderer(scene: Scene, quality: str | Quality | None, _variant: str) -> Renderer:
    return Renderer(scene, quality=quality)


def _exposure_motion(
    layers: Layers, camera: Camera, motion: Mapping[str, Any], layout: Layout, belt: Belt | None
) -> tuple[Float32Array, Float32Array]:
    """Compute the motion of every pixel during the exposure, from camera and belt motion."""
    moving = None
    if belt is not None:
        moving = belt, np.isin(layers.instance, list(carried_instances(layout, belt.box)))
    return swept_by(layers.depth, camera, motion, moving)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


class Renderer:
    """Renderer for the frames of one scene, with cached uploads and shapes.

    As a context manager, it releases the cached data at the end::

        with ms.Renderer(scene, quality="balanced") as renderer:
            frames = [renderer.render(index) for index in range(12)]

    There is no device argument: a process has one Mitsuba variant (see :mod:`mitsplat.runtime.variant`), which all
    renderers share. Call ``ms.use_device("cuda")`` before the first renderer to use the GPU.

    Attributes:
        scene: The scene.
        quality: All values of the splat renderer.
        integrator: Mitsuba's integrator ``splat_proxy``, configured by the scene file.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
        quality: As in :func:`render_frame`.

    Raises:
        InputError: If the preset does not exist, or the selected Mitsuba variant cannot run the plugins.
    """

    def __init__(self, scene: Scene, *, quality: str | Quality | None = None) -> None:
        if not isinstance(quality, Quality):
            quality = replace(resolve_quality(quality or scene.spec.quality), **scene.spec.rendering.model_dump())
        ensure_variant()
        self.scene = scene
        self.quality = quality
        self._variant = mi.variant()
        self.integrator = make_integrator(quality=quality, **light_properties(scene))
        self._cached_surroundings: tuple[LayoutSurroundings, dict[str, Any]] | None = None
        self._belt_pattern: tuple[int, MaterialDraw, ByteImage, Any] | None = None  # of a belt
        self._cached_background: tuple[BackgroundDraw, Any] | None = None
        self._cached_objects: tuple[Layout, dict[str, Any]] | None = None
        self._layouts: dict[int, Layout] = {}
        self._cached_environment_map: tuple[str, Any] | None = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        (
            self.integrator,
            self._cached_surroundings,
            self._cached_objects,
            self._cached_environment_map,
            self._cached_background,
        ) = None, None, None, None, None
        self._belt_pattern = None
        self._layouts.clear()

    @one_at_a_time
    def render(
        self,
        index: int,
        *,
        layout: Layout | None = None,
        camera: Camera | None = None,
        lights: Sequence[LightEntry] | None = None,
        next_layout: Layout | None = None,
        next_camera: Camera | None = None,
    ) -> Frame:
        """Render and label one frame; see :func:`render_frame`.

        Raises:
            InputError: As in :func:`render_frame`; also if the renderer is closed, or if the Mitsuba variant has
                changed since its creation.
        """
        if self.integrator is None:
            raise InputError("the renderer is closed: render before its `with` ends")
        if mi.variant() != self._variant:
            raise InputError(f"the renderer was made in Mitsuba's variant {self._variant} (got {mi.variant()} by now)")
        seconds: dict[str, float] = {}
        if layout is None:
            with _timed(seconds, "settle"):
                layout = self._settle(layout_of(self.scene, index))
        layout, following = self._at_moment(layout, index)
        next_layout = following if next_layout is None else next_layout
        with _timed(seconds, "place"):
            plan = plan_frame(
                self.scene,
                index,
                layout,
                camera=camera,
                next_layout=next_layout,
                next_camera=next_camera,
                lights=lights,
            )
            # A scene has few parts, so that loading them serially is faster than waking threads.
            mitsuba_scene = mi.load_dict(
                self.describe(layout, plan.lights, lights is not None, plan.belt), parallel=False
            )
        with _timed(seconds, "render"):
            layers = render_layers(self.integrator, mitsuba_scene, plan.camera, seed=plan.seed)
        with _timed(seconds, "composite"):
            motion = plan.viewpoint.get("motion")
            swept = None if motion is None else _exposure_motion(layers, plan.camera, motion, layout, plan.belt)
            composite, shape = self.scene.spec.composite, layers.shape
            behind = self._background(draw_surroundings(self.scene.spec, index, layout.index).background, plan.camera)
            linear = light_layers(layers, composite, behind)
            development = develop_layers(
                linear,
                shape,
                plan.draws,
                tone=composite.tone,
                sensor=composite.sensor,
                seed=plan.seed,
                swept=swept,
                metered=composite.exposure == "auto",
            )
        with _timed(seconds, "silhouettes"):
            silhouettes = render_silhouettes(
                self.integrator, mitsuba_scene, plan.camera, source=self.scene.spec.labels.source
            )
        with _timed(seconds, "label"):
            labels = self._label(layers, silhouettes, layout, plan)
        with _timed(seconds, "composite"):
            image = development.image()
        made = {"plan": plan, "layout": layout, "layers": layers, "image": image, "labels": labels, "seconds": seconds}
        made["order_error"] = layers.order_error
        made["appearances"] = draw_appearances(self.scene, layout)
        return Frame.later({"rgb": partial(host_array, linear, shape)}, **made, next_layout=next_layout)

    def _at_moment(self, layout: Layout, index: int) -> tuple[Layout, Layout | None]:
        """Return the layout at a frame's moment and at the next view's moment; None for the latter if nothing moves."""
        spec = self.scene.spec
        view = index - layout_of(self.scene, index) * spec.output.views
        here = layout_at_view(spec, layout, view)
        after = layout_at_view(spec, layout, min(view + 1, spec.output.views - 1))
        return here, None if after is here else after

    def _settle(self, index: int) -> Layout:
        """Settle a layout and cache it for its next views."""
        if index not in self._layouts:
            while len(self._layouts) >= KEPT_LAYOUTS:
                del self._layouts[next(iter(self._layouts))]
            self._layouts[index] = settle_layout(self.scene, index)
        return self._layouts[index]

    def _label(self, layers: Layers, silhouettes: Mapping[int, Silhouette], layout: Layout, plan: FramePlan) -> Labels:
        scene, rules = self.scene, self.scene.spec.labels
        if rules.source == "splats":  # the depth that is not used stays on the device
            truth = Truth(layers.instance, layers.proxy_instance, silhouettes, layers.depth)
        else:
            truth = Truth(layers.proxy_instance, layers.instance, silhouettes, layers.proxy_depth)
        return label_instances(
            truth,
            layout.instances,
            scene.class_names,
            rules,
            camera=plan.camera,
            keypoints={i: asset.keypoint_array for i, asset in enumerate(scene.assets) if asset.keypoints},
        )

    def describe(
        self, layout: Layout, lights: tuple[LightSpec, ...], replaced: bool = False, belt: Belt | None = None
    ) -> dict[str, Any]:
        """Return Mitsuba's scene dictionary of a layout under given lights.

        Shape objects are reused as long as the layout is the same. The pattern of a ``belt`` is shifted by the belt's
        travel. With ``replaced``, the lights are not the scene's own. Such lights can move without recompilation of
        kernels.
        """
        if self._cached_objects is None or self._cached_objects[0] is not layout:
            objects, appearances = {}, draw_appearances(self.scene, layout)
            for instance in layout.instances:
                asset = self.scene.assets[instance.asset]
                objects[f"instance_{instance.id}"] = _asset_shape(
                    asset, instance.world_from_object, instance.id, appearances.get(instance.id)
                )
            self._cached_objects = layout, objects
        emitters = {
            f"light_{i}": self._cached_emitter(self._emitter(light), replaced) for i, light in enumerate(lights)
        }
        place = draw_surroundings(self.scene.spec, layout.index * self.scene.spec.output.views)
        surroundings = self._surroundings(place)
        return {"type": "scene", **surroundings, **self._belt_shape(belt), **self._cached_objects[1], **emitters}

    def _belt_shape(self, belt: Belt | None) -> dict[str, Any]:
        """Return the shape of a belt with its shifted pattern; empty if the belt has no pattern."""
        if belt is None or self._belt_pattern is None:
            return {}
        number, finish, image, bsdf = self._belt_pattern
        shape, mesh = self.scene.spec.shapes[number], self.scene.shape_meshes[number]
        return {f"shape_{number}": finished_mesh(mesh, shape, finish, image, bsdf, belt.travel)}

    def _emitter(self, light: LightSpec) -> dict[str, Any]:
        if isinstance(light, EnvironmentLight) and light.image is not None:
            light = light.model_copy(update={"image": str(self.scene.images[light.image])})
        return emitter_dict(light)

    def _cached_emitter(self, emitter: dict[str, Any], replaced: bool) -> Any:
        """Return an emitter, with the last environment map reused if its file is the same.

        Loading a large map can take longer than a frame. Lights with random draws are built so that their motion does
        not recompile kernels.
        """
        if emitter["type"] != "envmap":
            moves = replaced or any(light.draw for light in expand_rooms(self.scene.spec))
            return movable(emitter) if moves else emitter
        if self._cached_environment_map is None or self._cached_environment_map[0] != emitter["filename"]:
            self._cached_environment_map = emitter["filename"], mi.load_dict(emitter)
        state = mi.traverse(self._cached_environment_map[1])
        # As a literal constant, each new radiance would recompile the kernels.
        state["scale"], state["to_world"] = dr.opaque(mi.Float, emitter["scale"]), emitter["to_world"]
        state.update()
        return self._cached_environment_map[1]

    def _background(self, backing: BackgroundDraw | None, camera: Camera) -> Any:
        """Return the background picture on the device, cached until it changes."""
        if backing is None:
            return BACKGROUND
        if self._cached_background is None or self._cached_background[0] != backing:
            picture = background_picture(backing, self.scene.images[backing.image], camera.width, camera.height)
            self._cached_background = backing, device_array(picture)
        return self._cached_background[1]

    def _surroundings(self, place: LayoutSurroundings) -> dict[str, Any]:
        """Return the static shapes of the surroundings, cached until their appearance changes."""
        place = replace(place, background=None)
        if self._cached_surroundings is None or self._cached_surroundings[0] != place:
            self._cached_surroundings = place, self._static_shapes(place)
            self.integrator.white = white_irradiance(self.scene, place)
        return self._cached_surroundings[1]

    def _static_shapes(self, place: LayoutSurroundings) -> dict[str, Any]:
        shapes: dict[str, Any] = {}
        conveyor, self._belt_pattern = self.scene.spec.conveyor, None
        environment = drawn_environment(self.scene, place)
        if environment is not None:
            shapes["environment"] = _asset_shape(environment, np.eye(4), 0)
        for i, (shape, mesh) in enumerate(zip(self.scene.spec.shapes, self.scene.shape_meshes, strict=True)):
            if shape.visible and (finish := place.material_of(shape.name)) is not None:
                image = texture_image(finish, self.scene.images)
                bsdf = mi.load_dict(material(finish, None if image is None else bitmap_texture(image)))
                shapes[f"shape_{i}"] = finished_mesh(mesh, shape, finish, image, bsdf)
                if conveyor is not None and shape.name == conveyor.belt and image is not None:
                    self._belt_pattern = i, finish, image, bsdf
            elif shape.visible:
                shapes[f"shape_{i}"] = _visible_shape(shape.colour, mesh)
            elif shape.proxy:
                shapes[f"shape_{i}"] = make_splats_shape(NOTHING, proxy=mesh)
        return shapes


def _asset_shape(
    asset: Asset, world_from_asset: Float64Array, instance: int, appearance: ObjectAppearance | None = None
) -> Any:
    own = {"roughness": float(asset.roughness), "specular": float(asset.specular) if instance else 0.0}
    return make_splats_shape(
        asset.splats,
        world_from_asset,
        asset.mesh,
        instance=instance,
        capture_light=asset.capture_light,
        **(own | (appearance.properties() if appearance else {})),
    )


def _visible_shape(colour: tuple[float, float, float], mesh: trimesh.Trimesh) -> Any:
    """Build a uniformly diffuse mesh; its colour is display-encoded, as in the scene file."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": decode_srgb(colour).tolist()}}
    )
    return plain_mesh(mesh, props)


def light_properties(scene: Scene, place: LayoutSurroundings = NOWHERE) -> dict[str, Any]:
    """Return the lighting properties of the integrator ``splat_proxy`` from the scene file."""
    composite = scene.spec.composite
    return {
        "shadow": "none" if composite.shadow == "none" else "traced",
        "shadow_error": composite.shadow_error,
        "metered": composite.exposure == "auto",
        "occluders": composite.occluders,
        "bounce": composite.bounce,
        "highlight": composite.highlight,
        "reference": list(reference_point(scene)),
        # A sky inside a room represents light reflected by the walls. Walls must not occlude it, but near objects must.
        "sky_reach": backdrop_distance(scene.spec, reference_point(scene)) / 2,
        "white": white_irradiance(scene, place),
        # Pixels without splats show the background of mitsplat.frames.camera_response, not a light source.
        "hide_emitters": True,
    }


def white_irradiance(scene: Scene, place: LayoutSurroundings) -> float:
    """Return the irradiance [W/m^2] of display white in the surroundings, or 0 if it is unknown or not used.

    The image-space shadow does not use it, because it only evaluates light relative to the brightest value.
    """
    environment = drawn_environment(scene, place)
    if environment is None or scene.spec.composite.shadow == "image":
        return 0.0
    return environment.white or 0.0


def reference_point(scene: Scene) -> tuple[float, float, float]:
    """Return the point at which uniformly captured colours are unchanged [m]: below the middle of the drop region."""
    low, high = np.array(scene.spec.region.min), np.array(scene.spec.region.max)
    x, y = (low + high)[:2] / 2
    return float(x), float(y), float(low[2])
