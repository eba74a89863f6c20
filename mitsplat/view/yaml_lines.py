"""YAML lines of a scene file for changes made in the viewer."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from ruamel.yaml import YAML

from mitsplat.arrays import Float64Array
from mitsplat.scene.spec.camera_spec import Intrinsics
from mitsplat.scene.spec.light_spec import LightSpec


def light_line(light: LightSpec) -> str:
    """Return a light as an entry of ``lights:``, without default values."""
    stated = {"kind": light.kind, **light.model_dump(exclude_defaults=True)}
    return f"  - {_flow(stated)}\n"


def camera_lines(pose: Float64Array, look_at: npt.ArrayLike, intrinsics: Intrinsics) -> str:
    """Return a fixed camera at ``world_from_camera`` (4, 4), directed at a point [m], as the key ``camera:``.

    The point is moved onto the axis of the camera, at the same depth.
    """
    eye = pose[:3, 3]
    depth = max(float((np.asarray(look_at) - eye) @ pose[:3, 2]), 0.01)
    stated = {"eye": eye, "target": eye + depth * pose[:3, 2], "up": -pose[:3, 1]}
    lines = "".join(f"  {key}: {list(rounded(vector))}\n" for key, vector in stated.items())
    return f"camera:\n  kind: fixed\n{lines}  intrinsics: {_flow(intrinsics.model_dump(exclude_defaults=True))}\n"


def seed_line(seed: int) -> str:
    """Return the key ``seed:``."""
    return f"seed: {seed}\n"


def rounded(vector: npt.ArrayLike) -> tuple[float, ...]:
    """Round coordinates (3,) [m] to a tenth of a millimetre."""
    return tuple(round(float(value), 4) + 0.0 for value in np.asarray(vector))  # no negative zero


def _flow(value: Mapping[str, object]) -> str:
    """Format a mapping as one line of YAML."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style, yaml.width = True, 10_000
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # in the order given
    out = io.StringIO()
    yaml.dump(_plain(value), out)
    return out.getvalue().strip()


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value
