"""Integrator plugin ``splat_proxy``: splats for appearance, proxy meshes for light."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.images.masks import Silhouette
from mitsplat.plugins.parameters import Parameters
from mitsplat.quality import Quality, resolve_quality
from mitsplat.renderer.instances.antialiasing import Edges
from mitsplat.renderer.instances.primary_visibility import PrimaryVisibility
from mitsplat.renderer.instances.silhouettes import proxy_silhouettes, splat_silhouettes
from mitsplat.renderer.light.bounce import RadianceGrid
from mitsplat.renderer.light.emitter_sampling import reference_irradiance
from mitsplat.renderer.light.light import Accuracy, light_factor
from mitsplat.renderer.light.light_traits import Traits
from mitsplat.renderer.light.lit_surface import VisiblePixels, VisibleSurfaces
from mitsplat.renderer.meshes.mesh_radiance import PathTracer
from mitsplat.renderer.meshes.mirrored_splats import SplatMirror
from mitsplat.renderer.meshes.visible_meshes import MeshHits, VisibleEmitters, VisibleMeshes, is_transmissive
from mitsplat.renderer.occluders.proxies import Occluder, Proxies
from mitsplat.renderer.occluders.splat_occlusion import Caster
from mitsplat.renderer.projection.clouds import Cloud, CloudSet, Placement, merge_clouds, upload_cloud
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.renderer.splatting.march import Image, largest_and_mean, trace
from mitsplat.renderer.splatting.pairs import CrowdedError
from mitsplat.renderer.splatting.static_tile_cache import StaticTileCache
from mitsplat.runtime.dropped_rays import check_dropped_rays

AOVS = (
    "captured.R",
    "captured.G",
    "captured.B",
    "depth",
    "instance",
    "proxy.depth",
    "proxy.instance",
    "normal.X",
    "normal.Y",
    "normal.Z",
    "light.R",
    "light.G",
    "light.B",
    "highlight.R",
    "highlight.G",
    "highlight.B",
)
"""Channels after R, G, B, A: linear colour before light, depths along z [m], ids, world normal, light, highlight."""


_CacheKey = tuple[tuple[Any, ...], Quality, list["mi.Shape"]]
"""Camera, quality and visible shapes."""


@dataclass(frozen=True, eq=False)
class _Contents:
    """Device data of all shapes of a scene that emit no light; reused while these shapes stay the same."""

    shapes: tuple[mi.Shape, ...]
    clouds: CloudSet | None
    placements: tuple[Placement, ...]
    proxies: Proxies
    meshes: VisibleMeshes | None
    mirror: SplatMirror | None
    traits: Traits
    grid: RadianceGrid | None


class SplatProxyIntegrator(mi.CppADIntegrator):
    r"""Splats with proxy light (:monosp:`splat_proxy`).

    .. pluginparameters::

     * - quality
       - |string|
       - Preset of the splat renderer: ``fast``, ``balanced`` or ``exact``. (Default: ``balanced``)

     * - response
       - |string|
       - ``perspective``, or ``ewa`` for parallel rays within a Gaussian's footprint. (Default: ``perspective``)

     * - kernel
       - |string|
       - Footprint of a Gaussian: ``exact``, ``mip`` (widened by a pixel), or dilated as by the trainers ``3dgs`` and
         ``gsplat``. (Default: ``exact``)

     * - samples
       - |int|
       - Rays per pixel along each axis, 1 to 8; or the |string| ``edges``: one ray, and 2 x 2 at borders between
         instances or visible meshes. (Default: 1)

     * - lens_rings
       - |int|
       - Rings of sample points on the aperture of a thin lens, 1 to 8. (Default: 2)

     * - shadow
       - |string|
       - ``traced``: light from the scene's emitters, shadowed by the proxies. ``none``: colours as captured. (Default:
         ``traced``)

     * - shadow_error
       - |float|
       - Target standard error of mid-grey irradiance, scaled perceptually elsewhere; in (0, 1). With 0, every pixel
         takes ``shadow_samples`` rays. (Default: 0.03)

     * - metered
       - |bool|
       - True if automatic exposure normalises the mean brightness of the picture; ``shadow_error`` then refers to the
         exposed picture. (Default: false)

     * - shadow_samples
       - |int|
       - Largest number of shadow rays per pixel. (Default: 64)

     * - occluders
       - |string|
       - Occluders that cast the shadows of dynamic objects: ``proxies``, or ``splats`` for thin and porous objects,
         which takes longer. (Default: ``proxies``)

     * - bounce
       - |bool|
       - True if uniformly captured objects and diffuse meshes also receive the light that surroundings and visible
         meshes reflect. (Default: true)

     * - highlight
       - |bool|
       - True if surfaces show highlights of lights, by the roughness and specular of the splats. (Default: true)

     * - white
       - |float|
       - Irradiance under which uniformly captured colours are shown unchanged [W/m^2]. Use pi if radiance 1 is the
         white of the surroundings, as in baked ones. (Default: 0, the irradiance of an unoccluded horizontal surface at
         ``reference``)

     * - sky_reach
       - |float|
       - Largest distance at which an object occludes the sky [m]. With a distance below that of the walls of a room, a
         sky represents the light that the walls reflect. (Default: 0, any distance)

     * - reference
       - |point|
       - Point in the middle of the lit objects. (Default: origin)

     * - mesh_samples
       - |int|
       - Light paths per pixel of visible meshes that are not purely diffuse, 1 to 65536. (Default: 64)

     * - max_depth
       - |int|
       - Largest length of these paths, 2 to 64, as in Mitsuba's own integrators: 2 is direct light. (Default: 8)

     * - hide_emitters
       - |bool|
       - True if the camera sees no emitters: neither area lights nor an uncovered sky. (Default: false)

    Every :monosp:`splats` shape is blended front to back per pixel. Other meshes of the scene occlude splats behind
    them and are occluded by splats in front of them. They cast shadows on splats unless light passes through them.
    Purely diffuse meshes are lit like splats, from both sides, by emitters and by reflected light of the surroundings.
    All other materials of Mitsuba are path traced: metal reflects, and glass shows, splats, meshes and emitters. In
    reflections, splats that were captured under the scene's light do not show the shadows of added objects.

    The irradiance ``white`` is the white of the picture: radiance is multiplied by pi over it. With a sky, alpha is 1.
    The image holds linear R, G, B, A and the channels of ``aov_names``. ``shadow: traced`` needs at least one emitter;
    without emitters, colours stay as captured. Sensors are :monosp:`opencv_camera`, :monosp:`perspective` and
    :monosp:`thinlens`; the filter of their film and their sampler are not used.

    .. tabs::

        .. code-tab:: xml

            <integrator type="splat_proxy">
                <string name="quality" value="balanced"/>
                <float name="shadow_error" value="0.01"/>
            </integrator>
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        given = Parameters(props, "integrator 'splat_proxy'")
        refined: dict[str, Any] = {
            "response": given.string("response", "perspective"),
            "kernel": given.string("kernel", "exact"),
            "samples": props.get("samples", 1),
            "lens_rings": props.get("lens_rings", 2),
        }
        self.quality = replace(resolve_quality(given.string("quality", "balanced")), **refined)
        self.shadow = given.choice("shadow", "traced", "none")
        self.occluders = given.choice("occluders", "proxies", "splats")
        self.shadow_error = given.number("shadow_error", 0.03)
        if not 0 <= self.shadow_error < 1:
            given.refuse("shadow_error", "be in [0, 1)", self.shadow_error)
        self.metered = given.boolean("metered", False)
        self.shadow_samples = given.integer("shadow_samples", 64, 1, 4096)
        self.bounce, self.highlight = given.boolean("bounce", True), given.boolean("highlight", True)
        self.hide_emitters = given.boolean("hide_emitters", False)
        self.mesh_samples = given.integer("mesh_samples", 64, 1, 65536)
        self.max_depth = given.integer("max_depth", 8, 2, 64)
        self.white = given.number("white", 0.0)
        if not 0 <= self.white < np.inf:
            given.refuse("white", "be >= 0", self.white)
        self.sky_reach = given.number("sky_reach", 0.0)
        if not 0 <= self.sky_reach < np.inf:
            given.refuse("sky_reach", "be >= 0", self.sky_reach)
        self.reference = tuple(float(v) for v in np.array(props.get("reference", mi.ScalarPoint3f(0))).ravel())
        self._contents: _Contents | None = None
        self._uploaded: list[tuple[Splats, Cloud]] = []
        self._grid: tuple[mi.Shape, RadianceGrid | None] | None = None
        self._static_tiles: tuple[_CacheKey, StaticTileCache | None] | None = None

    def aov_names(self) -> list[str]:
        """Return the names of the channels after R, G, B and A."""
        return list(AOVS)

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render an image tensor (H, W, 4 + AOVs), linear RGBA first."""
        if not isinstance(sensor, mi.Sensor):
            sensor = scene.sensors()[sensor]
        layers = self.render_layers(scene, sensor, seed=int(seed))
        view = view_of(sensor)
        channels = [*layers["rgb"], layers["alpha"], *layers["captured"], layers["depth"], mi.Float(layers["instance"])]
        channels += [layers["proxy_depth"], mi.Float(layers["proxy_instance"]), *layers["normal"]]
        channels += [*layers["light"], *layers["highlight"]]
        flat = dr.empty(mi.Float, view.width * view.height * len(channels))
        pixel = dr.arange(mi.UInt32, view.width * view.height)
        for i, channel in enumerate(channels):
            dr.scatter(flat, channel, pixel * len(channels) + i)
        image = mi.TensorXf(flat, shape=(view.height, view.width, len(channels)))
        if evaluate:
            dr.eval(image)
            check_dropped_rays()
        return image

    def render_layers(self, scene: mi.Scene, sensor: mi.Sensor, *, seed: int = 0) -> dict[str, dr.ArrayBase]:
        """Render all layers as flat row-major device arrays: colours linear, depths along z [m].

        Through a thin lens, colours and opacity are means over its aperture; all other layers are those of its centre.
        ``order_error`` holds the largest and the mean error due to the blending order, see :class:`Image`. It is absent
        if the quality has no estimate.
        """
        contents = self._read(scene)
        views = view_of(sensor).apertures(self.quality.lens_rings)
        accuracy = Accuracy(self.shadow_error, self.shadow_samples, self.metered)
        paths = -(-self.mesh_samples // len(views))
        layers, errors = self._layers(contents, scene, views[0], accuracy, paths, seed), []
        errors.append(layers.pop("order_error"))
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

    def _layers(
        self, contents: _Contents, scene: mi.Scene, view: CameraView, accuracy: Accuracy, paths: int, seed: int
    ) -> dict[str, dr.ArrayBase]:
        """Render the layers through one point of the lens."""
        rays = view.rays()
        behind, emitters, z_max = self._trace_background(contents, scene, view, rays)
        splat = self._trace_splats(contents, scene, view, z_max)
        hit, static = contents.proxies.nearest(rays)
        proxy_depth = dr.select(hit.distance < dr.inf, hit.distance * view.cosine(rays), 0)
        dr.eval(splat, proxy_depth, hit, static)

        white = self._white(scene) if scene.emitters() else mi.Color3f(dr.opaque(mi.Float, float(np.pi)))
        shown = PrimaryVisibility.of(splat, behind, emitters, z_max, dr.pi / white)
        radiance = self._radiance(contents, scene, view, rays, behind, shown, white, paths, seed)
        light, highlight = mi.Color3f(1), mi.Color3f(0)
        if self.shadow == "traced" and scene.emitters():
            mesh = shown.diffuse & shown.front
            seen = VisiblePixels(
                rays.d,
                shown.cover,
                dr.select(mesh, behind.depth, splat.depth) if behind else splat.depth,
                dr.select(mesh, 0, splat.instance),
                contents.traits.seen(self._shape_votes(contents, view, z_max), splat.instance),
                mesh,
            )
            # Visible meshes receive light like static proxies, also where splats touch them.
            ground = behind.before(static) if behind else static
            dr.eval(seen, ground)
            light, highlight = light_factor(
                scene,
                contents.proxies,
                VisibleSurfaces(contents.traits, view, contents.proxies, rays.o, seen, hit, ground),
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
        if self.quality.samples == "edges":
            layers |= self._smooth_edges(contents, scene, view, layers, shown.key, radiance, white)
        return layers

    def _smooth_edges(
        self,
        contents: _Contents,
        scene: mi.Scene,
        view: CameraView,
        layers: dict[str, dr.ArrayBase],
        key: mi.UInt32,
        radiance: mi.Color3f,
        white: mi.Color3f,
    ) -> dict[str, mi.Float | mi.Color3f]:
        """Return colours and opacity with several rays averaged at borders between pixels of different ``key``."""
        edges = Edges.find(key, view)
        if edges is None:
            return {}
        rays = edges.rays()
        behind, emitters, z_max = self._trace_background(contents, scene, edges.fine, rays, edges.positions())
        splat = Image.empty(dr.width(rays.d))
        if contents.clouds is not None:
            splat = edges.trace(contents.clouds, contents.placements, self.quality, z_max)
        shown = PrimaryVisibility.of(splat, behind, emitters, z_max, dr.pi / white)
        pixel = edges.nearest_same(key, shown.key)

        def near(values: mi.Color3f) -> mi.Color3f:
            """Return the values of the nearest pixel with the same key."""
            return values if dr.width(values) == 1 else dr.gather(type(values), values, pixel)

        lights = near(layers["light"]), near(layers["highlight"])
        rgb, captured = shown.lit(*lights, None if radiance is None else near(radiance))
        fine = {"rgb": rgb, "alpha": shown.alpha, "captured": captured}
        dr.eval(fine)
        smooth = {name: edges.averaged(layers[name], values) for name, values in fine.items()}
        dr.eval(smooth)
        return smooth

    def _trace_background(
        self,
        contents: _Contents,
        scene: mi.Scene,
        view: CameraView,
        rays: mi.Ray3f,
        at: tuple[mi.Float, mi.Float] | None = None,
    ) -> tuple[MeshHits | None, VisibleEmitters | None, mi.Float | None]:
        """Return visible meshes and emitters along rays, and the depths [m] of the nearest of them.

        Rays pass through the positions ``at`` of the view [px], or through the centres of all its pixels.
        """
        behind = contents.meshes.trace(view, rays, at) if contents.meshes else None
        emitters = None if self.hide_emitters else VisibleEmitters.trace(scene, view, rays)
        z_max = behind.depth if behind else None
        if emitters:
            z_max = emitters.depth if z_max is None else dr.minimum(z_max, emitters.depth)
        return behind, emitters, z_max

    def _radiance(
        self,
        contents: _Contents,
        scene: mi.Scene,
        view: CameraView,
        rays: mi.Ray3f,
        behind: MeshHits | None,
        shown: PrimaryVisibility,
        white: mi.Color3f,
        paths: int,
        seed: int,
    ) -> mi.Color3f | None:
        """Return the radiance (Color3f) of path-traced meshes along their visible rays, in the picture's scale."""
        if behind is None or contents.meshes is None or contents.meshes.diffuse is None:
            return None
        pixel = dr.compress(shown.solid & ~shown.diffuse & (shown.splat_alpha < 1 - 1e-3))
        if not dr.width(pixel):
            return None
        ray, hit = (dr.gather(type(v), v, pixel) for v in (mi.Ray3f(rays), behind.hit))
        tracer = PathTracer(
            contents.meshes,
            scene,
            contents.proxies,
            contents.mirror,
            exposure=dr.pi / white,
            white=white,
            max_depth=self.max_depth,
            bounce=self.bounce,
            seed=seed,
        )
        found = tracer.radiance(view, ray, hit, pixel, paths)
        radiance = mi.Color3f(dr.zeros(mi.Float, dr.width(shown.splat_alpha)))
        dr.eval(radiance, found)
        dr.scatter(radiance, found, pixel)
        return radiance

    def silhouettes(self, scene: mi.Scene, sensor: mi.Sensor, *, source: str = "splats") -> dict[int, Silhouette]:
        """Return the unoccluded silhouette of every instance above 0, by its splats or its proxies (``source``).

        Positions are relative to the image and may lie outside it. An instance without pixels is omitted.
        """
        contents = self._read(scene)
        view = view_of(sensor)
        if source == "splats":
            if contents.clouds is None:
                return {}
            return splat_silhouettes(contents.clouds, contents.placements, view, self.quality)
        proxies: dict[int, list[tuple[trimesh.Trimesh, np.ndarray]]] = {}
        for shape in contents.shapes:
            if getattr(shape, "instance", 0) and shape.proxy is not None:
                proxies.setdefault(shape.instance, []).append((shape.proxy, shape.world_from_splats))
        return proxy_silhouettes(proxies, view)

    def _white(self, scene: mi.Scene) -> mi.Color3f:
        """Return the irradiance (Color3f) at which uniformly captured objects keep their colours."""
        return (
            mi.Color3f(dr.opaque(mi.Float, self.white)) if self.white else reference_irradiance(scene, self.reference)
        )

    def _shape_votes(self, contents: _Contents, view: CameraView, z_max: mi.Float | None) -> mi.UInt32 | None:
        """Return the shape of an instance that each pixel shows, or None if all its shapes are lit alike.

        Shapes are rows of :class:`Traits`.
        """
        if contents.traits.placements is None or contents.clouds is None:
            return None
        fine = view.sampled(self.quality.rays_per_axis)
        return trace(contents.clouds, contents.traits.placements, fine, self.quality, z_max=z_max).instance

    def _trace_splats(self, contents: _Contents, scene: mi.Scene, view: CameraView, z_max: mi.Float | None) -> Image:
        if contents.clouds is None:
            return Image.empty(view.width * view.height)
        fine = view.sampled(self.quality.rays_per_axis)
        static_tiles = self._static_tile_cache(contents, scene, fine, z_max)
        if static_tiles is not None:
            objects = [p for p in contents.placements if p.instance]
            with suppress(CrowdedError):
                return static_tiles.with_objects(contents.clouds, objects, fine, self.quality, z_max)
        return trace(contents.clouds, contents.placements, fine, self.quality, z_max=z_max)

    def _static_tile_cache(
        self, contents: _Contents, scene: mi.Scene, view: CameraView, z_max: mi.Float | None
    ) -> StaticTileCache | None:
        """Return the static tile cache of a camera, from its second use on."""
        static = [p for p in contents.placements if p.instance == 0]
        if contents.clouds is None or len(static) == len(contents.placements):
            return None
        if not any(contents.clouds.counts[p.cloud] for p in static):
            return None
        fixed = [s for s in contents.shapes if getattr(s, "instance", 0) == 0]
        if not self.hide_emitters:
            fixed += [s for s in scene.shapes() if s.is_emitter()]
        seen = view.key, self.quality, fixed
        if self._static_tiles is None or not _same_key(self._static_tiles[0], seen):
            self._static_tiles = seen, None
        elif self._static_tiles[1] is None:
            with suppress(CrowdedError):
                self._static_tiles = seen, StaticTileCache.of(contents.clouds, static, view, self.quality, z_max)
        return self._static_tiles[1]

    def _read(self, scene: mi.Scene) -> _Contents:
        """Upload the data of the shapes unless they are those of the last call."""
        # Emitter shapes change from frame to frame; as contents they are neither visible nor occluders.
        shapes = tuple(s for s in scene.shapes() if not s.is_emitter())
        known = self._contents
        if known is not None and _identical(known.shapes, shapes):
            return known
        carriers = [s for s in shapes if hasattr(s, "world_from_splats")]
        visible = [s for s in shapes if not hasattr(s, "world_from_splats")]
        distinct = list({id(c.splats): c.splats for c in carriers}.values())
        number = {id(splats): i for i, splats in enumerate(distinct)}
        placements = tuple(
            Placement(number[id(c.splats)], c.world_from_splats, c.instance, c.appearance) for c in carriers
        )
        occluders = [
            Occluder(c.proxy, c.instance, c.dynamic, c.world_from_splats) for c in carriers if c.proxy is not None
        ]
        casters = None
        if self.occluders == "splats":
            casters = [Caster(c.splats, c.instance, c.world_from_splats) for c in carriers if c.dynamic]
        clouds, meshes = self._upload(distinct), VisibleMeshes.build(visible)
        mirror = None
        if meshes is not None and meshes.diffuse is not None:
            mirror = SplatMirror.build(clouds, placements, distinct, [c.capture_light == "uniform" for c in carriers])
        self._contents = _Contents(
            shapes,
            clouds,
            placements,
            Proxies(occluders, [s for s in visible if not is_transmissive(s.bsdf())], casters),
            meshes,
            mirror,
            Traits.of(carriers, placements),
            self._surroundings(carriers),
        )
        return self._contents

    def _surroundings(self, carriers: list[mi.Shape]) -> RadianceGrid | None:
        """Return the radiance grid of the largest splats that were captured under the scene's light."""
        static = [c for c in carriers if not c.dynamic and c.capture_light == "scene" and len(c.splats)]
        if not static:
            return None
        largest = max(static, key=lambda c: len(c.splats))
        if self._grid is None or self._grid[0] is not largest:
            self._grid = largest, RadianceGrid.build(largest.splats, largest.world_from_splats)
        return self._grid[1]

    def _upload(self, distinct: list[Splats]) -> CloudSet | None:
        """Upload splats; copies of the last call are reused, because layouts of a scene share their assets."""
        kept = {id(splats): (splats, cloud) for splats, cloud in self._uploaded}
        self._uploaded = [
            kept.get(id(s)) or (s, upload_cloud(s.means, s.quats, s.scales, s.opacities, s.sh)) for s in distinct
        ]
        clouds = [cloud for _, cloud in self._uploaded]
        return merge_clouds(clouds) if sum(c.count for c in clouds) else None

    def to_string(self) -> str:
        """Return the description that Mitsuba prints."""
        return f"SplatProxyIntegrator[quality = {self.quality}, shadow = {self.shadow}]"


def _same_key(a: _CacheKey, b: _CacheKey) -> bool:
    """Return True if two keys of camera, quality and shapes are the same."""
    return a[:2] == b[:2] and _identical(a[2], b[2])


def _identical(some: Sequence[mi.Shape], others: Sequence[mi.Shape]) -> bool:
    return len(some) == len(others) and all(a is b for a, b in zip(some, others, strict=True))


mi.register_integrator("splat_proxy", lambda props: SplatProxyIntegrator(props))
