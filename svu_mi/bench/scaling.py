"""``svu bench scaling``: run time and memory of an estimate by texels and by views.

A line a + b n is fitted to the times; its R^2 measures linearity with a constant overhead. The
slope of the upper half on logarithmic axes is the exponent of growth where the overhead matters
least. Both use the shortest time of several runs, because other load only adds time. All sizes run
in turns, so that slow periods of the machine affect them equally.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from svu_mi.bench.captures import chosen_views
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar, Column, digits, seconds, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.bench.timing import allocated_mib, run, spread
from svu_mi.capture.capture import Capture
from svu_mi.core.memory import MODELS
from svu_mi.geometry.texels import Texels, texels
from svu_mi.pipeline import estimate

STEEPEST, LEAST_R2 = 1.1, 0.95
MODEL_OF = {"angular": "default", "spectrum": "spectrum"}  # memory models of default presets


@dataclass(frozen=True, kw_only=True)
class ScalingSizes:
    """Sizes of the scaling benchmark.

    Attributes:
        resolutions: Texels per side, with all views of the capture.
        views: Numbers of views; views are used several times if the capture has fewer.
        resolution: Texels per side of the curves over views.
        photographs: Number of views, and pixels per side, of the capture.
        repeats: Warm runs of each point.
    """

    resolutions: tuple[int, ...] = (128, 192, 256, 384, 512)
    views: tuple[int, ...] = (15, 30, 60, 120, 240)
    resolution: int = 256
    photographs: tuple[int, int] = (60, 128)
    repeats: int = 5


FULL = ScalingSizes()
QUICK = ScalingSizes(resolutions=(64, 128, 256), views=(15, 60, 240), resolution=96,
              photographs=(24, 128), repeats=3)  # fmt: skip


@dataclass(frozen=True)
class ScalingCase(CaseSubject):
    """A case that is estimated at several sizes."""

    @property
    def rows(self) -> tuple[Measurement, ...]:
        return PARTS

    @property
    def sizes(self) -> ScalingSizes:
        """Sizes of the scaling benchmark."""
        return QUICK if self.bench.quick else FULL

    def settings(self, row: Measurement | None) -> Any:
        return str(self.case.scene), self.case.defines, asdict(self.sizes), row and row.label

    def head(self) -> Record:
        return {"cell": self.title, "views": self.sizes.photographs[0],
                "resolution": self.sizes.resolution}  # fmt: skip

    def curve(self, method: Any, what: str) -> Record:
        """Measure run time and memory by number of texels or views.

        Returns:
            ``method``; ``what``, ``texels`` or ``views``; ``points`` with ``n``, ``seconds`` (a
            spread) and ``allocated_mib``; the fitted ``line`` (see ``line``).
        """
        views, film = self.sizes.photographs
        capture = self.bench.capture(self.case, "scaling", views=views, film=film, spp=8)
        layout = texels(capture.mesh, self.sizes.resolution)
        if what == "texels":
            layouts = [texels(capture.mesh, resolution) for resolution in self.sizes.resolutions]
            sizes = [(layout.count, capture, layout) for layout in layouts]
        else:
            sizes = [(n, repeated(capture, n), layout) for n in self.sizes.views]
        timings = _measured(sizes, method, self.sizes.repeats)
        return {"method": method, "what": what, **timings}


def _part(method: str, what: str) -> Measurement:
    return Measurement(f"{method}, {what}", lambda subject: subject.curve(method, what))


PARTS = tuple(_part(method, what) for method in MODEL_OF for what in ("texels", "views"))


def _curves(record: Record) -> list[Record]:
    return [curve for case in record["cells"] for curve in case["rows"].values()]


def find_bars(record: Record) -> list[Bar]:
    """Return the bars: limits of the exponent of growth and of R^2 of each curve."""
    bars = []
    for curve in _curves(record):
        name, fit = f"{curve['method']}, seconds by {curve['what']}", curve["line"]
        bars += [
            Bar(f"{name}: exponent of the upper half", fit["slope"], STEEPEST),
            Bar(f"{name}: R^2 of a + b n", fit["r2"], LEAST_R2, least=True),
        ]
    return bars


def repeated(capture: Capture, count: int) -> Capture:
    """Return a capture of ``count`` views: evenly spaced ones, or all of them repeatedly."""
    chosen = np.arange(count) % capture.count
    if count < capture.count:
        chosen = np.linspace(0, capture.count - 1, count).round().astype(int)
    return chosen_views(capture, chosen)


def line(n: Sequence[float], seconds: Sequence[float]) -> dict[str, float]:
    """Fit a + b n by least squares.

    Args:
        n: Sizes, ascending, at least three.
        seconds: Times of the sizes.

    Returns:
        ``a`` in seconds; ``b`` in seconds per n; ``r2``; ``slope``, the exponent p of n^p fitted
        to the upper half of the sizes (at least two).
    """
    x, y = np.array(n, np.float64), np.array(seconds, np.float64)
    b, a = np.polyfit(x, y, 1)
    rest = ((y - a - b * x) ** 2).sum() / ((y - y.mean()) ** 2).sum()
    upper = slice(min(len(x) // 2, len(x) - 2), None)
    slope, _ = np.polyfit(np.log(x[upper]), np.log(y[upper]), 1)
    return {"a": float(a), "b": float(b), "r2": float(1 - rest), "slope": float(slope)}


def _measured(
    sizes: Sequence[tuple[int, Capture, Texels]], method: Any, repeats: int
) -> dict[str, Any]:
    """Time all sizes in turns, after runs for kernels and memory; return the curve."""

    def function(size: tuple[int, Capture, Texels]) -> Callable[[], Any]:
        return lambda: estimate(*size[1:], method).entropy

    runs = [function(size) for size in sizes]
    run(runs[0])
    memory = [allocated_mib(partial(run, one)) for one in runs]
    rounds = [[run(one).wall for one in runs] for _ in range(repeats)]
    times = [spread(of_size) for of_size in zip(*rounds, strict=True)]
    n = [size[0] for size in sizes]
    points = [
        {"n": size, "seconds": seconds, "allocated_mib": peak}
        for size, seconds, peak in zip(n, times, memory, strict=True)
    ]
    return {"points": points, "line": line(n, [seconds["low"] for seconds in times])}


SHOWN = (
    Column("estimator", lambda curve: curve["method"]),
    Column("variable n", lambda curve: curve["what"]),
    Column("seconds by n", lambda curve: ", ".join(
        f"{p['n']:,}: {p['seconds']['low']:.3g}" for p in curve["points"])),
    Column("a", lambda curve: curve["line"]["a"], seconds),
    Column("b", lambda curve: curve["line"]["b"], lambda value: f"{1e6 * value:.3g} us"),
    Column("R^2", lambda curve: curve["line"]["r2"], digits(3)),
    Column("exponent, upper half", lambda curve: curve["line"]["slope"], digits(2)),
)  # fmt: skip
MEMORY = (
    Column("estimator", lambda curve: curve["method"]),
    Column("bytes per texel, allocator", lambda curve: 2**20 * np.polyfit(
        [p["n"] for p in curve["points"]], [p["allocated_mib"] for p in curve["points"]], 1)[0],
        digits(0)),
    Column("formula of resident memory", lambda curve: MODELS[MODEL_OF[curve["method"]]]),
)  # fmt: skip


def _tables(record: Record) -> list[str]:
    if not record["cells"]:
        return []
    case, curves = record["cells"][0], _curves(record)
    of_texels = [curve for curve in curves if curve["what"] == "texels"]
    return [
        f"Least wall-clock seconds of several runs, and the fit a + b n. Curves over texels have "
        f"{case['views']} views, curves over views have {case['resolution']} x "
        f"{case['resolution']} texels.",
        tabulate(SHOWN, curves),
        "Growth of the peak of Dr.Jit's allocator with texels. The formula is for all resident "
        "memory.",
        tabulate(MEMORY, of_texels),
    ]


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    return Experiment("scaling", [ScalingCase(bench, selection.cases[0])])


STUDY = Study(title="Scaling of an estimate", experiment=_experiment, tables=_tables,
              bars=find_bars, own_sizes=True)  # fmt: skip
