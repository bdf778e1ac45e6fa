"""Groups of texels, over which the same is solved on fewer unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from svu_mi.surface.layout import Texels
from svu_mi.surface.neighbors import Neighbors


def squares_of(texels: Texels) -> np.ndarray:
    """Return row and column of T texels in the map, (T, 2) int64."""
    index, width = texels.index.numpy().astype(np.int64), texels.resolution[0]
    return np.stack(np.divmod(index, width), axis=1)


def owners_of(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group what is in the same square.

    Args:
        squares: (T, 2) int64, rows and columns.

    Returns:
        The squares of G groups, (G, 2), and the group of each of the T, (T,) int64.
    """
    width = int(squares[:, 1].max(initial=0)) + 1
    numbers, owner = np.unique(squares[:, 0] * width + squares[:, 1], return_inverse=True)
    return np.stack(np.divmod(numbers, width), axis=1), owner


def grouped(around: Sequence[np.ndarray], owner: np.ndarray) -> tuple[Any, ...]:
    """Return which groups of texels are next to each other, as ``Neighbors.around`` has them.

    Args:
        around: columns (T,) of the texels' neighbours.
        owner: (T,) int64, which group each texel is of.
    """
    count = int(owner.max()) + 1
    numbers = []
    for column in around:
        other = owner[column]
        apart = other > owner  # each pair once
        numbers.append(owner[apart] * count + other[apart])
    pairs = np.divmod(np.unique(np.concatenate(numbers)), count)
    return Neighbors.of(np.stack(pairs, axis=1), count).around


def means(
    values: np.ndarray, weights: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted means of values (N, T) over groups, and the sums of the weights (N, T), which
    are positive: (N, G) each."""
    total = sums(weights, owner)
    return sums(weights * values, owner) / total, total


def sums(values: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return sums of values (N, T) over groups, (N, G), by the group (T,) that each texel is of."""
    return np.stack([np.bincount(owner, row) for row in values])
