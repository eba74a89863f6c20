"""Iteration over frames: the frames of a scene, or a film with given layouts and cameras."""

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
from mitsplat.scene.planning.conveyor import layout_at_view
from mitsplat.scene.planning.frame_plan import layout_index_of, to_index
from mitsplat.scene.planning.viewpoints import viewpoint_of
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LightEntry

Item = TypeVar("Item")
Shot = tuple[int, Layout | None, Camera | None]
"""Frame index, and optional layout and camera in place of the scene's."""

_UNLIMITED_LAYOUTS = 1 << 40
"""Number of layouts of an unlimited scene."""


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
    """Render and label frames lazily, one per iteration.

    ::

        for frame in ms.render_frames(scene):
            ...

    Each frame equals that of :func:`mitsplat.render_frame`, independent of the other frames. A layout is settled when
    its first frame is requested. With given ``layouts`` or ``cameras``, the frames form a film: the flow of each frame
    leads to the next one. Objects are matched by their id. The last frame has no flow.

    Args:
        scene: The scene.
        frames: Number of frames, or their indices. By default, the frames of the scene; with given layouts or cameras,
            the shorter of these. Indices may be endless, such as ``itertools.count()``.
        layouts: One layout per frame, or one for all frames; by default, the scene's settled layouts. A list must not
            be shorter than ``frames``.
        cameras: One camera per frame, or one for all frames; by default, those of the scene. A list must not be shorter
            than ``frames``.
        lights: As in :func:`mitsplat.render_frame`, for all frames.
        quality: As in :func:`mitsplat.render_frame`.
        progress: Show a progress bar in a terminal, or in a notebook with ipywidgets.

    Raises:
        InputError: As in :func:`mitsplat.render_frame`.
    """
    Scene.check(scene)
    indices = _frame_indices(scene, frames, layouts, cameras)
    parts: tuple[object, ...] = (indices, layouts, cameras)
    total = min((len(part) for part in parts if isinstance(part, Sized)), default=None)
    # More layouts do not change the first frames.
    output = scene.spec.output.model_copy(update={"layouts": _UNLIMITED_LAYOUTS})
    scene = replace(scene, spec=scene.spec.model_copy(update={"output": output}))
    with Renderer(scene, quality=quality) as renderer:
        if layouts is None and cameras is None:
            for index in _with_progress_bar(indices, total, progress):
                yield renderer.render(index, lights=lights)
            return
        shots = zip(indices, _one_per_frame(layouts), _one_per_frame(cameras), strict=False)
        for shot, following in _with_progress_bar(with_successor(shots), total, progress):
            index, layout, camera = shot
            next_layout, next_camera = (None, None) if following is None else _next_view(scene, shot, following)
            frame = renderer.render(
                index, layout=layout, camera=camera, lights=lights, next_layout=next_layout, next_camera=next_camera
            )
            if next_camera is None:  # the scene's next view is not part of the film
                frame = replace(frame, plan=replace(frame.plan, next_camera=None))
            elif following is not None:
                frame = _run_belt(scene, frame, following)
            yield frame


def _frame_indices(
    scene: Scene,
    frames: int | Iterable[int] | None,
    layouts: Layout | Iterable[Layout] | None,
    cameras: Camera | Iterable[Camera] | None,
) -> Iterable[int]:
    """Return the indices of the frames; lists of layouts and cameras must suffice for a given number of frames."""
    if frames is None:
        is_film = isinstance(layouts, Iterable) or isinstance(cameras, Iterable)
        return itertools.count() if is_film else range(scene.num_frames)
    if isinstance(frames, Iterable):
        indices = frames
    else:
        if (count := to_index(frames, "frames")) < 0:
            raise InputError(f"frames must be 0 or more (got {count})")
        indices = range(count)
    if isinstance(indices, Sized):
        for name, given in (("layouts", layouts), ("cameras", cameras)):
            if isinstance(given, Sized) and len(given) < len(indices):
                raise InputError(f"{name} must have one item for each of the {len(indices)} frames (got {len(given)})")
    return indices


def _next_view(scene: Scene, shot: Shot, following: Shot) -> tuple[Layout | None, Camera | None]:
    """Return the next layout and camera for the flow of a film; (None, None) if the next image has other objects."""
    (index, layout, _), (next_index, next_layout, next_camera) = shot, following
    if layout is None and layout_index_of(scene, index) != layout_index_of(scene, next_index):
        return None, None
    if next_layout is not None:
        view = next_index - layout_index_of(scene, next_index) * scene.spec.output.views
        next_layout = layout_at_view(scene, next_layout, view)
    return next_layout, viewpoint_of(scene, next_index, next_layout).camera if next_camera is None else next_camera


def _run_belt(scene: Scene, frame: Frame, following: Shot) -> Frame:
    """Return a frame whose flow leads to the moment of the next image of a film; without a belt, the same frame."""
    (next_index, next_layout, _), belt, conveyor = following, frame.plan.belt, scene.spec.conveyor
    if belt is None or conveyor is None:
        return frame
    view = next_index % scene.spec.output.views
    plan = replace(frame.plan, belt=replace(belt, interval=conveyor.interval * (view - frame.plan.view)))
    moved = frame.next_layout if next_layout is not None else layout_at_view(scene, frame.layout, view)
    return replace(frame, plan=plan, next_layout=moved)


def _one_per_frame(given: Item | Iterable[Item] | None) -> Iterator[Item | None]:
    """Return an iterator over the given items, or an endless repetition of a single item."""
    return iter(given) if isinstance(given, Iterable) else itertools.repeat(given)


def with_successor(items: Iterable[Item]) -> Iterator[tuple[Item, Item | None]]:
    """Pair every item with its successor; None for the last one."""
    rest = iter(items)
    now = next(rest, None)
    while now is not None:
        following = next(rest, None)
        yield now, following
        now = following


def _with_progress_bar(steps: Iterable[Item], total: int | None, progress: bool) -> Iterator[Item]:
    """Yield the steps, with a progress bar if the console can show one."""
    console = Console(stderr=True)
    if not progress or not (find_spec("ipywidgets") if console.is_jupyter else console.is_terminal):
        yield from steps
        return
    with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=console) as bar:
        yield from bar.track(steps, total=total, description="frames")
