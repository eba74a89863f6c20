"""A small capture whose truth is known: a textured box on a ChArUco board, rendered with sensor noise."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import mitsuba as mi
import numpy as np

from benchmarks.assets.known import table_scene
from benchmarks.assets.photographing import paint, photograph, speckle
from mitsplat.capture.boards.targets import Board
from mitsplat.geometry.camera import Camera

BOARD = Board(7, 5, 0.035)
BOX = np.array([0.07, 0.05, 0.07])
"""Edges of the box [m]; it stands in the middle of the board, z = 0 the board."""

SIZE = (480, 360)
"""Of photos [px]."""
FILM_SIZE = (320, 240)
"""Of a video [px]."""


def cameras(count: int) -> list[Camera]:
    """Cameras around the box, close enough that its sides are matched."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights, radii = np.resize([0.17, 0.22], count), np.resize([0.24, 0.21], count)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
    return [Camera.look_at(place, (0, 0, 0.02), width=SIZE[0], height=SIZE[1], fov_x=48) for place in places]


def capture_cameras() -> list[Camera]:
    """Cameras of a capture, 15 degrees apart, as far around as shows all sides: each pair of its photos is matched."""
    return cameras(24)[:16]


def render_capture(folder: Path, *, samples: int = 8) -> dict[str, Camera]:
    """Render photos into a folder; returns their cameras by name, in the board's frame [m]."""
    return photograph(box_scene(5), capture_cameras(), folder, samples=samples)


def box_scene(seed: int) -> dict[str, Any]:
    """The box on its board; another seed paints box and table differently."""
    rng = np.random.default_rng(seed)
    return table_scene(BOARD, rng) | {f"side{number}": side for number, side in enumerate(_sides(rng))}


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
        colour = paint(speckle(rng, 10, (0.8, 0.4, 0.3)))
        sides.append({"type": "rectangle", "to_world": mi.ScalarTransform4f(pose), "bsdf": colour})
    return sides


def walk(count: int) -> list[Camera]:
    """Cameras of a hand that goes around the box, up and down a little, 96 of them in a turn."""
    angles = 2 * np.pi / 96 * np.arange(count)
    heights, radii = 0.19 + 0.03 * np.sin(3 * angles), 0.23 + 0.015 * np.cos(3 * angles)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
    return [Camera.look_at(place, (0, 0, 0.02), width=FILM_SIZE[0], height=FILM_SIZE[1], fov_x=48) for place in places]


def render_video(file: Path, count: int = 68, *, samples: int = 4) -> dict[int, Camera]:
    """Render a video of 30 frames a second, of which every tenth is blurred; returns its cameras by frame.

    As many as show all sides.
    """
    with TemporaryDirectory() as folder:
        found = photograph(box_scene(5), walk(count), Path(folder), samples=samples)
        writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, FILM_SIZE)
        for number, name in enumerate(found):
            picture = cv2.imread(str(Path(folder) / name))
            writer.write(cv2.blur(picture, (9, 9)) if number % 10 == 5 else picture)
        writer.release()
    return dict(enumerate(found.values()))
