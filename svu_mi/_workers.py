"""Threads of Dr.Jit: at least two, and small parts of launches.

Mitsuba waits for Dr.Jit's workers to decode EXR files and load scenes: for ever where there are
none, which is the default on one core.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

from svu_mi.limits import FEWEST_THREADS
from svu_mi.memory import cores

PART = 2**12  # lanes of a launch that a worker takes at a time; 2^14 are Dr.Jit's own
SET_PART = "_Z23jit_llvm_set_block_sizej"  # of Dr.Jit's core in C++, without a Python name


def bootstrap() -> None:
    """Make sure of two threads where there is one core; elsewhere Dr.Jit is not even imported."""
    if cores() >= FEWEST_THREADS:
        return
    with suppress(ImportError):  # svu doctor says what is wrong with it
        import drjit as dr

        dr.set_thread_count(max(dr.thread_count(), FEWEST_THREADS))


def take_small_parts() -> None:
    """Let workers take small parts of a launch, so that all of them end at about the same time:
    texels do not take equally long. A Dr.Jit that is not known here stays as it is."""
    with suppress(OSError, AttributeError):  # no such library or function
        import drjit as dr

        core = ctypes.CDLL(str(Path(dr.__file__).with_name("libdrjit-core.so")))
        core[SET_PART](ctypes.c_uint(PART))
