"""What a check of stability is made of: cases of an axis, and what one of them found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.errors import SvuError
from svu_mi.posterior import ParameterGrid, PrincipledGrid

Grid = ParameterGrid | PrincipledGrid


@dataclass(frozen=True)
class Found:
    """What one case found.

    Attributes:
        errors: (N,) differences from the truth.
        bounds: (N,) or one number: how large they may be.
        entropy: (T,) entropies, empty if the case has none.
    """

    errors: np.ndarray
    bounds: np.ndarray | float
    entropy: np.ndarray


Case = tuple[str, Callable[[], Found]]


@dataclass(frozen=True)
class Axis:
    """A row of the table.

    Attributes:
        name: the quantity.
        range: its ends, in words.
        compared: what with what.
        cases: of a folder for meshes, and of whether only few are wanted.
    """

    name: str
    range: str
    compared: str
    cases: Callable[[Path, bool], Iterator[Case]]


def compared(
    ours: Any, truth: Any, bounds: np.ndarray | float, entropy: Any | None = None
) -> Found:
    """Return the absolute differences of two arrays, and their bounds."""
    errors = np.abs(np.asarray(ours, np.float64) - np.asarray(truth, np.float64)).ravel()
    values = np.zeros(0) if entropy is None else np.array(entropy, np.float64).ravel()
    return Found(errors, bounds, values)


def entropies(ours: Any, truth: Any, bounds: np.ndarray | float) -> Found:
    """``compared`` of entropies."""
    return compared(np.array(ours), truth, bounds, ours)


def refused(function: Callable[[], Any]) -> Found:
    """Error 0 if a function refuses its input with a sentence, infinite if it returns."""
    try:
        function()
    except SvuError:
        return Found(np.zeros(1), 0.0, np.zeros(0))
    return Found(np.full(1, np.inf), 0.0, np.zeros(0))


def exposures(
    rules: Iterable[tuple[str, Any, Any]], exposed: Callable[[Any, Any, int], Found], quick: bool
) -> Iterator[Case]:
    """Yield cases of radiance times 2^power for all rules that should not see it.

    Powers of two round nothing: entropy may differ by what its own sums round.

    Args:
        rules: name, preset and grid of each.
        exposed: runs one of a preset, a grid and a power.
        quick: only the ends.
    """
    for name, switches, grid in rules:
        if switches.noise == "fixed":
            continue
        for power in (-20, 20) if quick else (-20, -10, -1, 1, 10, 20):
            yield f"{name}, radiance times 2^{power}", partial(exposed, switches, grid, power)
