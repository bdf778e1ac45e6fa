"""Regularised spherical harmonic fit of scattered samples, one system per lane (Eq. 12).

    (Y^T W^2 Y + lambda R) c = Y^T W^2 f,    R = diag(e^l),    W = diag(w)

The paper penalises l = 0 as well (R_00 = 1), which leaks a constant signal into l > 0;
R_00 = 0 leaves it free. Two equivalent ways to solve it: by the (degree + 1)^2 normal equations
(``primal.py``), for any number of views and without memory for samples; or by one equation per
*visible* view (``dual.py``). Measured for 24 of 60 views: the dual takes a quarter of the time.

Both are computed in double precision inside the kernel: lambda is a millionth of the trace of
Y^T W^2 Y for a few hundred views, and single precision then loses a degree altogether.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.frequency.dual import fit_dual
from svu_mi.frequency.primal import fit_primal
from svu_mi.frequency.system import Sample, System
from svu_mi.interop import owned

CAPACITIES = (32, 64, 128, 256)
"""Sizes of the dual's local memory. Each is a kernel that takes a second to compile, while a lane
only works on, and touches, what its own views need: one size for all texels of a call."""

AUTO_CAPACITY = 128
"""The most views ``auto`` gives to the dual: 64 kB per lane, 1 MB of stack for 16 lanes."""

VIEWS_PER_COEFFICIENT = 2.5
"""Up to so many visible views per coefficient the dual is the faster one (measured at degree 6,
80, 98 and 128 visible views: 0.44, 0.59 and 0.82 of the time of the primal)."""


def fit_lanes(sample: Sample, views: Any, system: System, capacity: int) -> list[list[Any]]:
    """Fit Eq. 12 in every lane, inside the kernel that produces the samples.

    Args:
        sample: called once, while the loop over views is traced, with a UInt32 view index;
            returns the unit direction (Vector3f), the weight w of ``W = diag(w)`` (Float, 0
            where the lane does not see the view) and the values (``channels`` Floats). What
            it returns for a weight of 0 is not used.
        views: number of views, an opaque UInt32.
        system: the problem.
        capacity: the most visible views that a lane can hold, to solve the dual; more are dropped.
            Local memory is about 4 capacity^2 bytes per lane. 0 solves the primal, the same to
            rounding.

    Returns:
        (degree + 1)^2 coefficients in the order l*l + l + m, each a list of ``channels``
        Floats; 0 in a lane that sees no view.
    """
    if capacity:
        return fit_dual(sample, views, system, capacity)
    return fit_primal(sample, views, system)


@dataclass(frozen=True)
class SolverGroup:
    """Texels that one call of ``fit_lanes`` solves.

    Attributes:
        selection: texel indices, an ascending UInt32 array with at least one entry; the order of
            texels is kept, since neighbours see the same views.
        capacity: of the dual: the most views that a texel of the group sees, rounded up; 0 for
            the primal.
    """

    selection: Any
    capacity: int


def solver_groups(visible: Any, degree: int, method: str = "auto") -> list[SolverGroup]:
    """Group the texels that see anything by the kernel that solves them fastest.

    Args:
        visible: (T,) number of views that see each texel, UInt32 or NumPy.
        degree: l*, in [0, 9].
        method: ``auto``, or ``primal`` or ``dual`` for all texels.

    Returns:
        At most two groups, both with texels; a texel that sees no view is in neither.

    Raises:
        OptionError: an unknown method, or ``dual`` for a texel with more than 256 views.
    """
    counts = np.asarray(visible).reshape(-1)
    limits = {
        "auto": min(int(VIEWS_PER_COEFFICIENT * (degree + 1) ** 2), AUTO_CAPACITY),
        "primal": 0,
        "dual": CAPACITIES[-1],
    }
    if method not in limits:
        raise OptionError(f"The method of a fit must be auto, primal or dual, got {method!r}.")
    if method == "dual" and counts.max(initial=0) > CAPACITIES[-1]:
        raise OptionError(
            f"Texel {int(counts.argmax())} sees {counts.max()} views; the dual holds "
            f'{CAPACITIES[-1]}. Use method="auto" or "primal".'
        )
    few = (counts > 0) & (counts <= limits[method])
    held = int(counts[few].max(initial=0))
    parts = (few, next(size for size in CAPACITIES if size >= held)), (counts > limits[method], 0)
    return [
        SolverGroup(owned(mi.UInt32, np.flatnonzero(chosen).astype(np.uint32)), capacity)
        for chosen, capacity in parts if chosen.any()
    ]  # fmt: skip
