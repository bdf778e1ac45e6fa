"""Deferral of Ctrl-C to the end of a step.

Within custom operations and recorded loops, Dr.Jit replaces a ``KeyboardInterrupt`` by another
exception. An interrupt that is raised while C++ calls Python is lost.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C until the yielded function is called; a second Ctrl-C acts at once.

    Yields:
        Function that raises the deferred ``KeyboardInterrupt``, if any. Nothing is deferred
        outside of the main thread, or if SIGINT has a handler other than Python's default.
    """
    pressed = False

    def remember(number: int, frame: object) -> None:
        nonlocal pressed
        del number, frame
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    def answer() -> None:
        if pressed:
            raise KeyboardInterrupt

    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield answer
        return
    signal.signal(signal.SIGINT, remember)
    try:
        yield answer
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
