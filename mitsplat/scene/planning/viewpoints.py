"""Where a frame's image is taken from.

The seed and the frame's index decide it, and the layout that the frame shows where the scene file says that cameras
look at what lies there, or are chosen by what they see of it. Whoever asks without a layout gets one that may be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera, direction, interpolate_poses, look_at_pose
from mitsplat.scene.planning.visibility_prediction import PredictedView, VisibilityPredictor
from mitsplat.scene.spec.camera_spec import (
    CameraHemisphere,
    CameraOrbit,
    CameraSpec,
    CameraWalk,
    Handheld,
    Intrinsics,
    Motion,
)
from mitsplat.scene.spec.scene_spec import Output
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
_WAVES, _FASTEST = 8, 0.15
"""Cosines of a hand's motion along each axis, and the most periods in a view."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where an image is taken from.

    Attributes:
        camera: The camera.
        drawn: What it was drawn or chosen by, as JSON values: the position of the ``camera`` among several, the
            ``side`` of a stereo pair, ``zoom``, ``aperture`` and ``focus`` of a thin lens [m], the ``motion`` while the
            shutter is open (``exposure`` [s]; ``velocity`` [m/s] and ``rotation`` [degrees/s] in the camera's frame),
            the motion of the hand (``handheld``, see :func:`moved_by`), the ``target`` [m], the ``object`` that it is
            the middle of, which ``attempt`` it was, and what was ``predicted`` of the labelled objects. Empty for a
            scene that has none of these.
    """

    camera: Camera
    drawn: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Turn:
    """A frame as one of its camera's.

    Attributes:
        seed: Seed of the scene.
        index: Index of the frame.
        number: Position of its camera among the scene's.
        camera: What the scene file says of that.
        output: Size of the images.
        layout: Index of the layout.
        turn, turns: Which of the camera's views of the layout it is, and of how many.
    """

    seed: int
    index: int
    number: int
    camera: CameraSpec
    output: Output
    layout: int
    turn: int
    turns: int

    @property
    def time(self) -> float:
        """Time in [0, 1] of the camera's views of the layout."""
        return self.turn / max(1, self.turns - 1)

    def take(self, pose: Float64Array) -> tuple[Camera, dict[str, Any]]:
        """The camera at a pose in the hand that holds it, and what was drawn for that."""
        camera, drawn = self.camera, dict[str, Any]()
        if camera.zoom[0] < camera.zoom[1]:
            drawn["zoom"] = float(random_stream(self.seed, "camera zoom", self.index).uniform(*camera.zoom))
        if camera.handheld is not None:
            drawn["handheld"] = self._sway(camera.handheld).tolist()
            pose = pose @ moved_by(drawn["handheld"])
        taken = camera_at(pose, camera.intrinsics, self.output, drawn.get("zoom", camera.zoom[0]))
        if camera.defocus is not None:
            rng = random_stream(self.seed, "camera defocus", self.index)
            drawn["aperture"], drawn["focus"] = (
                float(rng.uniform(*bounds)) for bounds in (camera.defocus.aperture, camera.defocus.focus)
            )
            taken = replace(taken, aperture_radius=drawn["aperture"], focus_distance=drawn["focus"])
        if camera.motion is not None:
            drawn["motion"] = self._motion(camera.motion)
        return taken, drawn

    def _motion(self, motion: Motion) -> dict[str, Any]:
        """Exposure and readout [s], velocity [m/s] and rate of rotation [degrees/s], in the camera's frame."""
        rng = random_stream(self.seed, "camera motion", self.index)
        exposure, *rates = (float(rng.uniform(*bounds)) for bounds in (motion.exposure, motion.speed, motion.rotation))
        velocity, rotation = (rate * direction(2 * np.pi * rng.uniform(), rng.uniform(-1, 1)) for rate in rates)
        drawn = {"exposure": exposure, "velocity": velocity.tolist(), "rotation": rotation.tolist()}
        return drawn | ({"readout": float(rng.uniform(*motion.readout))} if motion.readout[1] else {})

    def _sway(self, hand: Handheld) -> Float64Array:
        """Displacement [m] and rotation vector [degrees] of a hand at a turn, shape (6,).

        A sum of cosines of random phases is about normal and has a variance of one half times their number, whatever
        their frequencies; these, of a period of seven views and more, make it smooth.
        """
        rng = random_stream(self.seed, "camera handheld", self.layout, self.number)
        rates, phases = rng.uniform(0, _FASTEST, (6, _WAVES)), rng.uniform(0, 1, (6, _WAVES))
        waves = np.cos(2 * np.pi * (rates * self.turn + phases)).sum(axis=1) * np.sqrt(2 / _WAVES)
        return np.asarray(waves * np.repeat([hand.position, hand.rotation], 3))


@lru_cache(maxsize=4)
def view_of(scene: Scene, index: int, layout: Layout | None = None) -> Viewpoint:
    """Where frame ``index`` is taken from; with its layout, what looks at or is chosen by what lies there.

    Raises:
        InputError: If none of a frame's tries fulfils what the scene file says that a view must.
    """
    spec = scene.spec
    cameras = (spec.camera, *spec.cameras)
    number_of_layout, view = divmod(index, spec.output.views)
    seats = spec.seats
    turn, seat = divmod(view, len(seats))
    number, side = seats[seat]
    camera = cameras[number]
    if side and camera.stereo is not None:
        left = view_of(scene, index - 1, layout)
        pose = left.camera.world_from_camera.copy()
        pose[:3, 3] += camera.stereo.baseline * pose[:3, 0]
        return Viewpoint(replace(left.camera, world_from_camera=pose), {**left.drawn, "side": "right"})
    turns = 1 + (spec.output.views - 1 - seat) // len(seats)
    here = _Turn(spec.seed, index, number, camera, spec.output, number_of_layout, turn, turns)
    own: dict[str, Any] = {"camera": number} if spec.cameras else {}
    own |= {"side": "left"} if camera.stereo else {}
    if isinstance(camera, CameraHemisphere):
        found = _hemisphere_view(scene, here, camera, layout)
        return Viewpoint(found.camera, {**own, **found.drawn})
    if isinstance(camera, CameraWalk):
        pose = _walk_pose(camera, here)
    else:
        if isinstance(camera, CameraOrbit):
            pose = _orbit_pose(camera, turn, turns)
        else:
            keys = [look_at_pose(key.eye, key.target, key.up) for key in camera.keys]
            pose = interpolate_poses(keys, here.time)[0]
        pose[:3, 3] += camera.jitter * random_stream(spec.seed, "camera jitter", index).standard_normal(3)
    eye, drawn = here.take(pose)
    return Viewpoint(eye, own | drawn)


def moved_by(motion: Sequence[float]) -> Float64Array:
    """Rigid transform (4, 4) of a displacement [m] and a rotation vector [degrees], both in the camera's frame."""
    moved = np.eye(4)
    moved[:3, 3] = motion[:3]
    moved[:3, :3] = Rotation.from_rotvec(motion[3:], degrees=True).as_matrix()
    return moved


def camera_at(pose: Float64Array, intrinsics: Intrinsics, output: Output, zoom: float = 1.0) -> Camera:
    """The camera of a scene file at a pose, for images of the output's size, its focal lengths times ``zoom``.

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
        fx=fx * zoom,
        fy=(fx if intrinsics.fy is None else intrinsics.fy) * zoom,
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


def _walk_pose(camera: CameraWalk, here: _Turn) -> Float64Array:
    """Monotone piecewise cubic interpolation (Fritsch and Carlson 1980) between places drawn for the layout."""
    rng = random_stream(here.seed, "camera walk", here.layout, here.number)
    ranges = np.array([camera.azimuth, np.sin(np.radians(camera.elevation)), camera.radius])
    places = rng.uniform(ranges[:, 0], ranges[:, 1], (camera.places, 3))
    azimuth, sine, radius = PchipInterpolator(np.linspace(0, 1, camera.places), places)(here.time)
    return _pose_around(np.array(camera.target, dtype=np.float64), np.radians(azimuth), sine, radius)


def _pose_around(target: Float64Array, azimuth: float, sine: float, radius: float) -> Float64Array:
    """Pose that looks at a target [m] from an azimuth [rad], a sine of the elevation and a distance [m]."""
    return look_at_pose(target + radius * direction(azimuth, sine), target)


def _hemisphere_view(scene: Scene, here: _Turn, camera: CameraHemisphere, layout: Layout | None) -> Viewpoint:
    """The first try that is accepted, or of all that are the one that comes nearest to the shares aimed at."""
    spec, index = scene.spec, here.index
    sight = (
        None
        if layout is None or (camera.look_at == "target" and not camera.chosen)
        else VisibilityPredictor.of(scene, layout)
    )
    if sight is None or not camera.chosen:
        target, seen = _target(camera, spec.seed, index, 0, sight)
        pose, target = _hemisphere_pose(camera, here, 0, target)
        eye, drawn = here.take(pose)
        return Viewpoint(
            eye, drawn if camera.look_at == "target" else {**drawn, "target": target.tolist(), "object": seen}
        )
    shares = (camera.occlusion, camera.truncation)
    fate = random_stream(spec.seed, "camera shares", index).uniform(size=2)
    best: tuple[float, Viewpoint] | None = None
    refused: list[tuple[float, str]] = []
    for number in range(camera.tries):
        target, seen = _target(camera, spec.seed, index, number, sight)
        pose, target = _hemisphere_pose(camera, here, number, target)
        if camera.truncation is not None and number % 2:
            rng = _stream(spec.seed, "camera border", index, number)
            pose, target = _look_past(here.take(pose)[0], pose, target, rng)
        eye, held = here.take(pose)
        framed = sight.framed(eye)
        if camera.accept is not None and (faults := sight.faults(framed, camera.accept)):
            refused.append((sum(miss for miss, _ in faults), " and ".join(text for _, text in faults)))
            continue
        prospect = sight.prospect(framed, camera.occlusion, camera.truncation, spec.labels.min_pixels)
        drawn = {"target": target.tolist(), "object": seen, "attempt": number, "predicted": prospect.to_json()} | held
        cost = _cost(prospect, [0.0 if share is None else share.share for share in shares], fate)
        if best is None or cost < best[0]:
            best = cost, Viewpoint(eye, drawn)
        if cost == 0:
            break
    if best is None:
        raise InputError(
            f"{scene.path}: camera.accept: none of {camera.tries} views of frame {index} is acceptable (the nearest "
            f"{min(refused)[1]}); ask for less, widen the camera's ranges or raise camera.tries"
        )
    return best[1]


def _cost(prospect: PredictedView, shares: list[float], fate: Float64Array) -> float:
    """How far a view is from the shares of objects that are aimed at.

    A share of few objects is seldom a whole number: it is rounded up or down by the frame's random numbers ``fate``, so
    that frames reach it on average although none knows of the others.
    """
    wanted = np.floor(np.multiply(shares, prospect.in_view) + fate)
    counts = np.array([prospect.hidden, prospect.cut])
    if not prospect.in_view:
        return float(len(prospect.visible))  # an image without objects has no share of them, whatever is asked for
    return float(np.abs(counts - wanted).sum()) / prospect.in_view


def _target(
    camera: CameraHemisphere, seed: int, index: int, number: int, sight: VisibilityPredictor | None
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
    camera: CameraHemisphere, here: _Turn, number: int, middle: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Pose of a try that looks at a point [m], and the target [m] that it turned out to look at."""
    seed, index = here.seed, here.index

    def draw(name: str, low: float, high: float) -> float:
        return float(_stream(seed, f"camera {name}", index, number).uniform(low, high))

    # Uniform by area on the sphere: the sine of the elevation is uniform (Archimedes).
    sines = np.sin(np.radians(camera.elevation))
    if camera.coverage == "even":
        shift = random_stream(seed, "camera coverage", number).uniform(size=3)
        low, high = np.array([camera.azimuth, sines, camera.radius], dtype=np.float64).T
        nth = here.layout * here.turns + here.turn + 1  # of all views of this camera
        azimuth, sine, radius = (low + (high - low) * np.mod(shift + nth * _STEPS, 1.0)).tolist()
    else:
        radius, azimuth = draw("radius", *camera.radius), draw("azimuth", *camera.azimuth)
        sine = draw("elevation", *sines)
    azimuth, roll = np.radians(azimuth), np.radians(draw("roll", *camera.roll))
    jitter = camera.target_jitter * _stream(seed, "camera target", index, number).standard_normal(3)
    target = np.add(middle, jitter)
    pose = _pose_around(target, azimuth, sine, radius)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll).as_matrix()
    return pose, target


def _look_past(
    lens: Camera, pose: Float64Array, target: Float64Array, rng: np.random.Generator
) -> tuple[Float64Array, Float64Array]:
    """The pose turned until its target [m] is near the border of such a camera, and the point as far that it shows."""
    place = np.array([rng.choice([-1, 1]) * rng.uniform(*_BORDER), rng.uniform(-1, 1)])[:: rng.choice([-1, 1])]
    slopes = place * (lens.width / lens.fx, lens.height / lens.fy) / 2
    away = float(np.linalg.norm(slopes))
    turn = Rotation.from_rotvec(np.arctan(away) / away * np.array([slopes[1], -slopes[0], 0.0])).as_matrix()
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ turn
    return turned, pose[:3, 3] + float(np.linalg.norm(target - pose[:3, 3])) * turned[:3, 2]


def _stream(seed: int, purpose: str, index: int, number: int) -> np.random.Generator:
    """Random numbers of a try of a frame; the first are those of frames that have but one."""
    return random_stream(seed, purpose, index, *([number] if number else []))
