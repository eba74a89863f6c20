"""Video decoding: upright frames with their times, by OpenCV's reader with FFmpeg decoders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import ByteImage
from mitsplat.errors import InputError
from mitsplat.storage.file_kinds import VIDEO_SUFFIXES, refuse_other_kinds

_RATE = 30.0
"""Target frame rate [1/s]; of faster videos, every second, third ... frame is read."""

_MISSING = 0.05
"""Fraction of frames and of time that may be missing at the end of a video, because containers are not exact."""


@dataclass(frozen=True)
class VideoReader:
    """Open video.

    Attributes:
        file: Video file.
        opened: OpenCV's reader.
        rate: Frame rate of the container [1/s]; 30 if it has none.
        stated: Number of frames by the container, possibly estimated; 0 if unknown.
    """

    file: Path
    opened: cv2.VideoCapture
    rate: float
    stated: int

    @property
    def stride(self) -> int:
        """Interval of the frames that are read."""
        return max(1, round(self.rate / _RATE))

    def times(self) -> Iterator[tuple[int, float]]:
        """Iterate over index and time [s] of the frames; :meth:`picture` returns the current one.

        Times increase even if the container has no times or invalid ones.

        Raises:
            InputError: At the end, if there was no frame, or the video is shorter than stated.
        """
        index, time, last = 0, 0.0, -1.0
        while self.opened.grab():
            time = self.opened.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if not time > last:
                time = last + 1 / self.rate if index else 0.0
            if index % self.stride == 0:
                yield index, time
            index, last = index + 1, time
        if index == 0:
            raise InputError(f"{self.file}: must hold at least one frame that can be decoded (got none)")
        length = self.stated / self.rate
        if index < (1 - _MISSING) * self.stated and time + 1 / self.rate < (1 - _MISSING) * length:
            raise InputError(
                f"{self.file}: must hold the {self.stated} frames that its header states (got {index}, {time:.1f} of "
                f"{length:.1f} s): it is incomplete or damaged: copy it again"
            )

    def picture(self) -> ByteImage:
        """Return the current frame, channels blue, green and red, shape (H, W, 3).

        Raises:
            InputError: If it cannot be decoded.
        """
        good, picture = self.opened.retrieve()
        if not good:
            raise InputError(f"{self.file}: must hold frames that can be decoded (got a damaged one)")
        return np.asarray(picture, dtype=np.uint8)


@contextmanager
def open_video(file: Path) -> Iterator[VideoReader]:
    """Open a video at its first frame; frames are rotated by the orientation stored in the file.

    Raises:
        InputError: If it is not a readable video, or OpenCV fails while it is read.
    """
    refuse_other_kinds(file, "a folder of photographs or a video", *VIDEO_SUFFIXES)
    opened = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    try:
        if not opened.isOpened():
            raise InputError(
                f"{file}: must be a complete video that FFmpeg reads, such as .mp4, .mov or .avi (got a file of "
                f"{file.stat().st_size} bytes that it cannot open)"
            )
        opened.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        rate, stated = opened.get(cv2.CAP_PROP_FPS), opened.get(cv2.CAP_PROP_FRAME_COUNT)
        yield VideoReader(file, opened, rate if 0 < rate < 1000 else _RATE, max(0, int(stated)))
    except cv2.error as error:  # such as frames of different sizes, or too large for memory
        raise InputError(f"{file}: must hold frames that can be decoded (got {error.err or error})") from error
    finally:
        opened.release()
