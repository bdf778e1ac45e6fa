"""Real spherical harmonics in lanes, and the zonal kernel of the dual fit.

Conventions, the same everywhere in the package:

* order ``index = l*l + l + m``: (0,0), (1,-1), (1,0), (1,1), (2,-2), ...
* orthonormal on the sphere, real, with the Condon-Shortley sign of ``dr.sh_eval``
  [Sloan, JCGT 2013]: the degree 1 functions are ``sqrt(3/4pi) * (-y, z, -x)``;
* lanes run over texels, coefficients are Python lists of Dr.Jit arrays.
"""

from __future__ import annotations

import math
from numbers import Integral
from typing import Any

import drjit as dr
from numpy.polynomial import legendre

from svu_mi.errors import OptionError, ShapeError

MAX_DEGREE = 9
"""The highest degree ``dr.sh_eval`` knows."""


def degree_of(count: int) -> int:
    """Return the degree of a full set of ``count = (degree + 1)^2`` coefficients.

    Raises:
        ShapeError: ``count`` is not a positive square.
    """
    root = math.isqrt(max(count, 0))
    if count < 1 or root * root != count:
        raise ShapeError(
            f"Expected (lmax + 1)^2 spherical harmonic coefficients, got {count}; the nearest "
            f"full sets have {max(root, 1) ** 2} and {(root + 1) ** 2}."
        )
    return root - 1


def check_degree(degree: Any, caller: str) -> int:
    """Return ``degree`` as an int in [0, 9].

    Raises:
        OptionError: it is not a whole number in that range.
    """
    whole = isinstance(degree, Integral) and not isinstance(degree, bool)
    if not whole or not 0 <= degree <= MAX_DEGREE:
        raise OptionError(f"{caller}: the degree must be a whole number in [0, 9], got {degree!r}.")
    return int(degree)


def basis(direction: Any, degree: int) -> list[Any]:
    """Evaluate Y_lm for a unit direction.

    Args:
        direction: a Dr.Jit 3-vector of unit length; its precision decides the precision.
        degree: the highest degree l, in [0, 9].

    Returns:
        (degree + 1)^2 arrays in the order l*l + l + m.
    """
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
    """Evaluate lambda * k(t) by Horner's rule.

    By the addition theorem this is Y(a)^T R^-1 Y(b) for unit vectors with a.b = t. Powers of t
    are safe here: R grows by e per degree, coefficients of P_l only by 1 + sqrt(2).

    Args:
        t: cosine of the angle, any Dr.Jit float array.
        powers: literals, as ``zonal_polynomial`` returns them.
    """
    value = type(t)(powers[-1])
    for power in reversed(powers[:-1]):
        value = dr.fma(value, t, power)
    return value
