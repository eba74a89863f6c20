"""Overview picture of a capture: points and cameras from above and from the side, and photos with their masks."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from mitsplat.arrays import Float64Array
from mitsplat.capture.capture import Capture
from mitsplat.geometry.triangulation import optical_axes

_PANEL = 640
_COLUMNS = 8
_TILE = 160
_CAMERA = (200, 40, 40)
_TINT = np.array([0.33, 0.0, 0.33], dtype=np.float32)


def capture_sheet(capture: Capture) -> Image.Image:
    """Draw the overview picture of a capture, in RGB."""
    centres, ahead = optical_axes(photo.camera for photo in capture.photos)
    reach = 1.1 * float(np.abs(centres).max()) or 1.0
    panels = []
    for axes, down in (((0, 1), 2), ((0, 2), 1)):
        order = np.argsort(capture.points[:, down] * (1 if down == 2 else -1))  # draws the nearest points last
        panels.append(_panel(capture.points[order], capture.colours[order], centres, ahead, axes, reach))
    tiles = [_tile(capture, index) for index in np.linspace(0, len(capture.photos) - 1, 24).round().astype(int)]
    rows = [np.hstack(tiles[start : start + _COLUMNS]) for start in range(0, len(tiles), _COLUMNS)]
    return Image.fromarray(np.vstack([np.hstack(panels), *rows]))


def _panel(
    points: Float64Array,
    colours: npt.NDArray[np.uint8],
    centres: Float64Array,
    ahead: Float64Array,
    axes: tuple[int, int],
    reach: float,
) -> npt.NDArray[np.uint8]:
    """Draw points and cameras along two axes, in a square that reaches from -``reach`` to ``reach`` (RGB).

    Args:
        points: Points (N, 3); the last ones are drawn over the others.
        colours: Their colours, shape (N, 3).
        centres: Centres of the cameras, shape (M, 3).
        ahead: Viewing directions of the cameras, shape (M, 3).
        axes: Axes of the picture to the right and up.
        reach: Half of the edge, in the unit of the points.
    """
    panel = np.full((_PANEL, _PANEL, 3), 255, dtype=np.uint8)

    def pixel(place: Float64Array) -> npt.NDArray[np.intp]:
        flat = place[:, axes] * (1, -1) / reach
        return np.asarray((flat + 1) * _PANEL / 2).astype(np.intp)

    place = pixel(points)
    inside = ((place >= 0) & (place < _PANEL - 1)).all(axis=1)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        panel[place[inside, 1] + dy, place[inside, 0] + dx] = colours[inside]
    for start, end in zip(pixel(centres).tolist(), pixel(centres + 0.08 * reach * ahead).tolist(), strict=True):
        cv2.line(panel, start, end, _CAMERA, 1, cv2.LINE_AA)
        cv2.circle(panel, start, 3, _CAMERA, -1, cv2.LINE_AA)
    return panel


def _tile(capture: Capture, index: int) -> npt.NDArray[np.uint8]:
    """Return a square thumbnail of a photo, with the background of its mask tinted."""
    _, rgb, mask, _ = capture.photos[index].fitted(_TILE)
    if mask is not None:
        rgb = mask[..., None] * rgb + (1 - mask[..., None]) * (0.3 * rgb + _TINT)
    tile = np.zeros((_TILE, _TILE, 3), dtype=np.uint8)
    height, width = rgb.shape[:2]
    y, x = (_TILE - height) // 2, (_TILE - width) // 2
    tile[y : y + height, x : x + width] = np.rint(255 * rgb)
    return tile
