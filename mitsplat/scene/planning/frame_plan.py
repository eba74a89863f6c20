"""Plans of frames: camera, lights and random draws, decided by the seed and the index of the frame.

Every random value has a stream of its own, named by its purpose. Adding a value therefore shifts no other value, and
any worker can plan any frame in any order.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import SupportsIndex

from mitsplat.arguments import describe
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import Belt, belt_of
from mitsplat.scene.planning.frame_lights import lights_at
from mitsplat.scene.planning.viewpoints import Viewpoint, check_eye, viewpoint_of
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.image_spec import DAYLIGHT
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightEntry, LightSpec
from mitsplat.scene.spec.named_files import light_images
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.splits import Split, split_of
from mitsplat.scene.streams import random_stream
from mitsplat.storage.files import JsonObject

_FRAME_DRAWS = (
    *("exposure", "vignetting", "chromatic_aberration", "motion_blur", "motion_angle", "iso"),
    *("white_balance", "hue", "saturation", "chroma_stretch", "chroma_angle", "sharpening", "jpeg"),
)
"""Names of the values that are drawn for every frame."""


@dataclass(frozen=True, eq=False)
class FramePlan:
    """Plan of a frame: everything except the resting poses of its objects.

    Attributes:
        index: Index of the frame.
        layout: Index of the layout.
        view: Index of the view in the layout.
        split: Split of the whole layout.
        camera: Camera of the image.
        next_camera: Camera of the next image of the layout; None for the last image.
        lights: Lights of this frame, with paths and random factors applied.
        draws: Random values by name, see :func:`mitsplat.frames.camera_response.develop`.
        seed: Seed of the pixel noise.
        viewpoint: Random draws of the camera, see :class:`mitsplat.scene.planning.viewpoints.Viewpoint`.
        belt: The conveyor belt at the moment of the frame, if the scene has one.
    """

    index: int
    layout: int
    view: int
    split: Split
    camera: Camera
    next_camera: Camera | None
    lights: tuple[LightSpec, ...]
    draws: dict[str, float]
    seed: int
    viewpoint: JsonObject = field(default_factory=dict)
    belt: Belt | None = None


def to_index(index: SupportsIndex, name: str) -> int:
    """Convert an index of any integer type to ``int``.

    Raises:
        InputError: If the value is no integer, such as text.
    """
    try:
        return operator.index(index)
    except TypeError:
        raise InputError(f"{name} must be a whole number (got {describe(index)})") from None


def layout_index_of(scene: Scene, index: int) -> int:
    """Return the index of the layout that frame ``index`` shows.

    Raises:
        InputError: If the scene has no such frame.
    """
    index = to_index(index, "frame")
    if not 0 <= index < scene.num_frames:
        raise InputError(f"{scene.path}: frame must be in 0 to {scene.num_frames - 1} (got {index})")
    return index // scene.spec.output.views


def plan_frame(
    scene: Scene,
    index: int,
    layout: Layout | None = None,
    *,
    camera: Camera | None = None,
    next_layout: Layout | None = None,
    next_camera: Camera | None = None,
    lights: Sequence[LightEntry] | None = None,
) -> FramePlan:
    """Plan frame ``index``. The seed and the index determine the plan, and also the layout.

    Args:
        scene: The scene.
        index: Index of the frame.
        layout: Resting poses of the objects. Without it, a camera whose view depends on the objects gets only a
            possible view.
        camera: Replaces the camera of the scene; nothing is drawn or selected for it.
        next_layout: Poses of the objects in the next image, if they move.
        next_camera: Camera of the next image. If absent, the next view of the layout; or ``camera``, if that is given
            and objects move.
        lights: Entries that replace the lights of the scene. They are drawn and moved along their paths in the same
            way.

    Raises:
        InputError: If there is no such frame, if no candidate view fulfils the conditions of the scene file, if the
            camera is inside an object or a visible shape, or if the lights are invalid.
    """
    index = to_index(index, "frame")
    spec, number = scene.spec, layout_index_of(scene, index)
    if lights is not None:
        spec = _with_lights(scene, lights)
    view = index - number * spec.output.views
    time = view / max(1, spec.output.views - 1)
    viewpoint = viewpoint_of(scene, index, layout) if camera is None else Viewpoint(camera)
    if camera is not None and layout is not None:
        check_eye(scene, index, layout, camera)
    if next_camera is None and camera is not None:
        next_camera = None if next_layout is None else camera
    elif next_camera is None and view + 1 < spec.output.views:
        next_camera = viewpoint_of(scene, index + 1, layout if next_layout is None else next_layout).camera
    return FramePlan(
        index=index,
        layout=number,
        view=view,
        split=split_of(number, spec.output),
        camera=viewpoint.camera,
        next_camera=next_camera,
        lights=lights_at(spec, number, index, time),
        draws={
            name: float(random_stream(spec.seed, name, index).uniform(*bounds))
            for name in _FRAME_DRAWS
            if (bounds := _range_of(spec, name)) is not None
        },
        seed=int(random_stream(spec.seed, "pixel noise", index).integers(2**31)),
        viewpoint=viewpoint.drawn,
        belt=belt_of(spec, view),
    )


def _with_lights(scene: Scene, lights: Sequence[LightEntry]) -> SceneSpec:
    """Return the specification of a scene with other lights, which may use only images of the scene file."""
    if not isinstance(lights, Sequence) or isinstance(lights, str):
        raise InputError(f"lights must be a list of lights (got a {type(lights).__name__}): put one light in [ ]")
    spec = SceneSpec(**{**dict(scene.spec), "lights": tuple(lights)})  # validates the lights
    if unknown := {name for _, name in light_images(spec)} - set(scene.images):
        raise InputError(f"images of lights must be images that the scene file names (got {min(unknown)!r})")
    for light in spec.lights:
        if isinstance(light, EnvironmentLight) and isinstance(light.pool, str):
            raise InputError(f"pools of lights must be lists of images that the scene file names (got {light.pool!r})")
    return spec


def _range_of(spec: SceneSpec, name: str) -> tuple[float, float] | None:
    """Return the range of a value that is drawn for a frame; None if the scene does not use the value."""
    ranges = spec.randomise
    if name == "white_balance" and spec.composite.white_balance not in ("auto", DAYLIGHT):
        return None
    if name in ("chromatic_aberration", "sharpening") and not any(getattr(ranges, name)):
        return None
    if name in ("chroma_stretch", "chroma_angle") and ranges.chroma_stretch == (1.0, 1.0):
        return None
    bounds: tuple[float, float] | None = (0.0, 360.0) if name == "motion_angle" else getattr(ranges, name)
    return bounds
