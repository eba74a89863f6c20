"""Selection of the LLVM library for Dr.Jit.

A Python wheel provides a recent LLVM, because the LLVM of Linux distributions aborts on recent processors.
"""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path

from mitsplat.errors import MissingResourceError

VARIABLE = "DRJIT_LIBLLVM_PATH"
MIN_LLVM = 16


def use_bundled_llvm() -> None:
    """Set Dr.Jit's libLLVM to that of this Python environment, unless the user has set one.

    Dr.Jit must not have been imported.
    """
    if not os.environ.get(VARIABLE):
        path = find_bundled_llvm()
        if path is not None:
            os.environ[VARIABLE] = str(path)


def find_bundled_llvm() -> Path | None:
    """Return the path of libLLVM that a wheel installed in this environment's ``lib`` folder, or None."""
    folders = {Path(sysconfig.get_path("data")) / "lib", Path(sysconfig.get_path("platlib")).parents[1]}
    for folder in sorted(folders):
        if (folder / "libLLVM.so").exists():
            return folder / "libLLVM.so"
    return None


def check_llvm() -> None:
    """Refuse an LLVM that would abort the process at the first kernel.

    Raises:
        MissingResourceError: If Dr.Jit has loaded no LLVM, or one that is too old.
    """
    import drjit  # after `use_bundled_llvm`, because Dr.Jit searches for LLVM only once

    version = drjit.detail.llvm_version()
    if version[0] >= MIN_LLVM:
        return
    found = f"has loaded LLVM {'.'.join(map(str, version))}" if version[0] >= 0 else "has found no LLVM"
    raise MissingResourceError(
        f"Dr.Jit {found}, but needs {MIN_LLVM} or newer: import mitsplat before drjit and mitsuba, "
        f"or set {VARIABLE} to a newer libLLVM"
    )
