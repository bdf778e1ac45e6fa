"""``svu bench``: accuracy and speed of svu_mi."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

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
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar=f"{{{','.join((*BENCHMARKS, 'all'))}}}",
        help=f"{'; '.join(f'{name}: {does}' for name, does in BENCHMARKS.items())}; all: "
        f"{' and '.join(ALL)}.",
    ),
]
Photographs = Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[CAPTURE]")]
Names = Annotated[str, tyro.conf.arg(metavar="A,B,...")]


@dataclass(frozen=True, kw_only=True)
class Bench(BaseCommand):
    """Measure accuracy, calibration and speed.

    Writes bench.json, bench.md and plots. The same command continues an interrupted run.
    """

    output: Output = Path("out/bench")
    data: Path | None = None
    """Folder with objects/ and envmaps/, or of Stanford-ORB; without it, the scenes of svu_mi."""
    objects: Names = ""
    """Objects to run; without it all (of svu_mi's: vase, knot and spheres)."""
    lights: Names = ""
    """Lights to run; without it all."""
    quick: bool = False
    """Small pictures, few texels; without --data two scenes, two lights."""
    fresh: bool = False
    """Compute finished cases again."""

    keep: bool = False
    """Reuse finished results of other versions of svu_mi, too."""
    stored: bool = False
    """Measure nothing; make tables and plots of existing results."""
    what: What = "all"
    capture: Photographs = None
    """real: the capture's folder, or its scene."""
    rows: Names = ""
    """recovery, orb, paper: rows to run; without it the usual ones."""
    every: int = 5
    """real: of the photographs, each so many-th is left out."""
    environment_view: str | None = None
    """orb: test photograph whose environment map is the light of recovery; without it the first."""

    def run(self, console: Console) -> int:
        """Run the benchmarks."""
        from svu_mi.bench.experiment import BenchRun
        from svu_mi.bench.problem_sizes import FULL, QUICK
        from svu_mi.bench.study import run_bench, study_of
        from svu_mi.core.io.files import prepare_folder
        from svu_mi.core.validation import require_known

        require_known([self.what], (*BENCHMARKS, "all"), "benchmark")
        self._check_capture()
        prepare_folder(self.output)
        self.start()
        chosen = ALL if self.what == "all" else (self.what,)
        studies = {name: study_of(name) for name in chosen}
        on_cases = any(study.runs_on == "cases" for study in studies.values())
        command = shlex.join(["svu", *sys.argv[1:]])
        bench = BenchRun(
            self.output, QUICK if self.quick else FULL, Progress(console), quick=self.quick,
            fresh=self.fresh, keep=self.keep, stored=self.stored,
        )  # fmt: skip
        record = run_bench(bench, chosen, self._selection(on_cases), command)
        for name, study in studies.items():
            for line in (*study.lines(record[name]), *self._missed(record[name])):
                print_line(console, line)
        print_line(console, f"Wrote {self.output}")
        return 0

    def _selection(self, on_cases: bool) -> Selection:
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

    def _missed(self, record: dict[str, Any]) -> list[str]:
        """Return a line for each missed target of a record; none for quick sizes."""
        return [
            f"Missed: {bar['what']}: {bar['value']:.3g} {bar['unit']}"
            for bar in record["bars"]
            if not (bar["holds"] or self.quick)
        ]

    def _check_capture(self) -> None:
        """Require a capture for ``real``, and refuse it for other benchmarks."""
        if self.what != "real":
            if self.capture is not None:
                raise OptionError(
                    f"svu bench {self.what} runs on scenes, not on {self.capture}; omit it, or use "
                    "svu bench real."
                )
            return
        if self.capture is None:
            raise OptionError("svu bench real needs a capture: svu bench real FOLDER.")
        if not self.capture.exists():
            raise CaptureError(f"{self.capture}: no such file or folder; give a capture.")
        require_range("--every", self.every, 2)


def parse_names(words: str, option: str) -> tuple[str, ...]:
    """Return the names of a comma-separated list; none for an empty one."""
    values = tuple(word.strip() for word in words.split(",")) if words.strip() else ()
    if not all(values):
        raise OptionError(f"{option} takes names separated by commas, none empty, got {words!r}.")
    return values
