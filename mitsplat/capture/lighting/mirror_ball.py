"""Detection of a mirror ball in a photograph, and the panorama that it reflects.

The method is the light probe of Debevec (1998), "Rendering synthetic objects into real scenes", for a camera at finite
distance. The ball is a unit sphere around the origin, and the camera is at the distance D in the direction d. A point
whose normal has the angle b to d is seen at the angle s from the ball's centre, with tan(s) = sin(b) / (D - cos(b)). It
reflects light from the angle 2 b + s to d. The last visible point has cos(b) = 1 / D and reflects light from 180
degrees - a, where sin(a) = 1 / D. So directions within a of the rear of the ball are never visible.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import maximum_filter

from mitsplat.arrays import BoolArray, ByteImage, Float32Array, Float64Array
from mitsplat.capture.lighting.panorama import directions, resized, solid_angles, unit_vector
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import homogeneous_matrix

WIDTH = 1024
"""Width of ball panoramas [px]."""
_PARALLEL_FOCAL = 1000.0
"""Focal length of a camera with unknown focal length, in radii of the ball; its rays are almost parallel."""
_COARSE, _FINE = 96, 700
"""Longest edges of the pictures in which circles are searched and refined [px]."""
_MIN_EDGE = 10
"""Minimum shorter edge of the search picture [px]."""
_MIN_RADIUS = 0.1
"""Minimum radius of a detected ball, as a fraction of the shorter edge."""
_MIN_INSIDE = 0.7
"""Minimum distance of a circle's centre from the border, in radii; partly visible balls are detected and rejected
later.
"""
_CANDIDATES = 30
_OUTLINE_SHARE = 0.85
"""Fraction of the best score from which a larger circle around the best one is taken as the outline."""
_MIN_SCORE = 0.55
"""Minimum score of a ball's outline."""
_STEPS = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3)
_NEIGHBOURHOOD = np.stack(np.meshgrid(*[np.arange(-8, 9) / 100] * 2, np.arange(94, 113) / 100, indexing="ij"), axis=-1)
"""Shifts as fractions of the radius, and factors of the radius."""
_MARGIN = 1.5
"""Width of the ball's rim that is mixed with the background [px]."""
_RING = 10.0
"""Width of the ring whose mean fills the blind region [degrees]."""

Circle = tuple[float, float, float]
"""Centre x, y and radius [px]."""


@dataclass(frozen=True, eq=False)
class BallPanorama:
    """Panorama that a mirror ball reflects.

    Attributes:
        radiance: Equirectangular radiance, (H, W, 3).
        blind: Half angle of the region hidden by the ball [degrees]; it has the mean radiance of a ring around it.
        clipped: Fraction of the ball's image in which radiance is a lower bound.
    """

    radiance: Float32Array
    blind: float
    clipped: float


def find_ball(*exposures: ByteImage) -> Circle | None:
    """Detect the outline of a ball in one of the exposures of a view; None if there is none.

    The score of a circle is the image gradient across it, averaged along it (Daugman 1993), minus the gradient along
    it. The gradient is limited, so that no part dominates. All circles are tested in a small picture, and the best are
    refined in larger ones. If the ball reflects a corner of the room as a circle inside its outline, the largest circle
    is taken.

    Args:
        exposures: RGB, (H, W, 3).
    """
    found = [ball for picture in exposures if (ball := _find_ball(picture)) is not None]
    return max(found, key=lambda ball: ball[0])[1] if found else None


def _find_ball(picture: ByteImage) -> tuple[float, Circle] | None:
    """Return the score and the circle of the best outline, or None."""
    scale = _COARSE / max(picture.shape[:2])
    if scale * min(picture.shape[:2]) < _MIN_EDGE:
        return None
    gradients = _Gradients.of(picture, scale)
    height, width = gradients.x.shape[:2]
    radii = np.geomspace(_MIN_RADIUS * min(height, width), 0.55 * min(height, width), 45)
    circles = np.stack(np.meshgrid(np.arange(0, width, 2.0), np.arange(0, height, 2.0), radii), axis=-1).reshape(-1, 3)
    reach = _MIN_INSIDE * circles[:, 2:]
    inside = (circles[:, :2] >= reach).all(axis=1) & (circles[:, :2] <= (width, height) - reach).all(axis=1)
    circles = circles[inside]
    circles = circles[np.argsort(-gradients.score_circles(circles))[:_CANDIDATES]]
    while scale < min(1.0, _FINE / max(picture.shape[:2])):
        finer = min(1.0, 2 * scale)
        gradients, circles = _Gradients.of(picture, finer), circles * finer / scale
        scale = finer
        circles = gradients.refine(circles)
    best = circles[gradients.score_circles(circles).argmax()]
    near = _NEIGHBOURHOOD * best[2]
    near[..., :2] += best[:2]
    score = gradients.score_circles(near.reshape(-1, 3)).reshape(near.shape[:3])
    peaks = (score == maximum_filter(score, 3)) & (score > _OUTLINE_SHARE * score.max())
    if score.max() < _MIN_SCORE:
        return None
    largest = near[peaks][near[peaks][:, 2].argmax()]
    ball = gradients.refine(largest[None])
    x, y, radius = (ball[0] / scale).tolist()
    return float(score.max()), (x, y, radius)


@dataclass(frozen=True, eq=False)
class _Gradients:
    """Gradients of a picture in CIELAB along x and y, (H, W, 3), and the gradient magnitude that counts fully."""

    x: Float32Array
    y: Float32Array
    steep: float

    @classmethod
    def of(cls, picture: ByteImage, scale: float) -> _Gradients:
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        lab = cv2.GaussianBlur(np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2LAB), np.float32), (0, 0), 0.8)
        x, y = (np.asarray(cv2.Scharr(lab, cv2.CV_32F, *axis, scale=1 / 32), np.float32) for axis in ((1, 0), (0, 1)))
        return cls(x, y, 1.0 + 1.5 * float(np.sqrt((x**2 + y**2).sum(axis=2)).mean()))

    def score_circles(self, circles: Float64Array) -> Float64Array:
        """Return the score, at most 1, of circles (x, y, radius), (N, 3), as outlines."""
        turn = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        score = [np.zeros(0)]
        for some in np.array_split(circles, 1 + len(circles) // 20_000):  # OpenCV accepts at most 32,767 rows
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

    def refine(self, circles: Float64Array) -> Float64Array:
        """Move and resize each circle to the local maximum of the score."""
        for step in (1.5, 0.75, 0.4):
            for _ in range(4):
                moved = circles[:, None] + step * _STEPS
                best = self.score_circles(moved.reshape(-1, 3)).reshape(len(moved), -1).argmax(axis=1)
                circles = moved[np.arange(len(moved)), best]
        return circles


def unwrap_ball(
    image: Float32Array, ball: Circle, focal: float | None, azimuth: float, elevation: float, clipped: BoolArray
) -> BallPanorama:
    """Compute the panorama that a ball reflects; the surroundings are assumed to be at infinity.

    Args:
        image: Radiance, (H, W, 3).
        ball: Outline of the ball, completely inside the image.
        focal: Focal length of the level camera [px]; None assumes parallel rays.
        azimuth: Azimuth of the camera as seen from the ball [degrees].
        elevation: Elevation of the camera as seen from the ball [degrees].
        clipped: Pixels in which radiance is a lower bound, (H, W).
    """
    height, width = image.shape[:2]
    x, y, radius = ball
    camera, distance = _ball_camera(
        width, height, ball, focal or _PARALLEL_FOCAL * radius, unit_vector(azimuth, elevation)
    )

    normal_angle = np.linspace(0.0, np.arccos(1 / distance), 4096)
    seen_at = np.arctan2(np.sin(normal_angle), distance - np.cos(normal_angle))
    mirrors = 2 * normal_angle + seen_at
    last = float(np.interp(seen_at[-1] * (1 - _MARGIN / radius), seen_at, mirrors))

    finer = min(3, int(np.ceil(np.pi * radius / WIDTH)))  # a pixel at the centre of the ball spans 2 / radius
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
    """Return the level camera that sees a unit sphere around the origin as a circle, and its distance.

    Rays v to the outline have one angle a to the axis c: v.c = cos(a), which is linear in c / cos(a).
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

    # Without roll, a pitch and a yaw rotate the axis to the direction from the camera to the ball.
    ahead = -towards
    pitch = np.arcsin(np.clip(ahead[2] / np.hypot(y, z), -1, 1)) + np.arctan2(y, z)
    level = z * np.cos(pitch) + y * np.sin(pitch)
    yaw = np.arctan2(ahead[1], ahead[0]) + np.arctan2(x, level)
    forward = unit_vector(float(np.degrees(yaw)), float(np.degrees(pitch)))
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    pose = homogeneous_matrix(np.stack([right, np.cross(forward, right), forward], axis=1), distance * towards)
    return Camera(width, height, focal, focal, width / 2, height / 2, pose), float(distance)
