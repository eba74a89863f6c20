"""Handling of Ctrl-C on the command line."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

from mitsplat.errors import INTERRUPTED


def handle_interrupts() -> None:
    """Let Ctrl-C end the process at once during an import, and raise `KeyboardInterrupt` otherwise.

    trimesh catches every exception while it imports SciPy and networkx, and then works without them; extension modules
    abort. The handler of a caller stays, and so does that of a background job, which ignores Ctrl-C.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    caller = frame
    while caller is not None:
        if caller.f_code.co_filename.startswith("<frozen importlib"):
            os._exit(INTERRUPTED)
        caller = caller.f_back
    signal.default_int_handler(number, frame)
