"""Roughness levels of the statistics: closer together where lobes are narrow."""

from __future__ import annotations

import numpy as np


def levels(count: int) -> np.ndarray:
    """Return t^1.3 at equally spaced t in [0, 1]."""
    t = np.arange(count) / max(count - 1, 1)
    return t**1.3


def place(roughness: np.ndarray | float, count: int) -> np.ndarray:
    """Return t (count - 1)."""
    return np.asarray(roughness, np.float64) ** (10 / 13) * (count - 1)
