"""What a process has one of: Mitsuba's variant with the plugins under it, and the turn to use Dr.Jit or Warp.

The rule for variants: mitsplat runs in ``llvm_ad_rgb`` and ``cuda_ad_rgb``. It uses the one that has been chosen by
``mi.set_variant``, before or after the import, chooses ``llvm_ad_rgb`` where none has been, and refuses to work in any
other one, which it leaves as it is. A variant belongs to the process, not to a thread, so switching it for the time of
a call would pull it from under other threads.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import mitsuba as mi

from mitsplat.errors import InputError
from mitsplat.runtime.dropped_rays import watch_rays
from mitsplat.runtime.llvm import check_llvm
from mitsplat.runtime.plugin_registration import register_plugins

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Those that the plugins run in; the first is the default."""

_turn = threading.RLock()

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def ensure_variant() -> None:
    """Choose ``llvm_ad_rgb`` if no variant has been chosen, and have the plugins under it when this returns.

    Raises:
        InputError: If the variant that has been chosen cannot run the plugins.
        MissingResourceError: If Dr.Jit has no usable LLVM.
    """
    with _turn:
        variant = mi.variant()
        if variant is not None and variant not in VARIANTS:
            raise InputError(
                f"Mitsuba's variant must be {' or '.join(VARIANTS)} for mitsplat (got {variant}): "
                f"call mi.set_variant('{VARIANTS[0]}'), or use `with mi.scoped_set_variant('{VARIANTS[0]}'):`"
            )
        if variant != "cuda_ad_rgb":
            check_llvm()
        if variant is None:
            mi.set_variant(VARIANTS[0])
        # Mitsuba names a variant before it calls back those who register under it: another thread may be that far.
        register_plugins(mi.variant())
        if mi.variant() == "cuda_ad_rgb":
            watch_rays()


def choose_variant(variant: str) -> None:
    """Choose one of :data:`VARIANTS` for this process, whatever was chosen before.

    Raises:
        MissingResourceError: If it is ``llvm_ad_rgb``, and Dr.Jit has no usable LLVM.
    """
    with _turn:
        if variant == VARIANTS[0]:
            check_llvm()
        mi.set_variant(variant)
        ensure_variant()


def one_at_a_time(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let calls from several threads take turns, as they share what a scene has on the device, and Warp's settings.

    Each uses all processors, so nothing is lost.
    """

    @wraps(function)
    def in_turn(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _turn:
            return function(*args, **kwargs)

    return in_turn
