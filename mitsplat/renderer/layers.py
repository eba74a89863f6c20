"""Rendering of scenes to layers; Python, YAML and XML scenes all use the integrator plugin ``splat_proxy``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.arguments import check_type
from mitsplat.arrays import AnyArray, BoolArray, Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_training import trained_kernel
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import Silhouette
from mitsplat.quality import Quality, resolve_quality
from mitsplat.renderer.lazy_value import LazyValue
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.scene_emitters import MitsubaDict
from mitsplat.runtime.dropped_rays import check_dropped_rays
from mitsplat.runtime.variant import ensure_variant, one_at_a_time


@dataclass(frozen=True, eq=False, repr=False)
class Layers(LazyValue):
    """Output of the integrator for one view, H x W pixels.

    Rendered layers stay on the device as long as this object exists. Each layer is copied to the host on first access.
    Layers of one channel are read-only: copy them to change them.

    Through a thin lens, ``rgb``, ``captured`` and ``alpha`` are means over its aperture. All other layers are those of
    the ray through its centre.

    Attributes:
        rgb: Linear colour with light and highlight applied, multiplied by alpha, (H, W, 3) float32.
        alpha: Opacity, (H, W) float32.
        captured: Linear colour before light, multiplied by alpha, (H, W, 3) float32.
        depth: Depth along the optical axis [m], 0 for background, (H, W) float32.
        instance: Id with the largest share of the pixel, (H, W) uint16. It is 0 if the environment or the remaining
            transmittance has the largest share.
        proxy_depth: Depth of the proxy meshes along the optical axis [m], (H, W) float32.
        proxy_instance: Id of the nearest proxy mesh, (H, W) uint16.
        normal: World-space unit normal of the nearest proxy, zero for a miss, (H, W, 3) float32.
        light: Factor of light, shadow and tinted reflections on the linear colour, (H, W, 3) float32.
        highlight: Reflections without the base colour, added to lit colours. On captured colours, the mirrored light of
            the capture is subtracted. (H, W, 3) float32.
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

    def __repr__(self) -> str:
        height, width = self.shape
        return f"Layers({width} x {height} px: {', '.join(field.name for field in fields(self))})"

    @classmethod
    def on_device(cls, channels: Mapping[str, dr.ArrayBase], shape: tuple[int, int]) -> Layers:
        """Create layers of (H, W) pixels from flat row-major device arrays; colours have three channels."""
        fetch = {name: _host_ids if name.endswith("instance") else host_array for name in channels}
        known = dict(channels)
        order_error = known.pop("order_error", None)
        makers = {name: partial(fetch[name], value, shape) for name, value in known.items()}
        return cls.later(makers, _channels=known, _shape=shape, _order_error=order_error)

    @property
    def order_error(self) -> dict[str, float] | None:
        """Largest and mean estimated error of display-encoded pixel colours due to the blending order.

        None if the quality has no estimate, such as ``fast``, and None for copies.
        """
        found = self.__dict__.get("_order_error")
        return None if found is None else dict(zip(("largest", "mean"), np.array(found).tolist(), strict=True))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width [px]."""
        height, width = self.__dict__.get("_shape") or self.alpha.shape
        return height, width

    def device_array(self, name: str) -> mi.Float | mi.Color3f:
        """Return a float layer as a flat row-major device array; colours and normals as Color3f."""
        channels = self.__dict__.get("_channels")
        return device_array(getattr(self, name)) if channels is None else channels[name]


def make_integrator(*, quality: str | Quality = "balanced", **properties: Any) -> mi.Integrator:
    """Create the integrator ``splat_proxy``.

    The integrator keeps its uploads as long as the shapes of the scene stay the same.

    Args:
        quality: Name of a preset, or a complete :class:`mitsplat.quality.Quality`.
        properties: Further properties of the plugin. Those that refine a preset, such as ``kernel``, are refused with a
            complete quality.

    Raises:
        InputError: If there is no such preset, or a property breaks a rule.
    """
    ensure_variant()
    if not isinstance(quality, Quality):
        resolve_quality(quality)  # Mitsuba would wrap its error
        return mi.load_dict({"type": "splat_proxy", "quality": quality, **properties})
    for name in sorted(properties.keys() & {field.name for field in fields(Quality)}):
        raise InputError(f"make_integrator: {name!r} must not be given together with a Quality, which has its value")
    integrator = mi.load_dict({"type": "splat_proxy", **properties})
    integrator.renderer.quality, integrator.renderer.is_kernel_stated = quality, True
    return integrator


def make_sensor(camera: Camera) -> mi.Sensor:
    """Create the sensor plugin ``opencv_camera`` of a camera."""
    ensure_variant()
    return mi.load_dict(describe_sensor(camera), parallel=False)


@lru_cache(maxsize=1)
def _sensor_of(camera: Camera, _variant: str) -> mi.Sensor:
    """Return the cached sensor of the last camera, because a frame uses it twice."""
    return make_sensor(camera)


def describe_sensor(camera: Camera) -> MitsubaDict:
    """Return Mitsuba's dictionary of a camera."""
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
    splats: Splats,
    world_from_splats: npt.ArrayLike | None = None,
    proxy: trimesh.Trimesh | None = None,
    **properties: Any,
) -> mi.Shape:
    """Create the shape plugin ``splats`` from data in memory.

    Args:
        splats: The Gaussians.
        world_from_splats: Rigid transform with a uniform scale, shape (4, 4); the identity by default.
        proxy: Mesh in the frame of the splats, which casts and receives shadows.
        properties: Further properties of the plugin.
    """
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
    """Render splats alone with their captured colours.

    Args:
        splats: Splats to render, as instance 1.
        camera: Camera.
        quality: Name of a preset, which gets the kernel ``mip`` if the splats were trained with antialiasing, or a
            :class:`mitsplat.quality.Quality`.

    Raises:
        InputError: If there is no such preset.
    """
    check_type(splats, Splats, "splats", "read a file with mitsplat.Splats.load(path)")
    check_type(camera, Camera, "camera", "create it by mitsplat.Camera or mitsplat.Camera.look_at")
    if not isinstance(quality, Quality):
        quality = replace(resolve_quality(quality), kernel=trained_kernel([splats.kernel]))
    ensure_variant()
    integrator, scene = _single_shape_scene(splats, str(mi.variant()))
    integrator.renderer.quality = quality
    layers = render_layers(integrator, scene, camera)
    dr.sync_thread()
    return layers


@lru_cache(maxsize=2)
def _single_shape_scene(splats: Splats, variant: str) -> tuple[mi.Integrator, mi.Scene]:
    """Return cached integrator and scene of splats, so that the next view of them needs no upload."""
    scene = mi.load_dict({"type": "scene", "splats": make_splats_shape(splats, instance=1)})
    return make_integrator(quality=Quality(), shadow="none"), scene


def render_layers(integrator: mi.Integrator, scene: mi.Scene, camera: Camera, *, seed: int = 0) -> Layers:
    """Run the integrator; each layer is copied to the host on first access, see :class:`Layers`.

    Args:
        integrator: From :func:`make_integrator`.
        scene: Mitsuba scene with shapes of the plugin ``splats``.
        camera: Camera; the sensors of the scene are not used.
        seed: Seed of the rays of light.
    """
    layers = integrator.renderer.render_layers(scene, _sensor_of(camera, str(mi.variant())), seed=seed)
    check_dropped_rays()
    return Layers.on_device(layers, (camera.height, camera.width))


def device_array(values: AnyArray) -> mi.Float | mi.Color3f:
    """Upload values as flat row-major floats: (H, W) as Float, (H, W, 3) as Color3f."""
    ensure_variant()
    flat = wrapped(mi.Float, values.astype(np.float32, copy=False))
    return flat if values.ndim == 2 else dr.unravel(mi.Color3f, flat)


def host_array(values: dr.ArrayBase, shape: tuple[int, int]) -> Float32Array:
    """Copy flat row-major device values to the host: (H, W), or (H, W, 3) for three channels.

    Arrays of one channel are read-only, because on a CPU they share the device's memory.
    """
    colour = dr.depth_v(values) == 2
    array = dr.ravel(values).numpy() if colour else values.numpy()
    size = (*shape, 3) if colour else shape
    if array.size < math.prod(size):  # a constant layer is one value on the device
        array = np.broadcast_to(array, size).copy()
    array.flags.writeable = colour
    return np.asarray(array.reshape(size), dtype=np.float32)


def _host_ids(ids: mi.UInt32, shape: tuple[int, int]) -> npt.NDArray[np.uint16]:
    """Copy ids to the host, (H, W); two ids are packed into 32 bits, because Dr.Jit has no 16-bit integers."""
    count = dr.width(ids)
    if count > 1:
        first = 2 * dr.arange(type(ids), (count + 1) // 2)
        second = dr.gather(type(ids), ids, first + 1, first + 1 < count)
        ids = dr.gather(type(ids), ids, first) | (second << 16)
    halves = ids.numpy().view(np.uint16)[:count]
    return halves.reshape(shape) if count > 1 else np.full(shape, halves)


def render_silhouettes(
    integrator: mi.Integrator, scene: mi.Scene, camera: Camera, *, source: Literal["splats", "proxies"] = "splats"
) -> dict[int, Silhouette]:
    """Return the unoccluded silhouette of every instance by its id; an instance without pixels is omitted.

    Args:
        integrator: From :func:`make_integrator`.
        scene: Mitsuba scene with shapes of the plugin ``splats``.
        camera: Camera; the sensors of the scene are not used.
        source: ``splats`` or ``proxies``.
    """
    silhouettes = dict(integrator.renderer.silhouettes(scene, _sensor_of(camera, str(mi.variant())), source=source))
    check_dropped_rays()
    return silhouettes


def find_hits(integrator: mi.Integrator, scene: mi.Scene, starts: Float64Array, ends: Float64Array) -> BoolArray:
    """Find the segments that a proxy or a visible mesh intersects.

    Args:
        integrator: From :func:`make_integrator`.
        scene: Mitsuba scene with the meshes.
        starts: Start points [m], shape (N, 3).
        ends: End points [m], shape (N, 3).

    Returns:
        True for the intersected segments, shape (N,).
    """
    blocked: BoolArray = integrator.renderer.blocked(scene, starts, ends)
    check_dropped_rays()
    return blocked
