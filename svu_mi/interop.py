"""NumPy arrays as Dr.Jit arrays that own their memory."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

LARGE = 2**20  # bytes, from which a second copy costs more than waiting for Dr.Jit


def owned(kind: Any, values: np.ndarray) -> Any:
    """Copy a NumPy array into a Dr.Jit array.

    ``mi.Float(array)`` and ``dr.copy`` of it go on using NumPy's memory. Later writes then
    show through, and, worse, Dr.Jit compiles another kernel for every combination of inputs
    that happen to be aligned to its packets: the same code compiles again on other data.

    Args:
        kind: a Dr.Jit type, such as ``mi.Float`` or ``mi.Point3f``.
        values: (N,) or, for a vector type, (dimension, N); converted to the type's precision.
    """
    if not values.size:
        return kind()
    if dr.depth_v(kind) > 1:
        return kind(*(owned(dr.value_t(kind), component) for component in values))
    plain = np.ascontiguousarray(values)
    # Dr.Jit makes its copy when its queue gets there, which may be after we have returned: give
    # it an array that nobody else writes to, or wait.
    if plain.nbytes < LARGE:
        return dr.opaque(kind(plain.copy()))
    found = dr.opaque(kind(plain))
    dr.sync_thread()
    return found
