"""One frame of a scene, from its plan to picture and labels."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.assets import Asset
from mitsplat.cad import emitter_dict
from mitsplat.camera import Camera
from mitsplat.colour import decode_srgb
from mitsplat.composite import develop, light_image
from mitsplat.label import LabelRules, Labels, Truth, label_instances
from mitsplat.plugins.device import plain_mesh
from mitsplat.quality import Quality, resolve_quality
from mitsplat.render import (
    Layers,
    make_integrator,
    make_splats_shape,
    render_layers,
    render_silhouettes,
)
from mitsplat.scene import FramePlan, Scene, layout_of, plan_frame
from mitsplat.settle import Layout, settle_layout
from mitsplat.spec import EnvironmentLight, LightSpec
from mitsplat.splats import Splats
from mitsplat.variant import ensure_variant, one_at_a_time

NOTHING = Splats(*(np.empty(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), 0, (0, 1, 3))))
"""Splats of a proxy that only receives and casts shadows."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A labelled picture of H x W pixels with everything that it was made from. In a notebook it shows itself.

    Attributes:
        index: Index of the frame in its scene.
        plan: Camera, lights and random draws.
        layout: Where the objects came to rest.
        image: Display-encoded picture, (H, W, 3) uint8.
        rgb: Linear picture before the camera's development, (H, W, 3) float32.
        depth: Depth along the optical axis [m], 0 where nothing is, (H, W) float32.
        instance: Instance id per pixel, 0 for the environment, (H, W) uint16.
        proxy_instance: The same from the proxy meshes, (H, W) uint16.
        normal: World-space normal of the proxies, (H, W, 3) float32.
        light: Factor of light and shadow on the linear colour, (H, W, 3) float32.
        camera: Same as ``plan.camera``.
        labels: Labels of the visible instances.
        draws: Same as ``plan.draws``.
        seconds: Time per stage [s].
        layers: Further layers for EXR files, by name.
    """

    index: int
    plan: FramePlan
    layout: Layout
    image: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.float32]
    depth: npt.NDArray[np.float32]
    instance: npt.NDArray[np.uint16]
    proxy_instance: npt.NDArray[np.uint16]
    normal: npt.NDArray[np.float32]
    light: npt.NDArray[np.float32]
    camera: Camera
    labels: Labels
    draws: Mapping[str, float]
    seconds: Mapping[str, float]
    layers: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict, repr=False)

    def _repr_png_(self) -> bytes:
        import cv2

        _, data = cv2.imencode(".png", cv2.cvtColor(self.image, cv2.COLOR_RGB2BGR))
        return bytes(data)


@one_at_a_time
def render_frame(
    scene: Scene, index: int, *, quality: str | Quality | None = None, layout: Layout | None = None
) -> Frame:
    """Render and label one frame.

    Args:
        scene: A scene of :func:`mitsplat.load_scene`.
        index: Frame index, below ``scene.num_frames``.
        quality: Preset of the splat renderer, which the scene file's ``rendering`` refines, or all its values; the
            preset of the scene file by default.
        layout: The frame's settled layout; settled here when not given.

    Raises:
        InputError: If the index is out of range, or the layout cannot be settled.
    """
    seconds: dict[str, float] = {}
    plan = plan_frame(scene, index)
    if not isinstance(quality, Quality):
        quality = replace(resolve_quality(quality or scene.spec.quality), **scene.spec.rendering.model_dump())
    ensure_variant()
    stage = _Studio.of(scene, quality, str(mi.variant()))
    if layout is None:
        with _timed(seconds, "settle"):
            layout = stage.settle(layout_of(scene, index))
    with _timed(seconds, "place"):
        mitsuba_scene = mi.load_dict(stage.describe(layout, plan.lights))
    with _timed(seconds, "render"):
        layers = render_layers(stage.integrator, mitsuba_scene, plan.camera, seed=plan.seed)
    with _timed(seconds, "composite"):
        rgb = light_image(layers, scene.spec.composite)
        composite = scene.spec.composite
        image = develop(rgb, plan.draws, tone=composite.tone, sensor=composite.sensor, seed=plan.seed)
    rules = scene.spec.labels
    with _timed(seconds, "silhouettes"):
        silhouettes = render_silhouettes(stage.integrator, mitsuba_scene, plan.camera, source=rules.source)
    with _timed(seconds, "label"):
        maps = [(layers.instance, layers.depth), (layers.proxy_instance, layers.proxy_depth)]
        (ids, depth), (second, _) = maps if rules.source == "splats" else reversed(maps)
        labels = label_instances(
            Truth(ids, second, silhouettes, depth),
            layout.instances,
            scene.class_names,
            LabelRules(**rules.model_dump(exclude={"source"})),
            camera=plan.camera,
            keypoints={i: asset.keypoint_array for i, asset in enumerate(scene.assets) if asset.keypoints},
        )
    return _frame(index, plan, layout, image, rgb, layers, labels, seconds)


def _frame(
    index: int,
    plan: FramePlan,
    layout: Layout,
    image: npt.NDArray[np.uint8],
    rgb: npt.NDArray[np.float32],
    layers: Layers,
    labels: Labels,
    seconds: dict[str, float],
) -> Frame:
    return Frame(
        index=index,
        plan=plan,
        layout=layout,
        image=image,
        rgb=rgb,
        depth=layers.depth,
        instance=layers.instance,
        proxy_instance=layers.proxy_instance,
        normal=layers.normal,
        light=layers.light,
        camera=plan.camera,
        labels=labels,
        draws=plan.draws,
        seconds=seconds,
        layers={"alpha": layers.alpha, "captured": layers.captured, "highlight": layers.highlight},
    )


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start


class _Studio:
    """What the frames of one scene share: the integrator with its uploads, and the shapes of the current layout."""

    def __init__(self, scene: Scene, quality: Quality) -> None:
        self.scene = scene
        self.integrator = make_integrator(quality=quality, **light_properties(scene))
        self.static = self._static_shapes()
        self._placed: tuple[Layout, dict[str, Any]] | None = None

    @staticmethod
    @lru_cache(maxsize=2)
    def of(scene: Scene, quality: Quality, variant: str) -> _Studio:
        """The studio of a scene under a variant, kept for the next frame."""
        return _Studio(scene, quality)

    @lru_cache(maxsize=4)  # noqa: B019 - a studio lives as long as its cache
    def settle(self, index: int) -> Layout:
        """A layout, kept for the next view of it."""
        return settle_layout(self.scene, index)

    def describe(self, layout: Layout, lights: tuple[LightSpec, ...]) -> dict[str, Any]:
        """Mitsuba's dictionary of a layout under some lights. Shapes stay the same objects while the layout does."""
        if self._placed is None or self._placed[0] is not layout:
            objects = {}
            for instance in layout.instances:
                asset = self.scene.assets[instance.asset]
                objects[f"instance_{instance.id}"] = _asset_shape(asset, instance.world_from_object, instance.id)
            self._placed = layout, objects
        emitters = {f"light_{i}": self._emitter(light) for i, light in enumerate(lights)}
        return {"type": "scene", **self.static, **self._placed[1], **emitters}

    def _emitter(self, light: LightSpec) -> dict[str, Any]:
        if isinstance(light, EnvironmentLight) and light.image is not None:
            light = light.model_copy(update={"image": str(self.scene.images[light.image])})
        return emitter_dict(light)

    def _static_shapes(self) -> dict[str, Any]:
        shapes: dict[str, Any] = {}
        if self.scene.environment is not None:
            shapes["environment"] = _asset_shape(self.scene.environment, np.eye(4), 0)
        for i, (shape, mesh) in enumerate(zip(self.scene.spec.shapes, self.scene.shape_meshes, strict=True)):
            if shape.visible:
                shapes[f"shape_{i}"] = _visible_shape(shape.colour, mesh)
            elif shape.proxy:
                shapes[f"shape_{i}"] = make_splats_shape(NOTHING, proxy=mesh)
        return shapes


def _asset_shape(asset: Asset, world_from_asset: npt.NDArray[np.float64], instance: int) -> Any:
    return make_splats_shape(
        asset.splats,
        world_from_asset,
        asset.mesh,
        instance=instance,
        capture_light=asset.capture_light,
        roughness=float(asset.roughness),
        specular=float(asset.specular) if instance else 0.0,
    )


def _visible_shape(colour: tuple[float, float, float], mesh: trimesh.Trimesh) -> Any:
    """A plain diffuse mesh; its colour is display-encoded, as in the scene file."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": decode_srgb(colour).tolist()}}
    )
    return plain_mesh(mesh, props)


def light_properties(scene: Scene) -> dict[str, Any]:
    """Properties of the integrator ``splat_proxy`` by which it lights a scene as its file says."""
    composite = scene.spec.composite
    return {
        "shadow": "none" if composite.shadow == "none" else "traced",
        "shadow_error": composite.shadow_error,
        "occluders": composite.occluders,
        "bounce": composite.bounce,
        "highlight": composite.highlight,
        "reference": list(reference_point(scene)),
        "white": white_irradiance(scene),
        # What no splat covers is the grey of mitsplat.composite, which draws no light source.
        "hide_emitters": True,
    }


def white_irradiance(scene: Scene) -> float:
    """Irradiance [W/m^2] of display white in the surroundings, or 0 where it is unknown or of no matter.

    The image-space shadow only looks at light relative to its brightest.
    """
    if scene.environment is None or scene.spec.composite.shadow == "image":
        return 0.0
    return scene.environment.white or 0.0


def reference_point(scene: Scene) -> tuple[float, float, float]:
    """Where uniformly captured colours are shown unchanged [m]: below the middle of the drop region."""
    low, high = np.array(scene.spec.region.min), np.array(scene.spec.region.max)
    x, y = (low + high)[:2] / 2
    return float(x), float(y), float(low[2])
