"""What spreads into holes from their border: least total variation, as recovery itself smooths."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np
import scipy

from svu_mi.inpaint.filling import SUREST
from svu_mi.inpaint.ground import Ground
from svu_mi.inpaint.pieces import Pieces

FARTHER = {"from the border": 1e-5, "cautiously from the border": 1e-2}
"""By title, how much the mean of all that is known counts at a texel of a hole, as a precision in
units of the variance of that: the more, the less far from the border anything spreads."""
AGAIN = 2  # times that links go by what has spread: edges go on into a hole
NEAREST = 8  # known texels that a hole is filled by to begin with


def spreads(ground: Ground, titles: Container[str] = FARTHER) -> Iterator[tuple[str, np.ndarray]]:
    """Let values spread from what is known: first over links as strong as those between equals,
    then over links that are weak across edges of what has spread [Vogel and Oman 1996]. Pieces of
    which nothing is known are as the mean of all. Of many texels groups come first, and what
    has spread over these says where edges are.

    Args:
        ground: what is known.
        titles: those of ``FARTHER`` that are asked for.

    Yields:
        A title, and (N, T).
    """
    known, values, weights = ground.known, ground.values, ground.weights
    mean = np.average(values[:, known], axis=1, weights=weights[:, known])[:, None]
    wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
    border = np.bincount(ground.pieces.piece, known)[ground.pieces.piece] > 0
    for title, found, edges in _starts(ground, titles, border, mean):
        trust = np.where(known, weights, FARTHER[title] * ground.size / wide**2)
        right = trust * np.where(known, values, mean)
        for hidden in [None] if edges else [~known, *[None] * AGAIN]:
            smoother = ground.smoother.with_precision(trust, found, hidden)
            found = np.where(known, values, smoother.fill(right, found, border))
        yield title, np.clip(found, 0, 1)


def _starts(
    ground: Ground, titles: Container[str], border: np.ndarray, mean: np.ndarray
) -> Iterator[tuple[str, np.ndarray, bool]]:
    """Yield titles, values (N, T) to begin with, and whether these know where edges are."""
    if ground.many:
        groups, owner = ground.halved
        for title, found in spreads(groups, titles):
            yield title, np.where(ground.known, ground.values, found[:, owner]), True
        return
    start = np.where(border, _nearest(ground.pieces, ground.values, ground.known), mean)
    for title in FARTHER:
        if title in titles:
            yield title, start, False


def _nearest(pieces: Pieces, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values of which those that are not known are as what is near, (N, T)."""
    places, found = pieces.apart(pieces.point), values.copy()
    tree = scipy.spatial.cKDTree(places[known])
    count = min(NEAREST, int(known.sum()))
    away, which = tree.query(places[~known], [*range(1, count + 1)], workers=-1)
    weights = 1 / np.maximum(away, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    for row, some in zip(found, values[:, known], strict=True):
        row[~known] = (some[which] * weights).sum(axis=1)
    return found
