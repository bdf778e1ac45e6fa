"""Peak signal-to-noise ratio."""

from typing import Any

import numpy as np

from svu_mi.errors import OptionError, ShapeError

CEILING_DB = 100.0  # largest PSNR, reached at an RMS error of 1e-5


def psnr(estimate: Any, truth: Any) -> float:
    """Return the peak signal-to-noise ratio 10 log10(1 / MSE), in dB, at most 100.

    Args:
        estimate: Estimated values in [0, 1], any shape.
        truth: True values, same shape.
    """
    a, b = np.array(estimate, np.float64), np.array(truth, np.float64)
    if a.shape != b.shape or a.size == 0:
        raise ShapeError(
            f"psnr() needs two non-empty arrays of equal shape, got {a.shape} and {b.shape}."
        )
    require_finite(a, "the estimate")
    require_finite(b, "the truth")
    mean_square = float(np.mean((a - b) ** 2))
    return min(CEILING_DB, -10 * float(np.log10(max(mean_square, 1e-30))))


def require_finite(values: np.ndarray, name: str) -> None:
    """Raise an error if values contain NaN or infinity."""
    bad = np.count_nonzero(~np.isfinite(values))
    if bad:
        raise OptionError(f"{name} has {bad} values that are NaN or infinite; remove those texels.")
