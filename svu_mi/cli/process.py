"""The process of ``svu``: it is there for one command, which makes its start and its end short."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

_own = False  # whether the process is there for the command alone


def run() -> NoReturn:
    """Run the command of this process's arguments, and end the process."""
    global _own
    _own = True
    with importing():
        from svu_mi.cli.main import main
    leave(main())


def is_own() -> bool:
    """Return whether the process is there for the command alone."""
    return _own


@contextmanager
def importing() -> Iterator[None]:
    """Look for no garbage meanwhile, nor among what is there by then: modules stay, and going
    through them takes a tenth of a second. A process that is not ours alone is left as it is."""
    if not _own:
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def leave(status: int) -> NoReturn:
    """End the process as it is: to take down what Python, Dr.Jit and Mitsuba hold takes a fifth
    of a second. Threads are waited for, and what was printed is written, by libraries in C, too."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # full, closed, none
            stream.flush()
    with suppress(OSError, AttributeError):  # no C library that can be asked
        ctypes.CDLL(None).fflush(None)
    os._exit(status)
