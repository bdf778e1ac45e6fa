"""Beside other work, in a thread: drawing, and importing what is needed later."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import Lock, Thread
from typing import Any

# After so many seconds the thread lets the other one go on, which asks a hundred times a second
# when it launches small kernels, and would wait for Python's own 5 ms each time.
TURN = 5e-4
SCIENCE = ("scipy.spatial", "scipy.special", "scipy.ndimage")  # which SciPy loads when it must
DRAWING = ("matplotlib.figure", "matplotlib.backends.backend_agg", "PIL.PngImagePlugin")

Aside = Callable[..., Future[Any]]
"""``aside(work, *arguments)`` has work done in the thread, after what it was given before."""


@contextmanager
def _short_turns() -> Iterator[None]:
    """Let threads take turns of ``TURN`` until the last of those is done that have asked for it."""
    with _turns.lock:
        if not _turns.asked:
            _turns.before = sys.getswitchinterval()
            sys.setswitchinterval(TURN)
        _turns.asked += 1
    try:
        yield
    finally:
        with _turns.lock:
            _turns.asked -= 1
            if not _turns.asked:
                sys.setswitchinterval(_turns.before)


class _Turns:
    def __init__(self) -> None:
        self.lock, self.asked, self.before = Lock(), 0, 0.0


_turns = _Turns()


def import_aside(*names: str) -> None:
    """Import modules in a thread: half a second of one processor, while photographs are decoded and
    kernels run."""

    def imported() -> None:
        with _short_turns(), suppress(Exception):  # whoever needs it will say so
            for name in names:
                import_module(name)

    with suppress(RuntimeError):  # no more threads
        Thread(target=imported).start()


@contextmanager
def drawing_aside() -> Iterator[Aside]:
    """Give a thread for work that takes no Dr.Jit, which is not asked from two threads at once.

    It is one thread, as matplotlib can do no more. At the end of the block all of it is done, or
    the first error that was raised there is raised here. If the block itself fails, what has not
    begun is left out.
    """
    given: list[Future[Any]] = []
    with _short_turns(), ThreadPoolExecutor(1, "aside") as thread:

        def aside(work: Callable[..., Any], *arguments: Any) -> Future[Any]:
            for one in given:
                if one.done():
                    one.result()  # what has failed is said now, not when all else is done
            given.append(thread.submit(work, *arguments))
            return given[-1]

        try:
            yield aside
            for one in given:
                one.result()
        except BaseException:
            thread.shutdown(wait=False, cancel_futures=True)
            raise
