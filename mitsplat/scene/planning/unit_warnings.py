"""Warnings of values of a scene file that are probably in another unit: millimetres, radians or 8-bit colours."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mitsplat.findings import Finding
from mitsplat.scene.spec.camera_spec import CameraHemisphere, CameraOrbit, CameraPath
from mitsplat.scene.spec.light_spec import DrawnLight, EnvironmentLight, LocalLight, RoomLight, SpotLight
from mitsplat.scene.spec.scene_spec import SceneSpec

MAX_REGION = 20.0
"""Largest plausible edge of a region [m]."""
MAX_LIGHT = 50.0
"""Largest plausible distance of a light from the origin [m]."""
MAX_COLOUR = 16.0
"""Largest plausible factor of the colour of a light."""
MAX_ROOM, MAX_JITTER = 200.0, 1.0
"""Largest plausible edge of a backdrop, and standard deviation of a random displacement [m]."""
MAX_CAMERA_JITTER = 0.3
"""Largest plausible standard deviation of a camera's position, as a fraction of its distance from the target."""
MAX_EXPOSURE, MAX_SPEED, MAX_INTERVAL = 1.0, 10.0, 120.0
"""Largest plausible exposure [s] and belt speed [m/s], and time between two images of a belt [s]."""
RADIAN_STEPS, RADIAN_DIGITS = (np.pi / 4, np.pi / 6), 0.006
"""Angles in degrees that equal a multiple of one of the first within the second are probably radians."""
MAX_RADIANS = np.pi / 2 + RADIAN_DIGITS
"""Elevations and cones of at most this many degrees are probably in radians."""


def unit_warnings(spec: SceneSpec) -> Iterator[Finding]:
    """Yield a finding for each value that is probably in another unit, with the unit as the remedy."""
    for number, (region, _) in enumerate(spec.all_regions):
        key = f"regions[{number - 1}]" if number else "region"
        edge = float(np.max(np.subtract(region.max, region.min)))
        if edge > MAX_REGION:
            yield Finding("region", False, f"{key}: it is {edge:.4g} m long", "is it in millimetres?")
    for number, light in enumerate(spec.lights):
        if isinstance(light, LocalLight):
            away = float(np.linalg.norm(light.position))
            if light.draw is not None and light.draw.distance is not None:
                away = light.draw.distance[1]
            if away > MAX_LIGHT:
                yield Finding("lights", False, f"lights[{number}]: it is {away:.4g} m away", "is it in millimetres?")
        if isinstance(light, LocalLight | EnvironmentLight) and max(light.colour) > MAX_COLOUR:
            text = f"lights[{number}].colour: its factors are up to {max(light.colour):g}"
            yield Finding("lights", False, text, "is it a colour from 0 to 255? Divide it by 255")
        if isinstance(light, RoomLight):
            if light.size > MAX_ROOM:
                text = f"lights[{number}].size: it is {light.size:.4g} m"
                yield Finding("lights", False, text, "is it in millimetres?")
            if (away := float(np.linalg.norm(light.around))) > MAX_LIGHT:
                text = f"lights[{number}].around: it is {away:.4g} m away"
                yield Finding("lights", False, text, "is it in millimetres?")
    yield from _length_warnings(spec)
    yield from _time_warnings(spec)
    yield from _angle_warnings(spec)


def _length_warnings(spec: SceneSpec) -> Iterator[Finding]:
    """Yield a finding for each position, size or displacement that is too large for metres."""
    for number, shape in enumerate(spec.shapes):
        solid = shape.box or shape.bin
        away = 0.0 if solid is None else float(np.linalg.norm(solid.position))
        if away > MAX_REGION:
            text = f"shapes[{number}]: it is {away:.4g} m away from the origin"
            yield Finding("shape", False, text, "is its position in millimetres?")
        if shape.jitter > MAX_JITTER:
            text = f"shapes[{number}].jitter: it is {shape.jitter:g} m"
            yield Finding("shape", False, text, "is it in millimetres?")
    away = _camera_distance(spec)
    for key in ("jitter", "target_jitter"):
        if (jitter := getattr(spec.camera, key, 0.0)) > MAX_CAMERA_JITTER * away:
            text = f"camera.{key}: it is {jitter:g} m, at {away:.3g} m from camera to target"
            yield Finding("views", False, text, "is it in millimetres?")
    if spec.backdrop is not None and max(spec.backdrop.size) > MAX_ROOM:
        text = f"backdrop.size: it is up to {max(spec.backdrop.size):.4g} m"
        yield Finding("backdrop", False, text, "is it in millimetres?")


def _camera_distance(spec: SceneSpec) -> float:
    """Return the largest distance of the camera from what it looks at [m], without jitter."""
    camera = spec.camera
    if isinstance(camera, CameraHemisphere):
        return camera.radius[1]
    if isinstance(camera, CameraOrbit):
        return float(np.hypot(camera.radius, camera.height))
    if isinstance(camera, CameraPath):
        return max(float(np.linalg.norm(np.subtract(key.eye, key.target))) for key in camera.keys)
    middle = np.add(spec.region.min, spec.region.max) / 2
    return float(np.linalg.norm(camera.pose[:3, 3] - middle))


def _time_warnings(spec: SceneSpec) -> Iterator[Finding]:
    """Yield a finding for each exposure, speed or interval that is too large for seconds and metres."""
    if spec.camera.motion is not None and (longest := spec.camera.motion.exposure[1]) > MAX_EXPOSURE:
        text = f"camera.motion.exposure: it is up to {longest:g} s"
        yield Finding("motion", False, text, "is it in milliseconds?")
    if spec.conveyor is not None:
        if abs(spec.conveyor.speed) > MAX_SPEED:
            text = f"conveyor.speed: it is {spec.conveyor.speed:g} m/s"
            yield Finding("motion", False, text, "is it in millimetres per second?")
        if spec.conveyor.interval > MAX_INTERVAL:
            text = f"conveyor.interval: it is {spec.conveyor.interval:g} s"
            yield Finding("motion", False, text, "is it in milliseconds?")


def _angle_warnings(spec: SceneSpec) -> Iterator[Finding]:
    """Yield a finding for each angle in degrees that is probably in radians."""
    turns: list[tuple[str, tuple[float, ...]]] = []
    turns += [(f"shapes[{number}]", one.box.rotate) for number, one in enumerate(spec.shapes) if one.box is not None]
    turns += [(f"objects[{number}]", pose.rotate) for number, one in enumerate(spec.objects) for pose in one.poses]
    flat, camera = list[tuple[str, tuple[float, ...]]](), spec.camera
    if isinstance(camera, CameraHemisphere):
        turns += [("camera.azimuth", camera.azimuth), ("camera.roll", camera.roll)]
        flat.append(("camera.elevation", camera.elevation))
    elif isinstance(camera, CameraOrbit):
        turns += [("camera.sweep", (camera.sweep,)), ("camera.start", (camera.start,))]
    for number, light in enumerate(spec.lights):
        key = f"lights[{number}]"
        if isinstance(light, EnvironmentLight):
            turns.append((f"{key}.rotate_z", (light.rotate_z,)))
        if isinstance(light, SpotLight):
            flat.append((f"{key}.cone", (light.cone,)))
        if isinstance(light, DrawnLight) and light.draw is not None:
            turns += [(f"{key}.draw.rotate_z", light.draw.rotate_z or ()), (f"{key}.draw.azimuth", light.draw.azimuth)]
            flat.append((f"{key}.draw.elevation", light.draw.elevation))
    for key, angles in turns:
        if any(map(_is_radian, angles)):
            verb = "it is rotated by" if "." not in key else "it is"
            text = f"{key}: {verb} {', '.join(f'{angle:g}' for angle in angles)} degrees"
            yield Finding("rotation", False, text, "are these angles radians?")
    for key, angles in flat:
        if any(angles) and max(map(abs, angles)) <= MAX_RADIANS:
            text = f"{key}: it is {', '.join(f'{angle:g}' for angle in angles)} degrees"
            yield Finding("rotation", False, text, "are these angles radians?")


def _is_radian(angle: float) -> bool:
    """Return True if an angle in degrees is a multiple of pi/4 or pi/6 up to a full turn.

    Multiples of pi/6 must have three decimals, because 1.05 may also be degrees.
    """
    quarter, sixth = (
        np.abs(abs(angle) - step * np.arange(1, round(2 * np.pi / step) + 1)).min() for step in RADIAN_STEPS
    )
    has_decimals = abs(angle * 100 - round(angle * 100)) > 1e-6
    return bool(quarter <= RADIAN_DIGITS or (has_decimals and sixth <= RADIAN_DIGITS / 10))
