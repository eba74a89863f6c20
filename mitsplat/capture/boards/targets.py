"""Printed targets of known size and their detection: the ChArUco board of ``mitsplat board``, and AprilTags."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.storage.files import write_file

PAPERS: Mapping[str, tuple[float, float]] = {"a4": (0.297, 0.210), "letter": (0.2794, 0.2159), "a3": (0.420, 0.297)}
"""Paper sizes in landscape, width and height [m]."""

_DOTS = 20
"""Dots per millimetre; squares of whole millimetres and the modules of their markers end on dots."""

_MARGIN = 0.008
"""Unprintable margin of printers [m]."""

_SMALL = 1000
"""Longer edge of images below which they are enlarged for the board detection [px]."""

LEAST_SQUARE = 0.001
"""Minimum square edge of a board [m], at which a module of a marker has two dots."""

_MARKER = 0.75
"""Edge of a marker as a fraction of its square."""


@dataclass(frozen=True)
class Board:
    """ChArUco board: a chessboard with ArUco markers (``DICT_5X5_250``) in its white squares.

    Attributes:
        columns, rows: Numbers of squares across and down.
        square: Edge of a square as printed [m].

    Raises:
        InputError: If there are fewer than 3x4 squares (six inner corners) or more than the dictionary has markers, or
            if the square edge is out of range.
    """

    columns: int = 7
    rows: int = 5
    square: float = 0.035

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 12 <= self.columns * self.rows <= 500:
            raise InputError(f"a board must have 3x4 to 500 squares (got {self.columns}x{self.rows})")
        if not LEAST_SQUARE <= self.square <= 10:
            raise InputError(f"a board's square must be {LEAST_SQUARE} to 10 m (got {self.square:g})")

    @property
    def aruco(self) -> cv2.aruco.CharucoBoard:
        """Board object of OpenCV."""
        markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, _MARKER * self.square, markers)

    @property
    def corners(self) -> Float64Array:
        """Inner corners on the board [m], shape (N, 3): origin in the middle, x right, y up, z out of the sheet."""
        return self.points(np.arange(1, self.columns), np.arange(1, self.rows)).reshape(-1, 3)

    def points(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Float64Array:
        """Return points on the board [m], shape (len(y), len(x), 3), in the axes of :attr:`corners`.

        Args:
            x: Positions from the left border [squares].
            y: Positions from the upper border [squares].
        """
        across, down = np.meshgrid(x, y)
        places = np.stack([across - self.columns / 2, self.rows / 2 - down, np.zeros(down.shape)], axis=-1)
        return np.asarray(places * self.square)

    def draw(self, dots: int) -> npt.NDArray[np.uint8]:
        """Draw the board without a margin, 8-bit grey, shape (H, W).

        Args:
            dots: Edge of a square in pixels.
        """
        size = (self.columns * dots, self.rows * dots)
        return np.asarray(self.aruco.generateImage(size, marginSize=0, borderBits=1))

    def write_pdf(self, path: Path, paper: str) -> None:
        """Write the sheet to print in true size, with a ruler to verify the size.

        Raises:
            InputError: If the board does not fit on the paper, or the file cannot be written.
        """
        width, height = PAPERS[paper]
        across, down = self.columns * self.square, self.rows * self.square
        caption = 0.010
        if across > width - 2 * _MARGIN or down > height - 2 * _MARGIN - caption:
            raise InputError(
                f"a board of {self.columns}x{self.rows} squares of {self.square:g} m ({across:g} x {down:g} m) does "
                f"not fit on {paper} with a margin of {_MARGIN:g} m"
            )

        def dots(metres: float) -> int:
            return round(metres * 1000 * _DOTS)

        sheet = Image.new("L", (dots(width), dots(height)), 255)
        corner = (dots((width - across) / 2), dots((height - caption - down) / 2))
        sheet.paste(Image.fromarray(self.draw(dots(self.square))), corner)
        draw = ImageDraw.Draw(sheet)
        base = dots(height - _MARGIN)
        text = f"{self.columns}x{self.rows} squares of {1000 * self.square:g} mm. Print at 100 %; this line is 100 mm:"
        font = ImageFont.load_default(dots(0.0035))
        draw.text((corner[0], base), text, fill=0, font=font, anchor="ls")
        start = corner[0] + round(draw.textlength(text, font=font)) + dots(0.003)
        draw.rectangle([start, base - dots(0.001), start + dots(0.1) - 1, base - dots(0.0005)], fill=0)
        for x in (start, start + dots(0.1) - 4):
            draw.rectangle([x, base - dots(0.0025), x + 3, base], fill=0)
        # PIL stores bilevel images without loss; grey images would become JPEG.
        page = sheet.convert("1", dither=Image.Dither.NONE)
        try:
            write_file(path, lambda part: page.save(part, "PDF", resolution=25.4 * _DOTS))
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error

    def find(self, grey: npt.NDArray[np.uint8]) -> dict[int, Float64Array]:
        """Detect the inner corners of the board in a grey image (H, W).

        Returns:
            Pixel positions (2,) by index of the corner; pixel centres are at +0.5.
        """
        # Markers of few pixels are detected only in enlarged images.
        factor = 2 if max(grey.shape) < _SMALL else 1
        image = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC) if factor > 1 else grey
        found, ids, _, _ = cv2.aruco.CharucoDetector(self.aruco).detectBoard(image)
        if ids is None or found is None:
            return {}
        pixels = (np.asarray(found, dtype=np.float64).reshape(-1, 2) + 0.5) / factor
        return {int(index): pixel for index, pixel in zip(np.ravel(ids), pixels, strict=True)}


def find_tags(grey: npt.NDArray[np.uint8]) -> dict[int, Float64Array]:
    """Detect AprilTags of family 36h11 in an image.

    A tag whose id occurs twice in the image is excluded, because it is ambiguous.

    Returns:
        Corners (4, 2) by tag id, clockwise from the upper left; pixel centres are at +0.5.
    """
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    quads, ids, _ = cv2.aruco.ArucoDetector(family, settings).detectMarkers(grey)
    if ids is None:
        return {}
    numbers = [int(number) for number in np.ravel(ids)]
    # This refinement has pixel centres at +0.5, unlike the rest of OpenCV.
    corners = (np.asarray(quad, dtype=np.float64).reshape(4, 2) for quad in quads)
    return {number: quad for number, quad in zip(numbers, corners, strict=True) if numbers.count(number) == 1}
