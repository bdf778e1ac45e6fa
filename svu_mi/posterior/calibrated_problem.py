"""Inputs of a calibrated posterior: statistics, noise, prior, and tables of nodes."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.parameters import MIXED
from svu_mi.posterior.quadrature import ProductAxis, QuadratureAxis
from svu_mi.reflection.roughness_levels import spline_weights
from svu_mi.statistics.cholesky_factors import Factors

NEVER = 1e30  # stands for -log 0


@dataclass(frozen=True)
class CalibratedProblem:
    """Inputs of a calibrated posterior. A row is a bin of all parameters but base colour.

    Attributes:
        copies: number of equal colour channels per channel of the factors.
        edges: (K + 1,) edges of the base colour bins; two equal edges if base colour is known.
        rows: (R * M,) float64, -log prior of each row.
        color_prior: (R * M * tables * K,) Float, density of base colour in a row; None: uniform.
        scale: (S,) or (1,) Float, sqrt(W / (s^2 tau)), W: sum of weights; scales factors to noise.
        min_energy: (S,) Float, smallest energy of all nodes, without the residual floor.
        tables: number of colour priors: 1 (shared by all channels) or one per channel.
    """

    factors: Factors
    copies: int
    roughness: QuadratureAxis
    mixed: ProductAxis
    edges: np.ndarray
    rows: np.ndarray
    color_prior: Any | None
    scale: Any
    min_energy: Any
    tables: int = 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of bins, (R, M, K)."""
        return self.roughness.bins, self.mixed.bins, len(self.edges) - 1

    def axis(self, name: str) -> QuadratureAxis:
        """Return the quadrature axis of a parameter."""
        return self.mixed.axes[MIXED.index(name)] if name in MIXED else self.roughness

    @cached_property
    def nodes(self) -> "NodeTables":
        """Node tables of the kernels."""
        return NodeTables.of(self)

    @cached_property
    def max_log_prior(self) -> float:
        """Maximum over nodes of the log prior density of all base colours [nats]."""
        if self.color_prior is None:
            return 0.0
        most = float(dr.max(self.color_prior)[0])
        return self.copies * self.factors.channels * float(np.log(max(most, 1.0)))

    @cached_property
    def least_color_prior(self) -> float:
        """Smallest density of base colour."""
        return 1.0 if self.color_prior is None else float(dr.min(self.color_prior)[0])

    def subset(self, chosen: np.ndarray) -> "CalibratedProblem":
        """Return the problem of the lanes ``chosen``, in [0, S)."""
        lanes = to_drjit(mi.UInt32, chosen)
        return replace(
            self, factors=self.factors.subset(chosen),
            scale=dr.gather(mi.Float, self.scale, lanes),
            min_energy=dr.gather(mi.Float, self.min_energy, lanes),
        )  # fmt: skip


@dataclass(frozen=True)
class NodeValues:
    """Values of a parameter at nodes, and its variance within each node's part: (N,) Floats."""

    value: Any
    variance: Any

    @staticmethod
    def of(value: np.ndarray, variance: np.ndarray) -> "NodeValues":
        return NodeValues(to_drjit(mi.Float, value), to_drjit(mi.Float, variance))

    def at(self, node: Any) -> Any:
        """Return the value of a node: Float."""
        return dr.gather(mi.Float, self.value, node)

    def moments(self, node: Any) -> tuple[Any, Any]:
        """Return mean and mean square over the part of a node: Float64."""
        mean = mi.Float64(self.at(node))
        return mean, dr.fma(mean, mean, mi.Float64(dr.gather(mi.Float, self.variance, node)))

    def sample(self, node: Any, random: Any) -> Any:
        """Sample uniformly within the part of a node; ``random`` is in [0, 1)."""
        variance = dr.gather(mi.Float, self.variance, node)
        return self.at(node) + (random - 0.5) * dr.sqrt(12 * variance)


@dataclass(frozen=True)
class NodeTables:
    """Node tables on the device: N roughness nodes ("rows"), L mixing nodes ("columns").

    Attributes:
        levels, weights: (N * 4,) UInt32 and Float, levels and spline weights of roughness nodes.
        rows: values of the N roughness nodes.
        columns: values of the L mixing nodes, for each mixing parameter.
        row, column: (N,), (L,) UInt32, bin of each node.
        prior: (N * L,) Float, -log prior.
        first: (R + 1,) UInt32, first roughness node of each bin.
        last: (N,) UInt32, number of mixing bins at the last node of a roughness bin, else 0.
    """

    levels: Any
    weights: Any
    rows: NodeValues
    columns: list[NodeValues]
    row: Any
    column: Any
    prior: Any
    first: Any
    last: Any

    @staticmethod
    def of(problem: CalibratedProblem) -> "NodeTables":
        r, m = problem.roughness, problem.mixed
        levels, weights = spline_weights(r.value, problem.factors.levels)
        ends = np.diff(r.bin, append=r.bins) != 0
        inside = [axis.mass / axis.of_bins()[axis.bin] for axis in (r, m)]
        values, variances = m.at_all("value"), m.at_all("part_variance")
        rows = problem.rows.reshape(problem.shape[:2])[r.bin][:, m.bin]
        prior = np.minimum(rows - np.log(inside[0])[:, None] - np.log(inside[1]), NEVER)
        return NodeTables(
            levels=to_drjit(mi.UInt32, levels.ravel().astype(np.uint32)),
            weights=to_drjit(mi.Float, weights.ravel()),
            rows=NodeValues.of(r.value, r.part_variance),
            columns=[NodeValues.of(*x) for x in zip(values, variances, strict=True)],
            row=to_drjit(mi.UInt32, r.bin.astype(np.uint32)),
            column=to_drjit(mi.UInt32, m.bin.astype(np.uint32)),
            prior=to_drjit(mi.Float, prior.ravel()),
            first=to_drjit(mi.UInt32, r.first.astype(np.uint32)),
            last=to_drjit(mi.UInt32, (ends * problem.shape[1]).astype(np.uint32)),
        )
