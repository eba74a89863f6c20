"""A mirror ball in a photograph: where it is, and the panorama that it mirrors.

A light probe after Debevec (1998), "Rendering synthetic objects into real scenes", here of a camera that is near.
The ball is a unit sphere around the origin, the camera at D radii from it in the direction d. A point whose normal is
at the angle b from d is seen at the angle s from the ball's middle, tan(s) = sin(b) / (D - cos(b)), and mirrors what
is at the angle 2 b + s from d. The last point that is seen has cos(b) = 1 / D and mirrors what is at 180 degrees - a,
where sin(a) = 1 / D: what is within a of the direction behind the ball is never seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import maximum_filter

from mitsplat.arrays import BoolArray, ByteImage, Float32Array, Float64Array
from mitsplat.capture.lighting.panorama import directions, resized, solid_angles, unit_vector
from mitsplat.geometry.camera import Camera

WIDTH = 1024
"""Of panoramas of balls [px]."""
_FAR = 1000.0
"""Focal length of a camera of which it is not known, in radii of the ball: its rays are parallel."""
_COARSE, _FINE = 96, 700
"""Longest edges of the pictures that circles are looked for in, and measured in [px]."""
_LOWEST = 10
"""Shorter edge of the first one below which nothing is looked for [px]."""
_SMALLEST = 0.1
"""Least radius of a ball that is found, as a share of the shorter edge."""
_INSIDE = 0.7
"""Share of its radius that a circle's middle is from the border: one that is cut is found as well, and refused."""
_CANDIDATES = 30
_NEARLY = 0.85
"""Share of the best circle's score from which a larger one around it is the outline."""
_LEAST = 0.55
"""Least score of a ball's outline."""
_STEPS = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3)
_AROUND = np.stack(np.meshgrid(*[np.arange(-8, 9) / 100] * 2, np.arange(94, 113) / 100, indexing="ij"), axis=-1)
"""Shifts by shares of the radius, and factors on it."""
_MARGIN = 1.5
"""Width of the ball's rim that is mixed with what is behind it [px]."""
_RING = 10.0
"""Width of the ring around the blind spot by which it is filled [degrees]."""

Circle = tuple[float, float, float]
"""Middle and radius [px]."""


@dataclass(frozen=True, eq=False)
class BallPanorama:
    """What a ball mirrors.

    Attributes:
        radiance: Equirectangular, (H, W, 3).
        blind: Half angle of what the ball hides, which has the mean of a ring around it [degrees].
        clipped: Share of the ball's image that is a lower bound.
    """

    radiance: Float32Array
    blind: float
    clipped: float


def find_ball(*exposures: ByteImage) -> Circle | None:
    """The circle that stands out as a ball's outline does in one of the exposures of a view, or None.

    Circles are judged by the gradient across them, averaged along them (Daugman 1993), which is capped so that no part
    outweighs the others, less that along them. All are tried in a small picture, and the best ones climb in finer ones.
    Where the ball mirrors a corner of the room as a circle within its outline, the largest counts.

    Args:
        exposures: RGB, (H, W, 3).
    """
    found = [ball for picture in exposures if (ball := _find_ball(picture)) is not None]
    return max(found, key=lambda ball: ball[0])[1] if found else None


def _find_ball(picture: ByteImage) -> tuple[float, Circle] | None:
    """The circle that stands out most, and its score."""
    scale = _COARSE / max(picture.shape[:2])
    if scale * min(picture.shape[:2]) < _LOWEST:
        return None
    slopes = _Slopes.of(picture, scale)
    height, width = slopes.x.shape[:2]
    radii = np.geomspace(_SMALLEST * min(height, width), 0.55 * min(height, width), 45)
    circles = np.stack(np.meshgrid(np.arange(0, width, 2.0), np.arange(0, height, 2.0), radii), axis=-1).reshape(-1, 3)
    reach = _INSIDE * circles[:, 2:]
    inside = (circles[:, :2] >= reach).all(axis=1) & (circles[:, :2] <= (width, height) - reach).all(axis=1)
    circles = circles[inside]
    circles = circles[np.argsort(-slopes.judge(circles))[:_CANDIDATES]]
    while scale < min(1.0, _FINE / max(picture.shape[:2])):
        finer = min(1.0, 2 * scale)
        slopes, circles = _Slopes.of(picture, finer), circles * finer / scale
        scale = finer
        circles = slopes.climb(circles)
    best = circles[slopes.judge(circles).argmax()]
    near = _AROUND * best[2]
    near[..., :2] += best[:2]
    score = slopes.judge(near.reshape(-1, 3)).reshape(near.shape[:3])
    peaks = (score == maximum_filter(score, 3)) & (score > _NEARLY * score.max())
    if score.max() < _LEAST:
        return None
    largest = near[peaks][near[peaks][:, 2].argmax()]
    ball = slopes.climb(largest[None])
    x, y, radius = (ball[0] / scale).tolist()
    return float(score.max()), (x, y, radius)


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Gradients of a picture in CIELAB along x and y, (H, W, 3), and how steep one must be to count fully."""

    x: Float32Array
    y: Float32Array
    steep: float

    @classmethod
    def of(cls, picture: ByteImage, scale: float) -> _Slopes:
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        lab = cv2.GaussianBlur(np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2LAB), np.float32), (0, 0), 0.8)
        x, y = (np.asarray(cv2.Scharr(lab, cv2.CV_32F, *axis, scale=1 / 32), np.float32) for axis in ((1, 0), (0, 1)))
        return cls(x, y, 1.0 + 1.5 * float(np.sqrt((x**2 + y**2).sum(axis=2)).mean()))

    def judge(self, circles: Float64Array) -> Float64Array:
        """How far each circle (x, y, radius), (N, 3), is an outline: up to 1."""
        turn = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        score = [np.zeros(0)]
        for some in np.array_split(circles, 1 + len(circles) // 20_000):  # OpenCV takes 32,767 rows at most
            x, y = (
                np.asarray(some[:, k : k + 1] + some[:, 2:] * wave(turn) - 0.5, np.float32)
                for k, wave in enumerate((np.cos, np.sin))
            )
            gx, gy = (np.asarray(cv2.remap(slope, x, y, cv2.INTER_LINEAR)) for slope in (self.x, self.y))
            c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
            across, along = (
                np.minimum(np.linalg.norm(part, axis=2) / self.steep, 1.0)
                for part in (gx * c + gy * s, gx * s - gy * c)
            )
            score.append((across - along).mean(axis=1))
        return np.concatenate(score)

    def climb(self, circles: Float64Array) -> Float64Array:
        """Each circle moved and sized to the best one near it."""
        for step in (1.5, 0.75, 0.4):
            for _ in range(4):
                moved = circles[:, None] + step * _STEPS
                best = self.judge(moved.reshape(-1, 3)).reshape(len(moved), -1).argmax(axis=1)
                circles = moved[np.arange(len(moved)), best]
        return circles


def unwrap_ball(
    image: Float32Array, ball: Circle, focal: float | None, azimuth: float, elevation: float, clipped: BoolArray
) -> BallPanorama:
    """The panorama that a ball mirrors, all of which counts as far away.

    Args:
        image: Radiance, (H, W, 3).
        ball: The ball's outline, all of it in the image.
        focal: Focal length of the camera [px], which is held level; None takes its rays for parallel.
        azimuth: Of the camera as seen from the ball [degrees].
        elevation: Of it [degrees].
        clipped: Where radiance is a lower bound, (H, W).
    """
    height, width = image.shape[:2]
    x, y, radius = ball
    camera, distance = _ball_camera(width, height, ball, focal or _FAR * radius, unit_vector(azimuth, elevation))

    normal_angle = np.linspace(0.0, np.arccos(1 / distance), 4096)
    seen_at = np.arctan2(np.sin(normal_angle), distance - np.cos(normal_angle))
    mirrors = 2 * normal_angle + seen_at
    last = float(np.interp(seen_at[-1] * (1 - _MARGIN / radius), seen_at, mirrors))

    finer = min(3, int(np.ceil(np.pi * radius / WIDTH)))  # towards the camera a pixel of the ball is 2 / radius wide
    towards = camera.centre / distance
    directed = directions(finer * WIDTH // 2, finer * WIDTH).reshape(-1, 3).astype(np.float64)
    cosine = directed @ towards
    angle = np.arccos(np.clip(cosine, -1, 1))
    aside = directed - cosine[:, None] * towards
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
    b = np.interp(np.minimum(angle, last), mirrors, normal_angle)[:, None]
    pixels, _ = camera.project(np.cos(b) * towards + np.sin(b) * aside)
    columns, rows = (pixels - 0.5).astype(np.float32).T.reshape(2, finer * WIDTH // 2, finer * WIDTH)
    fine = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    radiance = resized(np.asarray(fine, np.float32), WIDTH // 2, WIDTH)

    angle = np.arccos(np.clip(directions(WIDTH // 2, WIDTH) @ towards, -1, 1))
    ring = (angle <= last) & (angle > last - np.radians(_RING))
    weights = np.broadcast_to(solid_angles(*ring.shape), ring.shape)
    radiance[angle > last] = np.average(radiance[ring], axis=0, weights=weights[ring])

    across, down = np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y
    disc = across**2 + down[:, None] ** 2 < radius**2
    return BallPanorama(radiance, 180.0 - float(np.degrees(last)), float(clipped[disc].mean()))


def _ball_camera(width: int, height: int, ball: Circle, focal: float, towards: Float64Array) -> tuple[Camera, float]:
    """The level camera that sees a unit sphere around the origin in a circle, and its distance.

    Rays v to the outline are at one angle a to the axis c: v.c = cos(a), which is linear in c / cos(a).
    """
    middle = np.array([width, height]) / 2
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    outline = np.array(ball[:2]) + ball[2] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rays = np.column_stack([(outline - middle) / focal, np.ones(len(outline))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    solved = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]
    length = float(np.linalg.norm(solved))
    x, y, z = solved / length
    distance = length / np.sqrt(length**2 - 1)

    # Without roll, a pitch and a yaw take the axis to where the ball is from the camera.
    ahead = -towards
    pitch = np.arcsin(np.clip(ahead[2] / np.hypot(y, z), -1, 1)) + np.arctan2(y, z)
    level = z * np.cos(pitch) + y * np.sin(pitch)
    yaw = np.arctan2(ahead[1], ahead[0]) + np.arctan2(x, level)
    forward = unit_vector(float(np.degrees(yaw)), float(np.degrees(pitch)))
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = distance * towards
    return Camera(width, height, focal, focal, width / 2, height / 2, pose), float(distance)
