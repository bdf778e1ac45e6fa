"""Real spherical harmonics: basis, ridge and kernel of Eq. 12, power spectra.

    S(l) = sum over m = -l ... l of c_lm^2                                        (Eq. 8)

S is a sum, not a mean: its expectation for white noise of unit variance is 2l + 1. Conventions:

* order ``index = l*l + l + m``: (0,0), (1,-1), (1,0), (1,1), (2,-2), ...
* orthonormal on the sphere, real, with the Condon-Shortley sign of ``dr.sh_eval``
  [Sloan, JCGT 2013]: the degree 1 functions are ``sqrt(3/4pi) * (-y, z, -x)``;
* one lane per texel, coefficients as Python lists of Dr.Jit arrays.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from numpy.polynomial import legendre

from svu_mi.core.arrays import tensor
from svu_mi.errors import ShapeError

MAX_DEGREE = 9
"""Highest degree of ``dr.sh_eval``."""


def degree_of(count: int) -> int:
    """Return the degree of a full set of ``count = (degree + 1)^2`` coefficients."""
    root = math.isqrt(max(count, 0))
    if count < 1 or root * root != count:
        raise ShapeError(
            f"Expected (lmax + 1)^2 spherical harmonic coefficients, got {count}; the nearest "
            f"full sets have {max(root, 1) ** 2} and {(root + 1) ** 2}."
        )
    return root - 1


def ridge(degree: int, penalize_constant: bool) -> list[float]:
    """Return the diagonal of R in Eq. 12, one entry per degree: e^l, with R_00 = 1 or 0."""
    return [math.exp(l) if l or penalize_constant else 0.0 for l in range(degree + 1)]


def zonal_polynomial(degree: int, penalize_constant: bool) -> list[float]:
    """Return coefficients of t^n in lambda k(t) = sum_l (2l + 1) / (4 pi R_l) P_l(t), R_l > 0."""
    penalty = ridge(degree, penalize_constant)
    weights = [(2 * l + 1) / (4 * math.pi * r) if r else 0.0 for l, r in enumerate(penalty)]
    return [float(power) for power in legendre.leg2poly(weights)]


def zonal_kernel(t: Any, powers: list[float]) -> Any:
    """Evaluate lambda k(t) = lambda Y(a)^T R^-1 Y(b), t = a.b, by Horner's rule."""
    value = type(t)(powers[-1])
    for power in reversed(powers[:-1]):
        value = dr.fma(value, t, power)
    return value


ReadSample = Callable[[Any], tuple[Any, Any, list[Any]]]
"""``view -> (direction, weight, values)``: see ``fit_lanes``."""


@dataclass(frozen=True)
class FitSystem:
    """Parameters of Eq. 12 for both solvers; lists have one entry per degree."""

    degree: int
    channels: int
    ridge: list[float]  # e^l, or 0 for an unpenalised degree
    regularizer: Any  # lambda, opaque: a new value must not compile a new kernel

    @staticmethod
    def of(degree: int, channels: int, regularizer: float, penalize_constant: bool) -> "FitSystem":
        """Return the parameters of a fit."""
        penalty = ridge(degree, penalize_constant)
        return FitSystem(degree, channels, penalty, dr.opaque(mi.Float64, regularizer))

    @property
    def degrees(self) -> list[int]:
        """Degree of each coefficient."""
        return [l for l in range(self.degree + 1) for _ in range(2 * l + 1)]

    def basis(self, direction: list[Any]) -> list[Any]:
        """Evaluate Y_lm of a unit direction in double precision."""
        return dr.sh_eval(mi.Vector3d(*direction), self.degree)  # type: ignore[no-any-return]


def normalized_double(direction: Any) -> Any:
    """Normalise a direction in double precision, as fits of close views require."""
    return dr.normalize(mi.Vector3d(direction))


def power_per_degree(coefficients: list[list[Any]]) -> list[list[Any]]:
    """Return S(l) of each lane (Eq. 8): lmax + 1 lists of C arrays, in squared radiance."""
    spectrum = []
    for l in range(degree_of(len(coefficients)) + 1):
        orders = coefficients[l * l : (l + 1) ** 2]  # m = -l ... l
        channels = zip(*orders, strict=True)
        spectrum.append([sum(dr.square(c) for c in channel) for channel in channels])
    return spectrum


def power_spectrum(coefficients: Any) -> Any:
    """Return the power of each degree (Eq. 8).

    Args:
        coefficients: (T, (lmax + 1)^2, C) coefficients of T texels in the order l*l + l + m.

    Returns:
        (T, lmax + 1, C) TensorXf, in squared radiance.

    Raises:
        ShapeError: not three axes, or the second axis has a length that is not a square.

    Example:
        >>> svu.power_spectrum(np.ones((5, 49, 3))).shape
        (5, 7, 3)
        >>> np.array(svu.power_spectrum(np.ones((1, 9, 1)))).ravel()
        array([1., 3., 5.], dtype=float32)
    """
    axes = ("T", "(lmax+1)^2", "C")
    given = tensor(coefficients, "power_spectrum()", "coefficients", axes)
    texels, count, channels = given.shape
    degree = degree_of(count)
    if texels * channels == 0:
        return dr.zeros(mi.TensorXf, (texels, degree + 1, channels))
    square = dr.square(given)
    orders = [square[:, l * l : (l + 1) ** 2] for l in range(degree + 1)]  # m = -l ... l
    power = dr.stack([dr.sum(of_degree, axis=1) for of_degree in orders], axis=1)
    dr.eval(power)
    return power
