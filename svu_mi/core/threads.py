"""Number of Dr.Jit's threads."""

import drjit as dr

# Mitsuba waits for Dr.Jit's workers to decode EXR files. With one thread, which is the default on
# one core, it waits forever.
FEWEST_THREADS = 2


def ensure_threads(count: int = 0) -> None:
    """Set Dr.Jit's thread count (0: keep it); the minimum is ``FEWEST_THREADS``."""
    dr.set_thread_count(max(count or dr.thread_count(), FEWEST_THREADS))
