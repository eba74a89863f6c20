"""Live poses of simulators: layouts from the bodies of MuJoCo and Newton, and cameras from those of MuJoCo.

They replace the layout and the camera of a frame, so that one renderer shows every step of a simulation::

    with ms.Renderer(scene) as renderer:
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        camera = ms.camera_from_mujoco(model, data, "wrist", width=640, height=480)
        frame = renderer.render(0, layout=ms.layout_from_mujoco(scene, model, data), camera=camera)

MuJoCo has quaternions in the order w, x, y, z, and cameras look along -z with y up. Newton has quaternions in the order
x, y, z, w. Both are converted to the conventions of :mod:`mitsplat.gaussians.splat_cloud`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arguments import check_type
from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.scene.given_poses import asset_index
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.scene import Scene

if TYPE_CHECKING:
    import newton

_OBJECT = re.compile("(.+)_([1-9][0-9]{0,3})")
"""Name of an exported body: the asset and the instance id."""
_UNIT = 1e-3
"""Maximum deviation of a quaternion's length from 1. Poses in single precision pass."""


def identifier(text: str) -> str:
    """Return a name without characters that names of bodies and files do not have."""
    return re.sub(r"\W+", "_", text)


def layout_from_mujoco(
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: Mapping[str | int, str | int] | None = None,
    *,
    index: int = 0,
) -> Layout:
    """Create a layout from the poses of MuJoCo's bodies, ``data.xpos`` and ``data.xquat``.

    After ``mj_step``, these are the poses before the step; ``mj_forward`` updates them.

    Args:
        scene: The scene with the assets.
        model: Model of the simulation.
        data: State of the simulation.
        bodies: Name or index of each body that is shown, and the name, path or index of its asset, see
            :meth:`mitsplat.Layout.from_poses`. The frame of the body is that of the asset. Instance ids count from 1 in
            the order of the mapping. By default, all bodies with names of the form ``ASSET_ID``, as in models of
            ``mitsplat export --mjcf``; each body with a free joint must have such a name.
        index: Index of the layout. It determines the surroundings and the appearance of objects.

    Raises:
        InputError: If a body or asset does not exist or is ambiguous, two bodies have the same id, or a pose is not
            finite or has a quaternion whose length is not 1.
    """
    _check_mujoco(model, data)
    names = [model.body(number).name for number in range(model.nbody)]
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    poses = np.concatenate([data.xpos, np.roll(data.xquat, -1, axis=1)], axis=1)
    placed = _place(scene, names, set(free.tolist()), bodies)
    return _layout(scene, names, poses, placed, index, "call mujoco.mj_forward(model, data) first")


def layout_from_newton(
    scene: Scene,
    model: newton.Model,
    state: newton.State,
    bodies: Mapping[str | int, str | int] | None = None,
    *,
    index: int = 0,
) -> Layout:
    """Create a layout from the poses of Newton's bodies, ``state.body_q``.

    Args:
        scene: The scene with the assets.
        model: Model of the simulation. The name of a body is the last part of its label.
        state: State of the simulation.
        bodies: As in :func:`mitsplat.layout_from_mujoco`. Bodies of a model with several worlds are named by index,
            because each world has the same names.
        index: Index of the layout. It determines the surroundings and the appearance of objects.

    Raises:
        InputError: As in :func:`mitsplat.layout_from_mujoco`.
    """
    import newton  # slow, and already imported by the caller of this function

    check_type(model, newton.Model, "model", "create it by newton.ModelBuilder.finalize()")
    check_type(state, newton.State, "state", "create it by model.state()")
    names = [label.rpartition("/")[2] for label in model.body_label]
    simulated: Any = model  # arrays of Warp have no types
    poses: Any = state.body_q
    joints = zip(simulated.joint_type.numpy(), simulated.joint_child.numpy(), strict=True) if model.joint_count else ()
    free = {int(body) for kind, body in joints if kind == newton.JointType.FREE}
    poses = np.zeros((0, 7)) if poses is None else np.asarray(poses.numpy(), dtype=np.float64)
    placed = _place(scene, names, free, bodies)
    return _layout(scene, names, poses, placed, index, "create the state by model.state()")


def camera_from_mujoco(
    model: mujoco.MjModel, data: mujoco.MjData, name: str | int, *, width: int | None = None, height: int | None = None
) -> Camera:
    """Create a camera from a camera of MuJoCo: pose, and ``fovy`` or the intrinsics of its sensor.

    Args:
        model: Model of the simulation.
        data: State of the simulation.
        name: Name or index of the camera.
        width: Image width [px]; by default, that of the camera's resolution in the model.
        height: Image height [px]. As in MuJoCo's renderer, the window of a sensor fills the image; another aspect ratio
            gives pixels that are not square.

    Raises:
        InputError: If there is no such camera, it is orthographic, no image size is stated, or it has no pose.
    """
    _check_mujoco(model, data)
    try:
        number = model.camera(name).id
    except (KeyError, IndexError):
        known = ", ".join(model.camera(one).name for one in range(model.ncam)) or "none"
        raise InputError(f"camera {name!r}: must be a camera of the model ({known})") from None
    if model.cam_projection[number] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE:
        raise InputError(f"camera {name!r}: must have a perspective projection (got an orthographic one)")
    stated = model.cam_resolution[number].tolist()
    if stated == [1, 1] and (width is None or height is None):
        raise InputError(f"camera {name!r}: needs width and height, because the model states no resolution")
    if not data.cam_xmat[number].any():
        raise InputError(f"camera {name!r}: has no pose yet; call mujoco.mj_forward(model, data) first")
    width, height = stated[0] if width is None else width, stated[1] if height is None else height
    pose = homogeneous_matrix(data.cam_xmat[number].reshape(3, 3), data.cam_xpos[number])
    if model.cam_sensorsize[number].all():
        # Lengths in the plane of the sensor [m]; the offset of the window has y up.
        per_metre = np.array([width, height]) / model.cam_sensorsize[number]
        focal = model.cam_intrinsic[number, :2] * per_metre
        offset = model.cam_intrinsic[number, 2:] * per_metre
    else:
        focal = np.full(2, 0.5 * height / np.tan(0.5 * np.radians(model.cam_fovy[number])))
        offset = np.zeros(2)
    (fx, fy), (cx, cy) = focal.tolist(), (0.5 * np.array([width, height]) - offset).tolist()
    try:
        return Camera.from_opengl(pose, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    except ValueError as error:
        raise InputError(f"camera {name!r}: {error}") from None


def _check_mujoco(model: object, data: object) -> None:
    check_type(model, mujoco.MjModel, "model", "create it by mujoco.MjModel.from_xml_path(path)")
    check_type(data, mujoco.MjData, "data", "create it by mujoco.MjData(model)")


def _place(
    scene: Scene, names: Sequence[str], free: Collection[int], bodies: Mapping[str | int, str | int] | None
) -> dict[int, tuple[int, int]]:
    """Return the body and the asset of each instance id."""
    Scene.check(scene)
    if bodies is not None:
        if not isinstance(bodies, Mapping):
            raise InputError(f"bodies must map bodies to assets, as in {{'nut_1': 'nut'}} (got {bodies!r})")
        return {
            number: (_find_body(body, names), asset_index(asset, scene.asset_names, f"bodies[{body!r}]"))
            for number, (body, asset) in enumerate(bodies.items(), start=1)
        }
    exported = [(identifier(asset), path) for asset, path in scene.asset_names]
    known = {name for name, _ in exported}
    placed: dict[int, tuple[int, int]] = {}
    for body, name in enumerate(names):
        match = _OBJECT.fullmatch(name)
        if match and match[1] in known:
            number = int(match[2])
            if number in placed:
                raise InputError(
                    f"body {name!r}: must have an instance id of its own (body {names[placed[number][0]]!r} has "
                    f"{number}, too); name the bodies of one world by bodies={{INDEX: ASSET}}"
                )
            placed[number] = body, asset_index(match[1], exported, f"body {name!r}")
        elif body in free:
            raise InputError(
                f"body {repr(name) if name else body}: must be named ASSET_ID, an asset of the scene and a number of 1 "
                "to 9999, because it has a free joint; otherwise state the bodies that are shown, by their names or "
                "indices: bodies={BODY: ASSET}"
            )
    if not placed:
        raise InputError(
            "the model must have bodies named ASSET_ID, as models of `mitsplat export --mjcf` have (got "
            f"{', '.join(names) or 'none'}); otherwise name the bodies that are shown by bodies={{BODY: ASSET}}"
        )
    return placed


def _find_body(body: str | int, names: Sequence[str]) -> int:
    """Return the index of the body with a name or an index."""
    if isinstance(body, str):
        found = [number for number, name in enumerate(names) if name == body]
        if len(found) > 1:
            raise InputError(
                f"bodies[{body!r}]: must name one body (it names {len(found)}: use one of the indices "
                f"{', '.join(map(str, found))})"
            )
    else:
        found = [body] if 0 <= body < len(names) else []
    if not found:
        known = ", ".join(names) or "none"
        raise InputError(f"bodies[{body!r}]: must be a body of the model or its index (bodies: {known})")
    return found[0]


def _layout(
    scene: Scene,
    names: Sequence[str],
    poses: Float64Array,
    placed: Mapping[int, tuple[int, int]],
    index: int,
    remedy: str,
) -> Layout:
    """Create the layout of bodies whose poses (N, 7) are positions and quaternions x, y, z, w."""
    if len(poses) != len(names):
        raise InputError(f"the poses must be those of the model's {len(names)} bodies (got {len(poses)} poses)")
    instances = []
    for number, (body, asset) in sorted(placed.items()):
        row = poses[body]
        if not np.isfinite(row).all():
            raise InputError(
                f"body {names[body]!r}: must have a finite pose (got {row.tolist()}); has the simulation diverged?"
            )
        if abs((length := np.linalg.norm(row[3:])) - 1.0) > _UNIT:
            raise InputError(f"body {names[body]!r}: must have a quaternion of length 1 (got {length:.6g}); {remedy}")
        pose = homogeneous_matrix(Rotation.from_quat(row[3:]).as_matrix(), row[:3])
        instances.append(Instance(number, asset, scene.class_index(asset), pose))
    return Layout(index, tuple(instances), NO_PHYSICS)
