"""Prior of the calibrated posterior: a density within the bins of the grid."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.posterior import row_entropy
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.kernel import Prior
from svu_mi.posterior.quadrature import bin_widths


@dataclass(frozen=True)
class CalibratedPrior(Prior):
    """Prior with a continuous density within bins."""

    problem: CalibratedProblem

    @staticmethod
    def of(problem: CalibratedProblem, grid: PrincipledGrid) -> "CalibratedPrior":
        """Return the prior of bins, (R, M ..., K) float64, the mean over channels."""
        return CalibratedPrior(
            prior_tables(problem).mean(axis=3).reshape(grid.shape), grid.axes, problem
        )

    @cached_property
    def max_entropy(self) -> float:  # type: ignore[override]
        """Normalisation of entropies [nats]: the prior's entropy, mean over channels."""
        tables = np.moveaxis(prior_tables(self.problem), -1, 0)
        return float(np.mean([row_entropy.entropy_of(p) for p in tables]))

    @property
    def entropy(self) -> float:
        """Normalised entropy, 1 by definition."""
        return 1.0

    def moments(self, name: str) -> tuple[Any, Any]:
        """Return mean and standard deviation of a parameter (see ``Prior``)."""
        low, high, p = self._parts(name)
        if name == "base_color":
            p = np.repeat(prior_tables(self.problem).sum(axis=(0, 1)).T, self.problem.copies, 0)
        middle = (low + high) / 2
        mean = p @ middle
        spread = (middle - np.expand_dims(mean, -1)) ** 2 + (high - low) ** 2 / 12
        return mean, np.sqrt((p * spread).sum(axis=-1))

    def draws(self, count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
        """Sample parameters, with equal values in all channels (see ``Prior``)."""
        picked = random.choice(self.probabilities.size, count, p=self.probabilities.ravel())
        drawn = {}
        indices = np.unravel_index(picked, self.probabilities.shape)
        for name, bin_index in zip(self.axes, indices, strict=True):
            low, high, p = self._parts(name)
            own = bin_index
            if name != "base_color":
                axis = self.problem.axis(name)
                below = np.concatenate([[0], np.cumsum(p)])
                first, last = below[axis.first[bin_index]], below[axis.first[bin_index + 1]]
                at = first + random.random(count) * (last - first)
                own = np.clip(np.searchsorted(below, at, "right") - 1, axis.first[bin_index],
                              axis.first[bin_index + 1] - 1)  # fmt: skip
            drawn[name] = low[own] + random.random(count) * (high - low)[own]
        return drawn

    def _parts(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return low end, high end and prior probability of a parameter's N parts: (N,) each."""
        of_bins = self.marginal(name)
        if name == "base_color":
            edges = self.problem.edges
            return edges[:-1], edges[1:], of_bins
        axis = self.problem.axis(name)
        return axis.low, axis.high, of_bins[axis.bin] * axis.mass / axis.of_bins()[axis.bin]


def prior_tables(problem: CalibratedProblem) -> np.ndarray:
    """Return the prior of bins, (R, M, K, C) float64; the sum is 1 for each channel."""
    shape = (*problem.shape[:2], problem.tables, problem.shape[2])
    rows = np.exp(-problem.rows).reshape(*shape[:2], 1, 1)
    width = bin_widths(problem.edges)
    given = (
        np.ones(shape)
        if problem.color_prior is None
        else problem.color_prior.numpy().reshape(shape)
    )
    masses = np.moveaxis(rows * given * width, 2, 3)
    masses = masses / masses.sum(axis=(0, 1, 2))
    return np.repeat(masses, problem.factors.channels // problem.tables, axis=3)
