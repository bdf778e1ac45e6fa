"""Fig. 9 of the paper: which views to add to ten, by expected entropy or farthest from the others.

100 photographs of 96 x 96 on a sphere with 16 samples, direct light, 96 x 96 texels. Ten are chosen
by farthest-point sampling from the first; the other 90 are candidates, of which one after another
is added:

* `best view (paper)`: least expected entropy, Eq. 13 of power spectra as printed;
* `best view (ours)`: the same of our own estimate, preset `default`;
* `farthest`: the direction farthest from all so far.

After each view, the first two know its photograph, and estimate anew. After three, six and ten,
textures are recovered as in the paper (SH model) and by ours. PSNR, the mean over parameters as in
Table 2, and entropy are over the texels that any of the views sees; where nobody has looked yet,
entropy is 1. Tables have the mean over cells, how many views each strategy needs for +1 dB (of the
mean curve: added ones, interpolated), and a test of what best views gain over farthest ones in
every cell, as a mean over the added views: Wilcoxon's signed ranks, two-sided.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from svu_mi.bench.captures import Truth, chosen_views
from svu_mi.bench.experiment import OnCell, Record
from svu_mi.bench.guidance import Strategy
from svu_mi.bench.guidance.guidance_tables import views_needed
from svu_mi.bench.markdown import COLORS, INK, MARKS, page, table, tidy
from svu_mi.capture.capture import Capture
from svu_mi.capture.sensors import bounding_sphere, directions_of
from svu_mi.geometry.texels import Texels, texels
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.next_view import next_best_view
from svu_mi.guidance.strategies import farthest
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.recover import recover

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILM, VIEWS, SPP, TEXELS = 96, 100, 16, 96
QUICK_FILM, QUICK_VIEWS, QUICK_SPP, QUICK_TEXELS = 32, 24, 4, 32
START, ADDED = 10, (3, 6, 10)  # photographs; added ones after which textures are recovered
PAPER, OURS, FARTHEST = "best view (paper)", "best view (ours)", "farthest"
STRATEGIES = (PAPER, OURS, FARTHEST)
WAYS = {"paper": "recovered by the SH model (paper)", "default": "recovered by ours"}


@dataclass(frozen=True)
class Figure9(OnCell):
    """A case all of whose views are photographed, and strategies that choose among them."""

    rows = tuple(Strategy(name) for name in STRATEGIES)

    @property
    def name(self) -> str:
        return f"figure9/{self.cell.name}"

    def settings(self, row: Strategy | None) -> Any:
        return str(self.cell.scene), self.cell.defines, self.bench.quick, row and row.label

    def head(self) -> Record:
        return {"part": "figure9", "cell": self.title}

    @cached_property
    def capture(self) -> Capture:
        """All photographs."""
        views, film, spp = VIEWS, FILM, SPP
        if self.bench.quick:
            views, film, spp = QUICK_VIEWS, QUICK_FILM, QUICK_SPP
        return self.bench.capture(self.cell, "figure9", views=views, film=film, spp=spp)

    @cached_property
    def layout(self) -> Texels:
        """Texels of the textures."""
        return texels(self.capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)

    @cached_property
    def visible(self) -> np.ndarray:
        """(T,) bool, texels that any view sees."""
        return np.array(estimate(self.capture, self.layout, "spectrum", "paper").coverage) > 0

    @cached_property
    def truth(self) -> Truth:
        """True textures."""
        return Truth.of(self.capture, self.layout)

    @cached_property
    def start(self) -> list[int]:
        """Views of the start."""
        return self._farthest([0], START - 1)

    @cached_property
    def first(self) -> Record:
        """What ``judge`` says of the start."""
        return self.judge(self.start)

    def measure(self, row: Strategy) -> Record:
        """Return ``views`` of a strategy, the ``points`` of its curve, ``seconds_per_view``."""
        views, seconds = self.order(row.label)
        points = [self.first, *(self.judge(views[: START + added]) for added in ADDED)]
        return {"views": views, "seconds_per_view": seconds, "points": points}

    def order(self, strategy: str) -> tuple[list[int], float]:
        """Return the start and the views that a strategy adds, and seconds per added view."""
        chosen, count, began = list(self.start), START + ADDED[-1], time.perf_counter()
        if strategy == FARTHEST:
            chosen = self._farthest(self.start, ADDED[-1])
        while len(chosen) < count:
            left = [view for view in range(self.capture.count) if view not in chosen]
            candidates = Candidates.at(self.capture, left)
            best = next_best_view(self._estimate(chosen, strategy), candidates).proposals[0]
            chosen.append(left[best.candidate])
        return chosen, (time.perf_counter() - began) / ADDED[-1]

    def judge(self, views: Sequence[int]) -> Record:
        """Return average PSNR (dB) and mean entropy by way of recovery."""
        ours = self._estimate(views)
        paper = estimate(ours, method="spectrum", preset="paper")
        found: Record = {"psnr": {}, "entropy": {}}
        for name, known in (("paper", paper), ("default", ours)):
            entropy = np.array(known.entropy, np.float64)[self.visible]
            found["entropy"][name] = float(entropy.mean())
            textures = recover(ours, method="sh", preset=name).textures
            found["psnr"][name] = self.truth.psnr(textures, self.visible)["average"]
        return found

    def _estimate(self, views: Sequence[int], strategy: str = OURS) -> Estimate:
        taken = chosen_views(self.capture, views)
        if strategy == PAPER:
            return estimate(taken, self.layout, "spectrum", "paper")
        return estimate(taken, self.layout)

    def _farthest(self, views: Sequence[int], count: int) -> list[int]:
        """Return views, and ``count`` more by farthest-point sampling."""
        center, _ = bounding_sphere(self.capture.shape)
        return farthest(directions_of(self.capture.sensors, center), list(views), count)


# --- tables ---------------------------------------------------------------------------------


def curves(cells: Sequence[Record], strategy: str, what: str, way: str) -> np.ndarray:
    """Return (cells, 1 + marks) PSNR (dB) or entropy, at the start and after each mark."""
    points = [cell["rows"][strategy]["points"] for cell in cells]
    return np.array([[point[what][way] for point in of_cell] for of_cell in points])


def gains(cells: Sequence[Record], strategy: str, what: str, way: str) -> np.ndarray:
    """Return (cells, 1 + marks) curves above their start."""
    found = curves(cells, strategy, what, way)
    return found - found[:, :1]


def mean_gain(cells: Sequence[Record], strategy: str, what: str, way: str) -> np.ndarray:
    """Return (cells,) means of a curve above its start, over the added views."""
    places = np.array([0, *ADDED], float)
    return np.trapezoid(gains(cells, strategy, what, way), places, axis=1) / places[-1]


def figure9_tables(cells: list[Record]) -> list[str]:
    """Return curves, views needed and tests."""
    found = ["## Figure 9: views to add"]
    for way, title in WAYS.items():
        start = curves(cells, FARTHEST, "psnr", way)[:, 0].mean()
        found += [f"{len(cells)} cells, {title}; the start has {start:.2f} dB.",
                  _curve_table(cells, way)]  # fmt: skip
    return [*found, _entropy_table(cells), _paired_table(cells), _cell_table(cells)]


def _curve_table(cells: Sequence[Record], way: str) -> str:
    """Mean gains of PSNR by strategy, and the views needed for a gain."""
    mean = {s: gains(cells, s, "psnr", way).mean(axis=0) for s in STRATEGIES}
    last = float(mean[FARTHEST][-1])
    rows = [
        [s, *(f"{value:+.2f}" for value in mean[s][1:]), _needed(mean[s], 1.0),
         _needed(mean[s], last - 1e-9),
         f"{np.mean([cell['rows'][s]['seconds_per_view'] for cell in cells]):.1f}"]
        for s in STRATEGIES
    ]  # fmt: skip
    return table(
        ("gain (dB) with so many photographs", *(str(START + added) for added in ADDED),
         "views for +1 dB", f"views for {last:+.2f} dB", "seconds per view"), rows,
    )  # fmt: skip


def _needed(mean: np.ndarray, step: float) -> str:
    views = views_needed(ADDED, mean.tolist(), step) if step > 0 else 0.0
    return f"> {ADDED[-1]}" if np.isnan(views) else f"{views:.1f}"


def _entropy_table(cells: Sequence[Record]) -> str:
    rows = [
        [f"{title}: {s}",
         *(f"{value:.3f}" for value in curves(cells, s, "entropy", way).mean(axis=0))]
        for way, title in (("paper", "of spectra (paper)"), ("default", "ours"))
        for s in STRATEGIES
    ]  # fmt: skip
    return table(("mean entropy", *(str(START + added) for added in (0, *ADDED))), rows)


def _paired_table(cells: Sequence[Record]) -> str:
    """What a strategy gains over farthest-point sampling in every cell, and p of none."""
    rows = []
    for what, unit, sign in (("psnr", " dB", 1), ("entropy", "", -1)):
        for way, title in WAYS.items():
            for strategy in (PAPER, OURS):
                over = mean_gain(cells, strategy, what, way) - mean_gain(cells, FARTHEST, what, way)
                p = "-"
                if len(over) > 5 and over.any():
                    p = f"{scipy.stats.wilcoxon(over).pvalue:.3f}"
                label = title if what == "psnr" else f"entropy, {way}"
                rows.append([f"{strategy}, {label}", f"{over.mean():+.3f}{unit}",
                             f"{(sign * over > 0).sum()} of {len(over)}", p])  # fmt: skip
    return table(("over farthest", "mean over added views", "better in", "p"), rows)


def _cell_table(cells: Sequence[Record]) -> str:
    """The gain of every cell with all photographs, as recovered in the paper and by ours."""
    both = [(way, s) for way in WAYS for s in STRATEGIES]
    rows = [
        [cell["cell"], *(f"{gains([cell], s, 'psnr', way)[0, -1]:+.2f}" for way, s in both)]
        for cell in cells
    ]
    heads = (f"gain (dB) with {START + ADDED[-1]}", *(f"{s}, {way}" for way, s in both))
    return table(heads, rows)


def draw_figure9(found: Record) -> Figure | None:
    """Draw mean curves, from the records of all benchmarks; their standard error as a band."""
    cells = [cell for cell in found["paper"]["cells"] if cell["part"] == "figure9"]
    if not cells:
        return None
    figure = page(13, 3.2)
    panels = [("psnr", way, f"gain (dB), {title}") for way, title in WAYS.items()]
    panels += [("entropy", "paper", "entropy of spectra"), ("entropy", "default", "entropy")]
    for axes, (what, way, title) in zip(figure.subplots(1, 4), panels, strict=True):
        _draw(axes, cells, what, way)
        axes.set_title(f"mean of {len(cells)} cells: {title}", fontsize=9, color=INK)
        tidy(axes)
    figure.axes[0].legend(frameon=False, fontsize=8)
    return figure


def _draw(axes: Axes, cells: Sequence[Record], what: str, way: str) -> None:
    photographs = START + np.array([0, *ADDED])
    for strategy, color, mark in zip(STRATEGIES, COLORS, MARKS, strict=False):
        above = gains(cells, strategy, what, way)
        shown = above if what == "psnr" else curves(cells, strategy, what, way)
        mean = shown.mean(axis=0)
        axes.plot(photographs, mean, f"{mark}-", color=color, ms=4, lw=1.2, label=strategy)
        if len(cells) > 1:
            error = above.std(axis=0, ddof=1) / np.sqrt(len(cells))
            band = {"color": color, "alpha": 0.12, "lw": 0}
            axes.fill_between(photographs, mean - error, mean + error, **band)
    axes.set_xticks(photographs)
