"""Synthetic scene of three balls on uneven ground, as points with the cameras around them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.isolation import PhotoView
from mitsplat.geometry.camera import Camera

THINGS = ((0.0, 0.0), (0.16, 0.02), (-0.03, 0.18))
"""Ground positions of balls with a radius of 4 cm."""


def ground(places: Float64Array) -> Float64Array:
    """Return the heights of a wavy, sloped ground at positions (N, 2 or more) [m]."""
    return np.asarray(0.006 * np.sin(40 * places[:, 0]) * np.cos(30 * places[:, 1]) + 0.05 * places[:, 0])


def three_balls() -> tuple[Float64Array, Int64Array, list[PhotoView]]:
    """Sample points on the ground (label 0) and on visible parts of the balls (1, 2, 3), and place cameras around."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.4, 0.4, (3000, 3))
    flat[:, 2] = ground(flat)
    clear = np.all([np.linalg.norm(flat[:, :2] - middle, axis=1) > 0.03 for middle in THINGS], axis=0)
    parts, labels = [flat[clear]], [np.zeros(clear.sum(), dtype=np.int64)]
    for number, middle in enumerate(THINGS, 1):
        ball = rng.normal(size=(500, 3))
        ball *= 0.04 / np.linalg.norm(ball, axis=1, keepdims=True)
        ball = ball[ball[:, 2] > -0.03] + (*middle, 0.04 + float(ground(np.array([middle]))[0]))
        parts.append(ball)
        labels.append(np.full(len(ball), number))
    points = np.concatenate(parts) + rng.normal(0, 3e-4, (sum(map(len, parts)), 3))
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    eyes = np.column_stack([0.35 * np.cos(turns), 0.35 * np.sin(turns), np.full(16, 0.2)])
    aims = np.array([0, 0, 0.03]) + rng.normal(0, 0.01, (16, 3))
    cameras = [Camera.look_at(e, a, width=320, height=240, fov_x=60) for e, a in zip(eyes, aims, strict=True)]
    views = []
    for camera in cameras:
        pixels, depth = camera.project(points)
        inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (320, 240)).all(axis=1)
        views.append(PhotoView(camera, np.flatnonzero(inside).astype(np.int32)))
    return points, np.concatenate(labels), views


def capture_of_balls(folder: Path) -> Capture:
    """Save the scene as a capture with grey photos in a folder."""
    points, _, views = three_balls()
    photos = []
    (folder / "grey").mkdir(parents=True)
    for number, view in enumerate(views):
        file = folder / "grey" / f"{number:02d}.png"
        Image.new("RGB", (view.camera.width, view.camera.height), (90, 90, 90)).save(file)
        photos.append(Photo(file.name, file, view.camera, seen=view.seen))
    colours = np.full(points.shape, 128, dtype=np.uint8)
    return Capture(tuple(photos), points, colours, units="metre", up="z").save(folder / "capture")
