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
    """Set Dr.Jit's libLLVM to that of a wheel in this Python environment, unless the user has set one.

    Dr.Jit must not have been imported.
    """
    if os.environ.get(VARIABLE):
        return
    folders = {Path(sysconfig.get_path("data")) / "lib", Path(sysconfig.get_path("platlib")).parents[1]}
    library = next((path for folder in sorted(folders) if (path := folder / "libLLVM.so").exists()), None)
    if library is not None:
        os.environ[VARIABLE] = str(library)


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
