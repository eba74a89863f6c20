"""Mitsuba plugins, one per module: ``splats`` (shape), ``splat_proxy`` (integrator), ``opencv_camera`` (sensor)."""

from __future__ import annotations

import importlib
import sys

PLUGINS = ("splats", "opencv_camera", "splat_proxy")


def register(variant: str | None) -> None:
    """Register the plugins under a Mitsuba variant: their classes derive from types that exist once per variant.

    Scalar variants cannot run them and are left alone.
    """
    if variant is None or variant.startswith("scalar"):
        return
    for name in PLUGINS:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)
