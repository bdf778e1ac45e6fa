"""``svu bench recovery``: textures recovered from photographs, against the true ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from svu_mi.bench.captures import some_views
from svu_mi.bench.cases import Cell, chosen_cells
from svu_mi.bench.experiment import Bench, Experiment, OnCell, Record
from svu_mi.bench.problem_sizes import RecoverySizes
from svu_mi.bench.recovery.methods import Row, choose_rows
from svu_mi.bench.recovery.scores import Judge, Relit
from svu_mi.bench.recovery.tables import draw_recovery, find_bars, recovery_tables
from svu_mi.bench.study import Asked, Study
from svu_mi.bench.timing import Timed, warm
from svu_mi.capture import Capture
from svu_mi.errors import OptionError
from svu_mi.progress import Progress
from svu_mi.recovery.textures import lay_out
from svu_mi.surface import Texels

BRIEF = 4  # steps after which all kernels are compiled


@dataclass(frozen=True)
class Recovered(OnCell):
    """A cell, loaded only when a row is missing.

    Attributes:
        cell: object and the light of the photographs, which are from everywhere.
        relit_as: returns the same object under a light not used for recovery.
        rows: ways of recovery.
    """

    relit_as: Callable[[], Cell]
    rows: Sequence[Row]

    @property
    def sizes(self) -> RecoverySizes:
        """How large everything is, beside the photographs."""
        return self.bench.sizes.recovery

    def settings(self, row: Row | None) -> Any:
        cells = [(str(one.scene), one.defines) for one in (self.cell, self.other)]
        size = self.bench.sizes
        photographs = (size.views, size.film, size.spp, size.texels, size.seed)
        return cells, photographs, asdict(self.sizes), row and asdict(row)

    def head(self) -> Record:
        """Return what holds for all rows: names, counts, and what the true textures themselves
        reach at this resolution under the other light."""
        return {
            "object": self.cell.object, "light": self.cell.light, "relit": self.other.light,
            "views": self.capture.count, **self.judge.figures(),
            "truth_relit": self.relit.judge(lay_out(self.layout, self.judge.truth.values)),
        }  # fmt: skip

    def measure(self, row: Row) -> Record:
        """Recover, judge and relight; return the figures."""
        timed = run_warm(row, self.capture, self.layout, self.sizes)
        textures = timed.result.textures
        relit = self.relit.judge(textures)
        return {**figures(timed), **self.judge.judge(textures), "relit": relit}

    @cached_property
    def other(self) -> Cell:
        """The same object under another light."""
        return self.relit_as()

    @cached_property
    def capture(self) -> Capture:
        """The photographs."""
        whole = self.bench.capture(self.cell)
        return some_views(whole, min(self.sizes.even_views, whole.count))

    @cached_property
    def judge(self) -> Judge:
        """What textures are held against."""
        return Judge.of(self.capture, self.layout, self.sizes.poor)

    @cached_property
    def relit(self) -> Relit:
        """What pictures under the other light are held against."""
        sizes = self.sizes
        return Relit.of(self.capture, self.other, sizes.relit_views, sizes.relit_spp)


def under_another_light(cell: Cell, data: Path | None, workspace: Path) -> Cell:
    """Return the same object under the light after the cell's, in the order of all lights.

    Args:
        cell: object and light.
        data: folder the cell comes from, None for the scenes of svu_mi.
        workspace: for objects that have to be converted.

    Raises:
        OptionError: there is one light only.
    """
    around = chosen_cells(data, workspace, [cell.object])
    lights = [one.light for one in around]
    if len(lights) < 2:
        raise OptionError(
            f"{cell.title}: there is no second light to relight the object with; add another "
            "image to envmaps/."
        )
    return around[(lights.index(cell.light) + 1) % len(lights)]


def run_warm(row: Row, capture: Capture, grid: Texels, sizes: RecoverySizes) -> Timed:
    """Recover textures with compiled kernels.

    Kernels are compiled by a brief run that does not count. A row that takes longer than
    ``sizes.long_s`` is timed once.
    """
    run = partial(row.recover, capture, grid, sizes.scale)
    if not sizes.warm:
        return warm(run, sizes.repeats, long_s=0)
    row.recover_in(BRIEF, capture, grid, Progress())
    return warm(run, sizes.repeats, sizes.long_s)


def figures(timed: Timed) -> Record:
    """Return what is kept of a run of ``run_warm`` itself."""
    return {
        "seconds": timed.seconds,
        "runs": timed.runs,
        "compiled": timed.compiled,
        "steps": len(timed.result.losses),
        "timings": timed.timings,
    }


def _experiment(bench: Bench, asked: Asked) -> Experiment:
    sizes = bench.sizes.recovery
    rows = choose_rows(asked.rows or sizes.rows)
    subjects = (
        Recovered(bench, cell, partial(under_another_light, cell, asked.data, bench.folder), rows)
        for cell in asked.cells[: sizes.even_cells]
    )
    return Experiment("recovery", subjects)


STUDY = Study(
    title="Recovery of textures", experiment=_experiment, tables=recovery_tables, bars=find_bars,
    note="PSNR: means over the cells that have both rows. Times: medians over cells of ratios.",
    plots={"recovery": draw_recovery},
)  # fmt: skip
