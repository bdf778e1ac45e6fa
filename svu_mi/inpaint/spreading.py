"""What spreads into holes from their border: least total variation, as recovery itself smooths."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.inpaint.filling import SUREST
from svu_mi.inpaint.pieces import Pieces
from svu_mi.interop import owned
from svu_mi.recovery.field.field import TextureField

FARTHER = {"border": 1e-5, "border, cautiously": 1e-2}
"""By title, how much the mean of all that is known counts in a hole, as a precision in units of the
variance of that: the more, the less far from the border anything spreads."""
AGAIN = 2  # times that links go by what has spread: edges go on into a hole


def spread(
    field: TextureField, pieces: Pieces, known: np.ndarray, title: str
) -> np.ndarray:
    """Let values spread from what is known: first over links as strong as those between equals,
    then over links that are weak across edges of what has spread [Vogel and Oman 1996]. Pieces of
    which nothing is known are as the mean of all.

    Args:
        field: whose values.
        pieces: its texels.
        known: (T,) bool, of what they are known; no others are looked at.
        title: one of ``FARTHER``.

    Returns:
        (N, T).
    """
    weights, values = 1 / field.deviation**2, field.values
    mean = np.average(values[:, known], axis=1, weights=weights[:, known])[:, None]
    wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
    trust = np.where(known, weights, FARTHER[title] / wide**2)
    found = np.where(known, values, mean)
    border = np.bincount(pieces.piece, known)[pieces.piece] > 0
    right, free = _lanes(trust * found), _lanes(np.tile(border, (len(found), 1)))
    smoother = field.smoother.with_precision(trust, blind=~known)
    for _ in range(1 + AGAIN):
        found = np.array(smoother.fill(right, _lanes(found), free), np.float64)
        found = np.where(known, values, found.reshape(values.shape))
        smoother = field.smoother.with_values(found, trust)
    return np.clip(found, 0, 1)


def _lanes(values: np.ndarray) -> Any:
    return owned(mi.Float, values.astype(np.float32).ravel())
