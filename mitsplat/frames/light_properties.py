"""Lighting properties of the integrator ``splat_proxy`` from a scene file."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.asset import Asset
from mitsplat.frames.scene_builder import SceneBuilder
from mitsplat.renderer.emitters.emitter_sampling import reference_irradiance
from mitsplat.renderer.scene_emitters import MitsubaDict
from mitsplat.scene.planning.frame_lights import expand_rooms, lights_at
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightSpec
from mitsplat.scene.walls import backdrop_distance

CALIBRATION_DRAWS = 16
"""Draws of varying lights whose mean irradiance calibrates captured surroundings."""

Irradiance = tuple[float, float, float]


def light_properties(scene: Scene, layout: int = 0) -> MitsubaDict:
    """Return the lighting properties of the integrator for the environment of a layout."""
    composite = scene.spec.composite
    reference = reference_point(scene)
    return {
        "shadow": "none" if composite.shadow == "none" else "traced",
        "shadow_error": composite.shadow_error,
        # The exposure of a camera is assumed to suit the light, as an automatic exposure does. The image-space shadow
        # only evaluates light relative to the brightest value.
        "metered": composite.exposure != "fixed" or composite.shadow == "image",
        "occluders": composite.occluders,
        "bounce": composite.bounce,
        "highlight": composite.highlight,
        "reference": list(reference),
        # A sky inside a room represents light reflected by the walls. Walls must not occlude it, but near objects must.
        "sky_reach": backdrop_distance(scene.spec, reference) / 2,
        "white": {"type": "rgb", "value": list(white_irradiance(scene, layout))},
        # Pixels without splats show the background of mitsplat.frames.camera_response, not a light source.
        "hide_emitters": True,
    }


def white_irradiance(scene: Scene, layout: int) -> Irradiance:
    """Return the irradiance at which a white surface has the picture value 1 in a layout, by channel [W/m^2].

    It is that which the environment of the layout states, else pi, so that the picture holds radiance. A captured
    environment that states none is calibrated by :func:`capture_irradiance`.
    """
    environment = scene.environment_of(layout)
    if environment is not None and environment.white is not None:
        return (environment.white,) * 3
    return capture_irradiance(scene) if _has_captured_light(environment) and scene.spec.lights else (math.pi,) * 3


def background_light(scene: Scene, layout: int, lit: mi.Scene) -> mi.Color3f:
    """Return the factor (Color3f) that lights the background picture of a frame, whose Mitsuba scene is ``lit``.

    The background shows surfaces that are lit like the reference point: its value 1 is a white surface there. Behind
    captured surroundings, and where light has no effect, it keeps its values as they do.
    """
    factor = np.ones(3)
    if (
        scene.spec.composite.shadow == "traced"
        and lit.emitters()
        and not _has_captured_light(scene.environment_of(layout))
    ):
        factor = np.divide(irradiance_of(scene, lit), white_irradiance(scene, layout))
    return mi.Color3f(*[dr.opaque(mi.Float, float(channel)) for channel in factor])


def _has_captured_light(environment: Asset | None) -> bool:
    """Return True if the colours of an environment contain the light of its capture."""
    return environment is not None and environment.capture_light == "scene" and environment.splats.materials is None


def capture_irradiance(scene: Scene) -> Irradiance:
    """Return the irradiance under which white surfaces of a capture have the value 1, by channel [W/m^2].

    The brightness and white balance of a capture relative to the lights of a scene are unknown. They are chosen such
    that the lights illuminate a white surface at the reference point as the capture shows white surfaces. All frames
    share this calibration. If lights vary, it uses their mean over 16 draws.
    """
    spec, builder = scene.spec, SceneBuilder(scene)
    count = CALIBRATION_DRAWS if any(map(_varies, expand_rooms(spec))) else 1
    # The draws do not depend on the number of layouts, so that more layouts do not change a dataset.
    draws = [lights_at(spec, number, number, (number + 0.5) / count) for number in range(count)]
    lit = (mi.load_dict({"type": "scene", **builder.emitters(lights, movable=count > 1)}) for lights in draws)
    red, green, blue = np.mean([irradiance_of(scene, emitters) for emitters in lit], axis=0).tolist()
    return red, green, blue


def _varies(light: LightSpec) -> bool:
    """Return True if a light differs between frames."""
    moves = light.pool is not None if isinstance(light, EnvironmentLight) else bool(light.path)
    return moves or light.draw is not None


def irradiance_of(scene: Scene, lit: mi.Scene) -> Irradiance:
    """Return the irradiance of a Mitsuba scene's emitters at the reference point, by channel [W/m^2]."""
    red, green, blue = (channel[0] for channel in reference_irradiance(lit, reference_point(scene)))
    return red, green, blue


def reference_point(scene: Scene) -> tuple[float, float, float]:
    """Return the point in the middle of the lit objects [m]: the bottom centre of the drop region."""
    low, high = np.array(scene.spec.region.min), np.array(scene.spec.region.max)
    x, y = (low + high)[:2] / 2
    return float(x), float(y), float(low[2])
