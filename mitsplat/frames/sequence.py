"""Frames one after the other, for a loop in Python: those of a scene, or a film whose objects and cameras are given."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import replace
from importlib.util import find_spec
from typing import TypeVar

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from mitsplat.errors import InputError
from mitsplat.frames.frame import Frame, Renderer
from mitsplat.geometry.camera import Camera
from mitsplat.quality import Quality
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import carried
from mitsplat.scene.planning.frame_plan import layout_of, whole
from mitsplat.scene.planning.viewpoints import view_of
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LightEntry

Item = TypeVar("Item")
Shot = tuple[int, Layout | None, Camera | None]
"""Index of a frame, and where its objects lie and its image is taken from if not as the scene says."""

_ENDLESS = 1 << 40
"""Layouts of a scene that does not end."""


def render_frames(
    scene: Scene,
    frames: int | Iterable[int] | None = None,
    *,
    layouts: Layout | Iterable[Layout] | None = None,
    cameras: Camera | Iterable[Camera] | None = None,
    lights: Sequence[LightEntry] | None = None,
    quality: str | Quality | None = None,
    progress: bool = True,
) -> Iterator[Frame]:
    """Render and label frames one after the other, each when it is asked for.

    ::

        for frame in ms.render_frames(scene):
            ...

    A frame is that of :func:`mitsplat.render_frame` whichever others are rendered; a layout is settled when its first
    frame is asked for. With ``layouts`` or ``cameras`` of your own the frames are a film: the flow of each leads to the
    next one, along the way of objects that have the same id in both; the last one has none.

    Args:
        scene: The scene.
        frames: How many, or the index of each; those of the scene by default, or as many as there are layouts and
            cameras. Indices may go on for as long as frames are asked for, as ``itertools.count()`` does.
        layouts: Where the objects lie in each frame, or in all of them; as the scene settles them by default.
        cameras: Where the image of each frame is taken from, or of all of them; those of the scene by default.
        lights: As in :func:`mitsplat.render_frame`, for all of them.
        quality: As there.
        progress: Whether a bar tells of them, in a terminal or in a notebook that has ipywidgets.

    Raises:
        InputError: As there.
    """
    if frames is None:
        given = any(isinstance(each, Iterable) for each in (layouts, cameras))
        indices: Iterable[int] = itertools.count() if given else range(scene.num_frames)
    elif isinstance(frames, Iterable):
        indices = frames
    else:
        if (count := whole(frames, "frames")) < 0:
            raise InputError(f"frames must be 0 or more (got {count})")
        indices = range(count)
    parts: tuple[object, ...] = (indices, layouts, cameras)
    total = min((len(each) for each in parts if isinstance(each, Sized)), default=None)
    scene = without_end(scene)
    with Renderer(scene, quality=quality) as renderer:
        if layouts is None and cameras is None:
            for index in _told(indices, total, progress):
                yield renderer.render(index, lights=lights)
            return
        shots = zip(indices, _each(layouts), _each(cameras), strict=False)
        for shot, following in _told(_with_next(shots), total, progress):
            index, layout, camera = shot
            next_layout, next_camera = (None, None) if following is None else _next(scene, shot, following)
            frame = renderer.render(
                index, layout=layout, camera=camera, lights=lights, next_layout=next_layout, next_camera=next_camera
            )
            if next_camera is None:  # of the film, whatever view of the scene's comes next
                frame = replace(frame, plan=replace(frame.plan, next_camera=None))
            yield frame


def without_end(scene: Scene) -> Scene:
    """The scene with more layouts than anyone asks for; its first frames are the same."""
    output = scene.spec.output.model_copy(update={"layouts": _ENDLESS})
    return replace(scene, spec=scene.spec.model_copy(update={"output": output}))


def _next(scene: Scene, shot: Shot, following: Shot) -> tuple[Layout | None, Camera | None]:
    """What the flow to the following image of a film has to know; nothing if that has other objects."""
    (index, layout, _), (next_index, next_layout, next_camera) = shot, following
    if layout is None and layout_of(scene, index) != layout_of(scene, next_index):
        return None, None
    if next_layout is not None:
        view = next_index - layout_of(scene, next_index) * scene.spec.output.views
        next_layout = carried(scene.spec, next_layout, view)
    return next_layout, view_of(scene, next_index, next_layout).camera if next_camera is None else next_camera


def _each(given: Item | Iterable[Item] | None) -> Iterator[Item | None]:
    """One for every frame."""
    return iter(given) if isinstance(given, Iterable) else itertools.repeat(given)


def _with_next(items: Iterable[Item]) -> Iterator[tuple[Item, Item | None]]:
    """Every item with the one that follows it."""
    rest = iter(items)
    now = next(rest, None)
    while now is not None:
        following = next(rest, None)
        yield now, following
        now = following


def _told(steps: Iterable[Item], total: int | None, progress: bool) -> Iterator[Item]:
    """The steps, with a bar where one can be shown."""
    console = Console(stderr=True)
    if not progress or not (find_spec("ipywidgets") if console.is_jupyter else console.is_terminal):
        yield from steps
        return
    with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=console) as bar:
        yield from bar.track(steps, total=total, description="frames")
