"""Roughness levels of the statistics: closer together where lobes are narrow."""

from __future__ import annotations

import numpy as np


def levels(count: int) -> np.ndarray:
    """Return t^(4/3) at equally spaced t in [0, 1]."""
    t = np.arange(count) / max(count - 1, 1)
    return t * np.cbrt(t)


def place(roughness: np.ndarray | float, count: int) -> np.ndarray:
    """Return t (count - 1)."""
    return np.asarray(roughness, np.float64) ** 0.75 * (count - 1)
