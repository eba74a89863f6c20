"""Scenes to layers: every path to the renderer, Python, YAML or XML, ends in the integrator plugin ``splat_proxy``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import Silhouette
from mitsplat.quality import Quality, resolve_quality
from mitsplat.renderer.lazy_value import LazyValue
from mitsplat.renderer.rays.device_arrays import concatenated, wrapped
from mitsplat.runtime.dropped_rays import refuse_lost_rays
from mitsplat.runtime.variant import ensure_variant as ensure_variant
from mitsplat.runtime.variant import one_at_a_time


@dataclass(frozen=True, eq=False)
class Layers(LazyValue):
    """What the integrator makes of one view, H x W pixels.

    Layers that were rendered stay on the device as long as this does, and come to the host one by one, when they are
    first looked at. Those of one channel may not be written to: copy them.

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

    @classmethod
    def on_device(cls, channels: Mapping[str, Any], shape: tuple[int, int]) -> Layers:
        """Layers of (H, W) pixels that are flat row-major device arrays, colours of three channels."""
        fetch = {name: _host_ids if name.endswith("instance") else host_array for name in channels}
        known = dict(channels)
        order_error = known.pop("order_error", None)
        makers = {name: partial(fetch[name], value, shape) for name, value in known.items()}
        return cls.later(makers, _channels=known, _shape=shape, _order_error=order_error)

    @classmethod
    def stacked(cls, parts: Sequence[tuple[Layers, slice]]) -> Layers:
        """Layers of one below another, of each of which the stated rows are taken; all on the device, equally wide."""
        width = parts[0][0].shape[1]
        counts = [width * (rows.stop - rows.start) for _, rows in parts]

        def taken(value: Any, rows: slice) -> Any:
            if dr.depth_v(value) == 2:
                return type(value)(*[taken(channel, rows) for channel in value])
            place = dr.arange(mi.UInt32, width * (rows.stop - rows.start)) + dr.opaque(mi.UInt32, width * rows.start)
            # What is the same everywhere is one value on the device.
            return dr.gather(type(value), value, place if dr.width(value) > 1 else 0 * place)

        known = [(part.__dict__["_channels"], rows) for part, rows in parts]
        channels = {name: concatenated([taken(own[name], rows) for own, rows in known]) for name in known[0][0]}
        errors = [part.order_error for part, _ in parts]
        if errors[0] is not None:
            found = [(error["largest"], error["mean"]) for error in errors if error is not None]
            largest, mean = np.array(found).T
            channels["order_error"] = [largest.max(), np.average(mean, weights=counts)]
        return cls.on_device(channels, (sum(counts) // width, width))

    @property
    def order_error(self) -> dict[str, float] | None:
        """Largest and mean error of the pixels' display-encoded colours that the order of blending leaves, estimated.

        None where the quality estimates none, as ``fast``; and of copies.
        """
        found = self.__dict__.get("_order_error")
        return None if found is None else dict(zip(("largest", "mean"), np.array(found).tolist(), strict=True))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width [px]."""
        height, width = self.__dict__.get("_shape") or self.alpha.shape
        return height, width

    def device_array(self, name: str) -> Any:
        """A layer of floats as a flat row-major device array; colours and normals as three of them, Color3f."""
        channels = self.__dict__.get("_channels")
        return device_array(getattr(self, name)) if channels is None else channels[name]


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
    return mi.load_dict(describe_sensor(camera), parallel=False)


@lru_cache(maxsize=1)
def _sensor_of(camera: Camera, _variant: str) -> Any:
    """The sensor of the last camera, through which a frame is looked at twice."""
    return make_sensor(camera)


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
    layers = render_layers(integrator, scene, camera)
    dr.sync_thread()
    return layers


@lru_cache(maxsize=2)
def _alone(splats: Splats, variant: str) -> tuple[Any, Any]:
    """Integrator and scene of splats alone, kept so that the next view of the same splats uploads nothing."""
    scene = mi.load_dict({"type": "scene", "splats": make_splats_shape(splats, instance=1)})
    return make_integrator(shadow="none"), scene


def render_layers(integrator: Any, scene: Any, camera: Camera, *, seed: int = 0) -> Layers:
    """Run the integrator; each layer comes to the host when it is first looked at, see :class:`Layers`."""
    layers = integrator.render_layers(scene, _sensor_of(camera, str(mi.variant())), seed=seed)
    refuse_lost_rays()
    return Layers.on_device(layers, (camera.height, camera.width))


def device_array(values: npt.NDArray[Any]) -> Any:
    """Values (H, W), or (H, W, 3), as flat row-major floats on the device, or three of them, Color3f."""
    ensure_variant()
    flat = wrapped(mi.Float, values.astype(np.float32, copy=False))
    return flat if values.ndim == 2 else dr.unravel(mi.Color3f, flat)


def host_array(values: Any, shape: tuple[int, int]) -> Float32Array:
    """Flat row-major device values on the host by one copy: (H, W), or, of three channels, (H, W, 3).

    Those of one channel are read-only, because on a CPU they are the device's own.
    """
    colour = dr.depth_v(values) == 2
    array = dr.ravel(values).numpy() if colour else values.numpy()
    size = (*shape, 3) if colour else shape
    if array.size < math.prod(size):  # what is the same everywhere is one value on the device
        array = np.broadcast_to(array, size).copy()
    array.flags.writeable = colour
    return np.asarray(array.reshape(size), dtype=np.float32)


def _host_ids(ids: Any, shape: tuple[int, int]) -> npt.NDArray[np.uint16]:
    """Ids on the host, (H, W): two of them travel as one number of 32 bits, as Dr.Jit has none of 16."""
    count = dr.width(ids)
    if count > 1:
        first = 2 * dr.arange(type(ids), (count + 1) // 2)
        second = dr.gather(type(ids), ids, first + 1, first + 1 < count)
        ids = dr.gather(type(ids), ids, first) | (second << 16)
    halves = ids.numpy().view(np.uint16)[:count]
    return halves.reshape(shape) if count > 1 else np.full(shape, halves)


def render_silhouettes(integrator: Any, scene: Any, camera: Camera, *, source: str = "splats") -> dict[int, Silhouette]:
    """Every instance as it would be seen alone, by its ``splats`` or by its ``proxies``, see the integrator plugin."""
    silhouettes = dict(integrator.silhouettes(scene, _sensor_of(camera, str(mi.variant())), source=source))
    refuse_lost_rays()
    return silhouettes
