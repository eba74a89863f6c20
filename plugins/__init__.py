"""Mitsuba plugins, one per module: ``splats`` (shape), ``splat_proxy`` (integrator), ``opencv_camera`` (sensor)."""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from mitsplat.errors import MissingResourceError
from mitsplat.runtime.llvm import check_llvm
from mitsplat.runtime.variant import VARIANTS

PLUGINS = ("splats", "opencv_camera", "splat_proxy")

_registered: str | None = None


def register_under(variant: str | None) -> None:
    """Register the plugins once per variant.

    Under an unsupported variant, and with an LLVM that would abort the process, plugins are registered that raise a
    clear error.
    """
    global _registered
    if variant is None or variant == _registered:
        return
    if variant not in VARIANTS:
        refuse(f"needs the variant llvm_ad_rgb or cuda_ad_rgb (got {variant})")
        return
    if variant == "llvm_ad_rgb":
        try:
            check_llvm()
        except MissingResourceError as error:
            refuse(f"cannot be used: {error}")
            return
    register()
    _registered = variant


def register() -> None:
    """Register the plugins under the current variant, because their base classes exist once per variant."""
    for name in PLUGINS:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


def refuse(reason: str) -> None:
    """Register plugins that raise an error with a reason on use."""

    def refused(props: mi.Properties) -> mi.Object:
        raise RuntimeError(f"plugin {props.plugin_name()!r} {reason}")

    mi.register_shape("splats", refused)
    mi.register_sensor("opencv_camera", refused)
    mi.register_integrator("splat_proxy", refused)
