"""What a run is doing, and how long each stage took.

Dr.Jit compiles and launches when an array is evaluated, and shows nothing of it. A stage
measures its own time with the device synchronised at both ends, counts the kernels that
were compiled in it, and, with a console, shows a spinner or a bar.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import TaskID

COMPILING = "compiling kernels (first run only)"


class Stage:
    """One running stage; ``update`` moves its bar."""

    def __init__(self, bar: Bar | None = None, task: TaskID | None = None) -> None:
        self._bar, self._task = bar, task

    def update(self, done: int, total: int) -> None:
        """Show ``done`` of ``total`` steps."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=total, state="")

    def state(self, text: str) -> None:
        """Show a word on what the stage is waiting for."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, state=text)


class Progress:
    """Times stages; shows them if it was given a console.

    Attributes:
        timings: seconds per stage, in the order they ran.
        kernels: number of kernels compiled (not found in the cache) per stage.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.timings: dict[str, float] = {}
        self.kernels: dict[str, int] = {}
        self._console = console

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """Run a stage: ``with progress.stage("Fitting spectra"): ...``."""
        _synchronize()
        compiled = _compiled()
        start = time.perf_counter()
        with self._show(name) as shown:
            yield shown
            _synchronize()
        seconds = time.perf_counter() - start
        self.timings[name] = self.timings.get(name, 0.0) + seconds
        self.kernels[name] = self.kernels.get(name, 0) + _compiled() - compiled
        if self._console is not None:
            built = self.kernels[name]
            note = f", {built} kernel{'s' if built > 1 else ''} compiled" if built else ""
            self._console.print(f"{name}: {seconds:.2f} s{note}", highlight=False)

    @contextmanager
    def _show(self, name: str) -> Iterator[Stage]:
        if self._console is None or not self._console.is_terminal:
            yield Stage()
            return
        from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        columns = (
            SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24),
            TimeElapsedColumn(), TextColumn("[dim]{task.fields[state]}"),
        )  # fmt: skip
        with Bar(*columns, console=self._console, transient=True) as bar:
            yield Stage(bar, bar.add_task(name, total=None, state=COMPILING))


def _synchronize() -> None:
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.sync_thread()


def _compiled() -> int:
    """Number of kernels this process has compiled: launches found in no cache."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return 0
    return int(drjit.detail.launch_stats()[2])
