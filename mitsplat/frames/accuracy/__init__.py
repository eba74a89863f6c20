"""Time and error of the rendering presets on a scene, and their chart.

Input: a scene or splat file. Output: a :class:`Row` for each preset, and charts of them.
"""

from __future__ import annotations

from mitsplat.frames.accuracy.speed_accuracy import Row, measure_steps

__all__ = ["Row", "measure_steps"]
