"""A small capture whose truth is known: a textured box on a ChArUco board, rendered with sensor noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

from mitsplat.board import Board
from mitsplat.camera import Camera
from mitsplat.render import ensure_variant

BOARD = Board(7, 5, 0.035)
BOX = np.array([0.07, 0.05, 0.07])
"""Edges of the box [m]; it stands in the middle of the board, z = 0 the board."""

SIZE = (480, 360)


def cameras(count: int) -> list[Camera]:
    """Cameras around the box, close enough that its sides are matched."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights, radii = np.resize([0.17, 0.22], count), np.resize([0.24, 0.21], count)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
    return [Camera.look_at(place, (0, 0, 0.02), width=SIZE[0], height=SIZE[1], fov_x=48) for place in places]


def render_capture(folder: Path, count: int = 16, *, samples: int = 8) -> dict[str, Camera]:
    """Render photos into a folder; returns their cameras by name, in the board's frame [m]."""
    ensure_variant()
    folder.mkdir(parents=True, exist_ok=True)
    scene = mi.load_dict(_scene())
    rng = np.random.default_rng(0)
    views = {}
    for number, camera in enumerate(cameras(count)):
        radiance = np.array(mi.render(scene, sensor=_sensor(camera), spp=samples, seed=number))[..., :3]
        noisy = np.clip(radiance, 0, 1) ** (1 / 2.2) + rng.normal(0, 0.01, radiance.shape)
        name = f"photo{number:02}.png"
        Image.fromarray(np.rint(255 * noisy.clip(0, 1)).astype(np.uint8)).save(folder / name)
        views[name] = camera
    return views


def _sensor(camera: Camera) -> Any:
    """Mitsuba's own camera: x left and y up, half a pixel as here."""
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))),
            "to_world": mi.ScalarTransform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
            "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
        }
    )


def _scene() -> dict[str, Any]:
    rng = np.random.default_rng(5)
    board = BOARD.draw(60).astype(np.float32) / 255
    sheet = np.array([BOARD.columns, BOARD.rows]) * BOARD.square / 2
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.8}},
        "lamp": {
            "type": "sphere",
            "center": [0.4, -0.3, 0.9],
            "radius": 0.15,
            "light": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
        },
        "board": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale([float(sheet[0]), float(sheet[1]), 1]),
            "bsdf": _paint(np.repeat(0.05 + 0.75 * board[..., None], 3, axis=2)),
        },
        "table": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -0.0005]).scale([0.5, 0.5, 1]),
            "bsdf": _paint(_noise(rng, 40, (0.5, 0.45, 0.4))),
        },
        **{f"side{number}": side for number, side in enumerate(_sides(rng))},
    }


def _sides(rng: np.random.Generator) -> list[dict[str, Any]]:
    """The box's visible sides, each painted differently: equal ones would be matched with each other."""
    sides = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1)):
        normal = sign * np.eye(3)[axis]
        across = np.eye(3)[(axis + 1) % 3]
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([across, np.cross(normal, across), normal])
        pose[:3, :2] *= np.abs(BOX / 2 @ pose[:3, :2])
        pose[:3, 3] = BOX / 2 * normal + (0, 0, BOX[2] / 2)
        paint = _paint(_noise(rng, 10, (0.8, 0.4, 0.3)))
        sides.append({"type": "rectangle", "to_world": mi.ScalarTransform4f(pose), "bsdf": paint})
    return sides


def _noise(rng: np.random.Generator, size: int, colour: tuple[float, float, float]) -> np.ndarray:
    return np.clip(np.array(colour) * rng.uniform(0.1, 1.3, (size, size, 1)), 0, 1).astype(np.float32)


def _paint(texture: np.ndarray) -> dict[str, Any]:
    """A matt surface with this texture, its first row above."""
    bitmap = mi.Bitmap(np.ascontiguousarray(texture[::-1], dtype=np.float32))
    colour = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
