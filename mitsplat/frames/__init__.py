"""One frame of a scene, from its plan to picture and labels.

Input: a scene and the index of a frame. Output: a :class:`Frame` with the developed picture, its layers and its labels.
A :class:`Renderer` holds the data that the frames of a scene share. Further modules: the camera's response, and scenes
as Mitsuba XML.
"""

from __future__ import annotations

from mitsplat.frames.frame import Frame, Renderer, render_frame

__all__ = ["Frame", "Renderer", "render_frame"]
