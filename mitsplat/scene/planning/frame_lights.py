"""Lights of a frame: random draws of their values, and their positions on paths.

The seed and the index of the layout determine the lights, or the index of the frame for lights that vary per frame.
Every value has a random stream of its own, named by the entry of the light, the number of its copy, and the key.
"""

from __future__ import annotations

import numpy as np

from mitsplat.geometry.camera_poses import direction
from mitsplat.scene.spec.light_spec import AimedLight, EnvironmentLight, LightDraw, LightSpec, RoomLight
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.streams import random_stream, weighted_choice

_UNIFORM = ("position", "size", "radiance", "rotate_z")
"""Keys whose values, or components, are uniform between two bounds."""


def expand_rooms(spec: SceneSpec) -> tuple[LightSpec, ...]:
    """Return the lights of a scene file, with rooms expanded to their lights."""
    found: list[LightSpec] = []
    for light in spec.lights:
        found += light.expand() if isinstance(light, RoomLight) else (light,)
    return tuple(found)


def lights_at(spec: SceneSpec, layout: int, index: int, time: float) -> tuple[LightSpec, ...]:
    """Return the lights of frame ``index``, at ``time`` in [0, 1] of the paths of its layout."""
    found = []
    for position, light in enumerate(expand_rooms(spec)):
        number, copies = layout, 1
        if light.draw is not None:
            number = index if light.draw.vary == "frame" else layout
            counts = random_stream(spec.seed, f"light {position} count", number)
            copies = int(counts.integers(*light.draw.count, endpoint=True))
        if isinstance(light, EnvironmentLight):
            light = _with_image(light, random_stream(spec.seed, f"light {position} image", layout))
        for copy in range(copies):
            name, draw = f"{position}.{copy}", light.draw
            drawn = light if draw is None else _draw_values(light, draw, spec.seed, name, number)
            found.append(_at_time(drawn, time))
    return tuple(found)


def _with_image(sky: EnvironmentLight, rng: np.random.Generator) -> EnvironmentLight:
    """Return an environment light with one image of its pool."""
    if sky.pool is None:
        return sky
    image = sky.names[weighted_choice(rng, np.ones(len(sky.names)))[0]]
    return sky.model_copy(update={"image": image, "pool": None})


def _draw_values(light: LightSpec, draw: LightDraw, seed: int, name: str, number: int) -> LightSpec:
    """Return a light with values drawn from its ranges."""

    def stream(key: str) -> np.random.Generator:
        return random_stream(seed, f"light {name} {key}", number)

    def uniform(key: str, low: float, high: float) -> float:
        return float(stream(key).uniform(low, high))

    state: dict[str, object] = {"draw": None}
    for key in _UNIFORM:
        if (bounds := getattr(draw, key)) is not None:
            value = np.asarray(stream(key).uniform(*bounds)).tolist()
            state[key] = tuple(value) if isinstance(value, list) else value
    if draw.temperature is not None:
        low, high = draw.temperature
        state["temperature"] = 1.0 / uniform("temperature", 1.0 / high, 1.0 / low)
    if draw.colour is not None:
        one, other = np.array(draw.colour)
        state["colour"] = tuple((one + uniform("colour", 0.0, 1.0) * (other - one)).tolist())
    if draw.distance is not None:
        target = light.target if isinstance(light, AimedLight) else (0.0, 0.0, 0.0)
        azimuth = np.radians(uniform("azimuth", *draw.azimuth))
        # Uniform by area on the sphere: the sine of the elevation is uniform (Archimedes).
        sine = uniform("elevation", *np.sin(np.radians(draw.elevation)))
        offset = uniform("distance", *draw.distance) * direction(azimuth, sine)
        state["position"] = tuple(np.add(target, offset).tolist())
    return light.model_copy(update=state)


def _at_time(light: LightSpec, time: float) -> LightSpec:
    """Return a light at ``time`` in [0, 1] of its path."""
    if isinstance(light, EnvironmentLight) or not light.path:
        return light
    times = np.linspace(0.0, 1.0, len(light.path))
    positions = np.array([key.position or light.position for key in light.path])
    place = tuple(float(np.interp(time, times, positions[:, axis])) for axis in range(3))
    state: dict[str, object] = {"position": place, "path": ()}
    if light.temperature is not None:
        inverse_kelvins = [1.0 / (key.temperature or light.temperature) for key in light.path]
        state["temperature"] = float(1.0 / np.interp(time, times, inverse_kelvins))
    return light.model_copy(update=state)
