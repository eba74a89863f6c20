"""Viewer page: viser's server, the display of parts, and the panels beside them."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import rich
import viser
from scipy.spatial.transform import Rotation

from mitsplat.arrays import ByteImage, Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import Axis
from mitsplat.geometry.camera import Camera
from mitsplat.view.guard import Guard, check_address, guarded
from mitsplat.view.scene_parts import (
    HIDDEN_AT_START,
    Frustum,
    Lines,
    ShownMesh,
    ShownPart,
    ShownPoints,
    ShownSplats,
    base_colours,
    bounds_of,
    changes,
    share_gaussians,
)

_HALF_MAX = 200.0
"""Maximum standard deviation sent to browsers; viser stores covariances as half floats, whose maximum is 65504."""
_START_FOV = 0.9
"""Vertical field of view of a page without a camera view [rad]."""
_PANE_HEIGHT = 360
"""Height of the pane of a small browser window [px]."""
_BLUR, _DRAWN = 0.3, 0.25
"""viser adds ``_BLUR`` [px²] to the variances of a projected Gaussian, and draws it if the product of its opacity and
the determinant of its covariance is at least ``_DRAWN`` [px⁴] (``GaussianSplatsHelpers.ts``)."""


@dataclass(frozen=True)
class Address:
    """Network address of the page.

    Attributes:
        host: Name or address to listen on.
        port: TCP port.
    """

    host: str = "localhost"
    port: int = 8080


class Page:
    """Page in the browser that shows parts and a picture beside them.

    Args:
        title: Title above the controls.
        address: Network address of the page.
        gaussians: Maximum number of Gaussians of all clouds together; more are subsampled.

    Attributes:
        gui: viser's controls.
        port: TCP port of the server.
        url: Address to open, which ends in a token.

    Raises:
        InputError: If the address cannot be bound.
    """

    def __init__(self, title: str, address: Address, *, gaussians: int) -> None:
        check_address(address.host, address.port)
        guard = Guard.for_host(address.host)
        with _without_messages(), guarded(guard) as pool:
            self._server = viser.ViserServer(address.host, address.port, label=title, verbose=False)
        pool.threads = self._server._thread_executor
        self.port = self._server.get_port()
        host = f"[{address.host}]" if ":" in address.host else address.host
        self.url = f"http://{host}:{self.port}/{guard.token}"
        self._gaussians = gaussians
        self._shown: dict[str, ShownPart] = {}
        self._handles: dict[str, Any] = {}
        self._start: Camera | None = None
        self._clicked: Callable[[int], object] = lambda index: None
        self.gui = self._server.gui
        self.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, dark_mode=True)
        self._server.scene.set_up_direction("+z")
        self._panel = self.gui.add_panel()
        with self._panel.add_tab("Picture"):
            self._picture = self.gui.add_image(np.zeros((9, 16, 3), dtype=np.uint8), format="jpeg", visible=False)
            self._caption = self.gui.add_markdown("")
        self._panel.dock_left()
        self._panel.set_width(480)
        self.gui.main_panel.dock_right()
        self._alerted: str | None = None
        self._alert = self.gui.add_html("", visible=False)
        self._groups = self.gui.add_folder("Show", order=1000, visible=False)
        with self._groups:
            self._thinned = self.gui.add_markdown("", visible=False)
        self._group_names: set[str] = set()

    def close(self) -> None:
        """Stop the server."""
        with _without_messages():
            self._server.stop()

    def on_click(self, clicked: Callable[[int], object]) -> None:
        """Set the callback for a click on a camera; its argument is the index of the camera."""
        self._clicked = clicked

    def on_point(self, pointed: Callable[[Float64Array, Float64Array], object]) -> None:
        """Set the callback for a click anywhere; its arguments are origin and direction of the ray, (3,) each."""

        def handle(event: viser.SceneClickEvent) -> None:
            pointed(np.array(event.ray_origin), np.array(event.ray_direction))

        self._server.scene.on_click()(handle)

    def on_move(self, moved: Callable[[viser.CameraHandle], object]) -> None:
        """Set the callback for a moved view; its argument is viser's camera.

        It is first called after the view of the browser has reached the initial camera of the page.
        """

        def listen(client: viser.ClientHandle) -> None:
            begun = False

            def handle(camera: viser.CameraHandle) -> None:
                nonlocal begun
                begun = begun or np.allclose(camera.position, self._server.initial_camera.position, atol=1e-4)
                if begun:
                    moved(camera)

            client.camera.on_update(handle)

        self._server.on_client_connect(listen)

    def add_handle(self, moved: Callable[[Float64Array], object]) -> viser.TransformControlsHandle:
        """Add a hidden handle of viser for dragging; ``moved`` is called with the new position [m]."""
        handle = self._server.scene.add_transform_controls(
            "/handle", scale=0.15, disable_rotations=True, visible=False, depth_test=False
        )
        handle.on_update(lambda _: moved(np.asarray(handle.position)))
        return handle

    def show(self, parts: Iterable[ShownPart]) -> None:
        """Show exactly these parts; only changes are sent."""
        shared, count = share_gaussians(parts, self._gaussians)
        wanted = {part.name: part for part in shared}
        removed, added, moved = changes(self._shown, wanted)
        with self._server.atomic():
            for name in removed:
                self._handles.pop(name).remove()
            for part in added:
                self._add_group(part.group)
                self._handles[part.name] = self._add(part)
            for part in moved:
                handle = self._handles[part.name]
                handle.position, handle.wxyz = part.pose[:3, 3], _wxyz(part.pose)
        self._shown = wanted
        drawn = sum(part.drawable.count for part in shared if isinstance(part.drawable, ShownSplats))
        self._thinned.visible = drawn < count
        self._thinned.content = (
            f"{drawn:,} of {count:,} Gaussians are shown, enlarged. `mitsplat view --gaussians {count}` shows all."
        )

    def show_picture(self, image: ByteImage, caption: str) -> None:
        """Show an RGB picture (H, W, 3) beside the parts, with a caption in Markdown."""
        self._picture.image, self._picture.visible = image, True
        self._caption.content = caption

    def set_picture_width(self, width: int) -> None:
        """Set the width of the picture panel [px]."""
        self._panel.set_width(width)

    def caption(self, text: str) -> None:
        """Set the caption below the picture, in Markdown."""
        self._caption.content = text

    def alert(self, sentence: str | None) -> None:
        """Show an error message, or hide it if None."""
        if sentence == self._alerted:
            return
        self._alerted, self._alert.visible = sentence, sentence is not None
        if sentence is not None:
            style = "margin:0.5em;padding:0.6em;border-left:4px solid #d33;background:#d332;overflow-wrap:anywhere"
            self._alert.content = f'<div role="alert" style="{style}">{html.escape(sentence)}</div>'

    def look_through(self, camera: Camera) -> None:
        """Move the view of all present and future browsers to a camera."""
        self._start = self._start or camera
        pose, fov = camera.world_from_camera, 2 * float(np.arctan(0.5 * camera.height / camera.fy))
        ahead = pose[:3, 3] + self._distance(pose) * pose[:3, 2]
        start = self._server.initial_camera
        start.position, start.look_at, start.up, start.fov = pose[:3, 3], ahead, -pose[:3, 1], fov
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at = pose[:3, 3], ahead
                client.camera.up_direction, client.camera.fov = -pose[:3, 1], fov

    def look_around(self, up: Axis = "z") -> None:
        """Show all parts from an oblique view; ``up`` sets the axis that points up."""
        above = np.zeros(3)
        above["xyz".index(up[-1])] = -1 if up.startswith("-") else 1
        self._server.scene.set_up_direction(above)
        aside = np.roll(above, 1)
        low, high = bounds_of(self._shown.values())
        middle = (low + high) / 2
        away = [
            np.linalg.norm(part.pose[:3, 3] - middle)
            for part in self._shown.values()
            if isinstance(part.drawable, Frustum)
        ]
        size = max(float(np.linalg.norm(high - low)), 1.5 * float(max(away, default=0.0)))
        eye = middle + size * (0.7 * aside - 0.9 * np.cross(above, aside) + 0.6 * above)
        fov, side = float(np.degrees(_START_FOV)), 720
        self.look_through(Camera.look_at(eye, middle, up=above, width=side, height=side, fov_x=fov, near=1e-3))

    def _distance(self, pose: Float64Array) -> float:
        """Return the distance from a camera to the centre of rotation ahead of it [m]."""
        middle = bounds_of(self._shown.values()).mean(axis=0)
        return max(float((middle - pose[:3, 3]) @ pose[:3, 2]), 0.05)

    def _pixel_size(self, part: ShownPart) -> float:
        """Return the size of a pixel [m] at the middle of a part in the first view.

        Without a camera for the first view, the part fills the page.
        """
        low, high = bounds_of([part])
        if self._start is None:
            return float(np.linalg.norm(high - low)) / _PANE_HEIGHT
        distance = float(np.linalg.norm((low + high) / 2 - self._start.world_from_camera[:3, 3]))
        return distance * self._start.height / (self._start.fy * _PANE_HEIGHT)

    def _add_group(self, group: str) -> None:
        if group in self._group_names:
            return
        self._group_names.add(group)
        visible, self._groups.visible = group not in HIDDEN_AT_START, True
        root = self._server.scene.add_frame(f"/{group}", show_axes=False, visible=visible)
        with self._groups:
            box = self.gui.add_checkbox(group, visible)
        box.on_update(lambda _: setattr(root, "visible", box.value))

    def _add(self, part: ShownPart) -> viser.SceneNodeHandle:
        scene, drawable = self._server.scene, part.drawable
        place = {"position": part.pose[:3, 3], "wxyz": _wxyz(part.pose)}
        if isinstance(drawable, ShownSplats):
            return scene.add_gaussian_splats(
                part.name, **splat_arrays(drawable.thinned(), self._pixel_size(part)), **place
            )
        if isinstance(drawable, ShownMesh):
            opacity = None if drawable.opacity == 1.0 else drawable.opacity
            vertices, faces = np.asarray(drawable.mesh.vertices, dtype=np.float32), np.asarray(drawable.mesh.faces)
            return scene.add_mesh_simple(
                part.name,
                vertices,
                faces,
                color=drawable.colour,
                opacity=opacity,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
                **place,
            )
        if isinstance(drawable, Lines):
            colours = np.array(drawable.colour, dtype=np.uint8)
            return scene.add_line_segments(
                part.name, drawable.segments, colours, thickness=2.0, thickness_units="screen", **place
            )
        if isinstance(drawable, ShownPoints):
            return scene.add_point_cloud(
                part.name, drawable.points, drawable.colours, point_size=drawable.edge, **place
            )
        return self._add_frustum(part.name, drawable, place)

    def _add_frustum(self, name: str, drawable: Frustum, place: dict[str, Float64Array]) -> viser.CameraFrustumHandle:
        camera, height = drawable.camera, 0.5 * drawable.camera.height / drawable.camera.fy
        aspect = camera.width / camera.height
        handle = self._server.scene.add_camera_frustum(
            name,
            fov=2 * float(np.arctan(height)),
            aspect=aspect,
            scale=drawable.depth
            * float(np.cbrt(height * height * aspect / 3)),  # viser expects the edge of a cube of equal volume
            thickness=1.5,
            thickness_units="screen",
            color=drawable.colour,
            **place,
        )
        handle.on_click(lambda _: self._clicked(drawable.index))
        return handle


def splat_arrays(splats: Splats, pixel: float = 0.0) -> dict[str, Any]:
    """Return viser's arrays of Gaussians: centres, covariances, colours, opacities and a scale.

    viser does not draw Gaussians that are smaller than about half a pixel, so that objects of many small Gaussians
    would be missing. These are enlarged for a view in which a pixel has the size ``pixel`` [m].

    Covariances are sent as half floats, which would round those of Gaussians of a millimetre to zero. So all values are
    enlarged, and ``scale`` reduces them again.
    """
    variances = np.clip(np.sqrt(_DRAWN / np.maximum(splats.opacities, _DRAWN)) - _BLUR, 0.0, None)
    scales = np.maximum(splats.scales, (1.05 * pixel * np.sqrt(variances))[:, None]).astype(np.float64)
    factor = _HALF_MAX / max(float(scales.max(initial=0.0)), 1e-6)
    axes = Rotation.from_quat(splats.quats).as_matrix() if len(splats) else np.zeros((0, 3, 3))
    axes = axes * (factor * scales)[:, None, :]
    return {
        "centers": (factor * splats.means).astype(np.float32),
        "covariances": (axes @ axes.transpose(0, 2, 1)).astype(np.float32),
        "rgbs": base_colours(splats),
        "opacities": splats.opacities[:, None],
        "scale": 1.0 / factor,
    }


@contextmanager
def _without_messages() -> Iterator[None]:
    """Suppress viser's messages about start, address and stop."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _wxyz(pose: Float64Array) -> Float64Array:
    return np.asarray(Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True))
