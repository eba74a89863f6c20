"""Reference scene for light estimates: a room with known lights, a mirror ball, and a camera with a known response."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.capture.lighting.panorama import directions, unit_vector
from mitsplat.images.colour import encode_srgb
from mitsplat.runtime.variant import ensure_variant

ensure_variant()

CENTRE = np.array([0.0, 0.0, 1.0])
"""Centre of the ball [m]."""
RADIUS, AWAY = 0.03, 0.5
"""Radius of the ball, and distance from its centre to the camera [m]."""
AZIMUTH, ELEVATION, FOV = 250.0, 20.0, 12.0
SIZE = (270, 180)
FOCAL = round(18.0 / np.tan(np.radians(FOV) / 2))
"""Focal length for 35 mm film [mm]. The images have the aspect ratio of the film."""


@dataclass(frozen=True)
class RoomLamp:
    """Rectangular light: position, target, width and height, radiance."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    size: tuple[float, float]
    radiance: tuple[float, float, float]

    @property
    def direction(self) -> Float64Array:
        away = np.array(self.position) - CENTRE
        return away / np.linalg.norm(away)

    @property
    def corners(self) -> Float64Array:
        """Corners in order around the rectangle, relative to the ball's centre."""
        up = np.array([0.0, 1.0, 0.0] if self.position[:2] == self.target[:2] else [0.0, 0.0, 1.0])
        forward = np.subtract(self.target, self.position) / np.linalg.norm(np.subtract(self.target, self.position))
        across = np.cross(up, forward)
        across /= np.linalg.norm(across)
        sides = 0.5 * self.size[0] * across, 0.5 * self.size[1] * np.cross(forward, across)
        middle = np.array(self.position) - CENTRE
        return np.array([middle + a * sides[0] + b * sides[1] for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])


LAMPS = (
    RoomLamp((0.9, 0.6, 2.55), (0.9, 0.6, 0.0), (0.6, 0.3), (22.0, 20.0, 17.0)),
    RoomLamp((-1.95, -0.8, 1.5), (0.0, -0.8, 1.5), (0.8, 0.9), (4.0, 4.8, 6.0)),
)
"""A warm light below the ceiling, and a window."""


def lambert_irradiance(corners: Float64Array) -> float:
    """Compute the irradiance of a horizontal plane by a polygon of radiance 1 above the horizon (Lambert 1760).

    ``1/2 sum of theta_i (n_i . z)``, where theta_i is the angle that edge i subtends and n_i is the normal of the plane
    through edge i and the origin.
    """
    total = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        across = np.cross(a, b)
        angle = np.arctan2(np.linalg.norm(across), a @ b)
        total += 0.5 * angle * across[2] / np.linalg.norm(across)
    return abs(total)


def room(thing: dict[str, Any] | None) -> dict[str, Any]:
    """Build walls of different colours, a black box and the lights, with an object in place of the ball."""

    def rectangle(origin: Any, target: Any, half: tuple[float, float], **more: Any) -> dict[str, Any]:
        up = [0, 1, 0] if tuple(origin[:2]) == tuple(target[:2]) else [0, 0, 1]
        pose = mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=up)
        return {"type": "rectangle", "to_world": pose @ mi.ScalarTransform4f().scale([*half, 1]), **more}

    def paint(*rgb: float) -> dict[str, Any]:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}

    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "floor": rectangle((0, 0, 0), (0, 0, 1), (2, 2), bsdf=paint(0.35, 0.33, 0.3)),
        "ceiling": rectangle((0, 0, 2.6), (0, 0, 0), (2, 2), bsdf=paint(0.75, 0.75, 0.75)),
        "east": rectangle((2, 0, 1.3), (0, 0, 1.3), (2, 2), bsdf=paint(0.6, 0.55, 0.5)),
        "west": rectangle((-2, 0, 1.3), (0, 0, 1.3), (2, 2), bsdf=paint(0.5, 0.6, 0.5)),
        "north": rectangle((0, 2, 1.3), (0, 0, 1.3), (2, 2), bsdf=paint(0.55, 0.55, 0.65)),
        "south": rectangle((0, -2, 1.3), (0, 0, 1.3), (2, 2), bsdf=paint(0.6, 0.6, 0.6)),
        "box": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([1.2, -1.2, 0.4]).scale(0.4),
            "bsdf": paint(0.1, 0.1, 0.12),
        },
    }
    for number, lamp in enumerate(LAMPS):
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(lamp.radiance)}}
        half = (0.5 * lamp.size[0], 0.5 * lamp.size[1])
        scene[f"lamp_{number}"] = rectangle(lamp.position, lamp.target, half, emitter=emitter)
    return scene | ({} if thing is None else {"thing": thing})


def ball(**bsdf: Any) -> dict[str, Any]:
    return {"type": "sphere", "center": CENTRE.tolist(), "radius": RADIUS, "bsdf": bsdf}


def render(
    scene: dict[str, Any], size: tuple[int, int], samples: int, *, aside: tuple[float, float, float] = (0, 0, 0)
) -> Float32Array:
    """Render the image of the level camera that looks at the ball, or beside it."""
    eye = CENTRE + AWAY * unit_vector(AZIMUTH, ELEVATION)
    pose = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=(CENTRE + aside).tolist(), up=[0, 0, 1])
    sensor = {
        "type": "perspective",
        "fov": FOV,
        "to_world": pose,
        "film": {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": samples},
    }
    return np.array(mi.render(mi.load_dict(scene | {"sensor": sensor}), seed=1))[..., :3]


def true_panorama(width: int, samples: int) -> Float32Array:
    """Render the incident radiance at the ball's centre."""
    sight = np.repeat(directions(width // 2, width).reshape(-1, 3), samples, axis=0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(sight))
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*CENTRE.tolist()), mi.Vector3f(sight.T)))
    scene = mi.load_dict(room(None))
    radiance, _, _ = scene.integrator().sample(scene, sampler, ray)
    return np.array(dr.ravel(radiance)).reshape(width // 2, width, samples, 3).mean(axis=2)


def photographs(folder: Path, radiance: Float32Array, times: list[float], suffix: str = ".png") -> list[Path]:
    """Write 8-bit photographs with a camera's noise, tone curve and EXIF data.

    A radiance of 0.25 becomes white in 1 s.
    """
    random, files = np.random.default_rng(0), []
    for number, time in enumerate(times):
        electrons = random.poisson(20_000 * np.minimum(4 * time * radiance, 2.0)) + random.normal(0, 4, radiance.shape)
        encoded = encode_srgb(np.clip(electrons / 20_000, 0, 1))
        curved = 0.5 * encoded + 0.5 * encoded**2 * (3 - 2 * encoded)  # higher contrast, as in cameras
        image = Image.fromarray(np.rint(255 * curved).astype(np.uint8))
        exif = image.getexif()
        exif.get_ifd(0x8769).update({0x829A: time, 0xA405: FOCAL})
        files.append(folder / f"{number}{suffix}")
        image.save(files[-1], exif=exif.tobytes())
    return files
