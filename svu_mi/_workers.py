"""A second thread for Dr.Jit where a process may use one core only.

Mitsuba has Dr.Jit's workers decode EXR files and load scenes, and waits for them: for ever where
there are none, which is what Dr.Jit begins with on one core.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from svu_mi.limits import FEWEST_THREADS


def bootstrap() -> None:
    """Make sure of two threads where there is one core; elsewhere Dr.Jit is not even imported."""
    if _cores() >= FEWEST_THREADS:
        return
    with suppress(ImportError):  # svu doctor says what is wrong with it
        import drjit as dr

        dr.set_thread_count(max(dr.thread_count(), FEWEST_THREADS))


def _cores() -> int:
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
