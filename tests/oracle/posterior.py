"""Eq. 3, 5 and 11 by brute force: every cell of the grid, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from svu_mi.bench.oracle import distances as distances
from svu_mi.bench.oracle import entropy as entropy
from svu_mi.bench.oracle import model as model
from svu_mi.bench.oracle import nodes as nodes
from svu_mi.bench.oracle import normalize as normalize


@dataclass(frozen=True)
class Prior:
    """What there is to say of a texel nobody saw: p(psi) and nothing else.

    Attributes:
        p: (*grid,) probabilities of cells.
        nodes: of every axis, in order.
    """

    p: np.ndarray
    nodes: list[np.ndarray]

    @staticmethod
    def of(weights: np.ndarray, nodes: list[np.ndarray]) -> Prior:
        """Take weights of cells (*grid,), or one per node of the first axis."""
        shape = [len(axis) for axis in nodes]
        whole = np.ones(shape)
        for cell in np.ndindex(*shape):
            whole[cell] = weights[cell] if np.ndim(weights) == len(shape) else weights[cell[0]]
        return Prior(whole / whole.sum(), nodes)

    def entropy(self) -> float:
        """H over log n (Eq. 5)."""
        return entropy(self.p)

    def marginal(self, axis: int) -> np.ndarray:
        """Probabilities of the nodes of an axis."""
        return np.moveaxis(self.p, axis, 0).reshape(len(self.nodes[axis]), -1).sum(axis=1)

    def mean(self, axis: int) -> float:
        """Of a parameter."""
        return float((self.marginal(axis) * self.nodes[axis]).sum())

    def sd(self, axis: int) -> float:
        """Standard deviation of a parameter."""
        away = (self.nodes[axis] - self.mean(axis)) ** 2
        return float(np.sqrt((self.marginal(axis) * away).sum()))
