"""Simpler ways to choose views, which expected entropy has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


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

    For each texel, radiance is linearised in roughness, metallic and the base colour of every
    channel at its most probable parameters: F = sum J^T J / (s^2 tau) + P, with the precision P
    of a uniform prior on [0, 1], 12 for each.
    """

    PRECISION = 12.0

    def __init__(self, jacobians: np.ndarray, views: int) -> None:
        """Make it of Jacobians (V, T, C, P) over s sqrt(tau); the first ``views`` are taken."""
        information = np.einsum("vtci,vtcj->vtij", jacobians, jacobians, optimize=True)
        self._added = information[views:]
        self._known = information[:views].sum(axis=0) + self.PRECISION * np.eye(
            information.shape[-1]
        )

    def gains(self) -> np.ndarray:
        """Mean over texels of what the logarithm of the determinant grows by."""
        known = np.linalg.slogdet(self._known)[1]
        return (np.linalg.slogdet(self._known + self._added)[1] - known).mean(axis=1)

    def choose(self, candidate: int) -> None:
        """Add a candidate."""
        self._known = self._known + self._added[candidate]


def jacobians(
    table: np.ndarray, nodes: list[np.ndarray], rows: np.ndarray, colors: np.ndarray
) -> np.ndarray:
    """Differentiate radiance by roughness, what mixes and the base colour of C channels.

    Args:
        table: (V, T, R, L, 4) of e, p, q, d of every roughness level and channel of the light; 0
            where a view does not see a texel.
        nodes: (R,) of roughness and (M,) of every parameter that mixes.
        rows: (T,) where to differentiate: rows of the grid.
        colors: (T, C) and base colours.

    Returns:
        (V, T, C, N + C) for N nodes, 0 between different channels; by roughness from the
        neighbouring levels, and 0 for what is known of others.
    """
    # The command line reads this module at its start, without Dr.Jit.
    from svu_mi.reflection.principled import columns, mixture, slope

    levels, count, shared = len(nodes[0]), len(rows), len(nodes)
    level, *places = np.unravel_index(rows, [len(axis) for axis in nodes])
    mixed = [axis[place][:, None] for axis, place in zip(nodes[1:], places, strict=True)]

    def dot(x: Sequence[Any], at: np.ndarray) -> np.ndarray:
        parts = np.moveaxis(table[:, np.arange(count), at], -1, 0)  # (V, T, L) each
        found = sum(a * b for a, b in zip(x, columns(*parts), strict=True))
        return np.broadcast_to(found, (*table.shape[:2], colors.shape[1]))

    def radiance(at: np.ndarray) -> np.ndarray:
        return dot(mixture(*mixed).at(colors), at)

    low, high = np.maximum(level - 1, 0), np.minimum(level + 1, levels - 1)
    width = np.maximum(nodes[0][high] - nodes[0][low], 1e-6)[:, None]
    J = np.zeros((*table.shape[:2], colors.shape[1], shared + colors.shape[1]))
    J[..., 0] = (radiance(high) - radiance(low)) / width
    for k, axis in enumerate(nodes[1:]):
        J[..., 1 + k] = dot(slope(mixed, k).at(colors), level) * (len(axis) > 1)
    by_color = dot(mixture(*mixed).scaled, level)
    for channel in range(colors.shape[1]):
        J[..., channel, shared + channel] = by_color[..., channel]
    return J
