"""Comparisons of whole estimates: with double precision, with another capture, with a refusal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from oracle.rounding import U

from extremes.captures import ball, exact
from extremes.cases import Case, Found, compared, entropies, refused
from svu_mi.capture import Capture
from svu_mi.options import AnyPreset, Method
from svu_mi.pipeline import Estimate, estimate
from svu_mi.surface import texels

RESOLUTION = 16
METHODS: tuple[Method, ...] = ("angular", "spectrum")
WAYS: tuple[tuple[Method, str], ...] = (
    ("angular", "default"), ("angular", "fixed"), ("spectrum", "default"),
)  # fmt: skip
"""Methods and presets that are different mathematics."""

Taken = Callable[[], Capture]


def run(capture: Capture, method: Method, switches: str | AnyPreset = "default") -> Estimate:
    """Estimate at the resolution of all cases."""
    return estimate(capture, texels(capture.mesh, RESOLUTION), method, switches)


def agrees(
    taken: Taken, method: Method, switches: str | AnyPreset = "default", every: int = 9
) -> Found:
    """Entropy of one in ``every`` texels against double precision from their samples on."""
    found = run(taken(), method, switches)
    chosen = np.flatnonzero(np.array(found.coverage) > 0)[::every]
    truth = exact(found, chosen)
    H = np.array(found.entropy, np.float64)
    errors = np.abs(H[chosen] - [x.entropy for x in truth])
    return Found(errors, np.array([x.bound for x in truth]), H)


def both(name: str, taken: Taken, quick: bool) -> Iterator[Case]:
    """A capture by both methods, with noise that is estimated and that is not."""
    every = 29 if quick else 9
    for method, named in WAYS:
        yield f"{name}, {method}, {named}", partial(agrees, taken, method, named, every)


def photographed(folder: Path, **changes: Any) -> Taken:
    """A capture that is rendered when it is first asked for."""
    return cache(lambda: ball(**changes).capture(folder))


def same_entropy(before: Taken, after: Taken, method: Method, switches: AnyPreset) -> Found:
    """Entropy of every texel of two captures, which 16 roundings of its last place may part."""
    one, other = (run(taken(), method, switches) for taken in (before, after))
    return entropies(other.entropy, one.entropy, 16 * U)


def same_coverage(before: Taken, after: Taken) -> Found:
    """Part of the texels that another number of views sees: of those on a border, some flip."""
    one, other = (run(taken(), "angular") for taken in (before, after))
    changed = np.mean(np.array(one.coverage) != np.array(other.coverage))
    return compared([changed], 0.0, 0.02, other.entropy)


def refused_run(taken: Taken, method: Method) -> Found:
    """Error 0 if a capture can be made, but not be estimated."""
    capture = taken()  # made before: only the estimate may refuse it
    return refused(lambda: run(capture, method))
