"""Where a photo shows the bare board: surely not the object, though it may be as black as the board's squares are."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.board import Board
from mitsplat.camera import Camera
from mitsplat.capture import FloatArray
from mitsplat.masks import BoolArray

_DOTS = 16
"""Samples along a square's edge."""

_RIM = 3
"""Samples beyond a square that must be as printed as well: a black square shows nothing but its edges."""

_LIKENESS = 0.9
"""Correlation with the print from which a square is bare."""

_BLOT = 0.4
"""Largest difference from the print anywhere in a bare square, as a share of the contrast of black and white."""


def bare_squares(board: Board, world_from_board: FloatArray, camera: Camera, grey: npt.NDArray[np.uint8]) -> BoolArray:
    """Pixels of the squares that an image shows as they are printed, shape (H, W).

    Each square is laid flat and compared with the print, up to the brightness and contrast of the light there. A square
    counts only as a whole, with what surrounds it, so that what covers a part of it leaves none of it.

    Args:
        board: The print.
        world_from_board: Its pose (4, 4), in the camera's world.
        camera: Of the image.
        grey: The image, 8-bit, shape (H, W).
    """
    found = np.zeros(grey.shape, dtype=np.uint8)
    flat, shown = _laid_flat(board, world_from_board, camera, grey)
    print_ = _blurred(
        np.pad(cv2.resize(board.draw(4 * _DOTS), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), _RIM)
    )
    flat = _blurred(flat)
    inside = np.zeros(flat.shape, dtype=bool)
    inside[_RIM:-_RIM, _RIM:-_RIM] = True  # beyond the board anything may lie
    corners = _places(board, np.arange(board.columns + 1.0), np.arange(board.rows + 1.0))
    pixels, _ = camera.project(corners.reshape(-1, 3) @ world_from_board[:3, :3].T + world_from_board[:3, 3])
    pixels = pixels.reshape(board.rows + 1, board.columns + 1, 2)
    for row in range(board.rows):
        for column in range(board.columns):
            window = tuple(slice(k * _DOTS, (k + 1) * _DOTS + 2 * _RIM) for k in (row, column))
            use = inside[window]
            if shown[window][use].all() and _alike(flat[window][use], print_[window][use]):
                outline = pixels[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
                cv2.fillConvexPoly(found, np.rint((outline - 0.5) * 16).astype(np.int32), 1, shift=4)
    return found > 0


def _alike(values: FloatArray, printed: FloatArray) -> bool:
    """Whether values are those of the print, times and plus something."""
    values, printed = values - values.mean(), printed - printed.mean()
    spread = float(printed @ printed)
    contrast = float(values @ printed) / spread
    if not contrast > 0:
        return False
    likeness = contrast * np.sqrt(spread / float(values @ values))
    # The print is 0 to 255, so the contrast is that of the image's black and white as well.
    return bool(likeness > _LIKENESS and np.abs(values - contrast * printed).max() < _BLOT * 255 * contrast)


def _places(board: Board, x: FloatArray, y: FloatArray) -> FloatArray:
    """Places on the board [m], shape (len(y), len(x), 3), of positions in squares from its upper left corner."""
    across, down = np.meshgrid(x, y)
    return np.stack([across - board.columns / 2, board.rows / 2 - down, np.zeros_like(down)], axis=-1) * board.square


def _laid_flat(
    board: Board, world_from_board: FloatArray, camera: Camera, grey: npt.NDArray[np.uint8]
) -> tuple[FloatArray, BoolArray]:
    """The board and its rim in samples of the image, and which of these the image holds."""
    x, y = ((np.arange(-_RIM, n * _DOTS + _RIM) + 0.5) / _DOTS for n in (board.columns, board.rows))
    places = _places(board, x, y)
    pixels, _ = camera.project(places.reshape(-1, 3) @ world_from_board[:3, :3].T + world_from_board[:3, 3])
    pixels = pixels.reshape(*places.shape[:2], 2)
    shown = np.asarray(((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=-1))
    step = float(np.nanmedian(np.linalg.norm(np.diff(pixels, axis=1), axis=-1))) if shown.any() else 1.0
    smooth = cv2.GaussianBlur(grey, (0, 0), max(0.3, 0.4 * step))
    grid = np.nan_to_num(pixels - 0.5, nan=-1.0).astype(np.float32)
    flat = cv2.remap(smooth, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return flat.astype(np.float64), shown


def _blurred(image: npt.NDArray[np.generic]) -> FloatArray:
    """Cameras are off by a fraction of a sample; what is sharper than that must not count."""
    return np.asarray(cv2.GaussianBlur(np.asarray(image, dtype=np.float64), (0, 0), 1.0))
