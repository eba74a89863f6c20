"""Scenes to layers: every path to the renderer, Python, YAML or XML, ends in the integrator plugin ``splat_proxy``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array
from mitsplat.camera import Camera
from mitsplat.lost_rays import refuse_lost_rays
from mitsplat.masks import Silhouette
from mitsplat.quality import Quality, resolve_quality
from mitsplat.splats import Splats
from mitsplat.variant import ensure_variant as ensure_variant
from mitsplat.variant import one_at_a_time


@dataclass(frozen=True, eq=False)
class Layers:
    """What the integrator makes of one view, H x W pixels.

    Through a thin lens, ``rgb``, ``captured`` and ``alpha`` are means over its aperture; all else is what its centre
    sees.

    Attributes:
        rgb: Linear colour with light and highlight applied, multiplied by alpha, (H, W, 3) float32.
        alpha: Opacity, (H, W) float32.
        captured: Linear colour before light, multiplied by alpha, (H, W, 3) float32.
        depth: Depth along the optical axis [m], 0 where nothing is, (H, W) float32.
        instance: Id that has the largest share of the pixel, 0 where that is the environment's or what is left of the
            ray, (H, W) uint16.
        proxy_depth: The same depth of the proxy meshes, (H, W) float32.
        proxy_instance: Id of the nearest proxy mesh, (H, W) uint16.
        normal: World-space unit normal of the nearest proxy, zero where there is none, (H, W, 3) float32.
        light: Factor that light and shadow put on the linear colour, (H, W, 3) float32.
        highlight: Linear colour to add to captured colours in light, less what they hold of their own light's mirror
            image, (H, W, 3) float32.
    """

    rgb: Float32Array
    alpha: Float32Array
    captured: Float32Array
    depth: Float32Array
    instance: npt.NDArray[np.uint16]
    proxy_depth: Float32Array
    proxy_instance: npt.NDArray[np.uint16]
    normal: Float32Array
    light: Float32Array
    highlight: Float32Array


def make_integrator(*, quality: str | Quality = "balanced", **properties: Any) -> Any:
    """The integrator ``splat_proxy``, which keeps what it uploaded as long as it sees the same shapes.

    ``properties`` are those of the plugin.
    """
    ensure_variant()
    integrator = mi.load_dict({"type": "splat_proxy", **properties})
    integrator.quality = resolve_quality(quality)
    return integrator


def make_sensor(camera: Camera) -> Any:
    """A camera as the sensor plugin ``opencv_camera``."""
    ensure_variant()
    return mi.load_dict(describe_sensor(camera))


def describe_sensor(camera: Camera) -> dict[str, Any]:
    """Mitsuba's dictionary of a camera."""
    pose = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "opencv_camera",
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": " ".join(repr(float(k)) for k in camera.distortion),
        "lens": camera.lens,
        "aperture_radius": camera.aperture_radius,
        "focus_distance": camera.focus_distance,
        "near_clip": camera.near,
        "to_world": mi.ScalarTransform4f(pose),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
    }


def make_splats_shape(
    splats: Splats, world_from_splats: npt.ArrayLike | None = None, proxy: Any = None, **properties: Any
) -> Any:
    """The shape plugin ``splats`` around data in memory; ``properties`` are those of the plugin."""
    ensure_variant()
    from mitsplat.plugins.splats import SplatsShape  # derives from a class of the variant

    props = mi.Properties("splats")
    for name, value in properties.items():
        props[name] = value
    if world_from_splats is not None:
        props["to_world"] = mi.ScalarTransform4f(np.asarray(world_from_splats, dtype=np.float64))
    return SplatsShape(props, splats=splats, proxy=proxy)


@one_at_a_time
def render_splats(splats: Splats, camera: Camera, *, quality: str | Quality = "balanced") -> Layers:
    """Render splats alone, with the colours as captured.

    Args:
        splats: What to render; it becomes instance 1.
        camera: From where.
        quality: A preset's name or a :class:`mitsplat.quality.Quality`.

    Raises:
        InputError: If there is no such preset.
    """
    ensure_variant()
    integrator, scene = _alone(splats, str(mi.variant()))
    integrator.quality = resolve_quality(quality)
    return render_layers(integrator, scene, camera)


@lru_cache(maxsize=2)
def _alone(splats: Splats, variant: str) -> tuple[Any, Any]:
    """Integrator and scene of splats alone, kept so that the next view of the same splats uploads nothing."""
    scene = mi.load_dict({"type": "scene", "splats": make_splats_shape(splats, instance=1)})
    return make_integrator(shadow="none"), scene


def render_layers(integrator: Any, scene: Any, camera: Camera, *, seed: int = 0) -> Layers:
    """Run the integrator and bring its layers to the host."""
    layers = integrator.render_layers(scene, make_sensor(camera), seed=seed)
    shape = camera.height, camera.width

    def host(channel: Any) -> npt.NDArray[Any]:
        # What is the same everywhere is one value on the device.
        return np.broadcast_to(np.array(channel), shape[0] * shape[1]).reshape(shape)

    def one(name: str, dtype: type) -> Any:
        return host(layers[name]).astype(dtype, copy=False)

    def three(name: str) -> Float32Array:
        return np.stack([host(channel) for channel in layers[name]], axis=-1)

    brought = Layers(
        rgb=three("rgb"),
        alpha=one("alpha", np.float32),
        captured=three("captured"),
        depth=one("depth", np.float32),
        instance=one("instance", np.uint16),
        proxy_depth=one("proxy_depth", np.float32),
        proxy_instance=one("proxy_instance", np.uint16),
        normal=three("normal"),
        light=three("light"),
        highlight=three("highlight"),
    )
    refuse_lost_rays()
    return brought


def render_silhouettes(integrator: Any, scene: Any, camera: Camera, *, source: str = "splats") -> dict[int, Silhouette]:
    """Every instance as it would be seen alone, by its ``splats`` or by its ``proxies``, see the integrator plugin."""
    silhouettes = dict(integrator.silhouettes(scene, make_sensor(camera), source=source))
    refuse_lost_rays()
    return silhouettes
