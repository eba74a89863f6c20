"""Frames of a video file one after another, upright, with their times: OpenCV's reader, which has FFmpeg's decoders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import ByteImage
from mitsplat.errors import InputError

_RATE = 30.0
"""Frames a second that are looked at; of faster videos every second, third … frame."""

_MISSING = 0.05
"""Share of its frames, and of its time, that may be missing at the end of a video: containers are not exact."""


@dataclass(frozen=True)
class VideoReader:
    """A video that is being read.

    Attributes:
        file: The video.
        opened: OpenCV's reader.
        rate: Frames a second, as the container says; 30 where it does not.
        stated: Frames that it holds, as the container says or lets guess; 0 where it does not.
    """

    file: Path
    opened: cv2.VideoCapture
    rate: float
    stated: int

    @property
    def stride(self) -> int:
        """Each how many-th frame is looked at."""
        return max(1, round(self.rate / _RATE))

    def times(self) -> Iterator[tuple[int, float]]:
        """Index and time [s] of each frame that is looked at; :meth:`picture` is what it shows, until the next one.

        Times increase, also where the container has none, or odd ones.

        Raises:
            InputError: At the end, if there was no frame, or the video ends before it should.
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
                f"{self.file}: must hold the {self.stated} frames that it is said to (got {index}, {time:.1f} of "
                f"{length:.1f} s): it is cut short or damaged, copy it again"
            )

    def picture(self) -> ByteImage:
        """The frame that was reached, blue, green and red, shape (H, W, 3).

        Raises:
            InputError: If it cannot be decoded.
        """
        good, picture = self.opened.retrieve()
        if not good:
            raise InputError(f"{self.file}: must hold frames that can be decoded (got a damaged one)")
        return np.asarray(picture, dtype=np.uint8)


@contextmanager
def open_video(file: Path) -> Iterator[VideoReader]:
    """Open a video at its first frame; frames are turned as the camera's sensor of gravity says.

    Raises:
        InputError: If it is none that can be read, or OpenCV gives up on it while it is used.
    """
    opened = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    try:
        if not opened.isOpened():
            raise InputError(
                f"{file}: must be a whole video that FFmpeg reads, such as .mp4, .mov or .avi (got a file of "
                f"{file.stat().st_size} bytes that it cannot open)"
            )
        opened.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        rate, stated = opened.get(cv2.CAP_PROP_FPS), opened.get(cv2.CAP_PROP_FRAME_COUNT)
        yield VideoReader(file, opened, rate if 0 < rate < 1000 else _RATE, max(0, int(stated)))
    except cv2.error as error:  # such as frames of several sizes, or of more memory than there is
        raise InputError(f"{file}: must hold frames that can be decoded (got {error.err or error})") from error
    finally:
        opened.release()
