"""Power of a spherical signal, degree by degree (paper, Sec. 3.3.1).

    S(l) = sum over m = -l ... l of c_lm^2                                        (Eq. 8)

A sum, not a mean: white noise of unit variance has 2l + 1 on average. A rotation of the
signal leaves every S(l) unchanged.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import harmonics
from svu_mi.interop import tensor


def power_lanes(coefficients: list[list[Any]]) -> list[list[Any]]:
    """Return S(l) of every lane (Eq. 8).

    Args:
        coefficients: (lmax + 1)^2 lists of C arrays in the order l*l + l + m, as
            ``fit_lanes`` returns them, in radiance up to exposure.

    Returns:
        lmax + 1 lists of C arrays, in squared radiance.

    Raises:
        ShapeError: the number of coefficients is not a square.
    """
    spectrum = []
    for l in range(harmonics.degree_of(len(coefficients)) + 1):
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
    degree = harmonics.degree_of(count)
    if texels * channels == 0:
        return dr.zeros(mi.TensorXf, (texels, degree + 1, channels))
    square = dr.square(given)
    orders = [square[:, l * l : (l + 1) ** 2] for l in range(degree + 1)]  # m = -l ... l
    power = dr.stack([dr.sum(of_degree, axis=1) for of_degree in orders], axis=1)
    dr.eval(power)
    return power
