"""Child process that chooses and writes video frames.

Usage: ``python -m mitsplat.capture.video.video_worker VIDEO FOLDER MOST LEAST``.

A damaged video can abort the process that decodes it, and decoders write messages to standard error. So
:mod:`mitsplat.capture.video.extraction` starts this module and reads its standard output, one JSON object per line.
``progress`` has the arguments of :data:`mitsplat.progress.Progress`. The last line is ``error``, a sentence, or
``found``, a description of the frames in FOLDER.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import ByteImage
from mitsplat.capture.video.decoding import open_video
from mitsplat.capture.video.frame_selection import STEP, Choice, FrameMeasure, choose
from mitsplat.capture.video.motion import MotionClock
from mitsplat.capture.video.sharpness import sharpness
from mitsplat.errors import InputError
from mitsplat.runtime.child_process import limit_memory
from mitsplat.storage.files import write_bytes

_MEMORY = 12 << 30
"""Address space for decoding [bytes]; decoders of large frames reserve some for each thread."""

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def main(video: Path, folder: Path, most: int, least: int) -> None:
    """Choose and write the frames, and print the result."""
    try:
        measures = _measure(video)
        choice = choose(measures, most)
        _check_choice(video, choice, measures[-1].time, most, least)
        names = _write(video, folder, choice)
    except InputError as error:
        _send(error=str(error))
        return
    _send(
        found={
            "names": names,
            "read": len(measures),
            "seconds": measures[-1].time,
            "cuts": choice.cuts,
            "moved": choice.moved,
        }
    )


def _measure(video: Path) -> list[FrameMeasure]:
    """Measure the image motion and the sharpness of each frame."""
    clock, measures = MotionClock(), list[FrameMeasure]()
    with open_video(video) as reader:
        for index, time in reader.times():
            grey: ByteImage = np.asarray(cv2.cvtColor(reader.picture(), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            measures.append(FrameMeasure(index, time, clock.add(grey), sharpness(grey)))
            _send(progress=(index + 1, max(index + 1, reader.stated), "watching the video"))
    return measures


def _check_choice(video: Path, choice: Choice, seconds: float, most: int, least: int) -> None:
    """Raise InputError if the video gives too few frames or too many."""
    if len(choice.frames) < least:
        if not choice.cuts and choice.moved < STEP:
            raise InputError(
                f"{video}: its picture must move by {least * STEP:.0%} of its width or more (got {choice.moved:.1%} in "
                f"{seconds:.1f} s): move around the object, which must have texture that can be tracked"
            )
        raise InputError(
            f"{video}: must show at least {least} views that differ by {STEP:.0%} of the picture's width (got "
            f"{len(choice.frames)} in {seconds:.1f} s): move farther around the object"
        )
    if len(choice.frames) > most:
        raise InputError(
            f"{video}: must have fewer cuts than frames to take (got {len(choice.cuts)} cuts, or movements "
            f"too fast to track, for {most} frames): film slowly without cuts, or take more frames (--frames)"
        )


def _write(video: Path, folder: Path, choice: Choice) -> list[str]:
    """Write the frames as JPEG of quality 95 with full colour resolution, and return their names."""
    names = {frame.index: _name(frame.time) for frame in choice.frames}
    with open_video(video) as reader:
        for index, _ in reader.times():
            if index in names:
                _, coded = cv2.imencode(".jpg", reader.picture(), _JPEG)
                write_bytes(folder / names[index], coded.tobytes())
                _send(progress=(index + 1, max(index + 1, reader.stated), "taking frames of the video"))
            if index >= choice.frames[-1].index:
                break
    return list(names.values())


def _name(time: float) -> str:
    """Return the file name of a frame by its time [s]: 75.04 gives ``01m15s040.jpg``."""
    minutes, milliseconds = divmod(round(1000 * time), 60_000)
    return f"{minutes:02}m{milliseconds // 1000:02}s{milliseconds % 1000:03}.jpg"


def _send(**message: object) -> None:
    sys.stdout.write(f"{json.dumps(message)}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    limit_memory(_MEMORY)
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
