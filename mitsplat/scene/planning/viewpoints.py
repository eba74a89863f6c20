"""Viewpoints of frames.

The seed and the index of the frame determine the viewpoint. If the scene file points cameras at objects or selects
views by the visible objects, the viewpoint also depends on the layout. Without a layout, such a camera gets a possible
viewpoint instead.
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
"""Number of neighbours that form a cluster with an object."""
_STEPS = 1.2207440846057596 ** -np.arange(1.0, 4.0)
"""Steps of the low-discrepancy sequence in three dimensions: powers of the root of x^4 = x + 1.

Source: Roberts, *The Unreasonable Effectiveness of Quasirandom Sequences*, 2018. Each point can be computed without the
points before it.
"""
_BORDER = (0.6, 1.0)
"""Range of the distance between target and image centre of views that should cut objects, in half widths or heights."""
_WAVES, _FASTEST = 8, 0.15
"""Number of cosines of the handheld motion along each axis, and their maximum frequency in periods per view."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Viewpoint of an image.

    Attributes:
        camera: The camera.
        drawn: Random values and selection results as JSON values, empty if the scene has none. Keys:

            * ``camera``: index of the camera among several;
            * ``side``: side of a stereo pair;
            * ``zoom``: factor on the focal lengths;
            * ``aperture``, ``focus``: thin lens [m];
            * ``motion``: motion during the exposure: ``exposure`` [s]; ``velocity`` [m/s] and ``rotation`` [degrees/s]
                in the camera's frame;
            * ``handheld``: handheld motion, see :func:`handheld_transform`;
            * ``target``: point in the centre of the image [m];
            * ``object``: id of the instance in the centre of the image;
            * ``attempt``: number of the candidate view;
            * ``predicted``: predicted visibility of the labelled objects.
    """

    camera: Camera
    drawn: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _CameraTurn:
    """Frame as one of the views of its camera.

    Attributes:
        seed: Seed of the scene.
        index: Index of the frame.
        number: Index of the camera among the cameras of the scene.
        camera: Specification of the camera.
        output: Size of the images.
        layout: Index of the layout.
        turn: Index of the view among the views of this camera in the layout.
        turns: Number of views of this camera in the layout.
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
        """Time in [0, 1] over the views of the camera in the layout."""
        return self.turn / max(1, self.turns - 1)

    def camera_at_pose(self, pose: Float64Array) -> tuple[Camera, dict[str, Any]]:
        """Return the camera at a pose plus handheld motion, and the values drawn for it."""
        camera, drawn = self.camera, dict[str, Any]()
        if camera.zoom[0] < camera.zoom[1]:
            drawn["zoom"] = float(random_stream(self.seed, "camera zoom", self.index).uniform(*camera.zoom))
        if camera.handheld is not None:
            drawn["handheld"] = self._handheld_motion(camera.handheld).tolist()
            pose = pose @ handheld_transform(drawn["handheld"])
        taken = camera_at(pose, camera.intrinsics, self.output, drawn.get("zoom", camera.zoom[0]))
        if camera.defocus is not None:
            rng = random_stream(self.seed, "camera defocus", self.index)
            drawn["aperture"], drawn["focus"] = (
                float(rng.uniform(*bounds)) for bounds in (camera.defocus.aperture, camera.defocus.focus)
            )
            taken = replace(taken, aperture_radius=drawn["aperture"], focus_distance=drawn["focus"])
        if camera.motion is not None:
            drawn["motion"] = self._draw_motion(camera.motion)
        return taken, drawn

    def _draw_motion(self, motion: Motion) -> dict[str, Any]:
        """Draw exposure [s], velocity [m/s] and rotation rate [degrees/s], in the camera's frame."""
        rng = random_stream(self.seed, "camera motion", self.index)
        exposure, *rates = (float(rng.uniform(*bounds)) for bounds in (motion.exposure, motion.speed, motion.rotation))
        velocity, rotation = (rate * direction(2 * np.pi * rng.uniform(), rng.uniform(-1, 1)) for rate in rates)
        return {"exposure": exposure, "velocity": velocity.tolist(), "rotation": rotation.tolist()}

    def _handheld_motion(self, hand: Handheld) -> Float64Array:
        """Return displacement [m] and rotation vector [degrees] of the handheld camera at a turn, shape (6,).

        A sum of N cosines with random phases is approximately normal and has a variance of N/2, whatever the
        frequencies. The periods here are about seven views or more, which makes the motion smooth.
        """
        rng = random_stream(self.seed, "camera handheld", self.layout, self.number)
        rates, phases = rng.uniform(0, _FASTEST, (6, _WAVES)), rng.uniform(0, 1, (6, _WAVES))
        waves = np.cos(2 * np.pi * (rates * self.turn + phases)).sum(axis=1) * np.sqrt(2 / _WAVES)
        return np.asarray(waves * np.repeat([hand.position, hand.rotation], 3))


@lru_cache(maxsize=4)
def view_of(scene: Scene, index: int, layout: Layout | None = None) -> Viewpoint:
    """Return the viewpoint of frame ``index``. The layout is needed only if the viewpoint depends on the objects.

    Raises:
        InputError: If no candidate view of the frame fulfils the conditions of the scene file.
    """
    spec = scene.spec
    cameras = (spec.camera, *spec.cameras)
    number_of_layout, view = divmod(index, spec.output.views)
    views_of_turn = spec.views_of_turn
    turn, place_in_turn = divmod(view, len(views_of_turn))
    number, side = views_of_turn[place_in_turn]
    camera = cameras[number]
    if side and camera.stereo is not None:
        left = view_of(scene, index - 1, layout)
        pose = left.camera.world_from_camera.copy()
        pose[:3, 3] += camera.stereo.baseline * pose[:3, 0]
        return Viewpoint(replace(left.camera, world_from_camera=pose), {**left.drawn, "side": "right"})
    turns = 1 + (spec.output.views - 1 - place_in_turn) // len(views_of_turn)
    camera_turn = _CameraTurn(spec.seed, index, number, camera, spec.output, number_of_layout, turn, turns)
    own: dict[str, Any] = {"camera": number} if spec.cameras else {}
    own |= {"side": "left"} if camera.stereo else {}
    if isinstance(camera, CameraHemisphere):
        found = _hemisphere_view(scene, camera_turn, camera, layout)
        return Viewpoint(found.camera, {**own, **found.drawn})
    if isinstance(camera, CameraWalk):
        pose = _walk_pose(camera, camera_turn)
    else:
        if isinstance(camera, CameraOrbit):
            pose = _orbit_pose(camera, turn, turns)
        else:
            keys = [look_at_pose(key.eye, key.target, key.up) for key in camera.keys]
            pose = interpolate_poses(keys, camera_turn.time)[0]
        pose[:3, 3] += camera.jitter * random_stream(spec.seed, "camera jitter", index).standard_normal(3)
    view_camera, drawn = camera_turn.camera_at_pose(pose)
    return Viewpoint(view_camera, own | drawn)


def handheld_transform(motion: Sequence[float]) -> Float64Array:
    """Return the rigid transform (4, 4) of a displacement [m] and a rotation vector [degrees] in the camera's frame."""
    moved = np.eye(4)
    moved[:3, 3] = motion[:3]
    moved[:3, :3] = Rotation.from_rotvec(motion[3:], degrees=True).as_matrix()
    return moved


def camera_at(pose: Float64Array, intrinsics: Intrinsics, output: Output, zoom: float = 1.0) -> Camera:
    """Return a camera of the scene file at a pose, for images of the output's size.

    The focal lengths are multiplied by ``zoom``.

    Raises:
        ValueError: If the intrinsics are invalid, such as those of a fisheye lens that sees backwards.
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
    """Return the pose of a view on an orbit.

    A full circle ends one step before its start. A partial circle ends at its end.
    """
    steps = views if abs(camera.sweep) == 360 else max(1, views - 1)
    azimuth = np.radians(camera.start + camera.sweep * view / steps)
    offset = (camera.radius * np.cos(azimuth), camera.radius * np.sin(azimuth), camera.height)
    return look_at_pose(np.add(camera.target, offset), camera.target)


def _walk_pose(camera: CameraWalk, camera_turn: _CameraTurn) -> Float64Array:
    """Return a pose by interpolation between the waypoints of the layout.

    The interpolation is monotone piecewise cubic (Fritsch and Carlson 1980).
    """
    rng = random_stream(camera_turn.seed, "camera walk", camera_turn.layout, camera_turn.number)
    ranges = np.array([camera.azimuth, np.sin(np.radians(camera.elevation)), camera.radius])
    places = rng.uniform(ranges[:, 0], ranges[:, 1], (camera.places, 3))
    azimuth, sine, radius = PchipInterpolator(np.linspace(0, 1, camera.places), places)(camera_turn.time)
    return _pose_around(np.array(camera.target, dtype=np.float64), np.radians(azimuth), sine, radius)


def _pose_around(target: Float64Array, azimuth: float, sine: float, radius: float) -> Float64Array:
    """Return the pose that looks at a target [m] from an azimuth [rad], a sine of the elevation and a distance [m]."""
    return look_at_pose(target + radius * direction(azimuth, sine), target)


def _hemisphere_view(
    scene: Scene, camera_turn: _CameraTurn, camera: CameraHemisphere, layout: Layout | None
) -> Viewpoint:
    """Return the accepted candidate view whose shares of hidden and cut objects are nearest to the targets.

    The search ends at the first accepted candidate that meets the targets exactly.
    """
    spec, index = scene.spec, camera_turn.index
    predictor = (
        None
        if layout is None or (camera.look_at == "target" and not camera.selects_views)
        else VisibilityPredictor.of(scene, layout)
    )
    if predictor is None or not camera.selects_views:
        target, seen = _target(camera, spec.seed, index, 0, predictor)
        pose, target = _hemisphere_pose(camera, camera_turn, 0, target)
        view_camera, drawn = camera_turn.camera_at_pose(pose)
        return Viewpoint(
            view_camera, drawn if camera.look_at == "target" else {**drawn, "target": target.tolist(), "object": seen}
        )
    shares = (camera.occlusion, camera.truncation)
    rounding = random_stream(spec.seed, "camera shares", index).uniform(size=2)
    best: tuple[float, Viewpoint] | None = None
    refused: list[tuple[float, str]] = []
    for number in range(camera.tries):
        target, seen = _target(camera, spec.seed, index, number, predictor)
        pose, target = _hemisphere_pose(camera, camera_turn, number, target)
        if camera.truncation is not None and number % 2:
            rng = _stream(spec.seed, "camera border", index, number)
            pose, target = _rotate_target_to_border(camera_turn.camera_at_pose(pose)[0], pose, target, rng)
        view_camera, motion_draws = camera_turn.camera_at_pose(pose)
        projected = predictor.project(view_camera)
        if camera.accept is not None and (violations := predictor.find_violations(projected, camera.accept)):
            refused.append((sum(miss for miss, _ in violations), " and ".join(text for _, text in violations)))
            continue
        prediction = predictor.predict(projected, camera.occlusion, camera.truncation, spec.labels.min_pixels)
        drawn = {
            "target": target.tolist(),
            "object": seen,
            "attempt": number,
            "predicted": prediction.to_json(),
        } | motion_draws
        cost = _cost(prediction, [0.0 if share is None else share.share for share in shares], rounding)
        if best is None or cost < best[0]:
            best = cost, Viewpoint(view_camera, drawn)
        if cost == 0:
            break
    if best is None:
        raise InputError(
            f"{scene.path}: camera.accept: none of {camera.tries} candidate views of frame {index} is acceptable "
            f"(the best one {min(refused)[1]}); relax camera.accept, widen the camera's ranges or increase camera.tries"
        )
    return best[1]


def _cost(prediction: PredictedView, shares: list[float], rounding: Float64Array) -> float:
    """Return the difference between the shares of objects in a view and the target shares.

    A share of few objects is seldom a whole number. The random numbers ``rounding`` of the frame round it up or
    down, so that the average over frames reaches the target although frames are independent.
    """
    wanted = np.floor(np.multiply(shares, prediction.in_view) + rounding)
    counts = np.array([prediction.hidden, prediction.cut])
    if not prediction.in_view:
        return float(len(prediction.visible))  # an image without objects meets no target share
    return float(np.abs(counts - wanted).sum()) / prediction.in_view


def _target(
    camera: CameraHemisphere, seed: int, index: int, number: int, predictor: VisibilityPredictor | None
) -> tuple[Float64Array, int | None]:
    """Return the point at the centre of a candidate view before jitter [m], and the id of the object there, if any."""
    if predictor is None or camera.look_at == "target" or not predictor.labelled.any():
        return np.array(camera.target, dtype=np.float64), None
    among = np.flatnonzero(predictor.labelled)
    drawn = int(among[_stream(seed, "camera look at", index, number).integers(len(among))])
    if camera.look_at == "objects":
        return predictor.centres[drawn], int(predictor.ids[drawn])
    away = np.linalg.norm(predictor.centres[among] - predictor.centres[drawn], axis=1)
    nearest = among[np.argsort(away, kind="stable")[: 1 + _NEIGHBOURS]]
    return predictor.centres[nearest].mean(axis=0), int(predictor.ids[drawn])


def _hemisphere_pose(
    camera: CameraHemisphere, camera_turn: _CameraTurn, number: int, middle: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the pose of a candidate view around a point [m], and its target with jitter [m]."""
    seed, index = camera_turn.seed, camera_turn.index

    def draw(name: str, low: float, high: float) -> float:
        return float(_stream(seed, f"camera {name}", index, number).uniform(low, high))

    # Uniform by area on the sphere: the sine of the elevation is uniform (Archimedes).
    sines = np.sin(np.radians(camera.elevation))
    if camera.coverage == "even":
        shift = random_stream(seed, "camera coverage", number).uniform(size=3)
        low, high = np.array([camera.azimuth, sines, camera.radius], dtype=np.float64).T
        nth = camera_turn.layout * camera_turn.turns + camera_turn.turn + 1  # of all views of this camera
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


def _rotate_target_to_border(
    lens: Camera, pose: Float64Array, target: Float64Array, rng: np.random.Generator
) -> tuple[Float64Array, Float64Array]:
    """Rotate a pose until its target is near the border of the image.

    Returns:
        The new pose, and the point in the centre of the new view at the distance of the target [m].
    """
    place = np.array([rng.choice([-1, 1]) * rng.uniform(*_BORDER), rng.uniform(-1, 1)])[:: rng.choice([-1, 1])]
    slopes = place * (lens.width / lens.fx, lens.height / lens.fy) / 2
    away = float(np.linalg.norm(slopes))
    turn = Rotation.from_rotvec(np.arctan(away) / away * np.array([slopes[1], -slopes[0], 0.0])).as_matrix()
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ turn
    return turned, pose[:3, 3] + float(np.linalg.norm(target - pose[:3, 3])) * turned[:3, 2]


def _stream(seed: int, purpose: str, index: int, number: int) -> np.random.Generator:
    """Return the random stream of a candidate view. Candidate 0 has the stream of frames with a single candidate."""
    return random_stream(seed, purpose, index, *([number] if number else []))
