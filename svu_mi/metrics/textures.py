"""How close recovered textures are to the true ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from svu_mi.errors import OptionError, ShapeError
from svu_mi.metrics.checks import require_finite

CEILING_DB = 100.0  # of a PSNR: that of an RMS error of 1e-5, and of none at all


def psnr(found: Any, truth: Any, peak: float = 1.0) -> float:
    """Return the peak signal-to-noise ratio 10 log10(peak^2 / MSE), in dB, at most 100.

    Args:
        found: estimate, any shape.
        truth: of the same shape.
        peak: largest possible value; 1 for parameters in [0, 1].

    Raises:
        ShapeError: the shapes differ, or there is no value.
        OptionError: NaN or infinite values, or a peak that is not positive.
    """
    if not peak > 0:
        raise OptionError(f"psnr(): the peak must be positive, got {peak}.")
    a, b = np.array(found, np.float64), np.array(truth, np.float64)
    if a.shape != b.shape or a.size == 0:
        raise ShapeError(
            f"psnr() needs two arrays of one shape with values, got {a.shape} and {b.shape}."
        )
    require_finite(a, "the estimate")
    require_finite(b, "the truth")
    mean_square = float(np.mean((a - b) ** 2)) / peak**2
    return min(CEILING_DB, -10 * float(np.log10(max(mean_square, 1e-30))))


def texture_psnr(found: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, float]:
    """Return the PSNR of every parameter, and their mean as ``average``.

    The average of Table 2 of the paper: a mean of decibels over parameters, each of which
    counts the same whatever its number of channels.

    Args:
        found: (T, C) or (T,) by parameter, in [0, 1].
        truth: the same.

    Raises:
        ShapeError: other parameters or shapes, or none.
        OptionError: NaN or infinite values.
    """
    if not truth or set(found) != set(truth):
        raise ShapeError(f"Parameters differ: found {sorted(found)}, true {sorted(truth)}.")
    by_name = {name: psnr(found[name], truth[name]) for name in truth}
    return {**by_name, "average": float(np.mean(list(by_name.values())))}


def texel_error(found: Mapping[str, Any], truth: Mapping[str, Any]) -> np.ndarray:
    """Return (T,) mean absolute errors: over channels, then over parameters.

    Args:
        found: (T, C) or (T,) by parameter.
        truth: the same.

    Raises:
        ShapeError: other parameters or numbers of texels, or none.
    """
    if not truth or set(found) != set(truth):
        raise ShapeError(f"Parameters differ: found {sorted(found)}, true {sorted(truth)}.")
    errors = []
    for name, true in truth.items():
        error = np.abs(np.array(found[name], np.float64) - np.array(true, np.float64))
        errors.append(error.reshape(len(error), -1).mean(axis=1))
    return np.mean(errors, axis=0)
