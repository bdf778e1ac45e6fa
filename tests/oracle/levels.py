"""Roughness levels of the statistics: closer together where lobes are narrow."""

from __future__ import annotations

import numpy as np


def levels(count: int) -> np.ndarray:
    """Return 1 / (2 / t - 1) at equally spaced t in [0, 1]."""
    t = np.arange(count) / max(count - 1, 1)
    return np.divide(1, 2 / np.maximum(t, 1e-300) - 1)


def place(roughness: np.ndarray | float, count: int) -> np.ndarray:
    """Return t (count - 1)."""
    r = np.asarray(roughness, np.float64)
    return (1 - (1 - r) / (1 + r)) * (count - 1)
