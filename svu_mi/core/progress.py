"""Stages of a run: their times, compiled kernels, and progress bars.

A stage measures its time with the device synchronised at both ends, counts the kernels that were
compiled in it, and is shown on a console, if one is given:

    progress = Progress(Console())        # or Progress(): measures, shows nothing
    with progress.stage("Gathering radiance") as stage:
        stage.update(3, 10)                          # optional: turns the spinner into a bar
    progress.timings                                 # {"Gathering radiance": 0.41}, seconds

On a terminal (or in a notebook) a stage is a live line, replaced by one plain line when it
ends; in a log file there is only that plain line, and one every ``PERIOD`` of a long stage.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from rich import progress as rich
from rich.console import Console
from rich.text import Text

from svu_mi.errors import printable

COMPILING = "compiling kernels (first run only)"
PATIENCE = 2.0  # seconds of silence after which a stage says that it may be compiling
PERIOD = 30.0  # seconds between lines about a stage in a log


class Stage:
    """One running stage: a task of rich's bar on a terminal, or lines of a log (``say``)."""

    def __init__(
        self, bar: Any = None, task: Any = None, say: Callable[[str], None] | None = None
    ) -> None:
        self._bar, self._task, self._say = bar, task, say
        self._last = time.monotonic()

    def update(self, done: int, total: int) -> None:
        """Show ``done`` of ``total`` steps; fits as a ``(done, total)`` callback."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total, state="")
        elif self._say is not None and time.monotonic() - self._last >= PERIOD and done < total:
            self._say(f"{done}/{total}")
            self._last = time.monotonic()

    def state(self, text: str) -> None:
        """Show what the stage is waiting for, until the next ``update``."""
        if self._bar is not None:
            self._bar.update(self._task, state=text)


class Progress:
    """Times the stages of a run; shows them if it was given a console.

    A stage that runs twice adds up; one that fails is shown but not recorded. Stages may be
    nested: only the outermost is live, and the inner one's time is part of both.

    Attributes:
        timings: seconds per stage, in the order they first ended.
        kernels: number of kernels compiled per stage, as opposed to found in the cache; a
            run in which all are 0 was warm.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.timings: dict[str, float] = {}
        self.kernels: dict[str, int] = {}
        self._console = console
        self._live = False

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """Run a stage: ``with progress.stage("Fitting spectra"): ...``.

        Args:
            name: what is being done; the key in ``timings`` and ``kernels``.
            total: number of steps, if it is known before the first ``update``.
        """
        # Dr.Jit runs ahead: without this, a stage would pay for its predecessor.
        _synchronize()
        compiled, start = compiled_kernels(), time.perf_counter()
        try:
            with self._shown(name, total) as stage:
                yield stage
                _synchronize()
        except BaseException:
            self.say(f"{name}: failed after {time.perf_counter() - start:.2f} s")
            raise
        seconds, built = time.perf_counter() - start, compiled_kernels() - compiled
        self.timings[name] = self.timings.get(name, 0.0) + seconds
        self.kernels[name] = self.kernels.get(name, 0) + built
        note = f", {built} kernel{'s' if built > 1 else ''} compiled" if built else ""
        self.say(f"{name}: {seconds:.2f} s{note}")

    def say(self, line: str) -> None:
        """Print a line of its own, if there is a console."""
        if self._console is None:
            return
        # Nobody may read any more, which rich ends the process for.
        with suppress(OSError, ValueError, SystemExit):
            # Soft wrap: a log has no width, and a name may hold [brackets].
            self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    @contextmanager
    def _shown(self, name: str, total: int | None) -> Iterator[Stage]:
        if self._console is None or self._live:
            yield Stage()
            return
        if not _can_redraw(self._console):
            yield Stage(say=lambda text: self.say(f"{name}: {text}"))
            return
        self._live = True
        try:
            with _bar(self._console) as bar:
                yield Stage(bar, bar.add_task(printable(name), total=total, state=None))
        finally:
            self._live = False


def _can_redraw(console: Console) -> bool:
    return (console.is_terminal and not console.is_dumb_terminal) or console.is_jupyter


def _bar(console: Console) -> Any:

    class Steps(rich.ProgressColumn):
        """Steps, and the stage's own word; after a silence, the likely reason."""

        def render(self, task: rich.Task) -> Text:
            steps = "" if task.total is None else f"{task.completed:.0f}/{task.total:.0f} "
            silent = task.completed == 0 and (task.elapsed or 0.0) > PATIENCE
            text = task.fields["state"]
            return Text(steps + printable(COMPILING if text is None and silent else text or ""))

    return rich.Progress(
        rich.SpinnerColumn("dots" if console.encoding.startswith("utf") else "line"),
        rich.TextColumn("{task.description}", markup=False), rich.BarColumn(bar_width=24),
        rich.TimeElapsedColumn(), Steps(), console=console, transient=True,
    )  # fmt: skip


def _synchronize() -> None:
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.sync_thread()


def compiled_kernels() -> int:
    """Return the number of kernels this process has compiled: launches found in no cache."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return 0
    _launches, _from_disk, compiled = drjit.detail.launch_stats()
    return int(compiled)
