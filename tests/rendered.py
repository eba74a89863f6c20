"""Small rendered capture with known ground truth: a textured box on a ChArUco board, with sensor noise."""

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
"""Edge lengths of the box [m]. The box stands in the middle of the board, which lies at z = 0."""

SIZE = (480, 360)
"""Size of photos [px]."""
FILM_SIZE = (320, 240)
"""Size of a video [px]."""


def cameras(count: int) -> list[Camera]:
    """Place cameras around the box, close enough to match its sides."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights, radii = np.resize([0.17, 0.22], count), np.resize([0.24, 0.21], count)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
    return [Camera.look_at(place, (0, 0, 0.02), width=SIZE[0], height=SIZE[1], fov_x=48) for place in places]


def capture_cameras() -> list[Camera]:
    """Return the cameras of a capture, 15 degrees apart, over an arc that shows all sides.

    The arc is not longer, because each pair of photos is matched.
    """
    return cameras(24)[:16]


def render_capture(folder: Path, *, samples: int = 8) -> dict[str, Camera]:
    """Render photos into a folder, and return their cameras by name, in the board's frame [m]."""
    return photograph(box_scene(5), capture_cameras(), folder, samples=samples)


def box_scene(seed: int) -> dict[str, Any]:
    """Build the box on its board. Another seed changes the textures of box and table."""
    rng = np.random.default_rng(seed)
    return table_scene(BOARD, rng) | {f"side{number}": side for number, side in enumerate(_sides(rng))}


def _sides(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Build the visible sides of the box with different textures. Equal sides would be matched with each other."""
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
    """Return the cameras of a hand-held walk around the box, with small vertical motion and 96 cameras per turn."""
    angles = 2 * np.pi / 96 * np.arange(count)
    heights, radii = 0.19 + 0.03 * np.sin(3 * angles), 0.23 + 0.015 * np.cos(3 * angles)
    places = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
    return [Camera.look_at(place, (0, 0, 0.02), width=FILM_SIZE[0], height=FILM_SIZE[1], fov_x=48) for place in places]


def render_video(file: Path, count: int = 68, *, samples: int = 4) -> dict[int, Camera]:
    """Render a video at 30 frames per second with every tenth frame blurred, and return its cameras by frame.

    The default number of frames shows all sides.
    """
    with TemporaryDirectory() as folder:
        found = photograph(box_scene(5), walk(count), Path(folder), samples=samples)
        writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, FILM_SIZE)
        for number, name in enumerate(found):
            picture = cv2.imread(str(Path(folder) / name))
            writer.write(cv2.blur(picture, (9, 9)) if number % 10 == 5 else picture)
        writer.release()
    return dict(enumerate(found.values()))
