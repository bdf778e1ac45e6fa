"""``svu bench sureness``: coverage of the intervals of textures and pictures.

Intervals are compared with the truth for textures recovered by SH; for a shared prior, with
photographs mostly from one side; for filled textures, with a third of the surface hidden; and, in
some cases, for pictures under two lights that were not used for recovery. Standard deviations are
compared with errors, and textures with a shared prior with those without.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.bench.captures import (
    TrueTextures,
    chosen_views,
    even_views,
    nearest_to_front,
    uneven_views,
)
from svu_mi.bench.cases import Case, chosen_cases
from svu_mi.bench.correlation import spearman
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar, Column, digits, seconds, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import SensorPixels
from svu_mi.capture.scene import load_scene
from svu_mi.capture.target import find_target
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.observations import observe
from svu_mi.recovery.inpaint.fill import fill
from svu_mi.recovery.recover import recover
from svu_mi.recovery.recovery_result import Recovery
from svu_mi.recovery.relighting import path_length, relight_draws
from svu_mi.recovery.uncertainty.texture_field import INTERVAL_MASS, TextureField, texture_field

RELIT_CASES, LIGHTS, VIEWS, SPP, DRAWS = 6, 2, 3, 36, 16
FRONT_VIEWS, BACK_VIEWS = 18, 4
LOWEST, HIGHEST = 0.82, 0.96  # bars of means over cases
WORST = 0.65  # bar of the worst case
HIDDEN = 1 / 3  # share of the surface without photographs
# Objects with rotational symmetry or with parts of one material; other objects have materials that
# occur on one side only.
REPEATING = ("vase", "spheres", "barrel", "chess_king_black", "chess_rook_white")
WIDTH = 1.645  # half width of the 90 % interval of a normal distribution


@dataclass(frozen=True)
class SurenessCase(CaseSubject):
    """A case whose textures are recovered with intervals.

    Attributes:
        others: Same object under other lights; empty without relit pictures.
    """

    others: Sequence[Case]

    @property
    def rows(self) -> tuple[Measurement, ...]:
        return PARTS if self.others else PARTS[:-1]

    def settings(self, row: Measurement | None) -> Any:
        lights = [(str(one.scene), one.defines) for one in self.others]
        return super().settings(row), lights, RELIT_CASES, LIGHTS, VIEWS, SPP, DRAWS

    @cached_property
    def textures_and_field(self) -> tuple[Recovery, TextureField]:
        """Textures from photographs all around, and their posterior field."""
        return _recovered(self._some(self.capture), self.layout)

    def textures(self) -> Record:
        """Return ``interval_coverage`` of visible texels."""
        return interval_coverage(*self.textures_and_field, self.truth)

    def sharing(self) -> Record:
        """Return ``interval_coverage`` with a shared prior, and photographs all around."""
        recovered = _recovered(self._some(self.capture), self.layout, sharing=True)
        return interval_coverage(*recovered, self.truth)

    def shared(self) -> Record:
        """Return ``interval_coverage`` with a shared prior and views mostly from one side."""
        scale = 1.0 if self.capture.count >= FRONT_VIEWS + BACK_VIEWS else 0.25
        front, back = (max(int(scale * count), 1) for count in (FRONT_VIEWS, BACK_VIEWS))
        uneven = uneven_views(self.capture, front, back)
        recovered = _recovered(uneven, self.layout, sharing=True)
        return interval_coverage(*recovered, self.truth)

    def filled(self) -> Record:
        """Fill a hidden third of the surface, and return its scores.

        Returns:
            ``hidden``, fraction of filled texels; ``held``, coverage of intervals by parameter;
            ``repeats``, True if the object is in ``REPEATING``; ``likeness``, main predictor by
            parameter; ``psnr_before`` and ``psnr``, average PSNR (dB) before and after filling.
        """
        layout, truth = self.layout, self.truth
        recovery, field = _recovered(_hiding(self.capture, layout), layout)
        seen = recovery.coverage > 0
        filled = fill(field, seen)
        shares = {}
        for name in NAMES:
            low, high = (end[~seen] for end in filled.field.interval(name, INTERVAL_MASS))
            true = np.asarray(truth.values[name], np.float64)[~seen]
            shares[name] = float(((low - 1e-6 <= true) & (true <= high + 1e-6)).mean())
        return {
            "hidden": float((~seen).mean()), "held": shares,
            "repeats": self.case.object in REPEATING,
            "likeness": {name: words.split(",")[0] for name, words in filled.likeness.items()},
            "psnr_before": truth.psnr(recovery.textures, ~seen)["average"],
            "psnr": truth.psnr(filled.textures, ~seen)["average"],
        }  # fmt: skip

    def pictures(self) -> Record:
        """Return scores of relit pictures, mean over lights.

        Returns:
            ``seconds``, and the entries of ``pixel_coverage``.
        """
        recovery, field = self.textures_and_field
        draws, records = list(field.draw(DRAWS)), []
        for other in self.others:
            scene = load_scene(other.scene, other.defines)
            shape = find_target(scene, self.capture.shape.id(), str(other.scene)).mesh
            lit = replace(even_views(self.capture, VIEWS), scene=scene, shape=shape, mesh=shape)
            start = time.perf_counter()
            relit = relight_draws(lit, recovery.textures, draws, spp=SPP)
            taken = time.perf_counter() - start
            records.append({"seconds": taken, **pixel_coverage(relit, _truth(lit))})
        return {name: float(np.mean([one[name] for one in records])) for name in records[0]}

    def _some(self, capture: Capture) -> Capture:
        return even_views(capture, min(self.bench.sizes.recovery.even_views, capture.count))


PARTS = tuple(
    Measurement(measure.__name__, measure)
    for measure in (
        SurenessCase.textures, SurenessCase.sharing, SurenessCase.shared, SurenessCase.filled,
        SurenessCase.pictures,
    )
)  # fmt: skip


def _hiding(capture: Capture, layout: Texels) -> Capture:
    """Return photographs from one side, such that about a third of the surface is hidden."""
    seen = observe(capture, layout)
    lane = dr.arange(mi.UInt32, layout.count)
    shows = np.stack([
        np.array(seen.visibility.bits.test(dr.opaque(mi.UInt32, view), lane))
        for view in range(capture.count)
    ])  # fmt: skip
    order = nearest_to_front(capture)
    unseen = 1 - np.logical_or.accumulate(shows[order]).mean(axis=1)
    count = max(int((unseen >= HIDDEN).sum()), 1)
    return chosen_views(capture, np.sort(order[:count]))


def _recovered(
    capture: Capture, layout: Texels, *, sharing: bool = False
) -> tuple[Recovery, TextureField]:
    recovery = recover(capture, layout, sharing=sharing)
    return recovery, texture_field(recovery, mesh=capture.mesh)


def interval_coverage(recovery: Recovery, field: TextureField, truth: TrueTextures) -> Record:
    """Compare textures and their posterior field with the truth, over visible texels.

    Returns:
        ``held``, fraction of texels whose interval contains the truth, and ``width``, rms standard
        deviation over rms error, by parameter; ``spearman``, rank correlation of standard deviation
        and error over all parameters; ``psnr``, average PSNR (dB).
    """
    seen = recovery.coverage > 0
    shares, widths, sds, errors = {}, {}, [], []
    for name in NAMES:
        low, high = (end[seen] for end in field.interval(name, INTERVAL_MASS))
        true = np.asarray(truth.values[name], np.float64)[seen]
        shares[name] = float(((low - 1e-6 <= true) & (true <= high + 1e-6)).mean())
        value = np.asarray(recovery.textures.at(field.texels, name), np.float64)[seen]
        errors.append(np.abs(value - true).ravel())
        sds.append(field.sd(name)[seen].ravel())
        widths[name] = float(np.sqrt(np.square(sds[-1]).mean() / np.square(errors[-1]).mean()))
    pooled = spearman(np.concatenate(sds), np.concatenate(errors))
    average = truth.psnr(recovery.textures, seen)["average"]
    return {"held": shares, "width": widths, "spearman": pooled, "psnr": average}


def _truth(capture: Capture) -> list[np.ndarray]:
    """Render the true object with the random numbers of ``relight_draws``."""
    pictures = SensorPixels(capture.sensors)
    integrator = mi.load_dict({"type": "path", "max_depth": path_length(capture.scene)})
    everything = [np.ones((height, width), bool) for width, height in pictures.sizes]
    return pictures.traced(capture.scene, integrator, everything, SPP)


def pixel_coverage(views: Sequence[Any], truth: Sequence[np.ndarray]) -> Record:
    """Compare relit pictures with the truth, over pixels of the object.

    Returns:
        ``held``, fraction of values whose error is within 1.64 standard deviations; ``spearman``
        of standard deviation and error; ``psnr_gain``, PSNR of the mean of draws minus PSNR of
        the picture with recovered textures.
    """
    sds, errors, inside = [], [], []
    squares = np.zeros(2)
    for view, true in zip(views, truth, strict=True):
        mask = view.inside
        error = np.abs(view.mean - true)[mask]
        sds.append(view.sd[mask].ravel())
        errors.append(error.ravel())
        inside.append((error <= WIDTH * view.sd[mask]).ravel())
        squares += [(error**2).sum(), ((view.picture - true)[mask] ** 2).sum()]
    return {
        "held": float(np.concatenate(inside).mean()),
        "spearman": spearman(np.concatenate(sds), np.concatenate(errors)),
        "psnr_gain": float(10 * np.log10(squares[1] / squares[0])),
    }


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench sureness``."""
    bars, rows = [], [case["rows"] for case in record["cells"]]
    for part, least in (("textures", LOWEST), ("shared", 0.78)):
        parts = [row[part] for row in rows if part in row]
        for name in NAMES if parts else ():
            values = [one["held"][name] for one in parts]
            title = f"{part}: {name}, intervals that contain the truth"
            bars.append(Bar(f"{title}, at least", float(np.mean(values)), least, least=True))
            if part == "textures":
                bars += [
                    Bar(f"{title}, at most", float(np.mean(values)), HIGHEST),
                    Bar(f"{title}, worst case", min(values), WORST, least=True),
                ]
        if part == "textures" and parts:
            mean = float(np.mean([one["spearman"] for one in parts]))
            bars.append(Bar("textures: Spearman of standard deviation and error", mean, 0.68,
                            least=True))  # fmt: skip
    both = [row for row in rows if "sharing" in row]
    bars += _bars_of_widths(both) if both else []
    filled = [row["filled"] for row in rows if "filled" in row]
    bars += _bars_of_filling(filled) if filled else []
    pictures = [row["pictures"] for row in rows if "pictures" in row]
    if pictures:
        value = {name: float(np.mean([one[name] for one in pictures]))
                 for name in ("held", "spearman")}  # fmt: skip
        bars += [
            Bar(
                "pictures: Spearman of standard deviation and error",
                value["spearman"],
                0.6,
                least=True,
            ),
            Bar(
                "pictures: pixels within 1.64 standard deviations, at least",
                value["held"],
                0.80,
                least=True,
            ),
            Bar("pictures: pixels within 1.64 standard deviations, at most", value["held"], 0.97),
        ]
    return bars


def _bars_of_widths(rows: Sequence[Record]) -> list[Bar]:
    """Return bars of standard deviations relative to errors, and of the gain of sharing."""
    bars = []
    for name in NAMES:
        widths = [row["textures"]["width"][name] for row in rows]
        title = f"widths: {name}, standard deviation over error"
        bars += [
            Bar(f"{title}, at least", float(np.mean(widths)), 0.8, least=True),
            Bar(f"{title}, at most", float(np.mean(widths)), 1.25),
            Bar(f"{title}, lowest case", min(widths), 0.6, least=True),
            Bar(f"{title}, highest case", max(widths), 1.6),
        ]
    gains = [row["sharing"]["psnr"] - row["textures"]["psnr"] for row in rows]
    repeating = [gain for gain, row in zip(gains, rows, strict=True) if row["filled"]["repeats"]]
    if repeating:
        title = "sharing: PSNR above default, mean of repetitive objects"
        bars.append(Bar(title, float(np.mean(repeating)), 1.0, "dB", True))
    return [*bars, Bar("sharing: PSNR above default, worst case", min(gains), -0.2, "dB", True)]


def _bars_of_filling(filled: Sequence[Record]) -> list[Bar]:
    gains = [one["psnr"] - one["psnr_before"] for one in filled]
    repeating = [gain for gain, one in zip(gains, filled, strict=True) if one["repeats"]]
    held = float(np.mean([list(one["held"].values()) for one in filled]))
    bars = [
        Bar(
            "filled: PSNR above spreading from the border, worst case", min(gains), -0.1, "dB", True
        ),
        Bar("filled: intervals that contain the truth, at least", held, 0.80, least=True),
        Bar("filled: intervals that contain the truth, at most", held, 0.97),
    ]
    if repeating:
        title = "filled: PSNR above spreading from the border, mean of repetitive objects"
        bars.insert(0, Bar(title, float(np.mean(repeating)), 2.0, "dB", True))
    return bars


def tables(record: Record) -> list[str]:
    """Return the tables of a record of ``svu bench sureness``."""
    lines = [(case["cell"], case["rows"]) for case in record["cells"]]
    count = len(lines)
    mean = {
        part: {name: _mean([row[part]["held"][name] for _, row in lines if part in row])
               for name in NAMES}
        for part in ("textures", "shared")
    }  # fmt: skip
    shown = [Column("case", lambda line: line[0])]
    for part, title in (("textures", ""), ("shared", ", shared, one-sided")):
        shown += [
            Column(f"{name}{title}", _figure(part, "held", name), digits(2)) for name in NAMES
        ]
        shown.append(Column(f"Spearman{title}", _figure(part, "spearman"),
                            digits(2)))  # fmt: skip
    shown += [
        *(Column(f"{name}: sd over error", _figure("textures", "width", name), digits(2))
          for name in NAMES),
        Column("PSNR", _figure("textures", "psnr"), digits(2)),
        Column("PSNR, sharing", _figure("sharing", "psnr"), digits(2)),
        Column("filled: share of texels", _figure("filled", "hidden"), digits(2)),
        Column("PSNR before", _figure("filled", "psnr_before"), digits(2)),
        Column("PSNR after", _figure("filled", "psnr"), digits(2)),
        Column("intervals", lambda line: _mean(line[1]["filled"]["held"].values()), digits(2)),
        Column("predictor",
               lambda line: ", ".join(dict.fromkeys(line[1]["filled"]["likeness"].values()))),
        Column("pixels within 1.64 sd", _figure("pictures", "held"), digits(2)),
        Column("Spearman, pixels", _figure("pictures", "spearman"), digits(2)),
        Column("PSNR of the mean of draws", _figure("pictures", "psnr_gain"),
               lambda value: f"{value:+.1f} dB"),
        Column("time", _figure("pictures", "seconds"), seconds),
    ]  # fmt: skip
    words = "; ".join(
        f"{part}: " + ", ".join(f"{name} {value:.3f}" for name, value in of.items() if value)
        for part, of in mean.items() if any(of.values())
    )  # fmt: skip
    return [
        "Share of visible texels whose 90 % interval contains the truth, and of the object's "
        f"pixels under other lights. Means over {count} cases: {words}.",
        tabulate(shown, lines),
    ]


def _mean(values: Collection[float]) -> float | None:
    return float(np.mean(list(values))) if values else None


def _figure(*path: str) -> Callable[[tuple[str, Any]], Any]:
    """Return a function that returns the entry at nested keys ``path`` of a line, or None."""
    return lambda line: reduce(lambda record, name: record and record.get(name), path, line[1])


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    subjects = []
    for number, case in enumerate(selection.cases):
        others: list[Case] = []
        if number % max(len(selection.cases) // RELIT_CASES, 1) == 0:
            others = _others(case, selection.data, bench.folder)
        subjects.append(SurenessCase(bench, case, others))
    return Experiment("sureness", subjects)


def _others(case: Case, data: Path | None, workspace: Path) -> list[Case]:
    """Return the same object under the lights that follow in the list."""
    around = chosen_cases(data, workspace, [case.object])
    first = [one.light for one in around].index(case.light)
    return [around[(first + k) % len(around)] for k in range(1, min(LIGHTS, len(around) - 1) + 1)]


STUDY = Study(title="Intervals of recovered textures and pictures", experiment=_experiment,
              tables=tables, bars=find_bars)  # fmt: skip
