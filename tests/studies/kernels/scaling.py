"""How run time and memory of an estimate grow with texels and with views.

A line a + b n is fitted to the times. Its R^2 says whether they are linear with a constant
overhead; the slope of the upper half on logarithmic axes says with which power they grow where
the overhead counts least. Both take the least time of several runs, as other load on a machine
only ever adds to it; and all sizes take turns, so that a slow spell does not bend the line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from studies.clock import run, spread
from studies.kernels.memory import MIB, MODEL_OF, allocated
from svu_mi.bench.captures import chosen_views
from svu_mi.bench.text import Bar
from svu_mi.capture import Capture
from svu_mi.needs import MODELS
from svu_mi.pipeline import estimate
from svu_mi.surface import Texels, texels

STEEPEST, LEAST_R2 = 1.1, 0.95
METHODS = ("angular", "spectrum")


@dataclass(frozen=True)
class Range:
    """What is varied.

    Attributes:
        resolutions: texels per side, with all views of the capture.
        views: numbers of views; those of the capture are used again and again.
        resolution: texels per side while views vary.
    """

    resolutions: tuple[int, ...] = (128, 192, 256, 384, 512)
    views: tuple[int, ...] = (15, 30, 60, 120, 240)
    resolution: int = 256


def measure_scaling(
    capture: Capture, sizes: Range, repeats: int, methods: tuple[str, ...] = METHODS
) -> dict[str, Any]:
    """Time estimates of a capture at several sizes.

    Args:
        capture: its photographs should be small, as they are in memory many times.
        sizes: what is varied.
        repeats: warm runs of each point.
        methods: of ``estimate``.

    Returns:
        ``curves``: one per method and ``what`` (``texels`` or ``views``), with its ``points``
        (``n``; ``seconds``, a spread; ``allocated_mib``) and ``line`` (see ``line``), that of
        the least times;
        ``bytes_per_texel`` by method: measured as the slope of the allocator's peak, and the
        ``formula`` of all resident memory; and ``bars``: no curve is steeper than linear, and a
        line explains it.
    """
    layouts = [texels(capture.mesh, resolution) for resolution in sizes.resolutions]
    layout = texels(capture.mesh, sizes.resolution)
    cases = {
        "texels": [(layout.count, capture, layout) for layout in layouts],
        "views": [(n, repeated(capture, n), layout) for n in sizes.views],
    }
    curves = [
        {"method": method, "what": what, **_curve(cases[what], method, repeats)}
        for method in methods
        for what in cases
    ]
    return {
        "resolution": sizes.resolution,
        "views": capture.count,
        "curves": curves,
        "bytes_per_texel": {
            curve["method"]: {
                "allocator": MIB * _slope(curve["points"], "allocated_mib"),
                "formula": MODELS[MODEL_OF[curve["method"]]],
            }
            for curve in curves
            if curve["what"] == "texels"
        },
        "bars": [bar.record() for curve in curves for bar in _bars(curve)],
    }


def _bars(curve: dict[str, Any]) -> list[Bar]:
    name, found = f"{curve['method']}, seconds by {curve['what']}", curve["line"]
    return [
        Bar(f"{name}: exponent of the upper half", found["slope"], STEEPEST, ""),
        Bar(f"{name}: R^2 of a + b n", found["r2"], LEAST_R2, "", least=True),
    ]


def repeated(capture: Capture, count: int) -> Capture:
    """Return a capture of ``count`` views: spread over the given ones, or these repeated."""
    chosen = np.arange(count) % capture.count
    if count < capture.count:
        chosen = np.linspace(0, capture.count - 1, count).round().astype(int)
    return chosen_views(capture, chosen)


def line(n: Sequence[float], seconds: Sequence[float]) -> dict[str, float]:
    """Fit a + b n by least squares.

    Args:
        n: at least three sizes, ascending.
        seconds: their times.

    Returns:
        ``a`` in seconds, ``b`` in seconds per n, ``r2``, and ``slope``: the exponent p of
        n^p that fits the upper half of the sizes, at least two.
    """
    x, y = np.array(n, np.float64), np.array(seconds, np.float64)
    b, a = np.polyfit(x, y, 1)
    rest = ((y - a - b * x) ** 2).sum() / ((y - y.mean()) ** 2).sum()
    upper = slice(min(len(x) // 2, len(x) - 2), None)
    slope, _ = np.polyfit(np.log(x[upper]), np.log(y[upper]), 1)
    return {"a": float(a), "b": float(b), "r2": float(1 - rest), "slope": float(slope)}


def _curve(
    cases: Sequence[tuple[int, Capture, Texels]], method: Any, repeats: int
) -> dict[str, Any]:
    """Measure the sizes in turns, after each was run once (the first twice) for its memory."""

    def function(case: tuple[int, Capture, Texels]) -> Callable[[], Any]:
        return lambda: estimate(*case[1:], method).entropy

    runs = [function(case) for case in cases]
    run(runs[0])
    memory = [allocated(partial(run, one)) for one in runs]
    rounds = [[run(one).wall for one in runs] for _ in range(repeats)]
    times = [spread(of_case) for of_case in zip(*rounds, strict=True)]
    n = [case[0] for case in cases]
    points = [
        {"n": size, "seconds": seconds, "allocated_mib": peak}
        for size, seconds, peak in zip(n, times, memory, strict=True)
    ]
    return {"points": points, "line": line(n, [seconds["low"] for seconds in times])}


def _slope(points: Sequence[dict[str, Any]], name: str) -> float:
    return float(np.polyfit([p["n"] for p in points], [p[name] for p in points], 1)[0])
