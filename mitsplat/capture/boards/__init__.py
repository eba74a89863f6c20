"""Boards and tags that are printed, stood upon, and found in photographs again.

In: the squares of a board, and photographs with their cameras. Out: a page to print, corners in pixels and in metres,
and which pixels show bare board. It knows neither captures nor masks.
"""

from __future__ import annotations

from mitsplat.capture.boards.board_mask import bare_squares
from mitsplat.capture.boards.targets import Board

__all__ = ["Board", "bare_squares"]
