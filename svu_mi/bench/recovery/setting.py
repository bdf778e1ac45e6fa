"""One cell of the benchmark, and how a row of it is measured."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.captures import some_views, uneven_views
from svu_mi.bench.recovery.cells import Task
from svu_mi.bench.recovery.judge import Judge, Relit
from svu_mi.bench.recovery.measure import figures, run_warm
from svu_mi.bench.recovery.rows import Row
from svu_mi.bench.sizes import RecoverySizes
from svu_mi.bench.store import Store, key_of
from svu_mi.capture import Capture
from svu_mi.recovery.textures import lay_out
from svu_mi.surface import Texels, texels

Record = dict[str, Any]
PLACE = "recovery"  # folder of finished rows


@dataclass(frozen=True)
class Setting:
    """A cell, loaded only when a row is missing."""

    bench: Bench
    task: Task

    @property
    def sizes(self) -> RecoverySizes:
        """How large everything is, beside the photographs."""
        return self.bench.sizes.recovery

    @cached_property
    def store(self) -> Store:
        return Store(self.bench.folder / PLACE / self.task.name)

    def key(self, row: Row) -> str:
        """Key of a row's record, whatever the version of the code."""
        task = self.task
        cell = [(str(one.scene), one.defines) for one in (task.cell, task.relit)]
        size = self.bench.sizes
        photographs = (size.views, size.film, size.spp, size.texels, size.seed)
        return key_of(task.group, cell, photographs, asdict(self.sizes), asdict(row))

    def measure(self, row: Row) -> Record:
        """Recover, judge and relight; return the figures."""
        timed = run_warm(row, self.capture, self.grid, self.sizes)
        textures = timed.result.textures
        return {
            "cell": self.head,
            **figures(timed),
            **self.judge.judge(textures),
            "relit": self.relit.judge(textures),
        }

    @cached_property
    def capture(self) -> Capture:
        cell, size = self.task.cell, self.bench.sizes
        if self.task.group == "even":
            whole = self.bench.capture(cell)
            return some_views(whole, min(self.sizes.even_views, whole.count))
        dense = replace(size, views=self.sizes.dense_views)
        whole = self.bench.capture(cell, dense, f"capture_{dense.views}_views")
        return uneven_views(whole, self.sizes.front, self.sizes.back)

    @cached_property
    def grid(self) -> Texels:
        return texels(self.capture.mesh, self.bench.sizes.texels)

    @cached_property
    def judge(self) -> Judge:
        return Judge.of(self.capture, self.grid, self.sizes.poor)

    @cached_property
    def relit(self) -> Relit:
        sizes = self.sizes
        return Relit.of(self.capture, self.task.relit, sizes.relit_views, sizes.relit_spp)

    @cached_property
    def head(self) -> Record:
        """What holds for all rows: names, counts, and what the true textures themselves reach
        at this resolution under the other light."""
        task = self.task
        return {
            "group": task.group, "object": task.cell.object, "light": task.cell.light,
            "relit": task.relit.light, "views": self.capture.count, **self.judge.figures(),
            "truth_relit": self.relit.judge(lay_out(self.grid, self.judge.truth.values)),
        }  # fmt: skip
