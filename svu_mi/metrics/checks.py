"""What every metric asks of its arguments."""

from __future__ import annotations

from typing import Any

import numpy as np

from svu_mi.errors import OptionError, ShapeError


def vector(values: Any, name: str, count: int | None = None) -> np.ndarray:
    """Return (n,) float64 after refusing what no metric can use.

    Args:
        values: n finite numbers.
        name: of the argument, for the message.
        count: the n it must have, if that is known.

    Raises:
        ShapeError: not one-dimensional, empty, or another n.
        OptionError: NaN or infinite values.
    """
    flat = np.array(values, np.float64)
    if flat.ndim != 1 or flat.size == 0:
        raise ShapeError(f"{name} must be a non-empty (n,) array, got shape {flat.shape}.")
    if count is not None and len(flat) != count:
        raise ShapeError(f"{name} must have {count} values like the others, got {len(flat)}.")
    require_finite(flat, name)
    return flat


def pair(x: Any, y: Any, names: tuple[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """Return two (n,) float64 arrays of one length (errors as ``vector``)."""
    first = vector(x, names[0])
    return first, vector(y, names[1], len(first))


def pictures(
    found: Any, truth: Any, mask: np.ndarray, caller: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return two (H, W, 3) float64 pictures of a mask's size.

    Raises:
        ShapeError: the shapes differ.
    """
    a, b = np.array(found, np.float64), np.array(truth, np.float64)
    if a.shape != b.shape or a.shape != (*mask.shape, 3):
        raise ShapeError(
            f"{caller} needs two (H, W, 3) pictures and an (H, W) mask, got {a.shape}, {b.shape} "
            f"and {mask.shape}."
        )
    return a, b


def require_finite(values: np.ndarray, name: str) -> None:
    """Refuse NaN and infinity.

    Raises:
        OptionError: there is one; the message counts them.
    """
    bad = int((~np.isfinite(values)).sum())
    if bad:
        raise OptionError(
            f"{name} has {bad} values that are NaN or infinite; leave those texels out."
        )
