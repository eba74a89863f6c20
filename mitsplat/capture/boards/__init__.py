"""Printed calibration boards and tags, and their detection in photographs.

Input: the squares of a board, and photographs with their cameras. Output: a page to print, corners in pixels and in
metres, and the pixels that show uncovered board. This package is independent of captures and masks.
"""

from __future__ import annotations

from mitsplat.capture.boards.board_mask import bare_squares
from mitsplat.capture.boards.targets import Board

__all__ = ["Board", "bare_squares"]
