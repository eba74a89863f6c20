"""Page of a scene: frames, drops, lights and camera, beside a real render of the current view."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import viser
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.frames.layer_sheet import LAYERS, LayerName, draw_layer
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.physics.settle import replay_layout
from mitsplat.quality import PRESETS, PresetName
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightSpec, PointLight, SpotLight
from mitsplat.scene.spec.object_spec import PRIMITIVES
from mitsplat.view.page import Page
from mitsplat.view.previews import PRESET_DELAYS, LatestRequestWorker, Preview, SceneRenders, ViewRequest, presets_up_to
from mitsplat.view.scene_parts import ShownPart, camera_parts, scene_parts
from mitsplat.view.yaml_lines import camera_lines, light_line, rounded, seed_line

_INTERVAL = 0.04
"""Time between the displayed moments of a drop [s]."""
_WIDTHS = ("320", "480", "640", "960", "1280")
_NO_LIGHT = "none"
_PLAIN = "Random appearances and materials are visible only in the render, not in the 3D view."


class ScenePage:
    """Page of a scene file; changes made in the browser are shown as YAML lines for the file.

    Args:
        page: Empty page.
        path: Scene file.
        allow_outside: Allow files outside the folder of the scene, as in :func:`mitsplat.load_scene`.

    Raises:
        InputError: If the scene is invalid at the start. Later errors are shown on the page, and the last valid scene
            stays.
    """

    def __init__(self, page: Page, path: Path, *, allow_outside: bool = False) -> None:
        self._page, self._path, self._allow_outside = page, path, allow_outside
        self._scene = load_scene(path, allow_outside=allow_outside)
        self._content_read = _content(path)
        self._lock = threading.RLock()
        self._index = 0
        self._pose: Float64Array | None = None
        self._page_poses: list[Float64Array] = []
        self._lights: dict[int, LightSpec] = {}
        self._layout: Layout | None = None
        self._cameras: tuple[object, list[ShownPart]] = (None, [])
        self._playing = False
        self._fault: str | None = None
        self._last_request: ViewRequest | None = None
        self._preview: tuple[ViewRequest, Preview] | None = None
        self._renders = SceneRenders(lambda text: page.caption(f"{text} …"))
        self._worker: LatestRequestWorker[_Request, Layout | Preview] = LatestRequestWorker(
            self._process, self._handle_result, self._handle_error
        )
        self._make_controls()
        self._request_render()
        self._show(None)
        self._look(plan_frame(self._scene, 0).camera)
        page.on_click(self._look_at_frame)
        page.on_move(self._moved)

    def close(self) -> None:
        """Stop rendering."""
        self._worker.close()

    def check(self) -> None:
        """Read the file again if it has changed, and raise errors of the render thread."""
        self._worker.check()
        content = _content(self._path)
        if content == self._content_read:
            return
        self._content_read = content
        try:
            scene = load_scene(self._path, allow_outside=self._allow_outside)
        except InputError as error:
            self._fault = str(error)
            self._page.alert(self._fault)
            return
        with self._lock:
            self._fault = None
            self._replace_scene(scene)

    def _replace_scene(self, scene: Scene) -> None:
        """Replace the displayed scene."""
        self._page.alert(self._fault)
        self._scene, self._layout, self._lights = scene, None, {}
        self._page_poses.clear()
        self._index = min(self._index, scene.num_frames - 1)
        self._frame.max = max(scene.num_frames - 1, 1)
        self._frame.value = self._index
        self._seed.value = seed_line(scene.spec.seed)
        self._light.options = self._light_names()
        self._plain.visible = _varies_appearance(scene)
        self._request_render()

    # Actions of the browser

    def _make_controls(self) -> None:
        gui, scene = self._page.gui, self._scene
        with gui.add_folder("Frame"):
            self._frame = gui.add_slider("frame", 0, max(scene.num_frames - 1, 1), 1, 0)
            step = gui.add_button_group("layout", ("previous", "next"))
            again = gui.add_button("Drop again", hint="Use the next seed for all random numbers.")
            play = gui.add_button("Play the drop")
            self._seed = gui.add_text("YAML", seed_line(scene.spec.seed), multiline=True)
        with gui.add_folder("Render"):
            self._layer = gui.add_dropdown("layer", LAYERS)
            self._finest = gui.add_dropdown("sharpen to", tuple(PRESETS), initial_value="exact")
            self._width = gui.add_dropdown("width [px]", _WIDTHS, initial_value="640")
            self._plain = gui.add_markdown(_PLAIN, visible=_varies_appearance(scene))
        with gui.add_folder("Camera", expand_by_default=False):
            back = gui.add_button("Back to the frame's camera")
            self._camera_yaml = gui.add_text("YAML", "", multiline=True)
        with gui.add_folder("Lights", expand_by_default=False):
            self._light = gui.add_dropdown("light", self._light_names())
            self._position = gui.add_vector3("position [m]", (0.0, 0.0, 0.0), step=0.01)
            self._target = gui.add_vector3("target [m]", (0.0, 0.0, 0.0), step=0.01)
            self._strength = gui.add_number("strength", 1.0, min=1e-6, step=0.1)
            self._light_yaml = gui.add_text("YAML", "", multiline=True)
            as_stated = gui.add_button("Lights as in the file")
        self._handle = self._page.add_handle(lambda position: self._move_light(position=position))

        self._frame.on_update(lambda _: self._look_at_frame(self._frame.value))
        step.on_click(lambda _: self._step(1 if step.value == "next" else -1))
        again.on_click(lambda _: self._drop_again())
        play.on_click(lambda _: self._play())
        self._layer.on_update(lambda _: self._show_preview())
        self._finest.on_update(lambda _: self._request_render())
        self._width.on_update(lambda _: self._request_render())
        back.on_click(lambda _: self._look_at_frame(self._index, force=True))
        self._light.on_update(lambda _: self._choose_light())
        self._position.on_update(lambda _: self._move_light(position=self._position.value))
        self._target.on_update(lambda _: self._move_light(target=self._target.value))
        self._strength.on_update(lambda _: self._move_light(strength=self._strength.value))
        as_stated.on_click(lambda _: self._reset_lights())

    def _look_at_frame(self, index: int, *, force: bool = False) -> None:
        """Move the view to the camera of a frame, as soon as the layout is known, which can determine the camera."""
        with self._lock:
            index = min(max(int(index), 0), self._scene.num_frames - 1)
            if index == self._index and not force and self._pose is None:
                return
            if index // self._views != self._index // self._views:
                self._layout = None
            self._index, self._pose = index, None
            self._page_poses.clear()
            self._frame.value = index
            self._request_render()

    def _step(self, layouts: int) -> None:
        self._look_at_frame(self._index + layouts * self._views)

    def _drop_again(self) -> None:
        with self._lock:
            self._replace_scene(reseeded(self._scene, self._scene.spec.seed + 1))

    def _play(self) -> None:
        with self._lock:
            self._playing = True
            self._request_render()

    def _moved(self, camera: viser.CameraHandle) -> None:
        """Handle a moved view of a browser; it is a manual move unless the view equals the camera of the frame."""
        with self._lock:
            pose = homogeneous_matrix(Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix(), camera.position)
            ours = [np.allclose(pose, own, atol=1e-4) for own in self._page_poses]
            if any(ours):  # moved by the page; browsers may report positions on the way
                if ours[-1] and self._pose is not None:
                    self._pose = None
                    self._show(self._layout)
                    self._request_render()
                return
            left, self._pose = self._pose is None, pose
            if left:
                self._show(self._layout)
            self._camera_yaml.value = camera_lines(pose, camera.look_at, self._scene.spec.camera.intrinsics)
            if not self._playing:
                self._request_render()

    def _choose_light(self) -> None:
        with self._lock:
            number = self._chosen
            light = None if number is None else self._lights_now()[number]
            placed = light is not None and not isinstance(light, EnvironmentLight)
            self._handle.visible = placed
            self._light_yaml.value = "" if light is None else light_line(light)
            if light is None:
                return
            if not isinstance(light, EnvironmentLight):
                self._position.value = self._handle.position = light.position
            if isinstance(light, AreaLight | SpotLight):
                self._target.value = light.target
            self._strength.value = getattr(light, _strength_of(light))

    def _move_light(self, **changed: Any) -> None:
        """Override properties of the selected light."""
        with self._lock:
            number = self._chosen
            if number is None:
                return
            light = self._lights_now()[number]
            try:
                moved = changed_light(light, **changed)
            except ValidationError:  # the page's own controls send no such value
                self._choose_light()
                return
            if moved == light:
                return
            self._lights[number] = moved
            self._choose_light()
            self._show(self._layout)
            self._request_render()

    def _reset_lights(self) -> None:
        with self._lock:
            self._lights = {}
            self._choose_light()
            self._show(self._layout)
            self._request_render()

    # Display

    @property
    def _views(self) -> int:
        return self._scene.spec.output.views

    @property
    def _chosen(self) -> int | None:
        names, name = self._light.options, self._light.value
        return None if name == _NO_LIGHT or name not in names else names.index(name) - 1

    def _light_names(self) -> tuple[str, ...]:
        return (_NO_LIGHT, *(f"{i}: {light.kind}" for i, light in enumerate(self._lights_now())))

    def _lights_now(self) -> tuple[LightSpec, ...]:
        lights = plan_frame(self._scene, self._index).lights
        return tuple(self._lights.get(i, light) for i, light in enumerate(lights))

    def _look(self, camera: Camera) -> None:
        """Move the views of all browsers to a camera, unless they are there."""
        pose = camera.world_from_camera
        if not any(np.allclose(pose, own, atol=1e-9) for own in self._page_poses):
            self._page_poses.append(pose)
            self._page.look_through(camera)

    def _show(self, layout: Layout | None) -> None:
        """Show the scene with a layout; without one, keep the objects displayed before."""
        if layout is None and self._preview is not None:
            return
        around = self._scene, self._index // self._views, layout is None
        if self._cameras[0] != around:
            self._cameras = around, list(camera_parts(self._scene, self._index, layout))
        own = f"/cameras/{self._index}"  # would surround a view through it
        cameras = [part for part in self._cameras[1] if self._pose is not None or part.name != own]
        self._page.show([*scene_parts(self._scene, self._index, layout, self._lights_now()), *cameras])

    def _show_preview(self) -> None:
        if self._preview is not None:
            preview = self._preview[1]
            layer: LayerName = self._layer.value if self._layer.value in LAYERS else "picture"
            title, image = draw_layer(preview.frame, layer)
            cost = f"**{preview.preset}** {preview.seconds:.2f} s{error_text(preview)}"
            self._page.show_picture(image, f"{cost} – {title}")

    def _request_render(self) -> None:
        with self._lock:
            lights = self._lights_now() if self._lights else None
            finest: PresetName = self._finest.value if self._finest.value in PRESETS else "exact"
            width = int(self._width.value) if self._width.value in _WIDTHS else 640
            self._last_request = ViewRequest(self._scene, self._index, self._pose, lights, width, finest)
            self._worker.submit((self._last_request, self._playing))

    # Render thread

    def _process(self, request: _Request) -> Iterator[Layout | Preview]:
        view, playing = request
        layout = self._renders.layout(view.scene, view.index)
        if playing:
            names = {one.id: view.scene.assets[one.asset].name for one in layout.instances}
            for moment in replay_layout(view.scene, layout, interval=_INTERVAL):
                if moment.dropped_again:
                    dropped = ", ".join(names[number] for number in moment.dropped_again)
                    self._page.caption(f"dropped again after {moment.time:.1f} s: {dropped}")
                yield moment.layout
                self._worker.wait(_INTERVAL)
        yield layout
        for preset in presets_up_to(view.finest):
            if self._worker.wait(PRESET_DELAYS[preset]):
                yield self._renders.render(view, preset)

    def _handle_result(self, request: _Request, result: Layout | Preview) -> None:
        with self._lock:
            if isinstance(result, Layout):
                if request[0].scene is self._scene and result.index == self._index // self._views:
                    self._layout = result
                    self._show(result)
                    if self._pose is None:
                        self._look(plan_frame(self._scene, self._index, result).camera)
                return
            self._preview = request[0], result
            self._page.alert(self._fault)  # clears the error of an earlier view
            self._show_preview()
            if self._playing and request[1]:
                self._playing = False
                if self._pose is not request[0].pose:
                    self._request_render()

    def _handle_error(self, error: InputError) -> None:
        with self._lock:
            self._playing = False
            self._page.alert(str(error))


_Request = tuple[ViewRequest, bool]
"""View, and True if the drop is to be played before it."""


def reseeded(scene: Scene, seed: int) -> Scene:
    """Return the scene with another seed; loaded assets are reused unless the seed determines them too."""
    if any(entry.pool == PRIMITIVES for entry in scene.spec.objects):
        return load_scene(scene.path, overrides={"seed": seed}, allow_outside=True)
    return replace(scene, spec=scene.spec.model_copy(update={"seed": seed}))


def _varies_appearance(scene: Scene) -> bool:
    """Return True if layouts vary the appearance of objects or shapes, which the splats in the browser do not show."""
    drawn = any(entry.appearance is not None for entry in scene.spec.objects)
    return drawn or any(shape.materials for shape in scene.spec.shapes)


def changed_light(
    light: LightSpec,
    *,
    position: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
    strength: float | None = None,
) -> LightSpec:
    """Return a light with changed properties; properties that its kind does not have are ignored.

    Raises:
        ValidationError: If a value is invalid for a light.
    """
    update: dict[str, Any] = {}
    if position is not None and not isinstance(light, EnvironmentLight):
        update["position"] = rounded(position)
    if target is not None and isinstance(light, AreaLight | SpotLight):
        update["target"] = rounded(target)
    if strength is not None:
        update[_strength_of(light)] = float(strength)
    return type(light).model_validate(light.model_dump() | update)


def error_text(preview: Preview) -> str:
    """Return the text about the error of a preview, for its caption."""
    error = preview.frame.order_error
    if error is None:
        return ", blending-order error unknown"
    return f", blending-order error {error['mean']:.1g} on average, at most {error['largest']:.2g}"


def _strength_of(light: LightSpec) -> str:
    return "intensity" if isinstance(light, SpotLight | PointLight) else "radiance"


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None
