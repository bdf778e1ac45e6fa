"""``svu bench``: accuracy and speed of the estimators."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from svu_mi.cli.inputs import Common, Output, say
from svu_mi.errors import OptionError
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.bench.cells import Cell
    from svu_mi.bench.orb.options import Options as OrbOptions
    from svu_mi.bench.recovery.options import Options

What = Annotated[
    Literal["accuracy", "checks", "speed", "kernels", "recovery", "guidance", "orb", "conventions",
            "all"],
    tyro.conf.Positional,
]  # fmt: skip
Names = Annotated[str, tyro.conf.arg(metavar="A,B,...")]


@dataclass(frozen=True, kw_only=True)
class Bench(Common):
    """Compare the estimators with a path-traced posterior, and time them.

    Writes bench.json, bench.md and plots. An interrupted run goes on where it stopped when
    the same command is given again.
    """

    what: What = "all"
    """accuracy: every object under every light; checks: what these comparisons take for granted,
    for some objects; speed: run times, of the first object and light; kernels: speed and error of
    each kernel, what skipping saves, scaling; all: these; recovery: textures recovered in every
    way, against the true ones; guidance: textures recovered from views chosen in every way, and
    the time that choosing takes; orb: textures recovered from the captures of Stanford-ORB, relit,
    against its photographs; conventions: how often svu check finds wrong axes."""
    output: Output = Path("out/bench")
    data: Path | None = None
    """Folder with objects/ and envmaps/; without it, the scenes of svu_mi. orb: the data set, with
    blender_HDR/ and ground_truth/; without it, these scenes in its layout."""
    objects: Names = ""
    """Objects to run; without it all (of svu_mi's: vase, knot and spheres). orb: captures, too."""
    lights: Names = ""
    """Lights to run; without it all."""
    quick: bool = False
    """Small pictures, few texels, main estimators; without --data two scenes, two lights."""
    main: bool = False
    """Only the main estimators, without the single switches."""
    fresh: bool = False
    """Compute finished cells anew."""
    rows: Names = ""
    """recovery, orb: ways of recovery to run; without it all, or (orb) those that trace no
    paths. conventions: ways that photographs come, such as COLMAP."""
    groups: Names = ""
    """recovery: even (photographs from everywhere), repeated, varied (from one side mostly, of
    materials that repeat or do not), costs (single steps); without it all."""
    keep: bool = False
    """recovery: take up results that another version of svu_mi found."""
    environment_view: str | None = None
    """orb: test photograph, such as 0003, whose environment map is the light of recovery; without
    it the first."""
    stored: bool = False
    """recovery: run nothing; make tables and plots of the results that are there."""

    def run(self, console: Console) -> int:
        """Run the benchmark."""
        from svu_mi.files import prepare_folder

        prepare_folder(self.output)
        self.start()
        from svu_mi.bench import accuracy, run_bench
        from svu_mi.bench.cells import FULL, QUICK
        from svu_mi.bench.orb import orb_lines
        from svu_mi.bench.variants import available

        bench = accuracy.Bench(
            self.output, QUICK if self.quick else FULL, Progress(console), fresh=self.fresh,
            quick=self.quick,
        )  # fmt: skip
        words = ["svu", *sys.argv[1:]]
        chosen = tuple(v for v in available() if v.main or not (self.main or self.quick))
        record = run_bench(
            bench, self._cells(), self.what, variants=chosen, recovery=self._recovery(),
            orb=self._orb(), ways=self._ways(), command=shlex.join(words),
        )  # fmt: skip
        for row in record["summary"]:
            if row["kind"] != "switch" and row["pearson"] is not None:
                line = f"{row['label']}: Pearson {row['pearson']['mean']:.2f}"
                say(console, line)
        for line in orb_lines(record["orb"]) if record["orb"] else ():
            say(console, line)
        parts = [record[name] or {} for name in ("kernels", "recovery", "guidance")]
        for bar in (bar for part in parts for bar in part.get("bars", ())):
            if not (bar["holds"] or self.quick):
                line = f"Missed: {bar['what']}: {bar['value']:.3g} {bar['unit']}"
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

    def _orb(self) -> OrbOptions | None:
        from svu_mi.bench.orb.options import Options

        if self.what != "orb":
            return None
        return Options(
            data=self.data, captures=names(self.objects, "--objects"),
            rows=names(self.rows, "--rows"), environment_view=self.environment_view,
        )  # fmt: skip

    def _ways(self) -> tuple[str, ...]:
        return names(self.rows, "--rows") if self.what == "conventions" else ()

    def _cells(self) -> tuple[Cell, ...]:
        from svu_mi.bench.cells import data_cells, own_cells

        if self.what == "orb":
            return ()
        objects, lights = names(self.objects, "--objects"), names(self.lights, "--lights")
        if self.data is None:
            return own_cells(objects, lights, quick=self.quick)
        return data_cells(self.data, self.output, objects, lights)


def names(words: str, option: str) -> tuple[str, ...]:
    """Return the names of a comma-separated list; none for an empty one.

    Raises:
        OptionError: an empty name.
    """
    found = tuple(word.strip() for word in words.split(",")) if words.strip() else ()
    if not all(found):
        raise OptionError(f"{option} takes names separated by commas, got {words!r}.")
    return found
