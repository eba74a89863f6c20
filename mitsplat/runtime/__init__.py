"""Process-wide state of the compute libraries: Mitsuba variant, device, LLVM, GPU memory, child processes.

In: the requested device. Out: a registered Mitsuba variant, and functions that serialise access to Dr.Jit and Warp.
"""
