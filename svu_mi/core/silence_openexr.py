"""Suppression of the error messages that OpenEXR and LibRaw print on stderr and ``sys.stdout``."""

import contextlib
import os
import sys
import tempfile
import threading
from typing import Any

# In the lines that OpenEXR and LibRaw print.
PRINTED = (b"(EXR_ERR_", b": Unexpected end of file", b": data corrupted at")


class Quiet:
    """Context that suppresses these messages while a thread reads or writes.

    On stdout, threads outside of the context print as usual. On stderr, all output is buffered
    until the last thread leaves; then all but these lines are printed. A crash loses them.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside: set[int] = set()
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._undo.enter_context(contextlib.redirect_stdout(_Others(self._inside)))
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    self._hold_stderr()
            self._inside.add(threading.get_ident())

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside.discard(threading.get_ident())
            if not self._inside:
                self._undo.close()

    def _hold_stderr(self) -> None:
        sys.stderr.flush()
        screen = os.dup(2)
        self._undo.callback(os.close, screen)
        held = tempfile.TemporaryFile()  # noqa: SIM115 - closed by ``_undo``
        self._undo.callback(held.close)
        os.dup2(held.fileno(), 2)

        def release() -> None:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                sys.stderr.flush()
            os.dup2(screen, 2)
            held.seek(0)
            lines = held.read().splitlines(keepends=True)
            with contextlib.suppress(OSError):
                os.write(2, b"".join(line for line in lines if not any(p in line for p in PRINTED)))

        self._undo.callback(release)


class _Others:
    """Proxy of stdout that discards the output of some threads."""

    def __init__(self, silent: set[int]) -> None:
        self._silent, self._stream = silent, sys.stdout

    def write(self, text: str) -> int:
        """Write ``text``, unless the current thread is silent."""
        if threading.get_ident() in self._silent:
            return len(text)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


quiet = Quiet()
