"""Import hook that runs a callback after Mitsuba has been imported, without importing it.

Commands that do not render thus start without Mitsuba. Its import takes a tenth of a second, and Dr.Jit then starts
CUDA on every visible GPU.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_NAME = "mitsuba"


def after_mitsuba(act: Callable[[], object]) -> None:
    """Call ``act`` after Mitsuba is imported, or immediately if it is already imported."""
    if _NAME in sys.modules:
        act()
    else:
        sys.meta_path.insert(0, _Finder(act))


class _Finder(MetaPathFinder):
    """Meta path finder that wraps the loader of Mitsuba."""

    def __init__(self, act: Callable[[], object]) -> None:
        self._act = act

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _NAME:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader, self._act)
        return spec


class _Loader(Loader):
    """Loader that delegates to another loader and then runs the callback."""

    def __init__(self, loader: Loader, act: Callable[[], object]) -> None:
        self._loader, self._act = loader, act

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        if module.__spec__ is not None:
            module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        self._act()
