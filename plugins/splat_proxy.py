"""Integrator plugin ``splat_proxy``: splats for appearance, proxy meshes for light."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.errors import InputError
from mitsplat.plugins.parameters import Parameters
from mitsplat.quality import resolve_quality
from mitsplat.renderer.composition.layer_renderer import LayerRenderer
from mitsplat.renderer.meshes.mesh_radiance import MAX_DEPTH
from mitsplat.renderer.rays.sensors import view_of
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
         ``gsplat``. (Default: ``mip`` if a splat file states that it was trained with antialiasing, else ``exact``)

     * - samples
       - |int|
       - Rays per pixel along each axis, 1 to 8; or the |string| ``edges``: one ray, and 2 x 2 at borders between
         instances or visible meshes. (Default: 1)

     * - lens_rings
       - |int|
       - Rings of sample points on the aperture of a thin lens, 1 to 8. (Default: 2)

     * - shadow
       - |string|
       - ``traced``: light from the scene's emitters, shadowed by the proxies. ``none``: colours as stored. (Default:
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
       - Largest number of shadow rays, and of reflection rays, per pixel. (Default: 64)

     * - occluders
       - |string|
       - Occluders that cast the shadows of dynamic objects: ``proxies``, or ``splats`` for thin and porous objects,
         which takes longer. (Default: ``proxies``)

     * - bounce
       - |bool|
       - True if objects and diffuse meshes also receive the light that surroundings and other objects reflect, and
         surroundings near objects that of the objects. (Default: true)

     * - highlight
       - |bool|
       - True if reflections without the base colour are added. (Default: true)

     * - white
       - |float| or |rgb|
       - Irradiance at which a white surface has the value 1 in the image [W/m^2]. Splats that were captured under
         uniform light keep their colours under it. (Default: pi, so that the image holds radiance)

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
    reflections, splats that were captured under the scene's light do not show the shadows of added objects. Surfaces of
    the material ``null`` are invisible. Participating media are refused.

    Radiance is multiplied by pi over ``white``. Splats that were captured under the light of the scene keep their
    colours; state the irradiance of a white surface in their capture as ``white``. With a sky, alpha is 1.
    The image holds linear R, G, B, A and the channels of ``aov_names``. ``shadow: traced`` needs at least one emitter;
    without emitters, colours stay as stored. Sensors are :monosp:`opencv_camera`, :monosp:`perspective` and
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
        shadow_error = given.number("shadow_error", 0.03)
        sky_reach = given.number("sky_reach", 0.0)
        if not 0 <= shadow_error < 1:
            given.refuse("shadow_error", "be in [0, 1)", shadow_error)
        if not 0 <= sky_reach < np.inf:
            given.refuse("sky_reach", "be >= 0", sky_reach)
        self.renderer = LayerRenderer(
            quality=replace(resolve_quality(given.string("quality", "balanced")), **refined),
            is_kernel_stated="kernel" in props,
            shadow=given.choice("shadow", "traced", "none"),
            occluders=given.choice("occluders", "proxies", "splats"),
            shadow_error=shadow_error,
            metered=given.boolean("metered", False),
            shadow_samples=given.integer("shadow_samples", 64, 1, 4096),
            bounce=given.boolean("bounce", True),
            highlight=given.boolean("highlight", True),
            hide_emitters=given.boolean("hide_emitters", False),
            mesh_samples=given.integer("mesh_samples", 64, 1, 65536),
            max_depth=given.integer("max_depth", 8, 2, MAX_DEPTH),
            white=given.colour("white", np.pi),
            sky_reach=sky_reach,
            reference=given.point("reference", (0.0, 0.0, 0.0)),
        )

    def aov_names(self) -> list[str]:
        """Return the names of the channels after R, G, B and A."""
        return list(AOVS)

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: mi.UInt32 | int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render an image tensor (H, W, 4 + AOVs), linear RGBA first."""
        if not isinstance(sensor, mi.Sensor):
            sensor = scene.sensors()[sensor]
        number = int(seed if isinstance(seed, int | np.integer) else seed[0])
        layers = self.renderer.render_layers(scene, sensor, seed=number)
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

    def sample(self, *_args: object, **_options: object) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
        """Refuse rays of another integrator, such as `aov`, which nests this one."""
        raise InputError(
            "integrator 'splat_proxy': must not be nested in another integrator; its image has depth, ids, normals and "
            "light as the channels of aov_names()"
        )

    def to_string(self) -> str:
        """Return the description that Mitsuba prints."""
        return f"SplatProxyIntegrator[quality = {self.renderer.quality}, shadow = {self.renderer.shadow}]"


mi.register_integrator("splat_proxy", lambda props: SplatProxyIntegrator(props))
