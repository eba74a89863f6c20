"""Folder of the frames chosen from a video: written by a child process, and reused until the video changes."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from mitsplat.arguments import list_first
from mitsplat.errors import InputError
from mitsplat.progress import Progress
from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import JsonObject, write_text

_RECORD = "video.json"
_METHOD = 1
"""Version of the frame selection; increase it when the selection changes."""
_MAX_LISTED_CUTS = 6
"""Maximum number of cuts that a warning lists by time."""


@dataclass(frozen=True)
class ChosenFrames:
    """Frames of a video as pictures in a folder.

    Attributes:
        video: Video file.
        folder: Folder of the pictures.
        names: File names of the pictures by their times, such as ``01m15s040.jpg``.
        read: Number of frames that were read.
        seconds: Time of the last frame [s].
        cuts: Times of discontinuities [s].
        moved: Total image motion as a fraction of the image width, without discontinuities.
    """

    video: Path
    folder: Path
    names: tuple[str, ...]
    read: int
    seconds: float
    cuts: tuple[float, ...]
    moved: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the video, one sentence each."""
        if not self.cuts:
            return ()
        times = list_first([f"{time:.1f} s" for time in self.cuts], _MAX_LISTED_CUTS)
        return (
            f"{self.video}: jumps at {times}, by a cut or a movement too fast to track: parts without common "
            "views with the rest have no cameras",
        )


def choose_frames(
    video: Path, folder: Path, *, most: int, least: int, progress: Progress | None = None
) -> ChosenFrames:
    """Write sharp frames of a video in even steps of motion, unless the folder has them already.

    The same video and numbers give the same frames. Pictures have the size and the display orientation of the video.

    Args:
        video: File that FFmpeg reads.
        folder: Folder of the frames; its content is replaced.
        most: Maximum number of frames.
        least: Minimum number of frames.
        progress: Callback with the frames done, their total and the present activity.

    Raises:
        InputError: If the file is no video, ends too early, or has too few or too many different views, or if the
            folder contains something else.
    """
    if most < least:
        raise InputError(f"at least {least} frames must be taken of a video (got {most})")
    inputs = {"video": file_hash(video), "most": most, "method": _METHOD}
    if (kept := _load_finished(video, folder, inputs)) is not None:
        return kept
    if folder.exists() and any(folder.iterdir()) and not (folder / _RECORD).is_file():
        raise InputError(f"{folder}: already exists and contains no frames of a video: choose another folder")
    # Written to another folder, so that earlier frames exist until all new ones do.
    made = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    try:
        found = _run_worker(video, made, most, least, progress)
        write_text(made / _RECORD, json.dumps({"inputs": inputs, **found}, indent=1))
        shutil.rmtree(folder, ignore_errors=True)
        made.rename(folder)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise
    return _chosen_frames(video, folder, found)


def _load_finished(video: Path, folder: Path, inputs: JsonObject) -> ChosenFrames | None:
    """Return the frames of an earlier run if they are complete and have the same inputs, else None."""
    try:
        record = json.loads((folder / _RECORD).read_text())
        if record.pop("inputs") != inputs:
            return None
        chosen = _chosen_frames(video, folder, record)
    except (OSError, ValueError, KeyError, TypeError):  # missing or damaged: recompute
        return None
    return chosen if {path.name for path in folder.glob("*.jpg")} == set(chosen.names) else None


def _chosen_frames(video: Path, folder: Path, found: JsonObject) -> ChosenFrames:
    return ChosenFrames(video, folder, **found | {"names": tuple(found["names"]), "cuts": tuple(found["cuts"])})


def _run_worker(video: Path, folder: Path, most: int, least: int, progress: Progress | None) -> JsonObject:
    """Run the child process that writes the frames, and return its result."""
    command = python_command("-m", "mitsplat.capture.video.video_worker", video, folder, str(most), str(least))
    # Excludes playlists, which FFmpeg would follow to other files.
    environment = python_environment({"OPENCV_FFMPEG_CAPTURE_OPTIONS": "protocol_whitelist;file"})
    found, error = None, None
    with (
        (folder / "log.txt").open("wb") as log,
        # The pipe closes when this process ends for any reason, which ends the child.
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment) as child,
    ):
        try:
            for line in child.stdout or ():
                message = json.loads(line)
                found, error = message.get("found"), message.get("error")
                if progress is not None and "progress" in message:
                    progress(*message["progress"])
        except BaseException:
            child.kill()
            raise
    if error is not None:
        raise InputError(error)
    if child.returncode < 0:
        raise InputError(
            f"{video}: must be a video that FFmpeg can decode (got signal {-child.returncode} of its decoder): convert "
            "it to another format"
        )
    if found is None:
        raise RuntimeError((folder / "log.txt").read_text()[-2000:])
    return dict(found)
