"""What spreads into holes from their border: least total variation, as recovery itself smooths."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np
from scipy.spatial import cKDTree

from svu_mi.inpaint.filling import SUREST
from svu_mi.inpaint.pieces import Pieces
from svu_mi.recovery.field.field import TextureField

FARTHER = {"from the border": 1e-5, "cautiously from the border": 1e-2}
"""By title, how much the mean of all that is known counts in a hole, as a precision in units of the
variance of that: the more, the less far from the border anything spreads."""
AGAIN = 2  # times that links go by what has spread: edges go on into a hole
NEAREST = 8  # known texels that a hole is filled by to begin with


def spreads(
    field: TextureField, pieces: Pieces, known: np.ndarray, titles: Container[str] = FARTHER
) -> Iterator[tuple[str, np.ndarray]]:
    """Let values spread from what is known: first over links as strong as those between equals,
    then over links that are weak across edges of what has spread [Vogel and Oman 1996]. Pieces of
    which nothing is known are as the mean of all.

    Args:
        field: whose values.
        pieces: its texels.
        known: (T,) bool, of what they are known; no others are looked at.
        titles: those of ``FARTHER`` that are asked for.

    Yields:
        A title, and (N, T).
    """
    weights, values = 1 / np.maximum(field.deviation, SUREST) ** 2, field.values
    mean = np.average(values[:, known], axis=1, weights=weights[:, known])[:, None]
    wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
    border = np.bincount(pieces.piece, known)[pieces.piece] > 0
    start = np.where(border, _nearest(pieces, values, known), mean)
    for title in (title for title in FARTHER if title in titles):
        trust, found = np.where(known, weights, FARTHER[title] / wide**2), start
        right = trust * np.where(known, values, mean)
        smoother = field.smoother.with_precision(trust, blind=~known)
        for again in range(AGAIN + 1):
            if again:
                smoother = smoother.with_precision(trust, found)
            found = np.where(known, values, smoother.fill(right, found, border))
        yield title, np.clip(found, 0, 1)


def _nearest(pieces: Pieces, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values of which those that are not known are as what is near, (N, T)."""
    places, found = pieces.apart(pieces.point), values.copy()
    tree = cKDTree(places[known])
    count = min(NEAREST, int(known.sum()))
    away, which = tree.query(places[~known], [*range(1, count + 1)], workers=-1)
    weights = 1 / np.maximum(away, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    for row, some in zip(found, values[:, known], strict=True):
        row[~known] = (some[which] * weights).sum(axis=1)
    return found
