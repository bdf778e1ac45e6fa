"""Brown's model of a lens as OpenCV's documentation prints it."""

from __future__ import annotations

import numpy as np

STEPS = 250


def distort(x: np.ndarray, y: np.ndarray, lens: dict[str, float]) -> np.ndarray:
    """Where a lens shows (2, ...) what a pinhole shows at (x, y), in parts of the focal length.

    Args:
        x: to the right.
        y: downwards.
        lens: k1, k2, k3, k4, p1, p2.
    """
    r2 = x**2 + y**2
    radial = 1 + lens["k1"] * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3 + lens["k4"] * r2**4
    return np.array([
        x * radial + 2 * lens["p1"] * x * y + lens["p2"] * (r2 + 2 * x**2),
        y * radial + lens["p1"] * (r2 + 2 * y**2) + 2 * lens["p2"] * x * y,
    ])  # fmt: skip


def straight(x: np.ndarray, y: np.ndarray, lens: dict[str, float]) -> np.ndarray:
    """Where a pinhole would show (2, ...) what the lens shows at (x, y), by small steps."""
    seen = point = np.array([x, y])
    for _ in range(STEPS):
        point = point - 0.5 * (distort(*point, lens) - seen)
    return point


def chequers(x: np.ndarray, y: np.ndarray, size: float) -> np.ndarray:
    """A chequered plane in [0, 1], soft enough to be interpolated: fields of ``size``."""
    return 0.5 + 0.5 * np.sin(np.pi * x / size) * np.sin(np.pi * y / size)
