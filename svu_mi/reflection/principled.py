"""Principled parameters in the reflection model (Sec. 3.2 of the paper).

Functions accept floats, NumPy and Dr.Jit arrays. Colours are linear, the index of refraction is
1.5. With base colour c and metallic m, radiance is a mixture of four parts: diffuse shading e, the
lobe d of a dielectric, and the lobe of a metal, c p + q with Schlick's Fresnel term q:

    r = (1 - m) (c e + d) + m (c p + q).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

F0 = 0.04
"""Reflectance at normal incidence of a dielectric with index 1.5."""

MIN_ALPHA = 1e-3
"""Minimum of the microfacet width alpha in Mitsuba."""


def paper_alpha(roughness: Any) -> Any:
    """Return alpha = roughness^2, the GGX width in the paper."""
    return roughness * roughness


def alpha_from_roughness(roughness: Any) -> Any:
    """Return alpha = max(roughness^2, 1e-3), the GGX width in Mitsuba's ``principled``."""
    alpha = paper_alpha(roughness)
    maximum = dr.maximum if dr.is_array_v(alpha) else np.maximum
    return maximum(alpha, MIN_ALPHA)


def columns(e: Any, p: Any, q: Any, d: Any, observed: Any = 0) -> tuple[Any, ...]:
    """Return the columns of r - b, for the ``observed`` radiance b (``Mixture``)."""
    return e, p, q - d, d - observed


COLUMNS = len(columns(0, 0, 0, 0))


@dataclass(frozen=True)
class Mixture:
    """Coefficients of the columns as a function of base colour c: x = slope c + offset.

    Constants 0 and 1 are Python numbers, which Dr.Jit omits from kernels.
    """

    slope: tuple[Any, ...]
    offset: tuple[Any, ...]

    def at(self, color: Any) -> list[Any]:
        """Return the coefficients x at a base colour."""
        return [color * a + b for a, b in zip(self.slope, self.offset, strict=True)]


def mixture(metallic: Any) -> Mixture:
    """Return the coefficients of the columns from the parameters in ``MIXED``."""
    return Mixture((1 - metallic, metallic, 0, 0), (0, 0, metallic, 1))


def paper_mixture(specular: Any) -> Mixture:
    """Return the mixture of the paper's parameters, r = Kd e + Ks p + q, with c = Kd."""
    return Mixture((1, 0, 0, 0), (0, specular, 1, 1))


def mixture_derivative(values: Sequence[Any], which: int) -> Mixture:
    """Return the derivative of ``mixture`` with respect to the parameter at index ``which``."""
    low, high = (
        mixture(*(end if k == which else value for k, value in enumerate(values))) for end in (0, 1)
    )
    return Mixture(_subtract(high.slope, low.slope), _subtract(high.offset, low.offset))


def _subtract(a: tuple[Any, ...], b: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def specular_from_principled(base_color: Any, *mixed: Any) -> Any:
    """Return Ks = R0 = 0.04 + (base_color - 0.04) metallic, in [0, 1]."""
    return _mix(base_color, mixed, columns(0, 1, 0, F0))


def diffuse_from_principled(base_color: Any, *mixed: Any) -> Any:
    """Return Kd = (1 - metallic) base_color, in [0, 1]."""
    return _mix(base_color, mixed, columns(1, 0, 0, 0))


def _mix(base_color: Any, mixed: Sequence[Any], columns: Sequence[float]) -> Any:
    """Return the mixture of constant columns."""
    x = mixture(*mixed).at(base_color)
    return sum(a * b for a, b in zip(x, columns, strict=True))
