"""Spherical harmonics, the fit of Eq. 12 and the power of Eq. 8, texel by texel.

Sizes: T texels, V views, C channels.
"""

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
        middle, *sides = (sph_harm_y(l, m, theta, phi) for m in range(l + 1))
        columns += [math.sqrt(2) * side.imag for side in reversed(sides)]
        columns += [middle.real, *(math.sqrt(2) * side.real for side in sides)]
    return np.stack(columns, axis=-1)


def normal_equations(
    Y: np.ndarray,
    weights: np.ndarray,
    values: np.ndarray,
    regularizer: float,
    penalize_constant: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Y^T W^2 Y + lambda R and Y^T W^2 f of one texel: (N, N) and (N, C), N = (lmax + 1)^2.

    Args:
        Y: (V, N) the basis in the directions of visible views; only these are here.
        weights: (V,) w.
        values: (V, C).
        regularizer: lambda.
        penalize_constant: R_00 = 1, else 0.
    """
    lmax = math.isqrt(Y.shape[1]) - 1
    ridge = np.exp(degrees(lmax).astype(np.float64))
    if not penalize_constant:
        ridge[0] = 0
    w, f = weights.astype(np.float64)[:, None], values.astype(np.float64)
    return Y.T @ (w**2 * Y) + regularizer * np.diag(ridge), Y.T @ (w**2 * f)


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
    texels, _, channels = values.shape
    coefficients = np.zeros((texels, (lmax + 1) ** 2, channels))
    Y = basis(directions, lmax)  # of all texels at once: a call of SciPy's costs most
    for t in range(texels):
        seen = weights[t] > 0
        if seen.any():
            normal, right = normal_equations(
                Y[t, seen], weights[t, seen], values[t, seen], regularizer, penalize_constant
            )
            coefficients[t] = np.linalg.solve(normal, right)
    return coefficients


def power(coefficients: np.ndarray) -> np.ndarray:
    """S(l) = sum over m of c_lm^2, (T, lmax + 1, C) (Eq. 8)."""
    lmax = math.isqrt(coefficients.shape[1]) - 1
    return np.stack(
        [(coefficients[:, l * l : (l + 1) ** 2] ** 2).sum(axis=1) for l in range(lmax + 1)], axis=1
    )
