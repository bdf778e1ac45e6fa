"""Defer Ctrl-C to the end of a step.

Within a custom operation or a recorded loop, Dr.Jit turns a ``KeyboardInterrupt`` into an error
of its own, and one that is raised while C++ calls Python is lost: nobody could tell that the user
has had enough.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until it is asked for; a second one comes through at once.

    Yields:
        A function that raises the ``KeyboardInterrupt`` if there was one. In threads other
        than the main one, or where Ctrl-C has another meaning, nothing is held back.
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
