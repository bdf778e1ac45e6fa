"""Libraries that print before they raise are silenced."""

from __future__ import annotations

import contextlib
import os
import sys
import threading


class Quiet:
    """Silence a library's own lines on stdout and stderr; our exception says it better.

    Both belong to the whole process: the first thread that comes in turns them off and the
    last one that leaves turns them on again.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._undo.enter_context(contextlib.redirect_stdout(None))
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    self._silence_stderr()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._undo.close()

    def _silence_stderr(self) -> None:
        sys.stderr.flush()
        kept = os.dup(2)
        self._undo.callback(os.close, kept)
        sink = os.open(os.devnull, os.O_WRONLY)
        self._undo.callback(os.close, sink)
        os.dup2(sink, 2)
        self._undo.callback(os.dup2, kept, 2)


quiet = Quiet()
