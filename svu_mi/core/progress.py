"""Stages of a run: times, compiled kernels, progress bars.

A stage measures its time with the device synchronised at both ends, counts the compiled kernels,
and shows its progress if there is a console:

    progress = Progress(Console())        # Progress() measures silently
    with progress.stage("Gathering radiance") as stage:
        stage.update(3, 10)                          # optional: turns the spinner into a bar
    progress.timings                                 # {"Gathering radiance": 0.41}, seconds

On a terminal or in a notebook, a stage is a live line, which is replaced by a plain line at the
end. A log file contains only the plain line, and another one every ``PERIOD`` of a long stage.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from rich import progress as rich
from rich.console import Console
from rich.table import Column
from rich.text import Text

from svu_mi.errors import printable

COMPILING = "first run: compiling kernels"
PATIENCE = 2.0  # seconds without an update after which ``COMPILING`` is shown in such a run
PERIOD = 30.0  # seconds between two lines of one stage in a log


class Stage:
    """Running stage: a task of a progress bar on a terminal, or lines of a log (``say``)."""

    def __init__(
        self, bar: Any = None, task: Any = None, say: Callable[[str], None] | None = None
    ) -> None:
        self._bar, self._task, self._say = bar, task, say
        self._last = time.monotonic()

    def update(self, done: int, total: int) -> None:
        """Show ``done`` of ``total`` steps; usable as a ``(done, total)`` callback."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total, state="")
        elif self._say is not None and time.monotonic() - self._last >= PERIOD and done < total:
            self._say(f"{done}/{total}")
            self._last = time.monotonic()

    def state(self, text: str) -> None:
        """Show a status text until the next ``update``."""
        if self._bar is not None:
            self._bar.update(self._task, state=text)


class Progress:
    """Recorder of the stages of a run, which shows them if there is a console.

    Times of stages with the same name are added. A stage that fails is shown but not recorded.
    Stages may be nested: only the outermost is live, and an inner time is included in both.

    Attributes:
        timings: seconds per stage, ordered by the first end of each stage.
        kernels: number of kernels compiled per stage, excluding those found in the cache; all
            are 0 in a warm run.
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
            name: label of the stage, also its key in ``timings`` and ``kernels``.
            total: number of steps, if known before the first ``update``.
        """
        # Dr.Jit is asynchronous: finish the work of earlier stages before the clock starts.
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
        """Print a line if there is a console."""
        if self._console is None:
            return
        # If the reader has closed the pipe, rich raises SystemExit.
        with suppress(OSError, ValueError, SystemExit):
            # Soft wrap: a log has no width. No markup: names may contain [brackets].
            self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    @contextmanager
    def _shown(self, name: str, total: int | None) -> Iterator[Stage]:
        if self._console is None or self._live:
            yield Stage()
            return
        is_dumb = self._console.is_dumb_terminal or not self._console.is_terminal
        if is_dumb and not self._console.is_jupyter:
            yield Stage(say=lambda text: self.say(f"{name}: {text}"))
            return
        self._live = True
        try:
            with _bar(self._console, compiled_kernels() > 0) as bar:
                yield Stage(bar, bar.add_task(printable(name), total=total, state=None))
        finally:
            self._live = False


def _bar(console: Console, is_first_run: bool) -> Any:

    class Steps(rich.ProgressColumn):
        """Steps and status text; ``COMPILING`` if the first step of a first run takes long."""

        def render(self, task: rich.Task) -> Text:
            steps = "" if task.total is None else f"{task.completed:.0f}/{task.total:.0f} "
            silent = is_first_run and task.completed == 0 and (task.elapsed or 0.0) > PATIENCE
            text = task.fields["state"]
            shown = printable(COMPILING if text is None and silent else text or "")
            return Text(steps + shown, overflow="ellipsis", no_wrap=True)

    return rich.Progress(
        rich.SpinnerColumn("dots" if console.encoding.startswith("utf") else "line"),
        rich.TextColumn("{task.description}", markup=False), rich.BarColumn(bar_width=24),
        rich.TimeElapsedColumn(), Steps(Column(no_wrap=True)), console=console, transient=True,
    )  # fmt: skip


def _synchronize() -> None:
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.sync_thread()


def compiled_kernels() -> int:
    """Return the number of kernels that this process has compiled, not found in a cache."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return 0
    _launches, _from_disk, compiled = drjit.detail.launch_stats()
    return int(compiled)
