"""A video to the few of its frames that structure from motion needs: sharp, and each a step further than the last one.

In: a video file. Out: a folder of pictures, named by their time in the video, and where the video jumps. What the
pictures are used for it does not know.
"""

from __future__ import annotations

from mitsplat.capture.video.extraction import ChosenFrames, choose_frames

__all__ = ["ChosenFrames", "choose_frames"]
