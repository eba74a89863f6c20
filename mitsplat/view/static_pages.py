"""Static pages: an asset, a splat file, a capture, a dataset."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from mitsplat.arrays import ByteImage, Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.pipeline.picking import chosen_object, pick_along
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import Axis, default_up_axis
from mitsplat.view.dataset_index import OVERLAYS, DatasetIndex, Filter, OverlayName
from mitsplat.view.page import Page
from mitsplat.view.scene_parts import Frustum, ShownPart, ShownPoints, ShownSplats, asset_parts, capture_parts

_ANY = "any"
_EDGE = 960
"""Longest edge of a displayed photo [px]."""
_WIDE = 860
"""Width of the panel with images of a dataset [px]."""
_MASKS = ("outside darkened", "none")
_PICK, _PICK_NOT, _REMOVE = "--pick", "--pick-not", "--remove"
_NOTHING = "nothing"
_CLICKS = {
    _NOTHING: None,
    "marks the object": _PICK,
    "excludes another object": _PICK_NOT,
    "removes an object from the environment": _REMOVE,
}
"""Meanings of a click, and the corresponding command line option."""
_COLOURS = {_PICK: (255, 210, 0), _PICK_NOT: (60, 120, 255), _REMOVE: (255, 60, 60)}


def show_asset(page: Page, folder: Path) -> None:
    """Show an asset: its splats, mesh, convex pieces and keypoints."""
    asset = Asset.load(folder)
    page.show(asset_parts(asset))
    page.look_around()
    extent = asset.splats.bounds if asset.mesh is None else asset.mesh.bounds
    size = " × ".join(f"{side:.3g}" for side in np.ptp(extent, axis=0))
    facts = [
        f"**{asset.kind}**, class {asset.class_name}",
        f"{len(asset.splats)} Gaussians, spherical harmonics of degree {asset.splats.sh_degree}",
        f"{size} m" if asset.units == "metre" else f"{size}, of unknown units",
        "no mesh" if asset.mesh is None else f"mesh of {len(asset.mesh.faces)} faces",
        f"{len(asset.pieces)} convex pieces",
        *(f"look: {finding}" for finding in asset.check()),
    ]
    page.caption("\n\n".join(facts))


def show_splats(page: Page, path: Path) -> None:
    """Show a splat file; units are unknown, and the usual up axis of the format is assumed."""
    splats = Splats.load(path)
    page.show([ShownPart("/splats/file", ShownSplats(splats))])
    axes = get_args(Axis)
    up = page.gui.add_dropdown("up axis", axes, initial_value=default_up_axis(path))
    up.on_update(lambda _: page.look_around(up.value) if up.value in axes else None)
    page.look_around(up.value)
    size = " × ".join(f"{side:.3g}" for side in np.ptp(splats.bounds, axis=0)) if len(splats) else "nothing"
    page.caption(
        f"{len(splats)} Gaussians, spherical harmonics of degree {splats.sh_degree}\n\n{size} in units of the file"
    )


class CapturePage:
    """Page of a capture: points, cameras, and the selected photo with its mask; a click picks an object."""

    def __init__(self, page: Page, folder: Path) -> None:
        self._page, self._capture = page, Capture.load(folder)
        self._lock, self._picks = threading.RLock(), list[tuple[str, str]]()
        photos = self._capture.photos
        if not photos:
            raise InputError(f"{folder}: must have a photo to be shown (got none)")
        page.show(capture_parts(self._capture))
        with page.gui.add_folder("Pick objects by clicks"):
            self._click = page.gui.add_dropdown("a click", tuple(_CLICKS), initial_value=_NOTHING)
            self._summary = page.gui.add_markdown("")
            back = page.gui.add_button_group("forget", ("the last", "all"))
        self._photo = page.gui.add_slider("photo", 0, max(len(photos) - 1, 1), 1, 0)
        self._mask = page.gui.add_dropdown("mask", _MASKS)
        through = page.gui.add_button("Look through this camera")
        rejected = self._capture.rejected
        page.gui.add_markdown(
            f"{len(photos)} photos, {len(rejected)} rejected; {len(self._capture.points)} points; "
            f"units: {self._capture.units}"
        )
        self._photo.on_update(lambda _: self._show())
        self._mask.on_update(lambda _: self._show())
        through.on_click(lambda _: page.look_through(self._chosen.camera))
        page.on_click(self._clicked)
        page.on_point(self._pointed)
        self._click.on_update(lambda _: self._apply_picks(self._picks))
        back.on_click(lambda _: self._forget(all_of_them=back.value == "all"))
        page.look_around()
        self._show()

    def _pointed(self, origin: Float64Array, direction: Float64Array) -> None:
        """Add a pick for the point under a click, if there is one."""
        with self._lock:
            if (option := _CLICKS.get(self._click.value)) is None:
                return
            try:
                pick = pick_along(self._capture, origin, direction)
                self._apply_picks([*self._picks, (option, pick)])
            except InputError as error:
                self._page.alert(str(error))
                return
            name, _, _ = pick.rpartition(":")
            self._photo.value = [photo.name for photo in self._capture.photos].index(name)

    def _forget(self, *, all_of_them: bool) -> None:
        with self._lock:
            self._apply_picks([] if all_of_them else self._picks[:-1])

    def _apply_picks(self, picks: list[tuple[str, str]]) -> None:
        """Show the objects that the picks select, and the options for the command line; hide cameras while clicks pick.

        Raises:
            InputError: If the picks select nothing; the earlier picks remain.
        """
        chosen, self._picks = self._selected_parts(picks), picks
        parts = list(capture_parts(self._capture))
        if _CLICKS.get(self._click.value) is not None:  # a click on a camera would also pick
            parts = [part for part in parts if not isinstance(part.drawable, Frustum)]
        self._page.show([*parts, *chosen])
        self._show()
        words = " ".join(f"{option} {shlex.quote(pick)}" for option, pick in self._picks)
        self._summary.content = f"```\n{words}\n```" if words else ""

    def _selected_parts(self, picks: Sequence[tuple[str, str]]) -> list[ShownPart]:
        """Return the points of the objects that the picks select."""
        on, off, away = ([pick for kind, pick in picks if kind == option] for option in (_PICK, _PICK_NOT, _REMOVE))
        parts = []
        if on or off:
            parts.append(self._highlighted("object", chosen_object(self._capture, on, off).above, _COLOURS[_PICK]))
        if away:
            parts.append(self._highlighted("removed", chosen_object(self._capture, away).above, _COLOURS[_REMOVE]))
        return parts

    def _highlighted(self, name: str, points: Float64Array, colour: tuple[int, int, int]) -> ShownPart:
        size = 2 * ShownPoints(self._capture.points, self._capture.colours).edge
        return ShownPart(f"/chosen/{name}", ShownPoints(points, np.full(points.shape, colour, dtype=np.uint8), size))

    @property
    def _chosen(self) -> Photo:
        return self._capture.photos[min(max(int(self._photo.value), 0), len(self._capture.photos) - 1)]

    def _clicked(self, index: int) -> None:
        self._photo.value = index
        self._page.look_through(self._chosen.camera)

    def _show(self) -> None:
        photo = self._chosen
        try:
            image = photo_picture(photo, masked=self._mask.value == _MASKS[0])
        except InputError as error:
            self._page.alert(str(error))
            return
        self._page.alert(None)
        for option, pick in self._picks:
            name, _, pixel = pick.rpartition(":")
            if name == photo.name:
                place = np.array([float(value) for value in pixel.split(",")]) * image.shape[1] / photo.camera.width
                cv2.drawMarker(image, [round(value) for value in place], _COLOURS[option], cv2.MARKER_CROSS, 24, 2)
        masked = "" if photo.mask is None else ", with a mask"
        self._page.show_picture(image, f"{_literal(photo.name)}: observes {len(photo.seen)} points{masked}")


class DatasetPage:
    """Page of a dataset: images with their labels, and a filter."""

    def __init__(self, page: Page, folder: Path) -> None:
        self._page, self._index = page, DatasetIndex(folder)
        if not len(self._index):
            raise InputError(f"{folder}: must have an image to be shown (got none)")
        self._lock = threading.RLock()
        page.set_picture_width(_WIDE)  # the page has no other content
        gui, largest = page.gui, self._index.largest
        self._number = gui.add_slider("image", 0, 1, 1, 0)
        step = gui.add_button_group("step", ("previous", "next"))
        self._overlay = gui.add_dropdown("overlay", OVERLAYS)
        with gui.add_folder("Images with a label that is"):
            self._class = gui.add_dropdown("of class", (_ANY, *self._index.classes))
            self._visible = gui.add_multi_slider("visible [%]", 0, 100, 1, (0, 100))
            self._size = gui.add_multi_slider("as long as [px]", 0, largest, 1, (0, largest))
        self._summary = gui.add_markdown("")
        self._found: list[int] = []
        self._number.on_update(lambda _: self._show())
        self._overlay.on_update(lambda _: self._show())
        step.on_click(lambda _: self._step(1 if step.value == "next" else -1))
        for control in (self._class, self._visible, self._size):
            control.on_update(lambda _: self._filter())
        self._filter()

    @property
    def found(self) -> tuple[int, ...]:
        """Indices of the frames that pass the filter."""
        return tuple(self._found)

    def _filter(self) -> None:
        with self._lock:
            low, high = self._visible.value
            name = None if self._class.value == _ANY else str(self._class.value)
            short, long = self._size.value
            whole = (low, high) == (0, 100) and (short, long) == (0, self._index.largest)
            wanted = Filter(name) if whole else Filter(name, (low / 100, high / 100), (short, long))
            self._found = self._index.find(wanted)
            unreadable = self._index.unreadable
            self._summary.content = f"{len(self._found)} of {len(self._index)} images" + (
                f"; {unreadable} lines of the manifest cannot be read" if unreadable else ""
            )
            self._number.max = max(len(self._found) - 1, 1)
            self._number.value = 0
            self._show()

    def _step(self, by: int) -> None:
        with self._lock:
            self._number.value = min(max(int(self._number.value) + by, 0), max(len(self._found) - 1, 0))

    def _show(self) -> None:
        with self._lock:
            if not self._found:
                self._page.caption("no image passes the filter")
                return
            index = self._found[min(max(int(self._number.value), 0), len(self._found) - 1)]
            overlay: OverlayName = self._overlay.value if self._overlay.value in OVERLAYS else "none"
            try:
                caption, image = self._index.picture(index, overlay)
            except InputError as error:
                self._page.alert(str(error))
                return
            self._page.alert(None)
            self._page.show_picture(image, _literal(caption))


def photo_picture(photo: Photo, *, masked: bool) -> ByteImage:
    """Return a photo (H, W, 3) in the size of the page; if ``masked``, its background is darkened.

    Raises:
        InputError: If it cannot be read.
    """
    _, rgb, alpha, _ = photo.fitted(_EDGE)
    if masked and alpha is not None:
        rgb = rgb * (0.25 + 0.75 * alpha[..., None])
    return np.asarray(np.rint(255 * rgb), dtype=np.uint8)


def _literal(text: str) -> str:
    """Escape text for Markdown."""
    return "".join(f"\\{sign}" if sign in "\\`*_{}[]<>()#+-.!|~$" else sign for sign in text)
