"""Conversion of the lights of a scene file to Mitsuba's emitters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.images.colour import temperature_colour
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import LightSpec

MitsubaDict = dict[str, Any]
"""Description of a Mitsuba object, as ``mi.load_dict`` reads it."""


def emitter_dict(light: LightSpec, folder: Path | None = None) -> MitsubaDict:
    """Return Mitsuba's description of one light; environment images are relative to ``folder``."""
    ensure_variant()
    colour = np.asarray(light.colour)
    if light.kind != "environment" and light.temperature is not None:
        colour = colour * temperature_colour(light.temperature)
    if light.kind == "environment":
        if light.image is None:
            return {"type": "constant", "radiance": _rgb(light.radiance * colour)}
        return {
            "type": "envmap",
            "filename": str((folder or Path()) / light.image),
            "scale": light.radiance,
            "to_world": y_up_to_z_up(light.rotate_z),
        }
    if light.kind == "point":
        return {"type": "point", "position": list(light.position), "intensity": _rgb(light.intensity * colour)}
    forward = np.subtract(light.target, light.position)
    up = [0.0, 0.0, 1.0] if np.hypot(forward[0], forward[1]) > 1e-6 * np.linalg.norm(forward) else [0.0, 1.0, 0.0]
    pose = mi.ScalarTransform4f().look_at(origin=list(light.position), target=list(light.target), up=up)
    if light.kind == "spot":
        return {
            "type": "spot",
            "to_world": pose,
            "cutoff_angle": light.cone,
            "intensity": _rgb(light.intensity * colour),
        }
    return {
        "type": "rectangle",
        "to_world": pose @ mi.ScalarTransform4f().scale([0.5 * light.size[0], 0.5 * light.size[1], 1.0]),
        "emitter": {"type": "area", "radiance": _rgb(light.radiance * colour)},
    }


def load_emitter(description: MitsubaDict, *, movable: bool) -> mi.Emitter | mi.Shape:
    """Load an emitter; the pose of a movable one may change in every frame without a new compilation of kernels.

    By default, Mitsuba lists the parts of a scene in arbitrary order if it loads them itself. The order of emitters
    determines the rays of light. The pose of a movable rectangle is made opaque. Its frame is then computed on the
    device, and may differ in the last bit from a constant in kernels. The poses of all other emitters are data already.
    """
    emitter = mi.load_dict(description, parallel=False)
    if movable and description["type"] == "rectangle":
        state = mi.traverse(emitter)
        pose = state["to_world"]
        dr.make_opaque(pose)
        state["to_world"] = pose
        state.update()
    return emitter


def _rgb(value: Float64Array) -> MitsubaDict:
    return {"type": "rgb", "value": value.tolist()}


def y_up_to_z_up(degrees: float) -> mi.ScalarTransform4f:
    """Return the transform that rotates Mitsuba's y-up environment maps to z up, and then about z."""
    transform = mi.ScalarTransform4f()
    return transform.rotate([0, 0, 1], degrees) @ transform.rotate([1, 0, 0], 90.0)
