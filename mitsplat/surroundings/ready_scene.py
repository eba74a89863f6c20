"""Example scene file that drops objects on the free area of a photographed support, with cameras as in the photos."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE
from mitsplat.storage.files import write_text, yaml_scalar
from mitsplat.surroundings.supports import Support

_MARGIN = 0.05
"""Largest margin between the drop region and its surroundings [m]."""
_MAX_REGION = 0.6
"""Longest side of the drop region [m]."""
_MIN_GAP = 40.0
"""Least azimuth gap between photos that the scene's cameras also avoid [degrees]."""
_BOX_THICKNESS = 0.04
"""Thickness of the boxes [m]."""

_FOLDER = "{folder}"

Rectangle = tuple[float, float, float, float]
"""Rectangle: least and largest x, least and largest y [m]."""


def scene_text(name: str, supports: Sequence[Support], free: Rectangle, cameras: Sequence[Camera]) -> str:
    """Return the text of a scene file, with ``{folder}`` in place of the name of the asset's folder.

    Args:
        name: Name of the environment.
        supports: Supports in the asset's frame [m]; objects are dropped on the first, whose top is z = 0.
        free: Free rectangle of the first support.
        cameras: Cameras of the photos, in the same frame.
    """
    margin = min(_MARGIN, 0.25 * min(free[1] - free[0], free[3] - free[2]))
    spans = []
    for low, high in (free[:2], free[2:]):
        half = min((high - low) / 2 - margin, _MAX_REGION / 2)
        spans.append(((low + high) / 2 - half, (low + high) / 2 + half))
    (x0, x1), (y0, y1) = spans
    target = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.02])
    near, far, low, high, start, end = _camera_ranges(cameras, target)
    middle = cameras[len(cameras) // 2]
    fov = float(np.degrees(2 * np.arctan(middle.width / 2 / middle.fx)))
    boxes = "\n".join(
        f"  - {{name: {_surface_name(number)}, "
        f"box: {{size: [{_length(s.size[0])}, {_length(s.size[1])}, {_BOX_THICKNESS}], "
        f"position: [{_length(s.pose[0, 3])}, {_length(s.pose[1, 3])}, {_length(s.height - _BOX_THICKNESS / 2)}], "
        f"rotate: [0, 0, {s.angle:.2f}]}}}}"
        for number, s in enumerate(supports)
    )
    return _SCENE.format(
        name=yaml_scalar(name), folder=_FOLDER, boxes=boxes, margin=_length(margin),
        x0=_length(x0), x1=_length(x1), y0=_length(y0), y1=_length(y1),
        tx=_length(target[0]), ty=_length(target[1]), near=_length(near), far=_length(far),
        low=f"{low:.0f}", high=f"{high:.0f}", start=f"{start:.0f}", end=f"{end:.0f}", fov=f"{min(fov, 120):.0f}",
    )  # fmt: skip


def _camera_ranges(cameras: Sequence[Camera], target: Float64Array) -> tuple[float, float, float, float, float, float]:
    """Return the ranges of distance [m], elevation and azimuth [degrees] of most photos of a place."""
    away = np.array([camera.centre for camera in cameras]) - target
    distance = np.linalg.norm(away, axis=1)
    height = np.degrees(np.arcsin(np.clip(away[:, 2] / distance, -1, 1)))
    turn = np.sort(np.degrees(np.arctan2(away[:, 1], away[:, 0])))
    gaps = np.diff(np.append(turn, turn[0] + 360))
    widest = int(gaps.argmax())
    start, end = 0.0, 360.0
    if gaps[widest] > _MIN_GAP:
        start = float(np.append(turn, turn[0] + 360)[widest + 1]) % 360
        end = start + 360 - float(gaps[widest])
    near, far = np.quantile(distance, (0.15, 0.7))
    low, high = np.quantile(height, (0.2, 0.9)).clip(10, 80)
    return float(near), max(float(far), 1.05 * float(near)), float(low), max(float(high), float(low) + 2), start, end


def _surface_name(number: int) -> str:
    return "support" if number == 0 else f"surface{number}"


def _length(length: float) -> str:
    """Format a length to a tenth of a millimetre."""
    return f"{round(float(length), 4) + 0.0:g}"


def recorded_scene(out: Path) -> str | None:
    """Return the scene text in the verdict file of an asset's folder, or None."""
    try:
        scene = json.loads((out / VERDICT_FILE).read_text()).get("scene")
    except (OSError, ValueError, AttributeError):
        return None
    return scene.replace(_FOLDER, yaml_scalar(out.resolve().name)) if isinstance(scene, str) else None


def write_recorded_scene(out: Path, earlier: str | None) -> tuple[Path | None, str | None]:
    """Write the recorded scene of an asset, next to its folder; return the file, and a warning if it was edited.

    Args:
        out: Folder of the asset.
        earlier: Scene that an earlier run recorded; a file with another text was edited and is not replaced.
    """
    text, path = recorded_scene(out), out.resolve().parent / f"{out.resolve().name}.yaml"
    if text is None:
        return None, None
    if path.exists() and path.read_text() not in (text, earlier):
        return path, f"{path}: contains another scene and was not replaced; remove it to write a new one"
    write_text(path, text)
    return path, None


_SCENE = """\
# Solids of random materials dropped where {name} is free. Put assets of your own in their place.
name: {name}
environment: {folder}

shapes:
  # Level surfaces that were found in it; the splats show them, and these carry what falls there.
{boxes}

objects:
  - {{pool: primitives, count: [3, 6]}}
region: {{min: [{x0}, {y0}, 0.04], max: [{x1}, {y1}, 0.25]}}
enclosure: {{margin: {margin}}}

camera:  # similar to the cameras of the photos
  kind: hemisphere
  target: [{tx}, {ty}, 0.02]
  radius: [{near}, {far}]
  elevation: [{low}, {high}]
  azimuth: [{start}, {end}]
  accept: {{clearance: 0.1}}
  intrinsics: {{fov_x: {fov}}}
lights:  # a generic room; `mitsplat lights` measures yours
  - {{kind: area, position: [0.5, -0.4, 1.6], target: [0, 0, 0], size: [0.6, 0.6], radiance: 10}}
  - {{kind: environment, radiance: 0.4}}
composite: {{exposure: fixed}}  # that of the photos
output: {{width: 960, height: 540, layouts: 4, views: 3, image: jpg}}
"""
