"""Threads of Dr.Jit."""

from __future__ import annotations

import drjit as dr

# Mitsuba waits for Dr.Jit's workers to decode EXR files: for ever with one thread, which is the
# default on one core.
FEWEST_THREADS = 2


def ensure_threads(count: int = 0) -> None:
    """Have Dr.Jit use ``count`` threads (0: as many as now), but at least ``FEWEST_THREADS``."""
    dr.set_thread_count(max(count or dr.thread_count(), FEWEST_THREADS))
