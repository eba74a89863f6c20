"""Process-wide state of the compute libraries: Mitsuba variant, device, LLVM, GPU memory, child processes.

Input: the requested device. Output: a registered Mitsuba variant, and functions that serialise access to Dr.Jit and
Warp.
"""
