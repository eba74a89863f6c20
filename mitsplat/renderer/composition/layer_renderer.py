"""Rendering of all layers of a view: primary visibility, light, materials of meshes, and antialiased borders."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.images.masks import Silhouette
from mitsplat.quality import Quality
from mitsplat.renderer.composition.material_borders import FROM_PROXY
from mitsplat.renderer.composition.scene_contents import ContentsReader, SceneContents
from mitsplat.renderer.composition.shape_state import ShapeState
from mitsplat.renderer.instances.antialiasing import Edges
from mitsplat.renderer.instances.primary_visibility import PrimaryVisibility
from mitsplat.renderer.instances.silhouettes import PlacedMesh, proxy_silhouettes, splat_silhouettes, with_area_beyond
from mitsplat.renderer.light.light import light_factor
from mitsplat.renderer.light.lighting import Accuracy
from mitsplat.renderer.light.lit_surface import VisiblePixels, VisibleSurfaces, is_raised
from mitsplat.renderer.meshes.mesh_radiance import PathTracer
from mitsplat.renderer.meshes.visible_meshes import MeshHits, VisibleEmitters, visible_parts
from mitsplat.renderer.occluders.proxies import Hit
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import ray_scene, segments
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.renderer.splatting.march import Image, largest_and_mean, trace
from mitsplat.renderer.splatting.pairs import CrowdedError
from mitsplat.renderer.splatting.static_tile_cache import StaticTileCache

_CacheKey = tuple[tuple[object, ...], Quality, ShapeState]
"""Camera, quality and visible shapes."""


@dataclass(eq=False)
class LayerRenderer:
    """Renderer of the layers of views, with caches that serve the next view.

    The fields are the parameters of the integrator :mod:`mitsplat.plugins.splat_proxy`. Unless ``is_kernel_stated``,
    the kernel that the splat files state takes the place of that of ``quality``.
    """

    quality: Quality
    is_kernel_stated: bool
    shadow: Literal["traced", "none"]
    occluders: Literal["proxies", "splats"]
    shadow_error: float
    metered: bool
    shadow_samples: int
    bounce: bool
    highlight: bool
    hide_emitters: bool
    mesh_samples: int
    max_depth: int
    white: tuple[float, float, float]
    sky_reach: float
    reference: tuple[float, ...]
    _contents: ContentsReader = field(default_factory=ContentsReader, init=False, repr=False)
    _visible_scene: tuple[ShapeState, mi.Scene] | None = field(default=None, init=False, repr=False)
    _static_tiles: tuple[_CacheKey, StaticTileCache | None] | None = field(default=None, init=False, repr=False)

    def render_layers(self, scene: mi.Scene, sensor: mi.Sensor, *, seed: int = 0) -> dict[str, dr.ArrayBase]:
        """Render all layers as flat row-major device arrays: colours linear, depths along z [m].

        Through a thin lens, colours and opacity are means over its aperture; all other layers are those of its centre.
        ``order_error`` holds the largest and the mean error due to the blending order, see :class:`Image`. It is absent
        if the quality has no estimate.
        """
        contents = self._contents.read(scene, self.occluders == "splats")
        scene = self._without_invisible_shapes(scene)
        views = view_of(sensor).apertures(self.quality.lens_rings)
        accuracy = Accuracy(self.shadow_error, self.shadow_samples, self.metered)
        paths = -(-self.mesh_samples // len(views))
        layers = self._layers(contents, scene, views[0], accuracy, paths, seed)
        errors = [layers.pop("order_error")]
        if len(views) > 1:
            # The mean of n views has sqrt(n) times less noise than each view.
            error, most = self.shadow_error * len(views) ** 0.5, -(-self.shadow_samples // len(views))
            coarse = Accuracy(error, most, self.metered)
            blurred = {name: layers[name] for name in ("rgb", "alpha", "captured")}
            for number, view in enumerate(views[1:], start=1):
                seen = self._layers(contents, scene, view, coarse, paths, seed + number)
                errors.append(seen["order_error"])
                blurred = {name: value + seen[name] for name, value in blurred.items()}
                dr.eval(blurred)
            layers |= {name: value / len(views) for name, value in blurred.items()}
            dr.eval(layers)
        if errors[0] is not None:
            layers["order_error"] = dr.concat([reduce(dr.maximum, [e[0] for e in errors]), sum(e[1] for e in errors)])
            layers["order_error"] /= mi.Float([1, len(views)])
        return layers

    def _without_invisible_shapes(self, scene: mi.Scene) -> mi.Scene:
        """Return a scene without shapes that change no light; it is reused while its shapes and emitters stay."""
        parts = visible_parts(scene)
        if parts is None:
            return scene
        if self._visible_scene is None or not self._visible_scene[0].holds_for(parts):
            visible = ray_scene({f"part_{i}": part for i, part in enumerate(parts)})
            self._visible_scene = ShapeState.of(parts), visible
        return self._visible_scene[1]

    def _layers(
        self, contents: SceneContents, scene: mi.Scene, view: CameraView, accuracy: Accuracy, paths: int, seed: int
    ) -> dict[str, dr.ArrayBase]:
        """Render the layers through one point of the lens."""
        rays = view.rays()
        meshes, emitters, z_max = self._trace_meshes_and_emitters(contents, scene, view, rays)
        splat = self._trace_splats(contents, scene, view, z_max)
        hit, static = contents.proxies.nearest(rays)
        proxy_depth = dr.select(hit.distance < dr.inf, hit.distance * view.cosine(rays), 0)
        dr.eval(splat, proxy_depth, hit, static)

        white = self._white()
        shown = PrimaryVisibility.of(splat, meshes, emitters, z_max, dr.pi / white)
        radiance = self._radiance(contents, scene, view, rays, meshes, shown, white, paths, seed)
        light, highlight = mi.Color3f(1), mi.Color3f(0)
        if self._is_lit(scene):
            metallic, roughness, luminance = self._border_materials(contents, view, hit, splat, z_max)
            shown = shown.with_luminance(luminance)
            mesh = shown.diffuse & shown.front
            seen = VisiblePixels(
                direction=rays.d,
                cover=shown.cover,
                depth=dr.select(mesh, meshes.depth, splat.depth) if meshes else splat.depth,
                instance=dr.select(mesh, 0, splat.instance),
                trait=contents.traits.seen(self._shape_votes(contents, view, z_max), splat.instance),
                mesh=mesh,
                metallic=metallic,
                roughness=roughness,
                normal=self._shading_normals(contents, view, hit, splat, z_max),
            )
            # Visible meshes receive light like static proxies, also where splats touch them.
            ground = meshes.before(static) if meshes else static
            dr.eval(seen, ground)
            visible = VisibleSurfaces(contents.traits, view, contents.proxies, rays.o, seen, hit, ground)
            light, highlight = light_factor(
                scene,
                contents.proxies,
                visible,
                accuracy=accuracy,
                seed=seed,
                reference=self.reference,
                white=white,
                sky_reach=self.sky_reach or np.inf,
                grid=contents.grid,
                bounce=self.bounce,
            )
        if not self.highlight:
            highlight = mi.Color3f(0)
        rgb, captured = shown.lit(light, highlight, radiance)
        layers = {
            "rgb": rgb,
            "alpha": shown.alpha,
            "captured": captured,
            "depth": splat.depth if z_max is None else dr.select(shown.front, z_max, splat.depth),
            "instance": splat.instance if z_max is None else dr.select(shown.front, 0, splat.instance),
            "proxy_depth": proxy_depth,
            "proxy_instance": hit.instance,
            "normal": mi.Vector3f(hit.normal),
            "light": light,
            "highlight": highlight,
            "order_error": None if splat.error is None else largest_and_mean(splat.error),
        }
        dr.eval(layers, shown.key)
        if self.quality.rays_at_borders > 1:
            layers |= self._smooth_edges(contents, scene, view, layers, shown.key, radiance, white)
        return layers

    def _smooth_edges(
        self,
        contents: SceneContents,
        scene: mi.Scene,
        view: CameraView,
        layers: dict[str, dr.ArrayBase],
        key: mi.UInt32,
        radiance: mi.Color3f | None,
        white: mi.Color3f,
    ) -> dict[str, mi.Float | mi.Color3f]:
        """Return colours and opacity with several rays averaged at borders between pixels of different ``key``."""
        raised = is_raised(*(layers[name] for name in ("instance", "depth", "proxy_instance", "proxy_depth")))
        edges = Edges.find(key, view, self.quality.rays_at_borders, raised)
        if edges is None:
            return {}
        rays = edges.rays()
        meshes, emitters, z_max = self._trace_meshes_and_emitters(contents, scene, edges.fine, rays, edges.positions())
        splat, own = Image.empty(dr.width(rays.d)), [dr.zeros(mi.Float, dr.width(rays.d))] * 4
        pixel = edges.pixels()
        key_at_pixel = dr.gather(mi.UInt32, key, pixel)
        if contents.clouds is not None:
            splat, own = edges.trace(
                contents.clouds, contents.placements, self._quality_of(contents), key_at_pixel, z_max
            )
        shown = PrimaryVisibility.of(splat, meshes, emitters, z_max, dr.pi / white)
        other = edges.nearest_other(key, shown.key)
        shares = shown.shares(splat, own, key_at_pixel)

        def mixed(values: mi.Color3f, share: mi.Color3f | mi.Float) -> mi.Color3f:
            """Return the mean of the values at the ray's pixel, with weight ``share``, and at the other pixel."""
            if dr.width(values) == 1:
                return values
            return dr.lerp(dr.gather(mi.Color3f, values, other), dr.gather(mi.Color3f, values, pixel), share)

        light, highlight = mixed(layers["light"], shares[0]), mixed(layers["highlight"], shares[1])
        if radiance is not None:
            radiance = dr.gather(mi.Color3f, radiance, dr.select(shown.key == key_at_pixel, pixel, other))
        rgb, captured = shown.lit(light, highlight, radiance)
        fine = {"rgb": rgb, "alpha": shown.alpha, "captured": captured}
        dr.eval(fine)
        smooth = {name: edges.averaged(layers[name], values) for name, values in fine.items()}
        dr.eval(smooth)
        return smooth

    def _trace_meshes_and_emitters(
        self,
        contents: SceneContents,
        scene: mi.Scene,
        view: CameraView,
        rays: mi.Ray3f,
        at: tuple[mi.Float, mi.Float] | None = None,
    ) -> tuple[MeshHits | None, VisibleEmitters | None, mi.Float | None]:
        """Return visible meshes and emitters along rays, and the depths [m] of the nearest of them.

        Rays pass through the positions ``at`` of the view [px], or through the centres of all its pixels.
        """
        meshes = contents.meshes.trace(view, rays, at) if contents.meshes else None
        emitters = None if self.hide_emitters else VisibleEmitters.trace(scene, view, rays)
        z_max = meshes.depth if meshes else None
        if emitters:
            z_max = emitters.depth if z_max is None else dr.minimum(z_max, emitters.depth)
        return meshes, emitters, z_max

    def _radiance(
        self,
        contents: SceneContents,
        scene: mi.Scene,
        view: CameraView,
        rays: mi.Ray3f,
        meshes: MeshHits | None,
        shown: PrimaryVisibility,
        white: mi.Color3f,
        paths: int,
        seed: int,
    ) -> mi.Color3f | None:
        """Return the radiance (Color3f) of path-traced meshes along their visible rays, in the picture's scale."""
        if meshes is None or contents.meshes is None or contents.meshes.diffuse is None:
            return None
        pixel = dr.compress(shown.solid & ~shown.diffuse & (shown.splat_alpha < 1 - 1e-3))
        if not dr.width(pixel):
            return None
        ray, hit = (dr.gather(type(v), v, pixel) for v in (mi.Ray3f(rays), meshes.hit))
        tracer = PathTracer(
            contents.meshes,
            scene,
            contents.proxies,
            contents.mirror,
            white=white,
            max_depth=self.max_depth,
            bounce=self.bounce,
            relights=self._is_lit(scene),
            seed=seed,
        )
        found = tracer.radiance(view, ray, hit, pixel, paths)
        radiance = mi.Color3f(dr.zeros(mi.Float, dr.width(shown.splat_alpha)))
        dr.eval(radiance, found)
        dr.scatter(radiance, found, pixel)
        return radiance

    def silhouettes(
        self, scene: mi.Scene, sensor: mi.Sensor, *, source: Literal["splats", "proxies"] = "splats"
    ) -> dict[int, Silhouette]:
        """Return the unoccluded silhouette of every instance above 0, by its splats or its proxies (``source``).

        Positions are relative to the image and may lie outside it. An instance without pixels is omitted.
        """
        contents = self._contents.read(scene, self.occluders == "splats")
        view = view_of(sensor)
        proxies: dict[int, list[PlacedMesh]] = {}
        for shape in contents.state.shapes:
            if getattr(shape, "instance", 0) and shape.proxy is not None:
                proxies.setdefault(shape.instance, []).append((shape.proxy, shape.world_from_splats))
        if source != "splats":
            found = proxy_silhouettes(proxies, view)
        elif contents.clouds is None:
            return {}
        else:
            found = splat_silhouettes(contents.clouds, contents.placements, view, self._quality_of(contents))
        return with_area_beyond(found, proxies, view)

    def blocked(self, scene: mi.Scene, starts: Float64Array, ends: Float64Array) -> BoolArray:
        """Return True for the segments between points (N, 3) [m] that a proxy or a visible mesh intersects."""
        contents = self._contents.read(scene, self.occluders == "splats")
        found = np.array(contents.proxies.blocked(segments(starts, ends)), dtype=bool)
        return np.broadcast_to(found, len(starts))

    def _quality_of(self, contents: SceneContents) -> Quality:
        """Return the quality with the kernel of a scene's splats."""
        return self.quality if self.is_kernel_stated else replace(self.quality, kernel=contents.kernel)

    def _is_lit(self, scene: mi.Scene) -> bool:
        """Return True if emitters light the splats; otherwise splats have their colours as stored."""
        return self.shadow == "traced" and bool(scene.emitters())

    def _white(self) -> mi.Color3f:
        """Return the irradiance (Color3f) at which a white surface has the picture value 1."""
        return mi.Color3f(*[dr.opaque(mi.Float, value) for value in self.white])

    def _border_materials(
        self, contents: SceneContents, view: CameraView, hit: Hit, splat: Image, z_max: mi.Float | None
    ) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return metalness, roughness and luminance at borders of materials, :data:`FROM_PROXY` elsewhere."""
        if contents.mixed is None:
            return mi.Float(FROM_PROXY), mi.Float(FROM_PROXY), mi.Float(FROM_PROXY)
        return contents.mixed.materials(view, self._quality_of(contents), hit, splat.instance, z_max)

    def _shading_normals(
        self, contents: SceneContents, view: CameraView, hit: Hit, splat: Image, z_max: mi.Float | None
    ) -> mi.Vector3f:
        """Return shading normals that replace those of the proxies, zero elsewhere."""
        if contents.normal_mapped is None:
            return mi.Vector3f(0)
        return contents.normal_mapped.normals(view, self._quality_of(contents), splat, hit, z_max)

    def _shape_votes(self, contents: SceneContents, view: CameraView, z_max: mi.Float | None) -> mi.UInt32 | None:
        """Return the shape of an instance that each pixel shows, or None if all its shapes are lit alike.

        Shapes are rows of :class:`~mitsplat.renderer.light.light_traits.Traits`.
        """
        if contents.traits.placements is None or contents.clouds is None:
            return None
        fine = view.sampled(self.quality.rays_per_axis)
        quality = self._quality_of(contents)
        return trace(contents.clouds, contents.traits.placements, fine, quality, z_max=z_max).instance

    def _trace_splats(
        self, contents: SceneContents, scene: mi.Scene, view: CameraView, z_max: mi.Float | None
    ) -> Image:
        """Render the splats in front of the depths ``z_max`` [m] of meshes and emitters."""
        if contents.clouds is None:
            return Image.empty(view.width * view.height)
        fine, quality = view.sampled(self.quality.rays_per_axis), self._quality_of(contents)
        static_tiles = self._static_tile_cache(contents, scene, fine, z_max)
        if static_tiles is not None:
            objects = [p for p in contents.placements if p.instance]
            with suppress(CrowdedError):
                return static_tiles.with_objects(contents.clouds, objects, fine, quality, z_max)
        return trace(contents.clouds, contents.placements, fine, quality, z_max=z_max)

    def _static_tile_cache(
        self, contents: SceneContents, scene: mi.Scene, view: CameraView, z_max: mi.Float | None
    ) -> StaticTileCache | None:
        """Return the static tile cache of a camera, from its second use on."""
        static = [p for p in contents.placements if p.instance == 0]
        if contents.clouds is None or len(static) == len(contents.placements):
            return None
        if not any(contents.clouds.counts[p.cloud] for p in static):
            return None
        fixed = [s for s in contents.state.shapes if getattr(s, "instance", 0) == 0]
        if not self.hide_emitters:
            fixed += [s for s in scene.shapes() if s.is_emitter()]
        quality = self._quality_of(contents)
        if self._static_tiles is None or not _is_key_of(self._static_tiles[0], view, quality, fixed):
            self._static_tiles = (view.key, quality, ShapeState.of(fixed)), None
        elif self._static_tiles[1] is None:
            with suppress(CrowdedError):
                cache = StaticTileCache.of(contents.clouds, static, view, quality, z_max)
                self._static_tiles = self._static_tiles[0], cache
        return self._static_tiles[1]


def _is_key_of(key: _CacheKey, view: CameraView, quality: Quality, shapes: Sequence[mi.Shape]) -> bool:
    """Return True if a key is that of a camera, a quality and shapes."""
    return key[:2] == (view.key, quality) and key[2].holds_for(shapes)
