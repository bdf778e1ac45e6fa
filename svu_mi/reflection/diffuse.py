"""Diffuse reflection under distant light, from moments of that light."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

from svu_mi.switches import Diffuse


def diffuse_shading(
    model: Diffuse, moments: list[Any], direction: Any, cosine: Any
) -> tuple[Any, Any]:
    """Radiance of a white diffuse surface, as a + roughness b.

    Disney's model [Burley 2015], as Mitsuba's ``principled`` has it, with Schlick weights
    F = (1 - cos)^5 of the incident (i) and outgoing (o) direction:

        f = ((1 - F_o / 2) (1 - F_i / 2) + R (F_o + F_i + F_o F_i (R - 1))) / pi,
        R = roughness (1 + w_i . w_o).

    The term R^2 F_o F_i, which is of any size only where both directions graze, is left out;
    what is left is linear in four moments of the light (``visibility.Reach``).

    Args:
        model: ``disney``, or ``lambert``: f = 1 / pi.
        moments: c0, m0 (3), c1, m1 (3) of one channel.
        direction: unit Vector3f w_o, in the frame of the moments.
        cosine: Float, cos theta_o.

    Returns:
        (a, b), radiance.
    """
    c0, m0, c1, m1 = moments[0], moments[1:4], moments[4], moments[5:8]
    if model == "lambert":
        return c0 / math.pi, 0.0 * c0
    F_o = (1 - cosine) ** 5
    d0 = c0 + sum(m * w for m, w in zip(m0, direction, strict=True))
    d1 = c1 + sum(m * w for m, w in zip(m1, direction, strict=True))
    a = (1 - 0.5 * F_o) * (c0 - 0.5 * c1)
    b = dr.lerp(d1, d0, F_o)
    return a / math.pi, b / math.pi
