"""Check for lamps that light no object: surroundings or shapes hide them, or they face away."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mitsuba as mi
import numpy as np

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.findings import Finding
from mitsplat.frames.light_properties import reference_point
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, segments
from mitsplat.runtime.dropped_rays import check_dropped_rays
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.frame_lights import lights_at
from mitsplat.scene.planning.visibility_prediction import enclosing_shape
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import AimedLight, LocalLight, RoomLight, SpotLight
from mitsplat.scene.spec.scene_spec import BACKDROP

DRAWS = 64
"""Number of layouts whose lamps are checked."""
MAX_HIDDEN = 0.15
"""Largest share of hidden lamps that is accepted: a robot arm may hide some positions."""
GRID = 5
"""Number of points along each axis of a drop region to which light must come."""


def check_lamps(scene: Scene) -> Iterator[Finding]:
    """Yield a finding for each entry of ``lights`` whose lamps often light no object.

    The first environment must not hide them from the reference point. Shapes must not hide them from all points of the
    drop regions, and they must not face away from all of these.
    """
    ensure_variant()
    environment = scene.environment_of(0)
    captured = None
    if environment is not None and environment.mesh is not None:
        captured = ray_scene({"environment": plain_mesh(environment.mesh)})
    meshes = [
        mesh
        for shape, mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True)
        if (shape.visible or shape.proxy) and shape.share == 1 and not shape.name.startswith(BACKDROP)
    ]
    shapes = ray_scene({f"shape_{i}": plain_mesh(mesh) for i, mesh in enumerate(meshes)}) if meshes else None
    for number, entry in enumerate(scene.spec.lights):
        lamps = _lamps(scene, number)
        if not lamps:
            continue
        ends = np.array([lamp.position for lamp in lamps])
        hidden = float(_blocked(captured, reference_point(scene), ends).mean())
        if hidden > MAX_HIDDEN:
            text = f"lights[{number}]: the environment hides {hidden:.0%} of these lamps from the objects"
            remedy = "limit draw.azimuth or draw.position to the sides without walls"
            if isinstance(entry, RoomLight):
                remedy = "choose a smaller size, or area lights with draw.azimuth on the sides without walls"
            yield Finding("light", False, text, remedy)
            continue
        towards = [_lit_places(scene, lamp) for lamp in lamps]
        if (away := float(np.mean([not len(places) for places in towards]))) > MAX_HIDDEN:
            which = "this lamp faces" if len(lamps) == 1 else f"{away:.0%} of these lamps face"
            text = f"lights[{number}]: {which} away from all objects"
            yield Finding("light", False, text, "correct its target, position or cone")
            continue
        dark = [
            not enclosing_shape(scene, end) and bool(_blocked(shapes, end, places).all())
            for end, places in zip(ends, towards, strict=True)
            if len(places)
        ]
        if dark and (hidden := float(np.mean(dark))) > MAX_HIDDEN:
            which = "this lamp" if len(lamps) == 1 else f"{hidden:.0%} of these lamps"
            text = f"lights[{number}]: shapes hide {which} from all objects"
            yield Finding("light", False, text, "move it above the table, or limit draw to places above it")


def _lamps(scene: Scene, number: int) -> list[LocalLight]:
    """Return the lamps that one entry of ``lights`` has in the layouts, without equal ones."""
    alone = scene.spec.model_copy(update={"lights": (scene.spec.lights[number],)})
    draws = [lights_at(alone, layout, layout, (layout + 0.5) / DRAWS) for layout in range(DRAWS)]
    return list(dict.fromkeys(light for lights in draws for light in lights if isinstance(light, LocalLight)))


def _lit_places(scene: Scene, lamp: LocalLight) -> Float64Array:
    """Return points (N, 3) [m] of the drop regions in the directions in which a lamp emits."""
    steps = np.linspace(0, 1, GRID)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    boxes = [np.array([region.min, region.max]) for region, _ in scene.spec.all_regions]
    places = np.concatenate([low + grid * (high - low) for low, high in boxes])
    if not isinstance(lamp, AimedLight):
        return places
    places = np.concatenate([places, [np.clip(lamp.target, low, high) for low, high in boxes]])
    axis, ways = np.subtract(lamp.target, lamp.position), places - lamp.position
    cosines = ways @ axis / np.maximum(np.linalg.norm(ways, axis=1) * np.linalg.norm(axis), 1e-12)
    least = np.cos(np.radians(lamp.cone)) if isinstance(lamp, SpotLight) else 0.0
    return np.asarray(places[cosines > least])


def _blocked(surfaces: mi.Scene | None, start: Sequence[float] | Float64Array, ends: Float64Array) -> BoolArray:
    """Return True for ends (N, 3) [m] that a surface, if there is one, hides from the start [m]."""
    if surfaces is None:
        return np.zeros(len(ends), dtype=bool)
    blocked = np.array(surfaces.ray_test(segments(np.broadcast_to(start, ends.shape), ends)), dtype=bool)
    check_dropped_rays()
    return np.broadcast_to(blocked, len(ends))
