"""Spherical harmonics, the fit of Eq. 12 and the power of Eq. 8, texel by texel."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import sph_harm_y


def degrees(lmax: int) -> np.ndarray:
    """Degree l of every coefficient in the order l*l + l + m."""
    return np.array([l for l in range(lmax + 1) for _ in range(2 * l + 1)])


def basis(directions: np.ndarray, lmax: int) -> np.ndarray:
    """Real orthonormal harmonics (..., (lmax + 1)^2) of directions (..., 3).

    Only the angles of a direction count, not its length. From SciPy's complex harmonics, with
    their Condon-Shortley sign:
    Y_l0, sqrt(2) Re Y_lm for m > 0, sqrt(2) Im Y_l|m| for m < 0.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    columns = []
    for l in range(lmax + 1):
        for m in range(-l, l + 1):
            complex_y = sph_harm_y(l, abs(m), theta, phi)
            if m == 0:
                columns.append(complex_y.real)
            else:
                columns.append(math.sqrt(2) * (complex_y.real if m > 0 else complex_y.imag))
    return np.stack(columns, axis=-1)


def fit(
    directions: np.ndarray,
    weights: np.ndarray,
    values: np.ndarray,
    lmax: int,
    regularizer: float,
    penalize_constant: bool,
) -> np.ndarray:
    """Solve (Y^T W^2 Y + lambda R) c = Y^T W^2 f for every texel (Eq. 12).

    Args:
        directions: (T, V, 3).
        weights: (T, V) w, 0 = not seen.
        values: (T, V, C).
        lmax: highest degree.
        regularizer: lambda.
        penalize_constant: R_00 = 1, else 0.

    Returns:
        (T, (lmax + 1)^2, C); 0 for a texel that sees nothing.
    """
    ridge = np.exp(degrees(lmax).astype(np.float64))
    if not penalize_constant:
        ridge[0] = 0
    texels, _, channels = values.shape
    coefficients = np.zeros((texels, len(ridge), channels))
    for t in range(texels):
        seen = weights[t] > 0
        if seen.any():
            w = weights[t, seen].astype(np.float64)[:, None]
            Y = basis(directions[t, seen], lmax)
            f = values[t, seen].astype(np.float64)
            normal = Y.T @ (w**2 * Y) + regularizer * np.diag(ridge)
            coefficients[t] = np.linalg.solve(normal, Y.T @ (w**2 * f))
    return coefficients


def power(coefficients: np.ndarray) -> np.ndarray:
    """S(l) = sum over m of c_lm^2, (T, lmax + 1, C) (Eq. 8)."""
    lmax = math.isqrt(coefficients.shape[1]) - 1
    return np.stack(
        [(coefficients[:, l * l : (l + 1) ** 2] ** 2).sum(axis=1) for l in range(lmax + 1)], axis=1
    )
