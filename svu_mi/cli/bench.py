"""``svu bench``: accuracy and speed of the estimators."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from svu_mi.cli.inputs import Common, Output, say
from svu_mi.errors import OptionError
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.bench import accuracy
    from svu_mi.bench.cells import Cell
    from svu_mi.bench.recovery.options import Options

What = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(metavar="{accuracy,checks,speed,recovery,guidance,all}"),
]
# Developers run these, in a clone of the sources.
MOVED = {"kernels": "studies.kernels", "conventions": "studies.conventions", "orb": "studies.orb",
         "stability": "extremes"}  # fmt: skip
Names = Annotated[str, tyro.conf.arg(metavar="A,B,...")]


@dataclass(frozen=True, kw_only=True)
class Measured(Common):
    """Options of all benchmarks: what is run, how large, and where results go."""

    output: Output = Path("out/bench")
    data: Path | None = None
    """Folder with objects/ and envmaps/; without it, the scenes of svu_mi."""
    objects: Names = ""
    """Objects to run; without it all (of svu_mi's: vase, knot and spheres)."""
    lights: Names = ""
    """Lights to run; without it all."""
    quick: bool = False
    """Small pictures, few texels, main estimators; without --data two scenes, two lights."""
    fresh: bool = False
    """Compute finished cells anew."""

    def bench(self, console: Console) -> accuracy.Bench:
        """Return where and how the benchmark runs, once the variant is set."""
        from svu_mi.bench.accuracy import Bench
        from svu_mi.bench.sizes import FULL, QUICK

        sizes = QUICK if self.quick else FULL
        return Bench(self.output, sizes, Progress(console), fresh=self.fresh, quick=self.quick)

    def cells(self) -> tuple[Cell, ...]:
        """Return the objects under the lights that are asked for."""
        from svu_mi.bench.cells import chosen_cells

        objects, lights = names(self.objects, "--objects"), names(self.lights, "--lights")
        return chosen_cells(self.data, self.output, objects, lights, quick=self.quick)

    def missed(self, record: dict[str, Any] | None) -> list[str]:
        """Return a line for each bar of a record that is not met; quick sizes have none to meet."""
        return [
            f"Missed: {bar['what']}: {bar['value']:.3g} {bar['unit']}"
            for bar in (record or {}).get("bars", ())
            if not (bar["holds"] or self.quick)
        ]


@dataclass(frozen=True, kw_only=True)
class Bench(Measured):
    """Compare the estimators with a path-traced posterior, and time them.

    Writes bench.json, bench.md and plots. An interrupted run goes on where it stopped when
    the same command is given again.
    """

    what: What = "all"
    """accuracy: every object under every light; checks: what these comparisons take for granted,
    for some objects; speed: run times, of the first object and light; all: these; recovery:
    textures recovered in every way, against the true ones; guidance: textures recovered from views
    chosen in every way, and the time that choosing takes."""
    main: bool = False
    """Only the main estimators, without the single switches."""
    rows: Names = ""
    """recovery: ways of recovery to run; without it all."""
    groups: Names = ""
    """recovery: even (photographs from everywhere), repeated, varied (from one side mostly, of
    materials that repeat or do not), costs (single steps); without it all."""
    keep: bool = False
    """recovery: take up results that another version of svu_mi found."""
    stored: bool = False
    """recovery: run nothing; make tables and plots of the results that are there."""

    def run(self, console: Console) -> int:
        """Run the benchmark."""
        from svu_mi.bench.run import WHAT, run_bench
        from svu_mi.bench.variants import available
        from svu_mi.files import prepare_folder
        from svu_mi.settings import require_known

        if self.what in MOVED:
            raise OptionError(
                f"svu bench {self.what} is no longer part of svu; in a clone of its sources, run "
                f"PYTHONPATH=tests python -m {MOVED[self.what]}."
            )
        require_known([self.what], WHAT, "benchmark")
        prepare_folder(self.output)
        self.start()
        words = ["svu", *sys.argv[1:]]
        chosen = tuple(v for v in available() if v.main or not (self.main or self.quick))
        record = run_bench(
            self.bench(console), self.cells(), self.what, variants=chosen,
            recovery=self._recovery(), command=shlex.join(words),
        )  # fmt: skip
        for row in record["summary"]:
            if row["kind"] != "switch" and row["pearson"] is not None:
                line = f"{row['label']}: Pearson {row['pearson']['mean']:.2f}"
                say(console, line)
        for line in self.missed(record["recovery"]) + self.missed(record["guidance"]):
            say(console, line)
        say(console, f"Wrote {self.output}")
        return 0

    def _recovery(self) -> Options:
        from svu_mi.bench.recovery.options import PARTS, Options

        groups = names(self.groups, "--groups") or PARTS
        return Options(
            data=self.data, rows=names(self.rows, "--rows"), groups=groups, keep=self.keep,
            stored=self.stored,
        )  # fmt: skip


def names(words: str, option: str) -> tuple[str, ...]:
    """Return the names of a comma-separated list; none for an empty one.

    Raises:
        OptionError: an empty name.
    """
    found = tuple(word.strip() for word in words.split(",")) if words.strip() else ()
    if not all(found):
        raise OptionError(f"{option} takes names separated by commas, got {words!r}.")
    return found
