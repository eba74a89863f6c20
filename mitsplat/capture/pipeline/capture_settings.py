"""Settings of the stage ``mitsplat capture``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mitsplat.arguments import check_fields
from mitsplat.capture.alignment.metric_frame import DEFAULT_BOARD, check_distance
from mitsplat.capture.boards.targets import LEAST_SQUARE, Board
from mitsplat.capture.capture import parse_pixel
from mitsplat.errors import InputError


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture.

    Attributes:
        kind: ``object`` is segmented by masks; ``environment`` is not.
        max_size: Longest edge of the photos [px]; larger photos are reduced.
        frames: Maximum number of frames taken from a video.
        board: ChArUco board to detect.
        tag: Edge length of printed AprilTags [m]; None if unknown.
        scale_from: Two points and their distance [m], as in :func:`mitsplat.capture.alignment.metric_frame.spot`.
        poses: COLMAP model or ``transforms.json`` with given cameras.
        metric: True if ``poses`` are in metres with z up; they are then not transformed.
        masks: Folder of masks.
        mask_model: ONNX file of a segmentation network.
        undistorted: Resample the photos to pinhole cameras.
        picks: Pixels on the object, PHOTO:X,Y in pixels of the capture's photos. Without picks, the object is the one
            at which the photos are directed.
        picks_not: Pixels on other objects.
        box: Minimum and maximum x, y and z of a box that contains the object, in the frame of the capture.
    """

    kind: Literal["object", "environment"] = "object"
    max_size: int = 1600
    frames: int = 150
    board: Board = DEFAULT_BOARD
    tag: float | None = None
    scale_from: tuple[str, str, float] | None = None
    poses: Path | None = None
    metric: bool = False
    masks: Path | None = None
    mask_model: Path | None = None
    undistorted: bool = False
    picks: tuple[str, ...] = ()
    picks_not: tuple[str, ...] = ()
    box: tuple[float, float, float, float, float, float] | None = None

    @property
    def has_hints(self) -> bool:
        """True if picks or a box indicate the object."""
        return bool(self.picks or self.picks_not or self.box)

    @property
    def named_photos(self) -> frozenset[str]:
        """Names of the photos in which picks or the points of a distance lie."""
        spots = [*self.picks, *self.picks_not, *(self.scale_from or ())[:2]]
        return frozenset(spot.rpartition(":")[0] or spot for spot in map(str, spots))

    def __post_init__(self) -> None:
        check_fields(self)
        rules = (
            (self.max_size < 64, f"the size of photos must be at least 64 px (got {self.max_size})"),
            (
                self.tag is not None and not LEAST_SQUARE <= self.tag <= 10,
                f"the edge of tags must be {LEAST_SQUARE} to 10 m (got {self.tag})",
            ),
            (self.metric and self.poses is None, "--metric requires --poses"),
            (
                self.masks is not None and self.mask_model is not None,
                "--masks and --mask-model both define the masks: give only one",
            ),
            (
                self.has_hints and not (self.kind == "object" and self.masks is None and self.mask_model is None),
                "--pick, --pick-not and --box select an object to segment: remove them with --masks, --mask-model or "
                "an environment",
            ),
            (
                self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)),
                f"a box must be X0 Y0 Z0 X1 Y1 Z1, each X0 < X1, Y0 < Y1, Z0 < Z1 (got {self.box})",
            ),
        )
        for broken, rule in rules:
            if broken:
                raise InputError(rule)
        if self.scale_from is not None:
            check_distance(self.scale_from)
        for pick in (*self.picks, *self.picks_not):
            parse_pixel(pick.rpartition(":")[2], pick)
