"""Where a photo shows the bare board: surely not the object, though it may be as black as the board's squares are."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.capture.boards.targets import Board
from mitsplat.geometry.camera import Camera

_DOTS = 16
"""Samples along a square's edge."""

_RIM = 3
"""Samples of the squares around one that must be as printed as well: a black square shows nothing but its edges."""

_LIKENESS = 0.9
"""Correlation with the print from which a square is bare."""

_BLOT = 0.3
"""Largest difference from the print anywhere in a bare square, as a share of the contrast of black and white."""


def bare_squares(
    board: Board, world_from_board: Float64Array, camera: Camera, grey: npt.NDArray[np.uint8]
) -> BoolArray:
    """Pixels of the squares that an image shows as they are printed, shape (H, W).

    Each square is laid flat and compared with the print, up to the brightness and contrast of the light there. A square
    counts only as a whole, with the edges of those around it, so that what covers a part of it leaves none of it. What
    is thinner than a tenth of a square, or covers a few modules of a marker in a grey like theirs, can go unseen.

    Args:
        board: The print.
        world_from_board: Its pose (4, 4), in the camera's world.
        camera: Of the image.
        grey: The image, 8-bit, shape (H, W).
    """
    found = np.zeros(grey.shape, dtype=np.uint8)
    flat, shown = _laid_flat(board, world_from_board, camera, grey)
    printed = _printed(board)
    corners = _places(board, np.arange(board.columns + 1.0), np.arange(board.rows + 1.0))
    pixels = _seen(corners, world_from_board, camera)
    for row in range(board.rows):
        for column in range(board.columns):
            window = tuple(slice(max(0, k * _DOTS - _RIM), (k + 1) * _DOTS + _RIM) for k in (row, column))
            if shown[window].all() and _alike(flat[window], printed[window]):
                outline = pixels[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
                cv2.fillConvexPoly(found, np.rint((outline - 0.5) * 16).astype(np.int32), 1, shift=4)
    return found > 0


@cache
def _printed(board: Board) -> Float64Array:
    """The print, 0 to 255, in the samples of :func:`_laid_flat`."""
    return _blurred(cv2.resize(board.draw(4 * _DOTS), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))


def _alike(values: Float64Array, printed: Float64Array) -> bool:
    """Whether values are those of the print, times and plus something."""
    values, printed = values - values.mean(), printed - printed.mean()
    spread = float((printed * printed).sum())
    contrast = float((values * printed).sum()) / spread
    if not contrast > 0:
        return False
    likeness = contrast * np.sqrt(spread / float((values * values).sum()))
    # The print is 0 to 255, so the contrast is that of the image's black and white as well.
    return bool(likeness > _LIKENESS and np.abs(values - contrast * printed).max() < _BLOT * 255 * contrast)


def _places(board: Board, x: Float64Array, y: Float64Array) -> Float64Array:
    """Places on the board [m], shape (len(y), len(x), 3), of positions in squares from its upper left corner."""
    across, down = np.meshgrid(x, y)
    return np.stack([across - board.columns / 2, board.rows / 2 - down, np.zeros_like(down)], axis=-1) * board.square


def _seen(places: Float64Array, world_from_board: Float64Array, camera: Camera) -> Float64Array:
    """Pixel positions (..., 2) of places on the board (..., 3)."""
    pixels, _ = camera.project(places.reshape(-1, 3) @ world_from_board[:3, :3].T + world_from_board[:3, 3])
    return pixels.reshape(*places.shape[:-1], 2)


def _laid_flat(
    board: Board, world_from_board: Float64Array, camera: Camera, grey: npt.NDArray[np.uint8]
) -> tuple[Float64Array, BoolArray]:
    """The board in samples of the image, and which of these the image holds."""
    x, y = ((np.arange(n * _DOTS) + 0.5) / _DOTS for n in (board.columns, board.rows))
    pixels = _seen(_places(board, x, y), world_from_board, camera)
    shown = np.asarray(((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=-1))
    steps = np.linalg.norm(np.diff(pixels, axis=1), axis=-1)[shown[:, 1:] & shown[:, :-1]]
    step = float(np.median(steps)) if len(steps) else 1.0
    smooth = cv2.GaussianBlur(grey, (0, 0), max(0.3, 0.4 * step))
    grid = np.nan_to_num(pixels - 0.5, nan=-1.0).astype(np.float32)
    flat = cv2.remap(smooth, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return _blurred(flat), shown


def _blurred(image: npt.NDArray[np.generic]) -> Float64Array:
    """Cameras are off by a fraction of a sample; what is sharper than that must not count."""
    return np.asarray(cv2.GaussianBlur(np.asarray(image, dtype=np.float64), (0, 0), 1.0))
