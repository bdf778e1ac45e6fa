"""Entry point of a command of a batch, which is killed when the batch ends.

    python -m svu_mi.cli.batch.child_process PARENT MEMORY entropy capture -o out/entropy ...

MEMORY is the number of bytes that it may take; 0 for all.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import runpy
import signal
import sys

from svu_mi.core.memory import allow

PR_SET_PDEATHSIG = 1  # of prctl, on Linux


def end_with_parent(parent: int) -> None:
    """Have this process killed when its parent ends (Linux only)."""
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended meanwhile
        sys.exit(1)


if __name__ == "__main__":
    end_with_parent(int(sys.argv.pop(1)))
    if size := int(sys.argv.pop(1)):
        allow(size)
    runpy.run_module("svu_mi", run_name="__main__", alter_sys=True)
