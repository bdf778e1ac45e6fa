"""Child process of a batch: runs one command, and is killed when the batch ends.

    python -m svu_mi.cli.batch.child_process PARENT MEMORY entropy capture -o out/entropy ...

PARENT is the process id of the batch. MEMORY limits the memory in bytes; 0 means no limit.
"""

import contextlib
import ctypes
import os
import runpy
import signal
import sys

from svu_mi.core.memory import allow

PR_SET_PDEATHSIG = 1  # option of prctl on Linux


def end_with_parent(parent: int) -> None:
    """Kill this process when its parent ends (Linux only)."""
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent has already ended
        sys.exit(1)


if __name__ == "__main__":
    end_with_parent(int(sys.argv.pop(1)))
    if size := int(sys.argv.pop(1)):
        allow(size)
    runpy.run_module("svu_mi", run_name="__main__", alter_sys=True)
