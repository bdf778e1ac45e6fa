"""Simpler ways to choose views, which expected entropy has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from svu_mi.posterior import PrincipledGrid


class Farthest:
    """Farthest-point sampling: the direction farthest from all views so far."""

    def __init__(self, directions: np.ndarray, views: int) -> None:
        """Make it of unit directions (V, 3) from the object; the first ``views`` are taken."""
        self._candidates, taken = directions[views:], directions[:views]
        self._angles = _angles(self._candidates, taken).min(axis=1, initial=np.pi)

    def gains(self) -> np.ndarray:
        """Angle to the nearest view so far, in radians."""
        return self._angles

    def choose(self, candidate: int) -> None:
        """Add a candidate."""
        own = _angles(self._candidates, self._candidates[[candidate]])[:, 0]
        self._angles = np.minimum(self._angles, own)


def farthest(directions: np.ndarray, taken: Sequence[int], count: int) -> list[int]:
    """Add directions by farthest-point sampling.

    Args:
        directions: (V, 3), of unit length.
        taken: indices of those to start from.
        count: how many to add.

    Returns:
        ``taken``, and ``count`` more, or fewer if there are fewer.
    """
    chosen = list(taken)
    strategy = Farthest(np.concatenate([directions[chosen], directions]), len(chosen))
    free = np.ones(len(directions), bool)
    free[chosen] = False
    for _ in range(min(count, int(free.sum()))):
        best = int(np.argmax(np.where(free, strategy.gains(), -np.inf)))
        strategy.choose(best)
        free[best] = False
        chosen.append(best)
    return chosen


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(a @ b.T, -1, 1))


class Random:
    """Any order, each as likely."""

    def __init__(self, candidates: int, seed: int) -> None:
        self._gains = np.random.default_rng(seed).permutation(candidates).astype(np.float64)

    def gains(self) -> np.ndarray:
        """Ranks."""
        return self._gains

    def choose(self, candidate: int) -> None:
        """Add a candidate: others keep their rank."""


class Coverage:
    """Most texels that few views see: each is worth 2^-n, seen by n views so far."""

    def __init__(self, seen: np.ndarray, views: int) -> None:
        """Make it of ``seen`` (V, T) bool; the first ``views`` are taken."""
        self._sees = seen[views:]
        self._worth = 0.5 ** seen[:views].sum(axis=0)

    def gains(self) -> np.ndarray:
        """Mean worth over texels."""
        return np.where(self._sees, self._worth, 0).mean(axis=1)

    def choose(self, candidate: int) -> None:
        """Add a candidate."""
        self._worth = self._worth * np.where(self._sees[candidate], 0.5, 1)


class DOptimal:
    """Largest determinant of the information matrix (D-optimality [Fedorov 1972]).

    For each texel, radiance is linearised in (roughness, metallic, base colour) at its most
    probable parameters: F = sum J J^T / sigma^2 + P, with the precision P of a uniform prior on
    [0, 1], 12 for each. A candidate of Jacobian J adds log(1 + J . F^-1 J / sigma^2).
    """

    PRECISION = 12.0

    def __init__(self, jacobians: np.ndarray, seen: np.ndarray, views: int) -> None:
        """Make it of Jacobians (V, T, 3) over sigma; the first ``views`` are taken."""
        J = jacobians.astype(np.float64) * seen[..., None]
        texels = J.shape[1]
        information = np.einsum("vti,vtj->tij", J[:views], J[:views])
        self._inverse = np.linalg.inv(information + self.PRECISION * np.eye(3))
        self._J = J[views:]
        self._texels = texels

    def gains(self) -> np.ndarray:
        """Mean over texels of what the logarithm of the determinant grows by."""
        quadratic = np.einsum("vti,tij,vtj->vt", self._J, self._inverse, self._J, optimize=True)
        return np.log1p(quadratic).mean(axis=1)

    def choose(self, candidate: int) -> None:
        """Add a candidate: a rank-1 change of the inverse [Sherman and Morrison 1950]."""
        J = self._J[candidate]
        u = np.einsum("tij,tj->ti", self._inverse, J)
        scale = 1 / (1 + np.einsum("ti,ti->t", J, u))
        self._inverse = self._inverse - scale[:, None, None] * u[:, :, None] * u[:, None, :]


def jacobians(table: np.ndarray, grid: PrincipledGrid, cells: np.ndarray) -> np.ndarray:
    """Differentiate radiance by roughness, metallic and base colour.

    Args:
        table: (V, T, 1 + 4 R): cos theta, then e, p, q, d of every roughness level, in radiance
            over sqrt(2) sigma (guidance/angular.py).
        grid: of the cells.
        cells: (T,) where to differentiate.

    Returns:
        (V, T, 3), in radiance over sigma; by roughness from the neighbouring levels, and 0 for
        parameters that are known.
    """
    levels, columns, count = grid.shape
    nodes = list(grid.axes.values())
    level, m, c = cells // (columns * count), cells // count % columns, cells % count
    m, c = nodes[1][m], nodes[2][c]
    columns_of = np.moveaxis(table[..., 1:].reshape(*table.shape[:2], levels, 4), 2, 0)

    def at(level: Any) -> Any:
        return (columns_of[level, :, np.arange(len(cells)), k].T for k in range(4))

    def radiance(level: Any) -> np.ndarray:
        e, p, q, d = at(level)
        return (1 - m) * (c * e + d) + m * (c * p + q)

    low, high = np.maximum(level - 1, 0), np.minimum(level + 1, levels - 1)
    width = np.maximum(nodes[0][high] - nodes[0][low], 1e-6)
    by_roughness = (radiance(high) - radiance(low)) / width
    e, p, q, d = at(level)
    by_metallic = (p - e) * c + q - d
    by_color = (1 - m) * e + m * p
    slopes = np.stack([by_roughness, by_metallic, by_color], axis=-1)
    return np.sqrt(2) * np.where(np.array(grid.shape) > 1, slopes, 0)
