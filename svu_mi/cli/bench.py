"""``svu bench``: accuracy and speed of svu_mi."""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from svu_mi.bench import ALL, BENCHMARKS
from svu_mi.cli.base_command import BaseCommand
from svu_mi.cli.shared_options import Output, require_range
from svu_mi.cli.streams import print_line
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError

if TYPE_CHECKING:
    from svu_mi.bench.cases import Case
    from svu_mi.bench.study import Selection

What = Annotated[
    str, Positional,
    arg(metavar="[BENCHMARK]", help=f"Benchmark to run; all: {' and '.join(ALL)}, the fast ones."),
]  # fmt: skip
Photographs = Annotated[Path | None, Positional, arg(metavar="[CAPTURE]")]
Names = Annotated[str, arg(metavar="A,B,...")]


@dataclass(frozen=True, kw_only=True)
class Bench(BaseCommand):
    """Measure accuracy, calibration and speed.

    Writes STUDY.json, bench.md and plots. The same command continues an interrupted run.
    """

    first = "what capture output data objects lights rows quick fresh stored"
    output: Output = Path("out/bench")
    data: Path | None = None
    """Folder with objects/ and envmaps/, or Stanford-ORB (default: the included scenes)."""
    objects: Names = ""
    """Objects to run, such as vase,knot (default: all)."""
    lights: Names = ""
    """Lights to run (default: all)."""
    quick: bool = False
    """Use small images and few texels; without --data also two scenes and two lights only."""
    fresh: bool = False
    """Compute finished cases again."""
    keep: bool = False
    """Also reuse finished results of other versions of svu_mi."""
    stored: bool = False
    """Make tables and plots of existing results without new measurements."""
    what: What = "all"
    capture: Photographs = None
    """Capture folder or scene for the benchmark real (default: none)."""
    rows: Names = ""
    """Rows of the table to run: recovery, orb, paper (default: the usual ones)."""
    every: int = 5
    """real: every N-th photograph is held out, N at least 2."""
    environment_view: str | None = None
    """orb: test photograph whose environment map recovery takes as light (default: the first)."""

    def run(self, console: Console) -> int:
        """Run the benchmarks."""
        from svu_mi.bench.experiment import BenchRun
        from svu_mi.bench.problem_sizes import FULL, QUICK
        from svu_mi.bench.study import run_bench, study_of, without_folders
        from svu_mi.core.io.files import prepare_folder
        from svu_mi.core.validation import require_known

        require_known([self.what], (*BENCHMARKS, "all"), "benchmark")
        self._check_capture()
        prepare_folder(self.output)
        self.start()
        chosen = ALL if self.what == "all" else (self.what,)
        studies = {name: study_of(name) for name in chosen}
        on_cases = any(study.runs_on == "cases" for study in studies.values())
        words = [word for word in sys.argv[1:] if word not in ("--stored", "--keep", "--fresh")]
        command = without_folders(shlex.join(["svu", *words]))
        bench = BenchRun(
            self.output, QUICK if self.quick else FULL, Progress(console), quick=self.quick,
            fresh=self.fresh, keep=self.keep, stored=self.stored,
        )  # fmt: skip
        record = run_bench(bench, chosen, self._selection(on_cases), command)
        for name, study in studies.items():
            for line in study.lines(record[name]):
                print_line(console, line)
            for bar in record[name]["bars"]:
                if not (bar["holds"] or self.quick):
                    print_line(console, "Missed: {what}: {value:.3g} {unit}".format(**bar))
        print_line(console, f"Wrote {self.output}")
        return 0

    def _selection(self, on_cases: bool) -> "Selection":
        """Return the selected cases (objects under lights), rows and capture."""
        from svu_mi.bench.cases import chosen_cases
        from svu_mi.bench.study import Selection

        objects = parse_names(self.objects, "--objects")
        lights = parse_names(self.lights, "--lights")
        cases: tuple[Case, ...] = ()
        if on_cases:
            cases = chosen_cases(self.data, self.output, objects, lights, quick=self.quick)
        return Selection(
            cases=cases, data=self.data, objects=objects, rows=parse_names(self.rows, "--rows"),
            capture=self.capture, every=self.every, environment_view=self.environment_view,
        )  # fmt: skip

    def _check_capture(self) -> None:
        """Require a capture for ``real``, and refuse it for other benchmarks."""
        if self.what != "real":
            if self.capture is not None:
                raise OptionError(
                    f"svu bench {self.what} runs on scenes, not on {self.capture}; omit the path, "
                    "or use svu bench real."
                )
            return
        if self.capture is None:
            raise OptionError("svu bench real needs a capture: svu bench real FOLDER.")
        if not self.capture.exists():
            raise CaptureError(f"{self.capture}: no such file or folder; give a capture.")
        require_range("--every", self.every, 2)


LISTED = "; ".join(f"{name}: {text}" for name, text in BENCHMARKS.items())
Bench.__doc__ = f"{Bench.__doc__}\n\n    Benchmarks: {LISTED}."


def parse_names(words: str, option: str) -> tuple[str, ...]:
    """Return the names of a comma-separated list; an empty tuple for an empty text."""
    values = tuple(word.strip() for word in words.split(",")) if words.strip() else ()
    if not all(values):
        raise OptionError(f"{option} takes names separated by commas, got {words!r}.")
    return values
