"""Principled parameters and what the reflection model makes of them (Sec. 3.2 of the paper).

Plain arithmetic: works on floats, NumPy arrays and Dr.Jit arrays alike. All quantities are
dimensionless; colours are linear. ``specular`` is 0.5, an index of refraction of 1.5.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

F0 = 0.04
"""Reflectance at normal incidence of a dielectric with index 1.5."""

MIN_ALPHA = 1e-3
"""Mitsuba's lower bound of the microfacet width."""


def unbounded_alpha(roughness: Any) -> Any:
    """Return alpha = roughness^2, the width of the GGX lobe as the paper has it."""
    return roughness * roughness


def alpha_from_roughness(roughness: Any) -> Any:
    """Return alpha = max(roughness^2, 1e-3), as Mitsuba's principled BSDF has it."""
    alpha = unbounded_alpha(roughness)
    maximum = dr.maximum if dr.is_array_v(alpha) else np.maximum
    return maximum(alpha, MIN_ALPHA)


def roughness_from_alpha(alpha: Any) -> Any:
    """Return the roughness whose alpha this is: sqrt(alpha)."""
    return alpha**0.5


def specular_from_principled(base_color: Any, metallic: Any) -> Any:
    """Return Ks = R0 = 0.04 + (base_color - 0.04) metallic, in [0, 1]."""
    return F0 + (base_color - F0) * metallic


def diffuse_from_principled(base_color: Any, metallic: Any) -> Any:
    """Return Kd = (1 - metallic) base_color, in [0, 1]."""
    return (1 - metallic) * base_color


def principled_from_specular(specular: Any, diffuse: Any) -> tuple[Any, Any]:
    """Return (base_color, metallic) that have this Ks and Kd.

    With c = base_color and m = metallic, Kd = c (1 - m) and Ks = F0 + (c - F0) m give
    c = s + F0 m with s = Kd + Ks - F0, and F0 m^2 + (s - F0) m - (Ks - F0) = 0.

    Args:
        specular: Ks in [0.04, 1].
        diffuse: Kd in [0, 1]; not both Kd = 0 and Ks = 0.04, which has no unique metallic.
    """
    s = diffuse + specular - F0
    half = s - F0
    # The positive root, written without cancellation.
    metallic = 2 * (specular - F0) / (half + (half * half + 4 * F0 * (specular - F0)) ** 0.5)
    return s + F0 * metallic, metallic
