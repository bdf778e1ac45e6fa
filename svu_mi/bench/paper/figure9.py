"""Fig. 9 of the paper: views added to ten initial ones, by entropy or farthest-point sampling.

100 photographs of 96 x 96 on a sphere with 16 samples, direct light, 96 x 96 texels. Ten are chosen
by farthest-point sampling from the first. The other 90 are candidates, which are added in turn:

* `best view (paper)`: least expected entropy, Eq. 13 for power spectra as printed;
* `best view (ours)`: the same for our estimate, preset `default`;
* `farthest`: direction farthest from all previous ones.

The first two estimate again from the photograph of each added view. After three, six and ten views,
textures are recovered with the SH model of the paper and with ours. PSNR (mean over parameters, as
in Table 2) and entropy are computed over all texels that any view shows. Texels without a
photograph have entropy 1. Tables contain means over cases and the interpolated number of added
views after which the mean curve has gained 1 dB. A two-sided Wilcoxon signed-rank test compares the
gains over farthest-point sampling, mean over the added views, of all cases.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from svu_mi.bench.captures import chosen_views
from svu_mi.bench.experiment import CaseSubject, Record
from svu_mi.bench.guidance import StrategyRow
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
START, ADDED = 10, (3, 6, 10)  # initial photographs; numbers of added ones with recovery
PAPER, OURS, FARTHEST = "best view (paper)", "best view (ours)", "farthest"
STRATEGIES = (PAPER, OURS, FARTHEST)
RECOVERIES = {"paper": "recovered by SH (paper)", "default": "recovered by SH (ours)"}


@dataclass(frozen=True)
class Figure9(CaseSubject):
    """A case with photographs of all candidates, among which strategies choose."""

    rows = tuple(StrategyRow(name) for name in STRATEGIES)

    @property
    def name(self) -> str:
        return f"figure9/{self.case.name}"

    def settings(self, row: StrategyRow | None) -> Any:
        return str(self.case.scene), self.case.defines, self.bench.quick, row and row.label

    def head(self) -> Record:
        return {"part": "figure9", "cell": self.title}

    @cached_property
    def capture(self) -> Capture:
        """All photographs."""
        views, film, spp = VIEWS, FILM, SPP
        if self.bench.quick:
            views, film, spp = QUICK_VIEWS, QUICK_FILM, QUICK_SPP
        return self.bench.capture(self.case, "figure9", views=views, film=film, spp=spp)

    @cached_property
    def layout(self) -> Texels:
        """Texels of the textures."""
        return texels(self.capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)

    @cached_property
    def visible(self) -> np.ndarray:
        """Texels that are visible in any view, (T,) bool."""
        return np.array(estimate(self.capture, self.layout, "spectrum", "paper").coverage) > 0

    @cached_property
    def start(self) -> list[int]:
        """Indices of the initial views."""
        return self._farthest([0], START - 1)

    @cached_property
    def first(self) -> Record:
        """Scores of the initial views."""
        return self.score(self.start)

    def measure(self, row: StrategyRow) -> Record:
        """Return chosen ``views``, scores (``points``) and ``seconds_per_view`` of a strategy."""
        views, seconds = self.order(row.label)
        points = [self.first, *(self.score(views[: START + added]) for added in ADDED)]
        return {"views": views, "seconds_per_view": seconds, "points": points}

    def order(self, strategy: str) -> tuple[list[int], float]:
        """Return the initial and added views of a strategy, and seconds per added view."""
        chosen, count, began = list(self.start), START + ADDED[-1], time.perf_counter()
        if strategy == FARTHEST:
            chosen = self._farthest(self.start, ADDED[-1])
        while len(chosen) < count:
            left = [view for view in range(self.capture.count) if view not in chosen]
            candidates = Candidates.at(self.capture, left)
            best = next_best_view(self._estimate(chosen, strategy), candidates).proposals[0]
            chosen.append(left[best.candidate])
        return chosen, (time.perf_counter() - began) / ADDED[-1]

    def score(self, views: Sequence[int]) -> Record:
        """Return average PSNR (dB) and mean entropy by recovery method."""
        ours = self._estimate(views)
        paper = estimate(ours, method="spectrum", preset="paper")
        scores: Record = {"psnr": {}, "entropy": {}}
        for name, known in (("paper", paper), ("default", ours)):
            entropy = np.array(known.entropy, np.float64)[self.visible]
            scores["entropy"][name] = float(entropy.mean())
            textures = recover(ours, method="sh", preset=name).textures
            scores["psnr"][name] = self.truth.psnr(textures, self.visible)["average"]
        return scores

    def _estimate(self, views: Sequence[int], strategy: str = OURS) -> Estimate:
        taken = chosen_views(self.capture, views)
        if strategy == PAPER:
            return estimate(taken, self.layout, "spectrum", "paper")
        return estimate(taken, self.layout)

    def _farthest(self, views: Sequence[int], count: int) -> list[int]:
        """Return the views, followed by ``count`` farthest-point samples."""
        center, _ = bounding_sphere(self.capture.shape)
        return farthest(directions_of(self.capture.sensors, center), list(views), count)


# --- tables ---------------------------------------------------------------------------------


def curves(cases: Sequence[Record], strategy: str, what: str, way: str) -> np.ndarray:
    """Return PSNR (dB) or entropy after 0 and ``ADDED`` views, (cases, 1 + marks)."""
    points = [case["rows"][strategy]["points"] for case in cases]
    return np.array([[point[what][way] for point in of_case] for of_case in points])


def increases(cases: Sequence[Record], strategy: str, what: str, way: str) -> np.ndarray:
    """Return the curves minus their first values, (cases, 1 + marks)."""
    values = curves(cases, strategy, what, way)
    return values - values[:, :1]


def mean_increase(cases: Sequence[Record], strategy: str, what: str, way: str) -> np.ndarray:
    """Return the mean increase over the added views, (cases,)."""
    places = np.array([0, *ADDED], float)
    return np.trapezoid(increases(cases, strategy, what, way), places, axis=1) / places[-1]


def figure9_tables(cases: list[Record]) -> list[str]:
    """Return three tables: curves, numbers of views, and significance tests."""
    sections = ["## Figure 9: views to add"]
    for way, title in RECOVERIES.items():
        start = curves(cases, FARTHEST, "psnr", way)[:, 0].mean()
        sections += [f"{len(cases)} cases, {title}; initial PSNR {start:.2f} dB.",
                  _curve_table(cases, way)]  # fmt: skip
    return [*sections, _entropy_table(cases), _paired_table(cases), _case_table(cases)]


def _curve_table(cases: Sequence[Record], way: str) -> str:
    """Return a table of mean PSNR gains by strategy, and of views needed for a gain."""
    mean = {s: increases(cases, s, "psnr", way).mean(axis=0) for s in STRATEGIES}
    last = float(mean[FARTHEST][-1])
    rows = [
        [s, *(f"{value:+.2f}" for value in mean[s][1:]), _needed(mean[s], 1.0),
         _needed(mean[s], last - 1e-9),
         f"{np.mean([case['rows'][s]['seconds_per_view'] for case in cases]):.1f}"]
        for s in STRATEGIES
    ]  # fmt: skip
    return table(
        ("gain (dB) by number of photographs", *(str(START + added) for added in ADDED),
         "views for +1 dB", f"views for {last:+.2f} dB", "seconds per view"), rows,
    )  # fmt: skip


def _needed(mean: np.ndarray, step: float) -> str:
    views = views_needed(ADDED, mean.tolist(), step) if step > 0 else 0.0
    return f"> {ADDED[-1]}" if np.isnan(views) else f"{views:.1f}"


def _entropy_table(cases: Sequence[Record]) -> str:
    rows = [
        [f"{title}: {s}",
         *(f"{value:.3f}" for value in curves(cases, s, "entropy", way).mean(axis=0))]
        for way, title in (("paper", "spectra (paper)"), ("default", "ours"))
        for s in STRATEGIES
    ]  # fmt: skip
    return table(("mean entropy", *(str(START + added) for added in (0, *ADDED))), rows)


def _paired_table(cases: Sequence[Record]) -> str:
    """Return a table of differences from farthest-point sampling, with p-values."""
    rows = []
    for what, unit, sign in (("psnr", " dB", 1), ("entropy", "", -1)):
        for way, title in RECOVERIES.items():
            for strategy in (PAPER, OURS):
                over = mean_increase(cases, strategy, what, way) - mean_increase(
                    cases, FARTHEST, what, way
                )
                p = "-"
                if len(over) > 5 and over.any():
                    p = f"{scipy.stats.wilcoxon(over).pvalue:.3f}"
                label = title if what == "psnr" else f"entropy, {way}"
                rows.append([f"{strategy}, {label}", f"{over.mean():+.3f}{unit}",
                             f"{(sign * over > 0).sum()} of {len(over)}", p])  # fmt: skip
    return table(("compared with farthest", "mean over added views", "better in", "p"), rows)


def _case_table(cases: Sequence[Record]) -> str:
    """Return a table of PSNR gains after all added views, by case, method and strategy."""
    both = [(way, s) for way in RECOVERIES for s in STRATEGIES]
    rows = [
        [case["cell"], *(f"{increases([case], s, 'psnr', way)[0, -1]:+.2f}" for way, s in both)]
        for case in cases
    ]
    heads = (f"gain (dB) with {START + ADDED[-1]}", *(f"{s}, {way}" for way, s in both))
    return table(heads, rows)


def draw_figure9(records: Record) -> Figure | None:
    """Plot mean curves with their standard errors as bands; None without cases."""
    cases = [case for case in records["paper"]["cells"] if case["part"] == "figure9"]
    if not cases:
        return None
    figure = page(13, 3.2)
    panels = [("psnr", way, f"gain (dB), {title}") for way, title in RECOVERIES.items()]
    panels += [
        ("entropy", "paper", "entropy of spectra (paper)"),
        ("entropy", "default", "entropy"),
    ]
    for axes, (what, way, title) in zip(figure.subplots(1, 4), panels, strict=True):
        _draw(axes, cases, what, way)
        axes.set_title(f"mean of {len(cases)} cases: {title}", fontsize=9, color=INK)
        tidy(axes)
    figure.axes[0].legend(frameon=False, fontsize=8)
    return figure


def _draw(axes: Axes, cases: Sequence[Record], what: str, way: str) -> None:
    photographs = START + np.array([0, *ADDED])
    for strategy, color, mark in zip(STRATEGIES, COLORS, MARKS, strict=False):
        above = increases(cases, strategy, what, way)
        shown = above if what == "psnr" else curves(cases, strategy, what, way)
        mean = shown.mean(axis=0)
        axes.plot(photographs, mean, f"{mark}-", color=color, ms=4, lw=1.2, label=strategy)
        if len(cases) > 1:
            error = above.std(axis=0, ddof=1) / np.sqrt(len(cases))
            band = {"color": color, "alpha": 0.12, "lw": 0}
            axes.fill_between(photographs, mean - error, mean + error, **band)
    axes.set_xticks(photographs)
