"""Where a frame's image is taken from.

The seed and the frame's index decide it, and the layout that the frame shows where the scene file says that cameras
look at what lies there, or are chosen by what they see of it. Whoever asks without a layout gets one that may be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.camera import Camera, interpolate_poses, look_at_pose
from mitsplat.errors import InputError
from mitsplat.scene.sight import Prospect, Sight
from mitsplat.scene.spec import Output
from mitsplat.scene.spec_camera import CameraHemisphere, CameraOrbit, Intrinsics
from mitsplat.scene.streams import random_stream

if TYPE_CHECKING:
    from mitsplat.scene.layout import Layout
    from mitsplat.scene.scene import Scene

_NEIGHBOURS = 2
"""Objects beside one that make a cluster with it."""
_STEPS = 1.2207440846057596 ** -np.arange(1.0, 4.0)
"""Of the sequence of low discrepancy in three dimensions: powers of the root of x^4 = x + 1 (Roberts, *The Unreasonable
Effectiveness of Quasirandom Sequences*, 2018). Each of its points is known without those before it."""
_BORDER = (0.6, 1.0)
"""How far from the image's middle a try looks past its target that should be cut, in half widths or heights."""


@dataclass(frozen=True, eq=False)
class View:
    """Where an image is taken from.

    Attributes:
        camera: The camera.
        drawn: What it was drawn or chosen by, as JSON values: its ``target`` [m], the ``object`` that it is the middle
            of, which ``attempt`` it was, and what was ``predicted`` of the labelled objects. Empty where the seed and
            the index alone decide.
    """

    camera: Camera
    drawn: Mapping[str, Any] = field(default_factory=dict)


@lru_cache(maxsize=4)
def view_of(scene: Scene, index: int, layout: Layout | None = None) -> View:
    """Where frame ``index`` is taken from; with its layout, what looks at or is chosen by what lies there.

    Raises:
        InputError: If none of a frame's tries fulfils what the scene file says that a view must.
    """
    spec = scene.spec
    camera, views = spec.camera, spec.output.views
    view = index % views
    if isinstance(camera, CameraHemisphere):
        return _hemisphere_view(scene, camera, index, layout)
    if isinstance(camera, CameraOrbit):
        pose = _orbit_pose(camera, view, views)
    else:
        keys = [look_at_pose(key.eye, key.target, key.up) for key in camera.keys]
        pose = interpolate_poses(keys, view / max(1, views - 1))[0]
    pose[:3, 3] += camera.jitter * random_stream(spec.seed, "camera jitter", index).standard_normal(3)
    return View(camera_at(pose, camera.intrinsics, spec.output))


def camera_at(pose: Float64Array, intrinsics: Intrinsics, output: Output) -> Camera:
    """The camera of a scene file at a pose, for images of the output's size.

    Raises:
        ValueError: If there is none, such as a fisheye that sees behind itself.
    """
    width, height = intrinsics.size or (output.width, output.height)
    if intrinsics.fov_x is not None:
        fx = 0.5 * width / float(np.tan(0.5 * np.radians(intrinsics.fov_x)))
    else:
        fx = float(intrinsics.fx or 0.0)
    camera = Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fx if intrinsics.fy is None else intrinsics.fy,
        cx=width / 2 if intrinsics.cx is None else intrinsics.cx,
        cy=height / 2 if intrinsics.cy is None else intrinsics.cy,
        world_from_camera=pose,
        distortion=intrinsics.distortion,
        near=intrinsics.near,
        lens=intrinsics.lens,
        aperture_radius=intrinsics.aperture,
        focus_distance=intrinsics.focus,
    )
    return camera.resized(output.width, output.height)


def _orbit_pose(camera: CameraOrbit, view: int, views: int) -> Float64Array:
    """A full circle ends one step before its start; a part of one ends at its end."""
    steps = views if abs(camera.sweep) == 360 else max(1, views - 1)
    azimuth = np.radians(camera.start + camera.sweep * view / steps)
    offset = (camera.radius * np.cos(azimuth), camera.radius * np.sin(azimuth), camera.height)
    return look_at_pose(np.add(camera.target, offset), camera.target)


def _hemisphere_view(scene: Scene, camera: CameraHemisphere, index: int, layout: Layout | None) -> View:
    """The first try that is accepted, or of all that are the one that comes nearest to the shares aimed at."""
    spec, sight = scene.spec, None if layout is None else Sight.of(scene, layout)
    if sight is None or not camera.chosen:
        target, seen = _target(camera, spec.seed, index, 0, sight)
        pose, target = _hemisphere_pose(camera, spec.seed, index, 0, target)
        drawn = {} if camera.look_at == "target" else {"target": target.tolist(), "object": seen}
        return View(camera_at(pose, camera.intrinsics, spec.output), drawn)
    shares = (camera.occlusion, camera.truncation)
    fate = random_stream(spec.seed, "camera shares", index).uniform(size=2)
    best: tuple[float, View] | None = None
    refused: list[tuple[float, str]] = []
    for number in range(camera.tries):
        target, seen = _target(camera, spec.seed, index, number, sight)
        pose, target = _hemisphere_pose(camera, spec.seed, index, number, target)
        eye = camera_at(pose, camera.intrinsics, spec.output)
        if camera.truncation is not None and number % 2:
            eye, target = _look_past(eye, target, _stream(spec.seed, "camera border", index, number))
        prospect = sight.prospect(eye, camera.occlusion, camera.truncation, spec.labels.min_pixels)
        if camera.accept is not None and (faults := sight.faults(eye, prospect, camera.accept)):
            refused.append((sum(miss for miss, _ in faults), " and ".join(text for _, text in faults)))
            continue
        drawn = {"target": target.tolist(), "object": seen, "attempt": number, "predicted": prospect.to_json()}
        cost = _cost(prospect, [0.0 if share is None else share.share for share in shares], fate)
        if best is None or cost < best[0]:
            best = cost, View(eye, drawn)
        if cost == 0:
            break
    if best is None:
        raise InputError(
            f"{scene.path}: camera.accept: none of {camera.tries} views of frame {index} is acceptable (the nearest "
            f"{min(refused)[1]}); ask for less, widen the camera's ranges or raise camera.tries"
        )
    return best[1]


def _cost(prospect: Prospect, shares: list[float], fate: Float64Array) -> float:
    """How far a view is from the shares of objects that are aimed at.

    A share of few objects is seldom a whole number: it is rounded up or down by the frame's random numbers ``fate``, so
    that frames reach it on average although none knows of the others.
    """
    wanted = np.floor(np.multiply(shares, prospect.in_view) + fate)
    counts = np.array([prospect.hidden, prospect.cut])
    if not prospect.in_view:
        return float(len(prospect.within))  # an image without objects has no share of them, whatever is asked for
    return float(np.abs(counts - wanted).sum()) / prospect.in_view


def _target(
    camera: CameraHemisphere, seed: int, index: int, number: int, sight: Sight | None
) -> tuple[Float64Array, int | None]:
    """What a try looks at [m] but for its jitter, and the object that it is the middle of."""
    if sight is None or camera.look_at == "target" or not sight.labelled.any():
        return np.array(camera.target, dtype=np.float64), None
    among = np.flatnonzero(sight.labelled)
    drawn = int(among[_stream(seed, "camera look at", index, number).integers(len(among))])
    if camera.look_at == "objects":
        return sight.centres[drawn], int(sight.ids[drawn])
    away = np.linalg.norm(sight.centres[among] - sight.centres[drawn], axis=1)
    nearest = among[np.argsort(away, kind="stable")[: 1 + _NEIGHBOURS]]
    return sight.centres[nearest].mean(axis=0), int(sight.ids[drawn])


def _hemisphere_pose(
    camera: CameraHemisphere, seed: int, index: int, number: int, middle: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Pose of a try that looks at a point [m], and the target [m] that it turned out to look at."""

    def draw(name: str, low: float, high: float) -> float:
        return float(_stream(seed, f"camera {name}", index, number).uniform(low, high))

    # Uniform by area on the sphere: the sine of the elevation is uniform (Archimedes).
    sines = np.sin(np.radians(camera.elevation))
    if camera.coverage == "even":
        shift = random_stream(seed, "camera coverage", number).uniform(size=3)
        low, high = np.array([camera.azimuth, sines, camera.radius], dtype=np.float64).T
        azimuth, sine, radius = (low + (high - low) * np.mod(shift + (index + 1) * _STEPS, 1.0)).tolist()
    else:
        radius, azimuth = draw("radius", *camera.radius), draw("azimuth", *camera.azimuth)
        sine = draw("elevation", *sines)
    azimuth, roll = np.radians(azimuth), np.radians(draw("roll", *camera.roll))
    cosine = np.sqrt(1.0 - sine * sine)
    jitter = camera.target_jitter * _stream(seed, "camera target", index, number).standard_normal(3)
    target = np.add(middle, jitter)
    offset = radius * np.array([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine])
    pose = look_at_pose(target + offset, target)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll).as_matrix()
    return pose, target


def _look_past(camera: Camera, target: Float64Array, rng: np.random.Generator) -> tuple[Camera, Float64Array]:
    """The camera turned until its target [m] is near the image's border, and the point as far that it looks at then."""
    place = np.array([rng.choice([-1, 1]) * rng.uniform(*_BORDER), rng.uniform(-1, 1)])[:: rng.choice([-1, 1])]
    slopes = place * (camera.width / camera.fx, camera.height / camera.fy) / 2
    away = float(np.linalg.norm(slopes))
    turn = Rotation.from_rotvec(np.arctan(away) / away * np.array([slopes[1], -slopes[0], 0.0])).as_matrix()
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ turn
    depth = float(np.linalg.norm(target - camera.centre))
    return replace(camera, world_from_camera=pose), camera.centre + depth * pose[:3, 2]


def _stream(seed: int, purpose: str, index: int, number: int) -> np.random.Generator:
    """Random numbers of a try of a frame; the first are those of frames that have but one."""
    return random_stream(seed, purpose, index, *([number] if number else []))
