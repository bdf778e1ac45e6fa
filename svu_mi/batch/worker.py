"""A command in a process of its own, which ends with the batch that started it.

    python -m svu_mi.batch.worker PARENT entropy capture -o out/entropy ...
"""

from __future__ import annotations

import contextlib
import os
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1  # of prctl, on Linux


def end_with(parent: int) -> None:
    """Have this process killed when its parent ends, in whatever way; only Linux can."""
    if sys.platform != "linux":
        return
    import ctypes

    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended meanwhile
        sys.exit(1)


if __name__ == "__main__":
    end_with(int(sys.argv.pop(1)))
    runpy.run_module("svu_mi", run_name="__main__", alter_sys=True)
