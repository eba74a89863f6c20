"""Selection of the viewpoint of each frame.

The seed and the index of the frame determine the viewpoint. If the scene file points cameras at objects or selects
views by the visible objects, the viewpoint also depends on the layout. Without a layout, such a camera gets a possible
viewpoint instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import direction, interpolate_poses, look_at_pose
from mitsplat.scene.planning.visibility_prediction import PredictedView, VisibilityPredictor, containing_solid
from mitsplat.scene.spec.camera_spec import TRIES, Acceptance, CameraFixed, CameraHemisphere, CameraOrbit, Intrinsics
from mitsplat.scene.spec.scene_spec import Output, SceneSpec
from mitsplat.scene.streams import random_stream
from mitsplat.storage.files import JsonObject

if TYPE_CHECKING:
    from mitsplat.scene.layout import Layout
    from mitsplat.scene.scene import Scene

_STEPS = 1.2207440846057596 ** -np.arange(1.0, 4.0)
"""Steps of the low-discrepancy sequence in three dimensions: powers of the root of x^4 = x + 1.

Source: Roberts, *The Unreasonable Effectiveness of Quasirandom Sequences*, 2018. Each point can be computed without the
points before it.
"""
_BORDER = (0.6, 1.0)
"""Range of the distance between target and image centre of views that should cut objects, in half widths or heights."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Viewpoint of an image.

    Attributes:
        camera: The camera.
        drawn: Random values and selection results as JSON values, empty if the scene has none. Keys:

            * ``motion``: ``exposure`` [s];
            * ``target``: point in the centre of the image [m];
            * ``object``: id of the instance in the centre of the image;
            * ``attempt``: number of the candidate view;
            * ``predicted``: predicted visibility of the labelled objects.
    """

    camera: Camera
    drawn: JsonObject = field(default_factory=dict)


@lru_cache(maxsize=4)
def viewpoint_of(scene: Scene, index: int, layout: Layout | None = None) -> Viewpoint:
    """Return the viewpoint of frame ``index``. The layout is needed only if the viewpoint depends on the objects.

    Raises:
        InputError: If no candidate view of the frame fulfils the conditions of the scene file.
    """
    spec, camera = scene.spec, scene.spec.camera
    if isinstance(camera, CameraHemisphere):
        return _hemisphere_view(scene, index, camera, layout)
    view, views = index % spec.output.views, spec.output.views
    if isinstance(camera, CameraFixed):
        pose = camera.pose
        turn = camera.rotation_jitter * random_stream(spec.seed, "camera rotation jitter", index).standard_normal(3)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn, degrees=True).as_matrix()
    elif isinstance(camera, CameraOrbit):
        pose = _orbit_pose(camera, view, views)
    else:
        keys = [look_at_pose(key.eye, key.target, key.up) for key in camera.keys]
        pose = interpolate_poses(keys, view / max(1, views - 1))[0]
    stated = pose[:3, 3].copy()
    for number in range(TRIES if camera.jitter else 1):
        pose[:3, 3] = stated + camera.jitter * _stream(spec.seed, "camera jitter", index, number).standard_normal(3)
        solid = "" if layout is None else containing_solid(scene, layout, pose[:3, 3])
        if not solid:
            return Viewpoint(*_camera_of_frame(spec, index, pose))
    raise InputError(f"{scene.path}: camera: the eye of frame {index} must not be in a solid (it is in {solid})")


def check_eye(scene: Scene, index: int, layout: Layout, camera: Camera) -> None:
    """Check that a given camera is not inside an object or a visible shape, which would hide everything.

    Raises:
        InputError: If it is.
    """
    if solid := containing_solid(scene, layout, camera.centre):
        raise InputError(f"{scene.path}: the camera of frame {index} must not be in a solid (it is in {solid})")


def _camera_of_frame(spec: SceneSpec, index: int, pose: Float64Array) -> tuple[Camera, JsonObject]:
    """Return the camera of a frame at a pose, and the values drawn for it."""
    drawn, motion = JsonObject(), spec.camera.motion
    if motion is not None:
        exposure = random_stream(spec.seed, "camera motion", index).uniform(*motion.exposure)
        drawn["motion"] = {"exposure": float(exposure)}
    return camera_at(pose, spec.camera.intrinsics, spec.output), drawn


def camera_at(pose: Float64Array, intrinsics: Intrinsics, output: Output) -> Camera:
    """Return a camera of the scene file at a pose (4, 4), for images of the output's size.

    A rectified camera is the pinhole camera with the same intrinsic matrix.

    Raises:
        ValueError: If the intrinsics are invalid, such as those of a fisheye lens that sees backwards.
    """
    size = intrinsics.size or (output.width, output.height)
    camera = Camera(
        *size,
        *intrinsics.focal_lengths(size),
        *intrinsics.principal_point(size),
        world_from_camera=pose,
        distortion=intrinsics.distortion,
        lens=intrinsics.lens,
        aperture_radius=intrinsics.aperture,
        focus_distance=intrinsics.focus,
    )
    camera = camera.resized(output.width, output.height)
    return replace(camera, distortion=(), lens="opencv") if output.rectify else camera


def _orbit_pose(camera: CameraOrbit, view: int, views: int) -> Float64Array:
    """Return the pose of a view on an orbit.

    A full circle ends one step before its start. A partial circle ends at its end.
    """
    steps = views if abs(camera.sweep) == 360 else max(1, views - 1)
    azimuth = np.radians(camera.start + camera.sweep * view / steps)
    offset = (camera.radius * np.cos(azimuth), camera.radius * np.sin(azimuth), camera.height)
    return look_at_pose(np.add(camera.target, offset), camera.target)


def _hemisphere_view(scene: Scene, index: int, camera: CameraHemisphere, layout: Layout | None) -> Viewpoint:
    """Return the viewpoint of a frame: the best candidate view, or the first one whose eye is outside of solids."""
    lens, drawn_motion = _camera_of_frame(scene.spec, index, np.eye(4))
    predictor = None
    if layout is not None and (camera.look_at == "objects" or camera.selects_views):
        predictor = VisibilityPredictor.of(scene, layout)
    candidates = _candidate_views(camera, lens, scene.spec.seed, index, predictor)
    if predictor is not None and camera.selects_views:
        best = _best_view(scene, index, camera, predictor, candidates)
        return replace(best, drawn=best.drawn | drawn_motion)
    solid = ""
    for view in candidates:
        solid = "" if layout is None else containing_solid(scene, layout, view.camera.centre)
        if not solid:
            aim = {} if camera.look_at == "target" else {"target": view.target.tolist(), "object": view.seen}
            return Viewpoint(view.camera, drawn_motion | aim)
    raise InputError(
        f"{scene.path}: camera: all {camera.tries} eyes drawn for frame {index} are in a solid (the last in "
        f"{solid}); widen the camera's ranges"
    )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Candidate view of a frame.

    Attributes:
        number: Number of the candidate, from 0.
        camera: The camera.
        target: Point in the centre of the image [m], shape (3,).
        seen: Id of the instance in the centre of the image, if one was drawn.
    """

    number: int
    camera: Camera
    target: Float64Array
    seen: int | None


def _candidate_views(
    camera: CameraHemisphere, lens: Camera, seed: int, index: int, predictor: VisibilityPredictor | None
) -> Iterator[_Candidate]:
    """Yield the candidate views of a frame; with target shares of cut objects, every other one has a border target."""
    for number in range(camera.tries):
        middle, seen = _target(camera, seed, index, number, predictor)
        pose, target = _hemisphere_pose(camera, seed, index, number, middle)
        if camera.truncation is not None and number % 2:
            rng = _stream(seed, "camera border", index, number)
            pose, target = _rotate_target_to_border(lens, pose, target, rng)
        yield _Candidate(number, replace(lens, world_from_camera=pose), target, seen)


def _best_view(
    scene: Scene, index: int, camera: CameraHemisphere, predictor: VisibilityPredictor, candidates: Iterable[_Candidate]
) -> Viewpoint:
    """Return the accepted candidate view whose shares of hidden and cut objects are nearest to the targets.

    The search ends at the first accepted candidate that meets the targets exactly.
    """
    shares = [0.0 if target is None else target.share for target in (camera.occlusion, camera.truncation)]
    rounding = random_stream(scene.spec.seed, "camera shares", index).uniform(size=2)
    best: tuple[float, Viewpoint] | None = None
    refused: list[tuple[float, str]] = []
    for view in candidates:
        projected = predictor.project(view.camera)
        if violations := predictor.find_violations(projected, camera.accept or Acceptance()):
            refused.append((sum(miss for miss, _ in violations), " and ".join(text for _, text in violations)))
            continue
        prediction = predictor.predict(projected, camera.occlusion, camera.truncation, scene.spec.labels.min_pixels)
        cost = _cost(prediction, shares, rounding)
        if best is None or cost < best[0]:
            drawn = {
                "target": view.target.tolist(),
                "object": view.seen,
                "attempt": view.number,
                "predicted": prediction.to_json(),
            }
            best = cost, Viewpoint(view.camera, drawn)
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
    return predictor.centres[drawn], int(predictor.ids[drawn])


def _hemisphere_pose(
    camera: CameraHemisphere, seed: int, index: int, number: int, middle: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the pose of a candidate view around a point [m], and its target with jitter [m]."""

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
    jitter = camera.target_jitter * _stream(seed, "camera target", index, number).standard_normal(3)
    target = np.add(middle, jitter)
    pose = look_at_pose(target + radius * direction(azimuth, sine), target)
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
