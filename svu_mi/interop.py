"""NumPy arrays as Dr.Jit arrays that own their memory."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def owned(kind: Any, values: np.ndarray) -> Any:
    """Copy a NumPy array into a Dr.Jit array.

    ``mi.Float(array)`` and ``dr.copy`` of it go on using NumPy's memory. Later writes then
    show through, and, worse, Dr.Jit compiles another kernel for every combination of inputs
    that happen to be aligned to its packets: the same code compiles anew on other data.

    Args:
        kind: a Dr.Jit type, such as ``mi.Float`` or ``mi.Point3f``.
        values: (N,) or, for a vector type, (dimension, N); converted to the type's precision.
    """
    plain = np.ascontiguousarray(values)
    return dr.opaque(kind(plain)) if plain.size else kind()
