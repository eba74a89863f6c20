"""Process-wide state: Mitsuba's variant with the registered plugins, and the lock for Dr.Jit and Warp.

mitsplat runs in ``llvm_ad_rgb`` and ``cuda_ad_rgb``. It uses the variant set by ``mi.set_variant``, before or after the
import. If none is set, it sets ``llvm_ad_rgb``. It refuses to work in any other variant, and does not change that
variant. A variant belongs to the process, not to a thread; switching it during a call would break other threads.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import mitsuba as mi

from mitsplat.errors import InputError
from mitsplat.runtime.dropped_rays import record_dropped_rays
from mitsplat.runtime.llvm import check_llvm
from mitsplat.runtime.plugin_registration import register_plugins
from mitsplat.runtime.threads import ensure_threads

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants in which the plugins run; the first is the default."""

_lock = threading.RLock()

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def ensure_variant() -> None:
    """Set ``llvm_ad_rgb`` if no variant is set, register the plugins for the variant, and set the minimum of threads.

    Raises:
        InputError: If the current variant cannot run the plugins.
        MissingResourceError: If Dr.Jit has no usable LLVM.
    """
    with _lock:
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
        ensure_threads()
        # Mitsuba changes the variant before it calls its callbacks, and another thread may be between both steps.
        register_plugins(mi.variant())
        if mi.variant() == "cuda_ad_rgb":
            record_dropped_rays()


def choose_variant(variant: str) -> None:
    """Set one of :data:`VARIANTS` for this process, replacing the current one.

    Raises:
        MissingResourceError: If it is ``llvm_ad_rgb``, and Dr.Jit has no usable LLVM.
    """
    with _lock:
        if variant == VARIANTS[0]:
            check_llvm()
        mi.set_variant(variant)
        ensure_variant()


def one_at_a_time(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Serialise calls from several threads, because they share a scene's device data and Warp's settings.

    Each call uses all processors, so that serialisation costs no speed.
    """

    @wraps(function)
    def locked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _lock:
            return function(*args, **kwargs)

    return locked
