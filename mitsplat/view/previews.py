"""Real renders of the current view: a worker thread for the newest request, and the renderer of a scene."""

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
from mitsplat.scene.planning.conveyor import layout_at_view
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LightSpec

Request = TypeVar("Request")
Result = TypeVar("Result")

PRESET_DELAYS: dict[PresetName, float] = {"fast": 0.0, "balanced": 0.3, "exact": 0.6}
"""Time without new requests before a preset starts [s], because a running render cannot be cancelled."""


class LatestRequestWorker(Generic[Request, Result]):
    """Worker thread for the newest request, which it processes in steps; a newer request replaces it between two steps.

    Args:
        work: Generator of the results of a request; it is not resumed after a newer request.
        on_result: Callback with a request and one of its results.
        on_error: Callback with the InputError that ended a request.
    """

    def __init__(
        self,
        work: Callable[[Request], Iterator[Result]],
        on_result: Callable[[Request, Result], object],
        on_error: Callable[[InputError], object],
    ) -> None:
        self._work, self._on_result, self._on_error = work, on_result, on_error
        self._changed = threading.Condition()
        self._waiting: Request | None = None
        self._closed = False
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mitsplat view: renders", daemon=True)
        self._thread.start()

    def submit(self, request: Request) -> None:
        """Replace all earlier requests by this one."""
        with self._changed:
            self._waiting = request
            self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        """Wait within a request, and return True if there is no newer request."""
        with self._changed:
            return not self._changed.wait_for(lambda: self._waiting is not None or self._closed, seconds)

    def close(self) -> None:
        """Stop after the current step."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def check(self) -> None:
        """Raise the error that ended the thread, if there is one; an InputError does not end it."""
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
                self._on_result(request, result)
                if not self.wait(0):
                    return
        except InputError as error:
            self._on_error(error)


@dataclass(frozen=True, eq=False)
class ViewRequest:
    """View to render.

    Attributes:
        scene: The scene.
        index: Index of the frame, which determines layout, lights and random draws.
        pose: ``world_from_camera``, shape (4, 4); None uses the camera of the frame.
        lights: Lights; None uses those of the frame.
        width: Width of the picture [px]; its height has the aspect ratio of the scene's output.
        finest: Best preset of the progressive rendering.
    """

    scene: Scene
    index: int
    pose: Float64Array | None = None
    lights: tuple[LightSpec, ...] | None = None
    width: int = 640
    finest: PresetName = "exact"


@dataclass(frozen=True, eq=False)
class Preview:
    """Rendered view: the preset, the frame, and the render time since the start of the request [s]."""

    preset: PresetName
    frame: Frame
    seconds: float


class SceneRenders:
    """Layouts and renders of a scene on demand, with one cached renderer per preset until the scene changes."""

    def __init__(self, note: Note) -> None:
        self._note = note
        self._scene: Scene | None = None
        self._layouts: dict[int, Layout] = {}
        self._renderers: dict[PresetName, Renderer] = {}

    def layout(self, scene: Scene, index: int) -> Layout:
        """Return the layout at the time of a frame; it is settled first if necessary."""
        if scene is not self._scene:
            self._scene, self._layouts, self._renderers = scene, {}, {}
        number = index // scene.spec.output.views
        if number not in self._layouts:
            self._note(f"settling layout {number}")
            self._layouts[number] = settle_layout(scene, number, progress=self._note)
        return layout_at_view(scene, self._layouts[number], index % scene.spec.output.views)

    def render(self, request: ViewRequest, preset: PresetName) -> Preview:
        """Render the view with one preset."""
        start = time.perf_counter()
        layout = self.layout(request.scene, request.index)
        if preset not in self._renderers:
            self._renderers[preset] = Renderer(request.scene, quality=preset)
        frame = self._renderers[preset].render(
            request.index, layout=layout, camera=view_camera(request, layout), lights=request.lights
        )
        return Preview(preset, frame, time.perf_counter() - start)


def view_camera(request: ViewRequest, layout: Layout) -> Camera:
    """Return the camera of the frame in preview size, at the requested pose if there is one."""
    camera = plan_frame(request.scene, request.index, layout).camera
    if request.pose is not None:
        camera = replace(camera, world_from_camera=request.pose)
    return camera.resized(request.width, max(1, round(request.width * camera.height / camera.width)))


def presets_up_to(finest: PresetName) -> Sequence[PresetName]:
    """Return the presets from the fastest to ``finest``."""
    names = list(PRESETS)
    return names[: names.index(finest) + 1]
