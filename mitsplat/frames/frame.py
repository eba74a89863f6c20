"""One frame of a scene, from its plan to picture and labels."""

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
from mitsplat.frames.rolling_shutter import Band, bands_of, project_by_row, stacked_silhouettes
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb
from mitsplat.images.masks import Silhouette
from mitsplat.labels.labels import Labels, Projection, Truth, label_instances
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
from mitsplat.scene.layout import Instance, Layout
from mitsplat.scene.planning.conveyor import Belt, carried, carried_by, carried_instances
from mitsplat.scene.planning.frame_lights import written_out
from mitsplat.scene.planning.frame_plan import FramePlan, layout_of, plan_frame
from mitsplat.scene.planning.layout_surroundings import (
    BackgroundDraw,
    LayoutSurroundings,
    MaterialDraw,
    draw_place,
    environment_at,
)
from mitsplat.scene.planning.object_appearance import ObjectAppearance, draw_appearances
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightEntry, LightSpec
from mitsplat.scene.walls import backdrop_distance

KEPT_LAYOUTS = 4
"""Settled layouts that a renderer keeps for further views of them."""

NOTHING = Splats(*(np.empty(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), 0, (0, 1, 3))))
"""Splats of a proxy that only receives and casts shadows."""

NOWHERE = LayoutSurroundings()
"""The place of a scene that draws none."""


@dataclass(frozen=True, eq=False)
class Frame(LazyValue):
    """A labelled picture of H x W pixels with everything that it was made from. In a notebook it shows itself.

    Layers and linear picture stay on the device, and come to the host when they are first looked at.

    Attributes:
        plan: Camera, lights and random draws.
        layout: Where the objects came to rest.
        layers: What the integrator made of the view.
        rgb: Linear picture before the camera's development, (H, W, 3) float32.
        image: Display-encoded picture, (H, W, 3) uint8.
        labels: Labels of the visible instances.
        seconds: Time of the host per stage [s]; the device may still work at what a stage began in the next ones.
        order_error: Estimated error of the pixels' display-encoded colours that the order of blending leaves, before
            light: ``largest`` and ``mean``. None where the quality estimates none.
        appearances: What was drawn of the appearance of objects, by instance id.
        next_layout: Where the objects lie in the image that follows, None if they stay.
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
        """Where the image is taken from."""
        return self.plan.camera

    @property
    def draws(self) -> Mapping[str, float]:
        """Random values by name."""
        return self.plan.draws

    @property
    def depth(self) -> Float32Array:
        """Depth along the optical axis [m], 0 where nothing is, (H, W)."""
        return self.layers.depth

    @property
    def instance(self) -> npt.NDArray[np.uint16]:
        """Instance id per pixel, 0 for the environment, (H, W)."""
        return self.layers.instance

    @property
    def proxy_instance(self) -> npt.NDArray[np.uint16]:
        """The same from the proxy meshes, (H, W)."""
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
        """Motion of every pixel to the image that follows [px], (H, W, 2); None if none follows.

        Nor if its rows are not exposed at once. Components are 1e10 where it is unknown, see
        :func:`mitsplat.frames.flow.optical_flow`.
        """
        if self.plan.next_camera is None or "readout" in self.plan.viewpoint.get("motion", {}):
            return None
        motions = {} if self.next_layout is None else motions_of(self.layout, self.next_layout)
        belt = self.plan.belt
        ids = self.instance if motions or belt is not None else None
        return optical_flow(self.depth, self.camera, self.plan.next_camera, ids, motions, belt)

    def _repr_png_(self) -> bytes:
        """The image and, beside it, its labels drawn over it."""
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
    """Render and label one frame, by a :class:`Renderer` that is kept for the next one of the scene.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
        index: Frame index, below ``scene.num_frames``.
        quality: Preset of the splat renderer, which the scene file's ``rendering`` refines, or all its values; the
            preset of the scene file by default.
        layout: The frame's settled layout, or one of your own (:meth:`mitsplat.Layout.of_poses`); settled here when not
            given.
        camera: In place of the scene's.
        lights: Entries in place of the scene's, as in a scene file: models, or mappings of keys to values.
        next_layout: Where the objects lie in the image that follows, for the flow; they stay when not given.
        next_camera: Where that image is taken from; by default the scene's next view of the layout, or ``camera`` if
            that is given and objects move.

    Raises:
        InputError: If the index is out of range, the layout cannot be settled, or the lights break a rule.
    """
    layout_of(scene, index)  # a wrong index costs nothing
    ensure_variant()
    return _kept_renderer(scene, quality, str(mi.variant())).render(
        index, layout=layout, camera=camera, lights=lights, next_layout=next_layout, next_camera=next_camera
    )


@one_at_a_time
@lru_cache(maxsize=2)
def _kept_renderer(scene: Scene, quality: str | Quality | None, _variant: str) -> Renderer:
    return Renderer(scene, quality=quality)


@dataclass(frozen=True, eq=False)
class _Look:
    """What a band of rows shows; ``swept`` is how far its pixels move while the shutter is open, down and right."""

    band: Band
    layers: Layers
    swept: tuple[Float32Array, Float32Array]
    silhouettes: Mapping[int, Silhouette]


def _swept(
    layers: Layers, camera: Camera, motion: Mapping[str, Any], layout: Layout, belt: Belt | None
) -> tuple[Float32Array, Float32Array]:
    """How far every pixel moves while the shutter is open, by the camera's motion and a belt's."""
    moving = None
    if belt is not None:
        moving = belt, np.isin(layers.instance, list(carried_instances(layout, belt.box)))
    return swept_by(layers.depth, camera, motion, moving)


def _projection(layout: Layout, plan: FramePlan) -> Projection | None:
    """Where points of instances are in an image whose rows are exposed one after another, None for others."""
    motion, belt = plan.viewpoint.get("motion", {}), plan.belt
    if "readout" not in motion:
        return None
    carried_ones = frozenset[int]() if belt is None else carried_instances(layout, belt.box)

    def project(points: Float64Array, instance: Instance) -> tuple[Float64Array, Float64Array]:
        velocity = belt.velocity if belt is not None and instance.id in carried_ones else np.zeros(3)
        return project_by_row(plan.camera, motion, points, velocity)

    return project


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


class Renderer:
    """Renders the frames of one scene, and holds what they share: uploads, and the layout's shapes.

    Used with ``with``, it lets go of that at the end::

        with ms.Renderer(scene, quality="balanced") as renderer:
            frames = [renderer.render(index) for index in range(12)]

    It takes no device, because that is Mitsuba's variant, of which a process has one (see
    :mod:`mitsplat.runtime.variant`): a second renderer could not keep to another. ``ms.use_device("cuda")`` before the
    first one takes the GPU.

    Attributes:
        scene: The scene.
        quality: All values of the splat renderer.
        integrator: Mitsuba's integrator ``splat_proxy``, lit as the scene file says.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
        quality: As in :func:`render_frame`.

    Raises:
        InputError: If there is no such preset, or a Mitsuba variant was chosen that cannot run the plugins.
    """

    def __init__(self, scene: Scene, *, quality: str | Quality | None = None) -> None:
        if not isinstance(quality, Quality):
            quality = replace(resolve_quality(quality or scene.spec.quality), **scene.spec.rendering.model_dump())
        ensure_variant()
        self.scene = scene
        self.quality = quality
        self._variant = mi.variant()
        self.integrator = make_integrator(quality=quality, **light_properties(scene))
        self._static: tuple[LayoutSurroundings, dict[str, Any]] | None = None
        self._pattern: tuple[int, MaterialDraw, ByteImage, Any] | None = None  # of a belt
        self._behind: tuple[BackgroundDraw, Any] | None = None
        self._placed: tuple[Layout, dict[str, Any]] | None = None
        self._settled: dict[int, Layout] = {}
        self._sky: tuple[str, Any] | None = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.integrator, self._static, self._placed, self._sky, self._behind = None, None, None, None, None
        self._pattern = None
        self._settled.clear()

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
            InputError: As there, after the end of the renderer's ``with``, or in another variant than it was made in.
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
            mitsuba_scene = self._load(layout, plan, lights is not None, plan.belt)
        with _timed(seconds, "render"):
            layers = render_layers(self.integrator, mitsuba_scene, plan.camera, seed=plan.seed)
        motion, swept, looks = plan.viewpoint.get("motion"), None, list[_Look]()
        if motion is not None:
            with _timed(seconds, "composite"):
                swept = _swept(layers, plan.camera, motion, layout, plan.belt)
            with _timed(seconds, "render"):
                bands = bands_of(plan.camera, motion, swept)
                looks = [self._look(band, plan, motion, layout, lights is not None, mitsuba_scene) for band in bands]
                if looks:
                    layers = Layers.stacked([(look.layers, look.band.rows) for look in looks])
                    swept = (
                        np.concatenate([look.swept[0] for look in looks]),
                        np.concatenate([look.swept[1] for look in looks]),
                    )
        with _timed(seconds, "composite"):
            composite, shape = self.scene.spec.composite, layers.shape
            behind = self._background(draw_place(self.scene.spec, index, layout.index).background, plan.camera)
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
            if looks:
                silhouettes = stacked_silhouettes([look.band for look in looks], [look.silhouettes for look in looks])
            else:
                silhouettes = self._silhouettes(mitsuba_scene, plan.camera)
        with _timed(seconds, "label"):
            labels = self._label(layers, silhouettes, layout, plan)
        with _timed(seconds, "composite"):
            image = development.image()
        made = {"plan": plan, "layout": layout, "layers": layers, "image": image, "labels": labels, "seconds": seconds}
        made["order_error"] = layers.order_error
        made["appearances"] = draw_appearances(self.scene, layout)
        return Frame.later({"rgb": partial(host_array, linear, shape)}, **made, next_layout=next_layout)

    def _silhouettes(self, mitsuba_scene: Any, camera: Camera) -> dict[int, Silhouette]:
        return render_silhouettes(self.integrator, mitsuba_scene, camera, source=self.scene.spec.labels.source)

    def _load(self, layout: Layout, plan: FramePlan, replaced: bool, belt: Belt | None) -> Any:
        """Mitsuba's scene of a layout; its few parts are made sooner than threads are woken."""
        return mi.load_dict(self.describe(layout, plan.lights, replaced, belt), parallel=False)

    def _look(
        self,
        band: Band,
        plan: FramePlan,
        motion: Mapping[str, Any],
        layout: Layout,
        replaced: bool,
        mitsuba_scene: Any,
    ) -> _Look:
        """What the rows of a band show at their moment, of a scene that only a belt changes until then."""
        belt = plan.belt
        if belt is not None:
            belt = replace(belt, time=belt.time + band.time)
            layout = carried_by(belt, layout)
            mitsuba_scene = self._load(layout, plan, replaced, belt)
        layers = render_layers(self.integrator, mitsuba_scene, band.camera, seed=plan.seed)
        ways = _swept(layers, band.camera, motion, layout, belt)
        silhouettes = self._silhouettes(mitsuba_scene, band.camera)
        return _Look(band, layers, (ways[0][band.rows], ways[1][band.rows]), silhouettes)

    def _at_moment(self, layout: Layout, index: int) -> tuple[Layout, Layout | None]:
        """A layout at the moment of a frame, and at that of the layout's next one, None if nothing moves until then."""
        spec = self.scene.spec
        view = index - layout_of(self.scene, index) * spec.output.views
        here = carried(spec, layout, view)
        after = carried(spec, layout, min(view + 1, spec.output.views - 1))
        return here, None if after is here else after

    def _settle(self, index: int) -> Layout:
        """A layout, kept for the next views of it."""
        if index not in self._settled:
            while len(self._settled) >= KEPT_LAYOUTS:
                del self._settled[next(iter(self._settled))]
            self._settled[index] = settle_layout(self.scene, index)
        return self._settled[index]

    def _label(self, layers: Layers, silhouettes: Mapping[int, Silhouette], layout: Layout, plan: FramePlan) -> Labels:
        scene, rules = self.scene, self.scene.spec.labels
        if rules.source == "splats":  # the depth that is not looked at stays on the device
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
            project=_projection(layout, plan),
        )

    def describe(
        self, layout: Layout, lights: tuple[LightSpec, ...], replaced: bool = False, belt: Belt | None = None
    ) -> dict[str, Any]:
        """Mitsuba's dictionary of a layout under some lights. Shapes stay the same objects while the layout does.

        Patterns on a ``belt`` are where it has run.

        No kernel is compiled when lights that are not the scene's, but ``replaced`` them, move.
        """
        if self._placed is None or self._placed[0] is not layout:
            objects, appearances = {}, draw_appearances(self.scene, layout)
            for instance in layout.instances:
                asset = self.scene.assets[instance.asset]
                objects[f"instance_{instance.id}"] = _asset_shape(
                    asset, instance.world_from_object, instance.id, appearances.get(instance.id)
                )
            self._placed = layout, objects
        emitters = {f"light_{i}": self._made(self._emitter(light), replaced) for i, light in enumerate(lights)}
        place = draw_place(self.scene.spec, layout.index * self.scene.spec.output.views)
        surroundings = self._surroundings(place)
        return {"type": "scene", **surroundings, **self._running(belt), **self._placed[1], **emitters}

    def _running(self, belt: Belt | None) -> dict[str, Any]:
        """The shape of a belt, its pattern where it has run; nothing if it has none."""
        if belt is None or self._pattern is None:
            return {}
        number, finish, image, bsdf = self._pattern
        shape, mesh = self.scene.spec.shapes[number], self.scene.shape_meshes[number]
        return {f"shape_{number}": finished_mesh(mesh, shape, finish, image, bsdf, belt.travel)}

    def _emitter(self, light: LightSpec) -> dict[str, Any]:
        if isinstance(light, EnvironmentLight) and light.image is not None:
            light = light.model_copy(update={"image": str(self.scene.images[light.image])})
        return emitter_dict(light)

    def _made(self, emitter: dict[str, Any], replaced: bool) -> Any:
        """An emitter; that of the last image if it has the same one, for to read a large one takes longer than a frame.

        Lights that are drawn are made so that no kernel is compiled when they move.
        """
        if emitter["type"] != "envmap":
            moves = replaced or any(light.draw for light in written_out(self.scene.spec))
            return movable(emitter) if moves else emitter
        if self._sky is None or self._sky[0] != emitter["filename"]:
            self._sky = emitter["filename"], mi.load_dict(emitter)
        state = mi.traverse(self._sky[1])
        # As a constant of kernels it would have them compiled anew for every radiance.
        state["scale"], state["to_world"] = dr.opaque(mi.Float, emitter["scale"]), emitter["to_world"]
        state.update()
        return self._sky[1]

    def _background(self, backing: BackgroundDraw | None, camera: Camera) -> Any:
        """What is behind everything, on the device; kept as long as it is the same."""
        if backing is None:
            return BACKGROUND
        if self._behind is None or self._behind[0] != backing:
            picture = background_picture(backing, self.scene.images[backing.image], camera.width, camera.height)
            self._behind = backing, device_array(picture)
        return self._behind[1]

    def _surroundings(self, place: LayoutSurroundings) -> dict[str, Any]:
        """What does not move in a place; the same objects as before if they look the same."""
        place = replace(place, background=None)
        if self._static is None or self._static[0] != place:
            self._static = place, self._static_shapes(place)
            self.integrator.white = white_irradiance(self.scene, place)
        return self._static[1]

    def _static_shapes(self, place: LayoutSurroundings) -> dict[str, Any]:
        shapes: dict[str, Any] = {}
        conveyor, self._pattern = self.scene.spec.conveyor, None
        environment = environment_at(self.scene, place)
        if environment is not None:
            shapes["environment"] = _asset_shape(environment, np.eye(4), 0)
        for i, (shape, mesh) in enumerate(zip(self.scene.spec.shapes, self.scene.shape_meshes, strict=True)):
            if shape.visible and (finish := place.finish_of(shape.name)) is not None:
                image = texture_image(finish, self.scene.images)
                bsdf = mi.load_dict(material(finish, None if image is None else bitmap_texture(image)))
                shapes[f"shape_{i}"] = finished_mesh(mesh, shape, finish, image, bsdf)
                if conveyor is not None and shape.name == conveyor.belt and image is not None:
                    self._pattern = i, finish, image, bsdf
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
    """A plain diffuse mesh; its colour is display-encoded, as in the scene file."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": decode_srgb(colour).tolist()}}
    )
    return plain_mesh(mesh, props)


def light_properties(scene: Scene, place: LayoutSurroundings = NOWHERE) -> dict[str, Any]:
    """Properties of the integrator ``splat_proxy`` by which it lights a place of a scene as its file says."""
    composite = scene.spec.composite
    return {
        "shadow": "none" if composite.shadow == "none" else "traced",
        "shadow_error": composite.shadow_error,
        "metered": composite.exposure == "auto",
        "occluders": composite.occluders,
        "bounce": composite.bounce,
        "highlight": composite.highlight,
        "reference": list(reference_point(scene)),
        # A sky in a room stands for what walls reflect, which they must not hide; things near each other do.
        "sky_reach": backdrop_distance(scene.spec, reference_point(scene)) / 2,
        "white": white_irradiance(scene, place),
        # What no splat covers is the grey of mitsplat.frames.camera_response, which draws no light source.
        "hide_emitters": True,
    }


def white_irradiance(scene: Scene, place: LayoutSurroundings) -> float:
    """Irradiance [W/m^2] of display white in a place's surroundings, or 0 where it is unknown or of no matter.

    The image-space shadow only looks at light relative to its brightest.
    """
    environment = environment_at(scene, place)
    if environment is None or scene.spec.composite.shadow == "image":
        return 0.0
    return environment.white or 0.0


def reference_point(scene: Scene) -> tuple[float, float, float]:
    """Where uniformly captured colours are shown unchanged [m]: below the middle of the drop region."""
    low, high = np.array(scene.spec.region.min), np.array(scene.spec.region.max)
    x, y = (low + high)[:2] / 2
    return float(x), float(y), float(low[2])
