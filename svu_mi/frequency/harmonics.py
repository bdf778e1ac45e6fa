"""Real spherical harmonics in lanes: basis, ridge and kernel of Eq. 12, power spectra.

    S(l) = sum over m = -l ... l of c_lm^2                                        (Eq. 8)

A sum, not a mean: white noise of unit variance has 2l + 1 on average. Conventions:

* order ``index = l*l + l + m``: (0,0), (1,-1), (1,0), (1,1), (2,-2), ...
* orthonormal on the sphere, real, with the Condon-Shortley sign of ``dr.sh_eval``
  [Sloan, JCGT 2013]: the degree 1 functions are ``sqrt(3/4pi) * (-y, z, -x)``;
* lanes run over texels, coefficients are Python lists of Dr.Jit arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import drjit as dr
import mitsuba as mi
from numpy.polynomial import legendre

from svu_mi.core.arrays import tensor
from svu_mi.errors import OptionError, ShapeError

MAX_DEGREE = 9
"""The highest degree of ``dr.sh_eval``."""


def degree_of(count: int) -> int:
    """Return the degree of a full set of ``count = (degree + 1)^2`` coefficients."""
    root = math.isqrt(max(count, 0))
    if count < 1 or root * root != count:
        raise ShapeError(
            f"Expected (lmax + 1)^2 spherical harmonic coefficients, got {count}; the nearest "
            f"full sets have {max(root, 1) ** 2} and {(root + 1) ** 2}."
        )
    return root - 1


def check_degree(degree: Any) -> int:
    """Return ``degree`` as an int in [0, 9]."""
    whole = isinstance(degree, Integral) and not isinstance(degree, bool)
    if not whole or not 0 <= degree <= MAX_DEGREE:
        raise OptionError(f"fit_sh(): the degree must be a whole number in [0, 9], got {degree!r}.")
    return int(degree)


def basis(direction: Any, degree: int) -> list[Any]:
    """Evaluate Y_lm of a unit direction: (degree + 1)^2 arrays in the order l*l + l + m."""
    return dr.sh_eval(direction, degree)


def ridge(degree: int, penalize_constant: bool) -> list[float]:
    """Diagonal of R in Eq. 12, one entry per degree: e^l, with R_00 = 1 or 0."""
    return [math.exp(l) if l or penalize_constant else 0.0 for l in range(degree + 1)]


def zonal_polynomial(degree: int, penalize_constant: bool) -> list[float]:
    """Powers of t in lambda * k(t) = sum_l (2l + 1) / (4 pi R_l) P_l(t), R_l = 0 left out."""
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
    ridge: list[float]  # e^l, 0 where a degree is free
    regularizer: Any  # lambda, an opaque double: a new value must not mean a new kernel

    @staticmethod
    def of(degree: int, channels: int, regularizer: float, penalize_constant: bool) -> FitSystem:
        """Set up the fit."""
        penalty = ridge(degree, penalize_constant)
        return FitSystem(degree, channels, penalty, dr.opaque(mi.Float64, regularizer))

    @property
    def degrees(self) -> list[int]:
        """The degree of every coefficient."""
        return [l for l in range(self.degree + 1) for _ in range(2 * l + 1)]

    def basis(self, direction: list[Any]) -> list[Any]:
        """Y_lm of a unit direction, in double precision."""
        return basis(mi.Vector3d(*direction), self.degree)


def normalized_double(direction: Any) -> Any:
    """Normalise a direction in double precision, which fits of close views need."""
    return dr.normalize(mi.Vector3d(direction))


def power_per_degree(coefficients: list[list[Any]]) -> list[list[Any]]:
    """Return S(l) of every lane (Eq. 8): lmax + 1 lists of C arrays, squared radiance."""
    spectrum = []
    for l in range(degree_of(len(coefficients)) + 1):
        orders = coefficients[l * l : (l + 1) ** 2]  # m = -l ... l
        channels = zip(*orders, strict=True)
        spectrum.append([sum(dr.square(c) for c in channel) for channel in channels])
    return spectrum


def power_spectrum(coefficients: Any) -> Any:
    """Return the power of every degree (Eq. 8).

    Args:
        coefficients: (T, (lmax + 1)^2, C), texels x coefficients x channels, in the order
            l*l + l + m; a tensor or anything NumPy understands.

    Returns:
        (T, lmax + 1, C) TensorXf, in squared radiance.

    Raises:
        ShapeError: not three axes, or a second axis that is not a square.
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
