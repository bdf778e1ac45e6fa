"""``svu batch``: process many captures."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from rich.console import Console
from tyro.conf import Positional, arg

from svu_mi.cli.base_command import BaseCommand, interruptible
from svu_mi.cli.shared_options import Output, Size, parse_size, require_range
from svu_mi.cli.streams import print_line
from svu_mi.core.io.folder_exchange import locked
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError

if TYPE_CHECKING:
    from svu_mi.cli.batch.runner import BatchRunner, Outcome

Address = Annotated[str, arg(metavar="ADDRESS")]
FAILED = 1  # exit status if a capture failed
StepName = Literal["entropy", "recover", "report", "export"]
Steps = Annotated[tuple[StepName, ...], arg(metavar="{entropy,recover,report,export} ...")]


@dataclass(frozen=True, kw_only=True)
class Batch(BaseCommand):
    """Process many captures, with an overview page.

    Each capture gets a folder with entropy, recovered, report.html and asset. The same command
    continues an interrupted batch, and updates changed captures. The exit status is 1 if a
    capture fails.
    """

    uses_matplotlib: ClassVar[bool] = False
    first = "captures output steps resolution preset workers scheduler"
    captures: Annotated[Path, Positional, arg(metavar="FOLDER | LIST.csv")]
    """Folder of capture folders; or a table with the column capture and optional columns name,
    resolution, preset, light, images and shape."""
    output: Output = Path("out/batch")
    steps: Steps = ("entropy", "recover", "report", "export")
    """Commands to run on each capture; export needs recover."""
    workers: int = 1
    """Captures processed at the same time, at least 1, which share threads and memory."""
    scheduler: Address = ""
    """Dask scheduler, such as tcp://10.0.0.5:8786; each worker processes one capture at a time and
    needs access to the same files (default: this machine)."""
    resolution: Size = ()
    """Texels per side, or width and height, if not in the table (default: of each command)."""
    preset: Literal["default", "fixed", "fast", "paper"] | None = None
    """Preset of entropy and report, if not in the table (default: default)."""

    def run(self, console: Console) -> int:
        """Process all captures, and update the page after each."""
        from svu_mi.cli.batch.batch_page import write_index
        from svu_mi.cli.batch.capture_list import read_list, require_separate

        runner, items = self._runner(), read_list(self.captures)
        require_separate(self.output, items)
        self.output.mkdir(parents=True, exist_ok=True)
        outcomes: list[Outcome] = []

        def stopped() -> str:
            return (
                f"Interrupted after {len(outcomes)} of {len(items)} captures; continue with the "
                "same command."
            )

        with locked(self.output.resolve()):
            progress = Progress(console)
            work = partial(runner.run_on_cluster, self.scheduler) if self.scheduler else runner.run
            with interruptible(stopped), progress.stage("Processing captures", len(items)) as stage:
                for outcome in work(items):
                    outcomes.append(outcome)
                    write_index(self.output, outcomes, len(items) - len(outcomes))
                    stage.update(len(outcomes), len(items))
                    if outcome.sentence:
                        print_line(console, f"{outcome.name}: {outcome.sentence}")
        failed = sum(bool(outcome.sentence) for outcome in outcomes)
        print_line(console, f"Wrote {self.output / 'index.html'}")
        print_line(console, _summary(outcomes, failed))
        return FAILED if failed else 0

    def _runner(self) -> BatchRunner:
        """Return the runner with these options."""
        from svu_mi.cli.batch.runner import BatchRunner
        from svu_mi.cli.batch.steps import STEPS

        require_range("--workers", self.workers, 1)
        if self.scheduler and self.workers > 1:
            raise OptionError(
                "--workers has no effect with --scheduler, which has its own workers; omit it."
            )
        if "export" in self.steps and "recover" not in self.steps:
            raise OptionError("--steps export needs the textures of recover; add recover.")
        options: dict[str, str] = {} if self.preset is None else {"preset": self.preset}
        if self.resolution:
            width, height = parse_size(self.resolution)
            options["resolution"] = f"{width} {height}"
        from svu_mi.core.threads import FEWEST_THREADS

        threads = self.threads or max((os.cpu_count() or 1) // self.workers, FEWEST_THREADS)
        words = ["--trust"] if self.trust else []
        if self.threads or not self.scheduler:  # cluster workers have their own threads
            words += ["-t", str(threads)]
        return BatchRunner(
            output=self.output, steps=[name for name in STEPS if name in self.steps],
            workers=self.workers, variant=self.variant, words=tuple(words), options=options,
        )  # fmt: skip


def _summary(outcomes: list[Outcome], failed: int) -> str:
    """Return a summary such as "11 of 12 captures done, 2 steps made; failed: ..."."""
    made = sum(outcome.steps_run for outcome in outcomes)
    done = f"{len(outcomes) - failed} of {len(outcomes)} captures done, {made} steps made"
    entropies = [o.figures["entropy"] for o in outcomes if "entropy" in o.figures]
    if entropies:
        done += f"; mean entropy {min(entropies):.2f} to {max(entropies):.2f}"
    names = ", ".join(outcome.name for outcome in outcomes if outcome.sentence)
    return f"{done}; failed: {names}." if failed else f"{done}."
