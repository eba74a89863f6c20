"""Selection of video frames for structure from motion: sharp frames with sufficient camera motion between them.

Input: a video file. Output: a folder of images, named by their time in the video, and the times of cuts in the video.
This package is independent of the later use of the images.
"""

from __future__ import annotations

from mitsplat.capture.video.extraction import ChosenFrames, choose_frames

__all__ = ["ChosenFrames", "choose_frames"]
