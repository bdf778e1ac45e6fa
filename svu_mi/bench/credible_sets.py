"""Coverage of the truth by highest-density credible sets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.bench.metric_inputs import finite_vector
from svu_mi.errors import OptionError, ShapeError
from svu_mi.evaluation.psnr import require_finite

TIE = 1e-6  # relative difference below which two float32 probabilities are equal


@dataclass(frozen=True)
class CredibleCoverage:
    """Frequency with which credible sets of one mass contain the truth.

    Attributes:
        level: Mass of the sets, in (0, 1).
        plain: Fraction of texels whose set contains the truth. Sets of whole cells have at least
            the mass ``level``, often much more, so a calibrated posterior exceeds the level.
        fractional: Fraction if the last cells are included with a probability that makes the
            mass exact; equals the level for a calibrated posterior.
        size: Mean fraction of the grid's cells in a set.
        count: Number of texels.
    """

    level: float
    plain: float
    fractional: float
    size: float
    count: int


def nearest_bins(axes: Mapping[str, Any], truth: Mapping[str, Any]) -> np.ndarray:
    """Return the flat index of the cell that contains the true values, (T,).

    Args:
        axes: Nodes of each axis by name, in the order of the grid's axes.
        truth: (T,) true values by name, for every axis. The nearest node wins, ties go to the
            lower one.
    """
    bins: list[np.ndarray] = []
    for name, nodes in axes.items():
        values = finite_vector(truth[name], name, len(bins[0]) if bins else None)
        bins.append(np.abs(values[:, None] - np.asarray(nodes)).argmin(axis=1))
    return np.ravel_multi_index(bins, [len(nodes) for nodes in axes.values()])


def credible_coverage(probabilities: Any, bins: Any, mass: float) -> CredibleCoverage:
    """Return how often the highest-density credible set contains the truth.

    The set is the smallest set of cells with at least the mass ``mass``, plus all cells that tie
    with the last one.

    Args:
        probabilities: (T, *grid) non-negative; the sum of each texel is 1.
        bins: (T,) flat index of the true cell (``nearest_bins``).
        mass: Mass of the set, in (0, 1).
    """
    if not 0 < mass < 1:
        raise OptionError(f"The level of a credible set must be in (0, 1), got {mass}.")
    p = _distributions(probabilities)
    true = np.array(bins)
    if true.shape != (len(p),) or true.dtype.kind not in "iu":
        raise ShapeError(f"bins must be ({len(p)},) integers, got {true.dtype} {true.shape}.")
    if true.min() < 0 or true.max() >= p.shape[1]:
        raise ShapeError(f"A true cell is outside the grid of {p.shape[1]} cells.")
    own = p[np.arange(len(p)), true][:, None]
    above = np.where(p > own * (1 + TIE), p, 0).sum(axis=1)
    tied = np.where(np.abs(p - own) <= TIE * own, p, 0).sum(axis=1)
    part = np.where(tied > 0, np.clip((mass - above) / np.maximum(tied, 1e-300), 0, 1), 0)
    return CredibleCoverage(
        level=mass, plain=float((above < mass - TIE).mean()), fractional=float(part.mean()),
        size=float(_sizes(p, mass).mean()), count=len(p),
    )  # fmt: skip


def _distributions(probabilities: Any) -> np.ndarray:
    p = np.array(probabilities, np.float64)
    if p.ndim < 2 or p.size == 0:
        raise ShapeError(f"probabilities must be (T, *grid), got shape {p.shape}.")
    p = p.reshape(len(p), -1)
    require_finite(p, "probabilities")
    sums = p.sum(axis=1)
    if (p < 0).any() or np.abs(sums - 1).max() > 1e-3:
        raise OptionError(
            f"probabilities must be distributions; their sums are {sums.min():.4g} to "
            f"{sums.max():.4g}."
        )
    return p / sums[:, None]


def _sizes(p: np.ndarray, mass: float) -> np.ndarray:
    """Return the fraction of cells in each set, (T,)."""
    ordered = -np.sort(-p, axis=1)
    reached = np.cumsum(ordered, axis=1) >= mass - TIE
    last = np.where(reached.any(axis=1), reached.argmax(axis=1), p.shape[1] - 1)
    threshold = ordered[np.arange(len(p)), last][:, None]
    return (p >= threshold * (1 - TIE)).mean(axis=1)
