"""Detection of uncovered board squares in a photo.

Uncovered squares are certainly not the object, even if the object is as black as the squares of the board.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.capture.boards.targets import Board
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import transform_points

_SAMPLES = 16
"""Samples along the edge of a square."""

_RIM = 3
"""Width of the rim around a square that must also match the print, in samples; a black square has detail only at its
edges.
"""

_MIN_CORRELATION = 0.9
"""Minimum correlation of an uncovered square with the print."""

_MAX_DIFFERENCE = 0.3
"""Maximum difference from the print at any sample of an uncovered square, as a fraction of the black-white contrast."""


def bare_squares(
    board: Board, world_from_board: Float64Array, camera: Camera, grey: npt.NDArray[np.uint8]
) -> BoolArray:
    """Return the pixels of squares that look as printed, shape (H, W).

    Each square is rectified and compared with the print, up to the local brightness and contrast. A square is accepted
    only as a whole, with the edges of its neighbours. So a partly covered square is rejected completely. Objects
    thinner than a tenth of a square, or objects that cover a few modules of a marker in a similar grey, can be missed.

    Args:
        board: The printed board.
        world_from_board: Pose of the board in the world of the camera, shape (4, 4).
        camera: Camera of the image.
        grey: 8-bit image, shape (H, W).
    """
    found = np.zeros(grey.shape, dtype=np.uint8)
    flat, shown = _rectify_board(board, world_from_board, camera, grey)
    printed = _draw_print(board)
    corners = board.points(np.arange(board.columns + 1), np.arange(board.rows + 1))
    pixels = _project_points(corners, world_from_board, camera)
    for row in range(board.rows):
        for column in range(board.columns):
            window = tuple(slice(max(0, k * _SAMPLES - _RIM), (k + 1) * _SAMPLES + _RIM) for k in (row, column))
            if shown[window].all() and _matches_print(flat[window], printed[window]):
                outline = pixels[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
                cv2.fillConvexPoly(found, np.rint((outline - 0.5) * 16).astype(np.int32), 1, shift=4)
    return found > 0


@cache
def _draw_print(board: Board) -> Float64Array:
    """Return the print, 0 to 255, in the samples of :func:`_rectify_board`."""
    return _blur(cv2.resize(board.draw(4 * _SAMPLES), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))


def _matches_print(values: Float64Array, printed: Float64Array) -> bool:
    """Return True if the values match the print up to a factor and an offset."""
    values, printed = values - values.mean(), printed - printed.mean()
    spread = float((printed * printed).sum())
    contrast = float((values * printed).sum()) / spread
    if not contrast > 0:
        return False
    likeness = contrast * np.sqrt(spread / float((values * values).sum()))
    # The print ranges from 0 to 255, so ``contrast`` also relates the black-white contrast of the image to 255.
    return bool(
        likeness > _MIN_CORRELATION and np.abs(values - contrast * printed).max() < _MAX_DIFFERENCE * 255 * contrast
    )


def _project_points(places: Float64Array, world_from_board: Float64Array, camera: Camera) -> Float64Array:
    """Return the pixel positions (..., 2) of points on the board (..., 3)."""
    pixels, _ = camera.project(transform_points(world_from_board, places.reshape(-1, 3)))
    return pixels.reshape(*places.shape[:-1], 2)


def _rectify_board(
    board: Board, world_from_board: Float64Array, camera: Camera, grey: npt.NDArray[np.uint8]
) -> tuple[Float64Array, BoolArray]:
    """Return the rectified board in samples of the image, and the samples that lie inside the image."""
    x, y = ((np.arange(n * _SAMPLES) + 0.5) / _SAMPLES for n in (board.columns, board.rows))
    pixels = _project_points(board.points(x, y), world_from_board, camera)
    shown = camera.contains(pixels)
    steps = np.linalg.norm(np.diff(pixels, axis=1), axis=-1)[shown[:, 1:] & shown[:, :-1]]
    step = float(np.median(steps)) if len(steps) else 1.0
    smooth = cv2.GaussianBlur(grey, (0, 0), max(0.3, 0.4 * step))
    grid = np.nan_to_num(pixels - 0.5, nan=-1.0).astype(np.float32)
    flat = cv2.remap(smooth, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return _blur(flat), shown


def _blur(image: npt.NDArray[np.generic]) -> Float64Array:
    """Blur an image, because camera errors of a fraction of a sample must not affect the comparison."""
    return np.asarray(cv2.GaussianBlur(np.asarray(image, dtype=np.float64), (0, 0), 1.0))
