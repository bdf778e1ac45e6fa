"""Validation of the arguments of metrics."""

from __future__ import annotations

from typing import Any

import numpy as np

from svu_mi.errors import ShapeError
from svu_mi.evaluation.psnr import require_finite


def finite_vector(values: Any, name: str, count: int | None = None) -> np.ndarray:
    """Return ``values`` as (n,) float64; raise an error for other shapes, NaN and infinity.

    Args:
        values: n finite numbers.
        name: Name of the argument in the message.
        count: Required n; None accepts any.
    """
    flat = np.array(values, np.float64)
    if flat.ndim != 1 or not flat.size or count not in (None, len(flat)):
        raise ShapeError(f"{name} must be a non-empty ({count or 'n'},) array, got {flat.shape}.")
    require_finite(flat, name)
    return flat


def two_vectors(**given: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return two (n,) float64 arrays of equal length (errors as in ``finite_vector``)."""
    (first, x), (second, y) = given.items()
    values = finite_vector(x, first)
    return values, finite_vector(y, second, len(values))


def two_pictures(picture: Any, truth: Any, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two (H, W, 3) float64 pictures that are finite inside the mask."""
    a, b = np.array(picture, np.float64), np.array(truth, np.float64)
    if a.shape != b.shape or a.shape != (*mask.shape, 3):
        raise ShapeError(
            f"Two (H, W, 3) pictures and an (H, W) mask are needed, got {a.shape}, {b.shape} and "
            f"{mask.shape}."
        )
    if not mask.any():
        raise ShapeError("The mask is empty; use a picture in which the object is visible.")
    require_finite(a[mask], "the picture")
    require_finite(b[mask], "the true picture")
    return a, b
