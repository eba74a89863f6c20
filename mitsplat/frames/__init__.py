"""One frame of a scene, from its plan to picture and labels.

In: a scene and the index of a frame. Out: a :class:`Frame`: the developed picture, its layers and its labels. A
:class:`Renderer` holds what the frames of a scene share. Beside it: the camera's response, scenes as Mitsuba XML, and
what the presets cost in time and error.
"""

from __future__ import annotations

from mitsplat.frames.frame import Frame, Renderer, render_frame

__all__ = ["Frame", "Renderer", "render_frame"]
