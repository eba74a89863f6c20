"""Real renders of what the browser looks at: a thread for the newest request, and what it does for a scene."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.frames.frame import Frame, Renderer
from mitsplat.geometry.camera import Camera
from mitsplat.physics.settle import settle_layout
from mitsplat.progress import Note
from mitsplat.quality import PRESETS, PresetName
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import carried
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LightSpec

Request = TypeVar("Request")
Result = TypeVar("Result")

PAUSES: dict[PresetName, float] = {"fast": 0.0, "balanced": 0.3, "exact": 0.6}
"""How long nothing must have been asked for before a preset begins [s]: a render that began cannot be broken off."""


class NewestFirst(Generic[Request, Result]):
    """A thread that works on the newest request, step by step, and drops it for a newer one between two steps.

    Args:
        work: Yields a request's results; it is not asked for the next one once there is a newer request.
        tell: Is told a request and one of its results.
        refuse: Is told the sentence of an InputError that ended a request.
    """

    def __init__(
        self,
        work: Callable[[Request], Iterator[Result]],
        tell: Callable[[Request, Result], object],
        refuse: Callable[[InputError], object],
    ) -> None:
        self._work, self._tell, self._refuse = work, tell, refuse
        self._changed = threading.Condition()
        self._waiting: Request | None = None
        self._closed = False
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mitsplat view: renders", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Work on this next, and on no earlier request any more."""
        with self._changed:
            self._waiting = request
            self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        """Within a request: wait, and say whether nothing newer was asked for meanwhile."""
        with self._changed:
            return not self._changed.wait_for(lambda: self._waiting is not None or self._closed, seconds)

    def close(self) -> None:
        """Stop after the step that is being worked on."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def check(self) -> None:
        """Raise what ended the thread, if anything but bad input did."""
        if self._fault is not None:
            raise self._fault

    def _run(self) -> None:
        try:
            while (request := self._next()) is not None:
                self._answer(request)
        except BaseException as error:  # noqa: BLE001 - raised where it is seen, by check()
            self._fault = error

    def _next(self) -> Request | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closed)
            request, self._waiting = self._waiting, None
            return None if self._closed else request

    def _answer(self, request: Request) -> None:
        try:
            for result in self._work(request):
                self._tell(request, result)
                if not self.wait(0):
                    return
        except InputError as error:
            self._refuse(error)


@dataclass(frozen=True, eq=False)
class ViewRequest:
    """What is to be rendered.

    Attributes:
        scene: The scene.
        index: Index of the frame, which decides layout, lights and random draws.
        pose: ``world_from_camera`` instead of the frame's own, shape (4, 4).
        lights: In place of the frame's.
        width: Of the picture [px]; its height follows from the scene's output.
        finest: Preset to sharpen up to.
    """

    scene: Scene
    index: int
    pose: Float64Array | None = None
    lights: tuple[LightSpec, ...] | None = None
    width: int = 640
    finest: PresetName = "exact"


@dataclass(frozen=True, eq=False)
class Preview:
    """A rendered view: by which preset, the frame, and how long it took from the request's turn [s]."""

    preset: PresetName
    frame: Frame
    seconds: float


class SceneRenders:
    """Layouts and pictures of a scene as it is asked for; keeps a renderer for each preset until the scene changes."""

    def __init__(self, note: Note) -> None:
        self._note = note
        self._scene: Scene | None = None
        self._layouts: dict[int, Layout] = {}
        self._renderers: dict[PresetName, Renderer] = {}

    def layout(self, scene: Scene, index: int) -> Layout:
        """The layout at the moment of a frame, settled now if it is not known."""
        if scene is not self._scene:
            self._scene, self._layouts, self._renderers = scene, {}, {}
        number = index // scene.spec.output.views
        if number not in self._layouts:
            self._note(f"settling layout {number}")
            self._layouts[number] = settle_layout(scene, number, progress=self._note)
        return carried(scene.spec, self._layouts[number], index % scene.spec.output.views)

    def render(self, request: ViewRequest, preset: PresetName) -> Preview:
        """The view in one preset."""
        start = time.perf_counter()
        layout = self.layout(request.scene, request.index)
        if preset not in self._renderers:
            self._renderers[preset] = Renderer(request.scene, quality=preset)
        frame = self._renderers[preset].render(
            request.index, layout=layout, camera=view_camera(request, layout), lights=request.lights
        )
        return Preview(preset, frame, time.perf_counter() - start)


def view_camera(request: ViewRequest, layout: Layout) -> Camera:
    """The frame's camera in the size of previews, or one like it that was moved."""
    camera = plan_frame(request.scene, request.index, layout).camera
    if request.pose is not None:
        camera = replace(camera, world_from_camera=request.pose)
    return camera.resized(request.width, max(1, round(request.width * camera.height / camera.width)))


def presets_up_to(finest: PresetName) -> Sequence[PresetName]:
    """From the fastest to the finest that is wanted."""
    names = list(PRESETS)
    return names[: names.index(finest) + 1]
