"""Which LLVM Dr.Jit uses: a wheel brings a modern one, because the versions that distributions ship abort on recent CPUs."""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST_USABLE = 16


def use_bundled_llvm() -> None:
    """Point Dr.Jit at the libLLVM of this Python environment, unless the user has set one. Call before any variant is used."""
    if not os.environ.get(VARIABLE):
        path = find_bundled_llvm()
        if path is not None:
            os.environ[VARIABLE] = str(path)


def find_bundled_llvm() -> Path | None:
    """The libLLVM that a wheel put into this environment's ``lib`` folder, or None."""
    folders = {Path(sysconfig.get_path("data")) / "lib", Path(sysconfig.get_path("platlib")).parents[1]}
    for folder in sorted(folders):
        for name in ("libLLVM.so", "libLLVM.dylib"):
            if (folder / name).exists():
                return folder / name
    return None
