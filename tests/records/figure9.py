"""Fig. 9 of the paper: which views to add to ten, by expected entropy or farthest from the others.

    python tests/records/figure9.py --data DATA -o figure9.json [--work FOLDER]
    python tests/records/figure9.py --table figure9.json [--plot figure9.png]

6 cells of our own (vase, knot and spheres under window and studio) and 6 of DATA: 100 photographs
of 96 x 96 on a sphere with 16 samples, direct light, 96 x 96 texels. Ten are chosen by farthest-
point sampling from the first; the other 90 are candidates, of which one after another is added:

* `best view (paper)`: least expected entropy, Eq. 13 of power spectra as printed;
* `best view (ours)`: the same of our own estimate, preset `default`;
* `farthest`: the direction farthest from all so far.

After each view, the first two know its photograph, and estimate anew. After three, six and ten,
textures are recovered as in the paper (SH model) and by ours. PSNR, the mean over parameters as in
Table 2, and entropy are over the texels that any of the 100 views sees; where nobody has looked
yet, entropy is 1. Tables have the mean over cells, how many views each strategy needs for +1 dB (of
the mean curve: added ones, interpolated), and a test of what best views gain over farthest ones in
every cell, as a mean over the added views: Wilcoxon's signed ranks, two-sided.

Finished cells of one version are kept; so are photographs. A cell takes one to three minutes on
two cores, most of it recovery as in the paper: 10 times 200 steps.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import record as records

import svu_mi as svu  # before Mitsuba: it chooses LLVM

import mitsuba as mi  # isort: skip

FILM, VIEWS, SPP, TEXELS = 96, 100, 16, 96
START, MARKS = 10, (3, 6, 10)  # photographs; added ones after which textures are recovered
OWN_LIGHTS, LIGHTS = ["window", "studio"], ["photo_studio_01"]
PAPER, OURS, FARTHEST = "best view (paper)", "best view (ours)", "farthest"
STRATEGIES = (PAPER, OURS, FARTHEST)
WAYS = {"paper": "recovered by the SH model (paper)", "default": "recovered by ours"}


class Shoot:
    """One cell, all of whose views are photographed, and strategies that choose among them."""

    def __init__(self, capture: Any) -> None:
        from svu_mi import metrics
        from svu_mi.capture.poses import bounding_sphere, directions_of
        from svu_mi.parameters import NAMES

        self.capture, self.grid = capture, svu.texels(capture.mesh, TEXELS)
        self.directions = directions_of(capture.sensors, bounding_sphere(capture.shape)[0])
        everything = svu.estimate(capture, self.grid, "spectrum", "paper")
        self.visible = np.array(everything.coverage) > 0
        known = metrics.ground_truth(capture, self.grid)
        self.truth = {name: getattr(known, name)[self.visible] for name in NAMES}

    def farthest(self, views: Sequence[int], count: int) -> list[int]:
        """Return views, and ``count`` more by farthest-point sampling."""
        from svu_mi.guidance.baselines import farthest

        return farthest(self.directions, views, count)

    def estimate(self, views: Sequence[int], strategy: str = OURS) -> Any:
        """Return what photographs from these views say to a strategy."""
        from svu_mi.bench.captures import chosen_views

        how = ("spectrum", "paper") if strategy == PAPER else ()
        return svu.estimate(chosen_views(self.capture, views), self.grid, *how)

    def order(self, strategy: str, start: Sequence[int]) -> tuple[list[int], float]:
        """Return the start and the views that a strategy adds, and seconds per added view."""
        chosen, count, began = list(start), len(start) + MARKS[-1], time.perf_counter()
        if strategy == FARTHEST:
            chosen = self.farthest(start, MARKS[-1])
        while len(chosen) < count:
            left = [view for view in range(VIEWS) if view not in chosen]
            candidates = svu.Candidates.at(self.capture, left)
            best = svu.next_best_view(self.estimate(chosen, strategy), candidates).proposals[0]
            chosen.append(left[best.candidate])
        return chosen, (time.perf_counter() - began) / MARKS[-1]

    def judge(self, views: Sequence[int]) -> dict[str, Any]:
        """Return PSNR by way of recovery and parameter, and entropy by preset."""
        from svu_mi import metrics

        ours = self.estimate(views)
        paper = svu.estimate(ours, method="spectrum", preset="paper")
        found: dict[str, Any] = {"psnr": {}, "entropy": {}}
        for name, known in (("paper", paper), ("default", ours)):
            entropy = np.array(known.entropy, np.float64)[self.visible]
            found["entropy"][name] = float(entropy.mean())
            textures = svu.recover(ours, method="sh", preset=name).textures
            values = {key: textures.at(self.grid, key)[self.visible] for key in self.truth}
            found["psnr"][name] = metrics.texture_psnr(values, self.truth)
        return found

    def run(self) -> dict[str, Any]:
        """Return the views and points of every strategy's curve."""
        start = self.farthest([0], START - 1)
        first, curves = self.judge(start), {}
        for strategy in STRATEGIES:
            views, seconds = self.order(strategy, start)
            points = [first, *(self.judge(views[: START + mark]) for mark in MARKS)]
            curves[strategy] = {"views": views, "seconds per view": seconds, "points": points}
        return curves


def curve(cell: dict[str, Any], strategy: str, what: str, way: str) -> np.ndarray:
    """Return a cell's average PSNR (dB) or mean entropy, at the start and after each mark."""
    points = [point[what][way] for point in cell["curves"][strategy]["points"]]
    return np.array([point["average"] if what == "psnr" else point for point in points])


def gains(cells: Sequence[dict[str, Any]], strategy: str, what: str, way: str) -> np.ndarray:
    """Return (cells, 1 + marks) curves above their start."""
    found = np.array([curve(cell, strategy, what, way) for cell in cells])
    return found - found[:, :1]


def groups(record: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return all cells, those of our own, and those of DATA; or the only ones there are."""
    found = records.groups(record["cells"])
    if len(found) < 2:
        return found
    return {"all": [cell for cells in found.values() for cell in cells], **found}


def needed(mean: np.ndarray, step: float) -> str:
    """Return the added views for a gain of so many dB."""
    from svu_mi.bench.guidance.verdict import views_needed

    views = views_needed(MARKS, mean.tolist(), step) if step > 0 else 0.0
    return f"> {MARKS[-1]}" if np.isnan(views) else f"{views:.1f}"


def tables(record: dict[str, Any]) -> str:
    """Return curves, views needed and tests, as Markdown."""
    parts = []
    for group, cells in groups(record).items():
        for way, title in WAYS.items():
            parts.append(curve_table(cells, way, f"{len(cells)} cells ({group}), {title}"))
        parts.append(entropy_table(cells))
        parts.append(paired_table(cells))
    parts.append(cell_table(record))
    return "\n\n".join(parts)


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def curve_table(cells: Sequence[dict[str, Any]], way: str, title: str) -> str:
    """Return mean gains of PSNR by strategy, and the views needed for a gain."""
    mean = {s: gains(cells, s, "psnr", way).mean(axis=0) for s in STRATEGIES}
    last = float(mean[FARTHEST][-1])
    rows = []
    for s in STRATEGIES:
        seconds = np.mean([cell["curves"][s]["seconds per view"] for cell in cells])
        rows.append([s, *(f"{value:+.2f}" for value in mean[s][1:]), needed(mean[s], 1.0),
                     needed(mean[s], last - 1e-9), f"{seconds:.1f}"])  # fmt: skip
    heads = ["gain (dB) with so many photographs", *(str(START + mark) for mark in MARKS),
             "views for +1 dB", f"views for {last:+.2f} dB", "seconds per view"]  # fmt: skip
    start = np.mean([curve(cell, FARTHEST, "psnr", way)[0] for cell in cells])
    return f"{title}; the start has {start:.2f} dB\n\n" + markdown(heads, rows)


def entropy_table(cells: Sequence[dict[str, Any]]) -> str:
    """Return mean entropies by strategy."""
    rows = []
    for way, title in (("paper", "of spectra (paper)"), ("default", "ours")):
        for strategy in STRATEGIES:
            mean = np.mean([curve(cell, strategy, "entropy", way) for cell in cells], axis=0)
            rows.append([f"{title}: {strategy}", *(f"{value:.3f}" for value in mean)])
    return markdown(["mean entropy", *(str(START + mark) for mark in (0, *MARKS))], rows)


def paired_table(cells: Sequence[dict[str, Any]]) -> str:
    """Return what a strategy gains over farthest-point sampling in every cell, and p of none."""
    from scipy.stats import wilcoxon

    rows = []
    for what, ways in (("psnr", WAYS), ("entropy", ("paper", "default"))):
        for way in ways:
            for strategy in (PAPER, OURS):
                over = mean_gain(cells, strategy, what, way) - mean_gain(cells, FARTHEST, what, way)
                sign, unit = (1, " dB") if what == "psnr" else (-1, "")
                p = f"{wilcoxon(over).pvalue:.3f}" if len(over) > 5 and over.any() else "-"
                title = WAYS[way] if what == "psnr" else f"entropy, {way}"
                rows.append([f"{strategy}, {title}", f"{over.mean():+.3f}{unit}",
                             f"{(sign * over > 0).sum()} of {len(over)}", p])  # fmt: skip
    return markdown(["over farthest", "mean over added views", "better in", "p"], rows)


def mean_gain(cells: Sequence[dict[str, Any]], strategy: str, what: str, way: str) -> np.ndarray:
    """Return (cells,) means of a curve above its start, over the added views."""
    places = np.array([0, *MARKS], float)
    return np.trapezoid(gains(cells, strategy, what, way), places, axis=1) / places[-1]


def cell_table(record: dict[str, Any]) -> str:
    """Return the gain of every cell with all photographs, as recovered in the paper and by ours."""
    rows = []
    for name, cell in record["cells"].items():
        ends = [gains([cell], s, "psnr", way)[0, -1] for way in WAYS for s in STRATEGIES]
        values = [f"{value:+.2f}" for value in ends]
        rows.append([name.replace("__", " / "), *values, f"{cell['seconds']:.0f}"])
    heads = [f"{s}, {way}" for way in WAYS for s in STRATEGIES]
    return markdown([f"gain (dB) with {START + MARKS[-1]}", *heads, "seconds"], rows)


def plot(record: dict[str, Any], file: Path) -> None:
    """Draw mean curves and those of every cell."""
    from svu_mi.bench.plots import INK, page, tidy
    from svu_mi.output.style import save_figure

    cells = list(record["cells"].items())
    rows = 1 + -(-len(cells) // 4)
    figure = page(13, 2.9 * rows)
    axes = figure.subplots(rows, 4, squeeze=False)
    every = [cell for _, cell in cells]
    panels = [
        ("psnr", "paper", "gain (dB), SH model (paper)"),
        ("psnr", "default", "gain (dB), ours"),
        ("entropy", "paper", "entropy of spectra (paper)"),
        ("entropy", "default", "entropy, ours"),
    ]
    for place, (what, way, title) in zip(axes[0], panels, strict=True):
        draw(place, every, what, way)
        place.set_title(f"mean of {len(every)} cells: {title}", fontsize=9, color=INK)
    for place, (name, cell) in zip(axes[1:].flat, cells, strict=False):
        draw(place, [cell], "psnr", "paper")
        place.set_title(f"{name.replace('__', ' / ')}: gain (dB), SH model", fontsize=9, color=INK)
    for place in axes.flat:
        tidy(place)
        place.set_visible(place.has_data())
    axes[0, 0].legend(frameon=False, fontsize=8)
    save_figure(figure, file)


def draw(place: Any, cells: Sequence[dict[str, Any]], what: str, way: str) -> None:
    """Draw the mean over cells, above the start's for PSNR; its standard error as a band."""
    from svu_mi.bench.plots import COLORS
    from svu_mi.bench.plots import MARKS as SHAPES

    photographs = START + np.array([0, *MARKS])
    for strategy, color, shape in zip(STRATEGIES, COLORS, SHAPES, strict=False):
        found = np.array([curve(cell, strategy, what, way) for cell in cells])
        above = found - found[:, :1]
        mean = (above if what == "psnr" else found).mean(axis=0)
        place.plot(photographs, mean, f"{shape}-", color=color, ms=4, lw=1.2, label=strategy)
        if len(cells) > 1:
            error = above.std(axis=0, ddof=1) / np.sqrt(len(cells))
            band = {"color": color, "alpha": 0.12, "lw": 0}
            place.fill_between(photographs, mean - error, mean + error, **band)
    place.set_xticks(photographs)


def parser() -> argparse.ArgumentParser:
    """Return what this record is asked."""
    found = records.arguments(__doc__)
    found.add_argument("--plot", type=Path, help="draw the curves into this PNG file")
    return found


def main() -> None:
    """Record all cells; finished ones of the same version are kept."""
    asked = parser().parse_args()
    if asked.table:
        record = json.loads(asked.table.read_text())
    else:
        mi.set_variant("llvm_ad_rgb")
        record = records.read(asked.output)
        cells = records.some_cells(asked.data, asked.work, OWN_LIGHTS, LIGHTS)
        record["cells"] = records.run("figure9", cells, asked, records.alone(measure, asked))
        records.save(asked.output, record)
    print(tables(record))
    if asked.plot:
        plot(record, asked.plot)


def measure(cell: Any, work: Path) -> dict[str, Any]:
    """Return the curves of a cell, and how long they took."""
    folder = work / f"{cell.name}_{FILM}_of_{VIEWS}"
    capture = records.rendered(cell, folder, FILM, VIEWS, SPP)
    began = time.perf_counter()
    curves = Shoot(capture).run()
    return {"seconds": time.perf_counter() - began, "curves": curves}


if __name__ == "__main__":
    main()
