"""What single steps of recovery cost: sharing, many views, and a long run's memory and kernels.

    PYTHONPATH=tests python -m studies.recovery_steps [--quick] [--data FOLDER] [--objects A]
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from studies import clock
from studies.command import Command, main
from studies.watching import Watch, describe_marks, step_seconds
from svu_mi.bench.captures import some_views
from svu_mi.bench.clock import once
from svu_mi.bench.experiment import Experiment, OnCell, Part, Record
from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.recovery.rows import PATH, SH, SH_PAPER, find_row
from svu_mi.bench.study import Study
from svu_mi.bench.text import Bar, Column, columns, digits, seconds
from svu_mi.capture import Capture, load_capture
from svu_mi.pipeline import estimate
from svu_mi.posterior import CalibratedPosterior
from svu_mi.posterior.object_prior import shared
from svu_mi.recovery.path.objective import path_objective
from svu_mi.recovery.regularized import Rule, each
from svu_mi.recovery.sh.objective import Pull
from svu_mi.recovery.textures import uniform
from svu_mi.regularization import GlobalSharing, TotalVariation
from svu_mi.surface import Texels, texels

WATCHED = (SH, PATH)  # in the long run
COLD = (SH, SH_PAPER, PATH)  # timed in a new process


@dataclass(frozen=True, kw_only=True)
class StepSizes:
    """How much is measured.

    Attributes:
        views: few and many, whose steps must cost the same.
        film: pixels per side of these photographs.
        steps: of the descents that this is measured on.
        repeats: descents of each.
        turns: pairs of path steps, with sharing and without, that are compared.
        long: steps of the run that is watched for memory and kernels.
        long_texels, long_views, long_film: texels per side and photographs of that run.
        scale: of the recoveries in a new process, as a part of the defaults.
    """

    views: tuple[int, int] = (20, 200)
    film: int = 128
    steps: int = 100
    repeats: int = 3
    turns: int = 15
    long: int = 300
    long_texels: int = 128
    long_views: int = 24
    long_film: int = 96
    scale: float = 1.0


FULL = StepSizes()
QUICK = StepSizes(views=(6, 24), film=48, steps=30, repeats=1, turns=1, long=30, long_texels=48,
                  long_views=6, long_film=32, scale=0.05)  # fmt: skip


@dataclass(frozen=True)
class Steps(OnCell):
    """A cell whose single steps are timed.

    Attributes:
        sizes: how much is measured.
    """

    sizes: StepSizes

    @property
    def rows(self) -> tuple[Part, ...]:
        return PARTS

    def settings(self, row: Part | None) -> Any:
        return super().settings(row), asdict(self.sizes)

    def sharing(self) -> Record:
        """Return, by rule, what ``sharing_cost`` returns."""
        found = estimate(self.capture, self.layout)
        posterior = found.posterior
        assert isinstance(posterior, CalibratedPosterior)
        rules: dict[str, Rule] = {
            "common prior": Pull.by_trust(shared(posterior), self.layout),
            "Eq. 14, 15": each(GlobalSharing(found, self.capture.mesh)),
        }
        return {name: sharing_cost(self.capture, self.layout, rule, self.sizes.turns)
                for name, rule in rules.items()}  # fmt: skip

    def views(self) -> Record:
        """Time steps of SH descent with few and with many views of the same object.

        Returns:
            ``few`` and ``many``: ``views``, ``seconds`` per step (the least of several runs'
            medians), ``texels`` that are seen.
        """
        sizes, (few, many) = self.sizes, self.sizes.views
        name = f"capture_{many}_views_{sizes.film}"
        whole = self.bench.capture(self.cell, name, views=many, film=sizes.film)
        layout = texels(whole.mesh, self.bench.sizes.texels)
        captures = {"few": some_views(whole, few), "many": whole}
        times: dict[str, list[float]] = {"few": [], "many": []}
        seen = {}
        for _ in range(sizes.repeats):
            for key, capture in captures.items():  # in turns: a slow spell hits both
                watch = Watch()
                found = SH.recover_in(sizes.steps, capture, layout, watch)
                times[key].append(step_seconds(watch.marks))
                seen[key] = int((found.coverage > 0).sum())
        return {
            key: {"views": capture.count, "seconds": min(times[key]), "texels": seen[key]}
            for key, capture in captures.items()
        }

    def long(self) -> Record:
        """Watch a long run of a small capture: what ``describe_marks`` says, by way of recovery."""
        sizes, found = self.sizes, {}
        name = f"capture_{sizes.long_views}_views_{sizes.long_film}"
        capture = self.bench.capture(
            self.cell, name, views=sizes.long_views, film=sizes.long_film
        )
        layout = texels(capture.mesh, sizes.long_texels)
        for row in WATCHED:
            watch = Watch()
            row.recover_in(sizes.long, capture, layout, watch)
            found[row.label] = describe_marks(watch.marks, sizes.long)
        return found

    def cold(self) -> Record:
        """Return, by way of recovery, what ``recover_once`` returns in a new process."""
        _ = self.capture  # it is rendered
        folder = self.bench.folder / "cells" / self.name / "capture"
        return {
            row.label: in_new_process(
                recover_once, folder=str(folder), resolution=self.bench.sizes.texels,
                label=row.label, scale=self.sizes.scale,
            )
            for row in COLD
        }  # fmt: skip


PARTS = (
    Part("sharing", Steps.sharing),
    Part("views", Steps.views),
    Part("long", Steps.long),
    Part("cold", Steps.cold),
)


def sharing_cost(capture: Capture, grid: Texels, rule: Rule, turns: int) -> Record:
    """Time steps of the path tracer, loss to gradients, with sharing and without, in turns.

    Args:
        capture: the photographs.
        grid: texels of its mesh.
        rule: of sharing, a function of all textures.
        turns: pairs of steps that count.

    Returns:
        ``seconds`` of a step without, ``seconds_shared``, medians; ``part``: the median over
        pairs of what sharing adds, as a part of a step; ``alone``: seconds of sharing by itself.
    """
    smooth = each(TotalVariation(grid, capture.mesh))
    _, options = PATH.options()
    objective = path_objective(capture, grid, options)
    start = dict(uniform(grid).items())
    counter = iter(range(10**9))

    def step(shared: bool, traced: bool = True) -> Any:
        textures = {name: mi.TensorXf(tensor) for name, tensor in start.items()}
        dr.enable_grad(*textures.values())
        loss = objective(textures, next(counter)) if traced else mi.Float(0)
        if traced:
            loss = loss + options.tv * smooth(textures)
        if shared:
            loss = loss + options.sharing * rule(textures)
        dr.backward(loss)
        return [dr.grad(tensor).array for tensor in textures.values()]

    pairs = []
    for turn in range(clock.WARM_UP + turns):
        # The order changes, so that neither kind always comes second.
        order = (False, True) if turn % 2 else (True, False)
        walls = {shared: clock.run(partial(step, shared)).wall for shared in order}
        pairs.append((walls[False], walls[True]))
    pairs = pairs[clock.WARM_UP :]
    alone = clock.measure(partial(step, True, traced=False), turns)
    return {
        "seconds": statistics.median(plain for plain, _ in pairs),
        "seconds_shared": statistics.median(shared for _, shared in pairs),
        "part": statistics.median(shared / plain - 1 for plain, shared in pairs),
        "alone": alone["wall"]["median"],
        "part_alone": alone["wall"]["median"] / statistics.median(plain for plain, _ in pairs),
        "pixels": options.pixels_per_batch,
        "spp": options.spp,
    }


def recover_once(folder: str, resolution: int, label: str, scale: float) -> dict[str, Any]:
    """Recover as a user's first run does, in a new process (see ``fresh.in_new_process``).

    Args:
        folder: of the capture.
        resolution: texels per side.
        label: of the row.
        scale: see ``StepSizes``.

    Returns:
        ``seconds`` of the recovery, and ``compiled`` kernels.
    """
    capture, row = load_capture(folder), find_row(label)
    timed = once(partial(row.recover, capture, texels(capture.mesh, resolution), scale))
    return {"seconds": timed.seconds, "compiled": timed.compiled}


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of a record, of the parts that it has."""
    return [bar for cell in record["cells"] for bar in _bars(cell["rows"])]


def _bars(parts: Record) -> Iterable[Bar]:
    for name, found in parts.get("sharing", {}).items():
        yield Bar(f"what sharing ({name}) adds to a path step", found["part"], 0.05)
    if "views" in parts:
        few, many = parts["views"]["few"], parts["views"]["many"]
        what = f"SH descent step, {many['views']} views over {few['views']}"
        yield Bar(what, many["seconds"] / few["seconds"], 1.1, "times")
    for method, found in parts.get("long", {}).items():
        label = f"{method}, {found['steps']} steps"
        yield Bar(f"{label}: kernels compiled after the start", found["compiled"], 0)
        if found["grown"] is not None:
            # The allocator of the C library gives pages back late: noise of a few MiB.
            yield Bar(f"{label}: growth of resident memory", found["grown"], 8.0, "MiB")


STEP = (
    Column("step", lambda line: line[0]),
    Column("of", lambda line: line[1]),
    Column("time", lambda line: line[2]),
)
LONG = (
    Column("long run", lambda line: line[0]),
    Column("steps", lambda line: line[1]["steps"]),
    Column("kernels compiled after the start", lambda line: line[1]["compiled"]),
    Column("resident MiB", lambda line: line[1]["resident"], digits(0)),
    Column("growth", lambda line: line[1]["grown"], lambda value: f"{value:+.1f}"),
    Column("time per step", lambda line: line[1]["seconds"], seconds),
)
FIRST = (
    Column("first run, empty kernel cache", lambda line: line[0]),
    Column("recovery", lambda line: line[1]["seconds"], seconds),
    Column("kernels compiled", lambda line: line[1]["compiled"]),
    Column("with start, imports and loading", lambda line: line[1]["process_seconds"], seconds),
)


def tables(record: Record) -> list[str]:
    """Return the tables of a record, of the parts that it has."""
    text: list[str] = []
    for cell in record["cells"]:
        parts = cell["rows"]
        text += [
            f"{cell['cell']}. One step, loss to gradients, median; what sharing adds is a median "
            "of pairs.",
            columns(STEP, _steps(parts)),
        ]
        text += [columns(shown, parts[name].items())
                 for name, shown in (("long", LONG), ("cold", FIRST)) if name in parts]  # fmt: skip
    return text


def _steps(parts: Record) -> list[tuple[str, str, str]]:
    rules = parts.get("sharing", {}).items()
    return [
        *((f"path, and with sharing ({name})",
           f"{one['pixels']:,} pixels, {one['spp']} paths each; {one['part']:+.1%}",
           f"{seconds(one['seconds'])}, {seconds(one['seconds_shared'])}") for name, one in rules),
        *((f"sharing ({name}) alone", f"{one['part_alone']:.1%} of a path step",
           seconds(one["alone"])) for name, one in rules),
        *((SH.label, f"{one['views']} views, {one['texels']:,} texels seen",
           seconds(one["seconds"])) for one in parts.get("views", {}).values()),
    ]  # fmt: skip


STUDY = Study(
    title="Single steps of recovery",
    experiment=lambda bench, asked: Experiment(
        "recovery_steps", [Steps(bench, asked.cells[0], QUICK if bench.quick else FULL)]
    ),
    tables=tables, bars=find_bars,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RecoverySteps(Command):
    """What steps of recovery cost, for the first object under the first light."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY


if __name__ == "__main__":
    raise SystemExit(main(RecoverySteps))
