"""What a scene's own material says of an object: parameters that do not vary over it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.parameters import NAMES, PARAMETERS


def is_principled(bsdf: Any) -> bool:
    """Return whether a BSDF, or None, has the parameters of ``principled``."""
    return bsdf is not None and all(dr.all(bsdf.has_attribute(name)) for name in NAMES)


def constant_parameters(shape: Any) -> dict[str, float]:
    """Return the ``principled`` parameters of a shape that are not textures, by name.

    A grey value each, within its range; a constant colour is left out unless it is grey. Empty for
    another BSDF, and when nothing varies: a material without any texture is a placeholder.

    Args:
        shape: a ``mi.Shape``.
    """
    bsdf = shape.bsdf()
    found: dict[str, float] = {}
    if not is_principled(bsdf):
        return found
    for key, value in mi.traverse(bsdf):
        name, _, kind = key.removeprefix("brdf_0.").partition(".")
        if name in NAMES and kind == "value":
            values = np.array(value, np.float64).ravel()
            if np.ptp(values) == 0 and PARAMETERS[name].holds(values[0]):
                found[name] = float(values[0])
    return found if len(found) < len(NAMES) else {}
