"""A few of many: the photographs, cameras or texels that stand for all of a kind."""

from __future__ import annotations

import numpy as np


def evenly_spaced(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` of the indices 0 to ``count - 1``, in order and evenly spaced.

    The first and the last are among them, unless only one is wanted.

    Returns:
        (min(count, most),) int64, each once.
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)
