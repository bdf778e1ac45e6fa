"""What a check of stability is made of: cases of an axis, and what one of them found."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.errors import SvuError


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
