"""Rendering and labelling of one frame of a scene."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import cv2
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.arguments import check_type
from mitsplat.arrays import Float32Array
from mitsplat.errors import InputError
from mitsplat.frames.camera_response import Development, apply_light, start_development
from mitsplat.frames.light_properties import background_light, irradiance_of, light_properties, white_irradiance
from mitsplat.frames.scene_builder import SceneBuilder
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import transform_points
from mitsplat.images.masks import Silhouette
from mitsplat.labels.flow import exposure_flow, instance_motions, optical_flow
from mitsplat.labels.keypoint_visibility import find_blocked_keypoints
from mitsplat.labels.labels import Labels, Truth, label_instances
from mitsplat.labels.overlay import draw_labels
from mitsplat.physics.settle import settle_layout
from mitsplat.quality import Quality, resolve_quality
from mitsplat.renderer.layers import Layers, find_hits, host_array, make_integrator, render_layers, render_silhouettes
from mitsplat.renderer.lazy_value import LazyValue
from mitsplat.runtime.variant import ensure_variant, one_at_a_time
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import carried_instances, layout_at_view
from mitsplat.scene.planning.frame_plan import FramePlan, layout_index_of, plan_frame
from mitsplat.scene.planning.object_appearance import ObjectAppearance, draw_appearances
from mitsplat.scene.planning.view_diagnosis import distance_to_box, pose_cause, sees
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LightEntry

MAX_CACHED_LAYOUTS = 4
"""Number of settled layouts that a renderer caches for further views."""


@dataclass(frozen=True, eq=False, repr=False)
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
    layers: Layers
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
    def depth(self) -> Float32Array:
        """Depth along the optical axis [m], 0 for no surface, (H, W)."""
        return self.layers.depth

    @property
    def instance(self) -> npt.NDArray[np.uint16]:
        """Instance id per pixel from the splats, 0 for the environment, (H, W)."""
        return self.layers.instance

    @property
    def normal(self) -> Float32Array:
        """Unit normals of the proxy meshes in world coordinates, 0 for no surface, (H, W, 3)."""
        return self.layers.normal

    @property
    def flow(self) -> Float32Array | None:
        """Motion of every pixel to the next image [px], (H, W, 2); None without a next image.

        Both components are 1e10 where the flow is unknown, see :func:`mitsplat.labels.flow.optical_flow`.
        """
        if self.plan.next_camera is None:
            return None
        motions = {} if self.next_layout is None else instance_motions(self.layout, self.next_layout)
        belt = self.plan.belt
        ids = self.instance if motions or belt is not None else None
        return optical_flow(self.depth, self.camera, self.plan.next_camera, ids, motions, belt)

    def __repr__(self) -> str:
        labels = self.labels
        return f"Frame({self.plan.index}: {labels.width} x {labels.height} px, {len(labels.instances)} labels)"

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
        InputError: If the index is out of range, an argument has another type, the layout cannot be settled, or the
            lights break a rule.
    """
    Scene.check(scene)
    layout_index_of(scene, index)  # check the index before costly work
    ensure_variant()
    return _cached_renderer(scene, quality, str(mi.variant())).render(
        index, layout=layout, camera=camera, lights=lights, next_layout=next_layout, next_camera=next_camera
    )


@one_at_a_time
@lru_cache(maxsize=2)
def _cached_renderer(scene: Scene, quality: str | Quality | None, _variant: str) -> Renderer:
    return Renderer(scene, quality=quality)


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
        integrator: Mitsuba's integrator ``splat_proxy``, configured by the scene file; None after the `with` block.
        scene_builder: Builder of Mitsuba scenes, which caches shapes and emitters.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
        quality: As in :func:`render_frame`.

    Raises:
        InputError: If the preset does not exist, or the selected Mitsuba variant cannot run the plugins.
    """

    def __init__(self, scene: Scene, *, quality: str | Quality | None = None) -> None:
        Scene.check(scene)
        if not isinstance(quality, Quality):
            quality = replace(resolve_quality(quality or scene.spec.quality), **scene.splat_options)
        ensure_variant()
        self.scene = scene
        self.quality = quality
        self.scene_builder = SceneBuilder(scene)
        self._variant, self._warned = mi.variant(), False
        self.integrator = make_integrator(quality=quality, **light_properties(scene))
        self._settled_layout = lru_cache(maxsize=MAX_CACHED_LAYOUTS)(partial(settle_layout, scene))
        self._white_irradiance = lru_cache(maxsize=MAX_CACHED_LAYOUTS)(partial(white_irradiance, scene))

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.integrator, self.scene_builder = None, SceneBuilder(self.scene)
        self._settled_layout.cache_clear()

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
        self._check_variant()
        _check_types(self.scene, layout, camera, next_layout, next_camera)
        seconds: dict[str, float] = {}
        if layout is None:
            with _timed(seconds, "settle"):
                layout = self._settled_layout(layout_index_of(self.scene, index))
        layout, layout_of_next_view = self._layouts_at_views(layout, index)
        next_layout = next_layout or layout_of_next_view
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
            mitsuba_scene = self._build_scene(layout, plan, replaced_lights=lights is not None)
        with _timed(seconds, "render"):
            layers = render_layers(self.integrator, mitsuba_scene, plan.camera, seed=plan.seed)
        with _timed(seconds, "composite"):
            lit = background_light(self.scene, layout.index, mitsuba_scene)
            background = lit * self.scene_builder.background(index, layout.index, plan.camera)
            linear = apply_light(layers, self.scene.spec.composite, background)
            development = self._start_development(linear, layers, layout, plan, mitsuba_scene)
        with _timed(seconds, "silhouettes"):
            silhouettes = render_silhouettes(
                self.integrator, mitsuba_scene, plan.camera, source=self.scene.spec.labels.source
            )
        with _timed(seconds, "label"):
            labels = self._label(layers, silhouettes, layout, plan.camera, mitsuba_scene)
        if camera is not None and not labels.instances and not self._warned:
            self._warn_of_empty_view(layout, plan)
        with _timed(seconds, "composite"):
            image = development.image()
        return Frame.later(
            {"rgb": partial(host_array, linear, layers.shape)},
            plan=plan,
            layout=layout,
            layers=layers,
            image=image,
            labels=labels,
            seconds=seconds,
            order_error=layers.order_error,
            appearances=draw_appearances(self.scene, layout),
            next_layout=next_layout,
        )

    def _check_variant(self) -> None:
        """Raise InputError if the renderer is closed or the Mitsuba variant has changed."""
        if self.integrator is None:
            raise InputError("the renderer is closed; call render() inside its `with` block")
        if mi.variant() != self._variant:
            raise InputError(
                f"Mitsuba's variant must stay {self._variant}, in which the renderer was created (got {mi.variant()})"
            )

    def _warn_of_empty_view(self, layout: Layout, plan: FramePlan) -> None:
        """Warn once if a given camera sees no object, with the likely cause."""
        boxes = []
        for one in layout.instances:
            mesh, pose = self.scene.assets[one.asset].mesh, one.world_from_object
            if mesh is not None:
                corners = transform_points(pose, trimesh.bounds.corners(mesh.bounds))
                boxes.append((corners.min(axis=0), corners.max(axis=0)))
        if not boxes or any(sees(plan.camera, low, high) for low, high in boxes):
            return
        self._warned = True
        low, high = np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)
        away = min(distance_to_box(plan.camera.centre, *box) for box in boxes)
        cause = pose_cause(plan.camera, low, high) or "turn the camera to the objects"
        text = f"frame {plan.index}: nothing is in view; the nearest object is {away:.3g} m from the camera: {cause}"
        warnings.warn(text, stacklevel=4)

    def _layouts_at_views(self, layout: Layout, index: int) -> tuple[Layout, Layout | None]:
        """Return the layout at the moments of a frame and of the next view; None for the latter if nothing moves."""
        views = self.scene.spec.output.views
        view = index - layout_index_of(self.scene, index) * views
        here = layout_at_view(self.scene, layout, view)
        after = layout_at_view(self.scene, layout, min(view + 1, views - 1))
        return here, None if after is here else after

    def _build_scene(self, layout: Layout, plan: FramePlan, *, replaced_lights: bool) -> mi.Scene:
        """Load the Mitsuba scene of a frame, and set the integrator's white to that of the layout's environment."""
        self.integrator.renderer.white = self._white_irradiance(layout.index)
        description = self.scene_builder.describe(layout, plan.lights, replaced_lights=replaced_lights, belt=plan.belt)
        # A scene has few parts, so that loading them serially is faster than waking threads.
        return mi.load_dict(description, parallel=False)

    def _start_development(
        self, linear: mi.Color3f, layers: Layers, layout: Layout, plan: FramePlan, mitsuba_scene: mi.Scene
    ) -> Development:
        """Start the camera response on the device, with blur by the motion of a belt."""
        motion, belt, flow = plan.viewpoint.get("motion"), plan.belt, None
        if motion is not None and belt is not None:
            carried = np.isin(layers.instance, list(carried_instances(self.scene, layout, belt.box)))
            flow = exposure_flow(layers.depth, plan.camera, motion["exposure"], belt, carried)
        composite, white = self.scene.spec.composite, self._white_irradiance(layout.index)
        is_balanced = composite.white_balance == "auto" and mitsuba_scene.emitters()
        return start_development(
            linear,
            layers.shape,
            plan.draws,
            composite,
            seed=plan.seed,
            exposure_flow=flow,
            white=white,
            light=irradiance_of(self.scene, mitsuba_scene) if is_balanced else white,
        )

    def _label(
        self, layers: Layers, silhouettes: Mapping[int, Silhouette], layout: Layout, camera: Camera, shown: mi.Scene
    ) -> Labels:
        """Label the instances by the ids of splats or proxies; the depth is that of the picture for both."""
        scene, rules, hits = self.scene, self.scene.spec.labels, partial(find_hits, self.integrator, shown)
        ids, other_ids = layers.instance, layers.proxy_instance
        if rules.source == "proxies":
            ids, other_ids = other_ids, ids
        truth = Truth(ids, other_ids, silhouettes, layers.depth)
        keypoints = {number: asset.keypoint_array for number, asset in enumerate(scene.assets) if asset.keypoints}
        blocked = find_blocked_keypoints(scene.assets, layout.instances, camera, hits)
        return label_instances(
            *(truth, layout.instances, scene.class_names, rules), camera=camera, keypoints=keypoints, blocked=blocked
        )


def _check_types(
    scene: Scene, layout: Layout | None, camera: Camera | None, next_layout: Layout | None, next_camera: Camera | None
) -> None:
    """Raise InputError if a given layout or camera has another type, or a layout is of another scene."""
    for place, shown in (("layout", layout), ("next_layout", next_layout)):
        if shown is not None:
            check_type(shown, Layout, place, "create it by mitsplat.Layout.from_poses(scene, poses)")
            _check_assets(shown, scene, place)
    for place, seen in (("camera", camera), ("next_camera", next_camera)):
        if seen is not None:
            check_type(seen, Camera, place, "create it by mitsplat.Camera or mitsplat.Camera.look_at")


def _check_assets(layout: Layout, scene: Scene, place: str) -> None:
    """Raise InputError if an object of a layout has an asset or a class that the scene does not have."""
    for asset, class_index in {(instance.asset, instance.class_index) for instance in layout.instances}:
        if asset >= len(scene.assets) or class_index != scene.class_index(asset):
            raise InputError(
                f"{place} must be of a scene with the same objects (got an object of asset {asset} and class "
                f"{class_index}, which {scene.path} does not have)"
            )
