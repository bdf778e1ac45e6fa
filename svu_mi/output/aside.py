"""Drawing beside other work: matplotlib, NumPy and Pillow in a thread, while kernels run."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import Thread
from typing import Any

# After so many seconds the thread lets the other one go on, which asks a hundred times a second
# when it launches small kernels, and would wait for Python's own 5 ms each time.
TURN = 5e-4
DRAWING = ("matplotlib.figure", "matplotlib.backends.backend_agg", "PIL.PngImagePlugin")

Aside = Callable[..., Future[Any]]
"""``aside(work, *arguments)`` has work done in the thread, after what it was given before."""


def import_aside() -> None:
    """Import what pages are drawn with in a thread, a third of a second that nobody waits for while
    kernels run."""

    def imported() -> None:
        before = sys.getswitchinterval()
        sys.setswitchinterval(TURN)
        try:
            with suppress(ImportError):  # whoever needs it will say so
                for name in DRAWING:
                    import_module(name)
        finally:
            sys.setswitchinterval(before)

    Thread(target=imported).start()


@contextmanager
def drawing_aside() -> Iterator[Aside]:
    """Give a thread for work that takes no Dr.Jit, which is not asked from two threads at once.

    It is one thread, as matplotlib can do no more. At the end of the block all of it is done, or
    the first error that was raised there is raised here. If the block itself fails, what has not
    begun is left out.
    """
    given: list[Future[Any]] = []
    before = sys.getswitchinterval()
    with ThreadPoolExecutor(1, "aside") as thread:

        def aside(work: Callable[..., Any], *arguments: Any) -> Future[Any]:
            for one in given:
                if one.done():
                    one.result()  # what has failed is said now, not when all else is done
            given.append(thread.submit(work, *arguments))
            return given[-1]

        sys.setswitchinterval(TURN)
        try:
            yield aside
            for one in given:
                one.result()
        except BaseException:
            thread.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            sys.setswitchinterval(before)
