"""Deferral of Ctrl-C to the end of a step, or of the import of a C++ module.

Within custom operations and recorded loops, Dr.Jit replaces a ``KeyboardInterrupt`` by another
exception. An interrupt that is raised while C++ calls Python is lost, or aborts the process.
"""

import _thread
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ExtensionFileLoader
from types import FrameType

WAIT = 0.02  # seconds until it is tested again whether an import has ended


def raise_after_imports(_: int, frame: FrameType | None) -> None:
    """Raise ``KeyboardInterrupt`` when no C++ module is being imported; a handler of SIGINT."""
    while frame is not None:
        if isinstance(frame.f_locals.get("self"), ExtensionFileLoader):
            again = threading.Timer(WAIT, _thread.interrupt_main)
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


@contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C until the yielded function is called; a second Ctrl-C acts at once.

    Yields:
        Function that raises the deferred ``KeyboardInterrupt``, if any. Nothing is deferred
        outside of the main thread, or if SIGINT has a handler other than Python's and ours.
    """
    pressed = False

    def remember(*_: object) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    def answer() -> None:
        if pressed:
            raise KeyboardInterrupt

    usual = signal.getsignal(signal.SIGINT)
    is_known = usual in (signal.default_int_handler, raise_after_imports)
    if not is_known or threading.current_thread() is not threading.main_thread():
        yield answer
        return
    signal.signal(signal.SIGINT, remember)
    try:
        yield answer
    finally:
        signal.signal(signal.SIGINT, usual)
