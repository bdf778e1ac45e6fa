"""Which texels are solved by which kernel: the dual for few views, the primal for many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.frequency.fit import Method
from svu_mi.interop import owned

CAPACITIES = (32, 64, 128, 256)
"""Sizes of the dual's local memory. Each is a kernel that takes a second to compile, while a lane
only works on, and touches, what its own views need: one size for all texels of a call."""

AUTO_CAPACITY = 128
"""The most views ``auto`` gives to the dual: 64 kB per lane, 1 MB of stack for 16 lanes."""

VIEWS_PER_COEFFICIENT = 2.5
"""Up to so many visible views per coefficient the dual is the faster one (measured at degree 6,
80, 98 and 128 visible views: 0.44, 0.59 and 0.82 of the time of the primal)."""


@dataclass(frozen=True, kw_only=True)
class SolverGroup:
    """Texels that one call of ``fit_lanes`` solves.

    Attributes:
        selection: texel indices, an ascending UInt32 array with at least one entry; the order of
            texels is kept, since neighbours see the same views.
        method: ``dual`` or ``primal``.
        capacity: the most views that a texel of the group sees, rounded up; 0 for ``primal``.
    """

    selection: Any
    method: Method
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
    if method not in ("auto", "primal", "dual"):
        raise OptionError(f"The method of a fit must be auto, primal or dual, got {method!r}.")
    largest = int(counts.max(initial=0))
    if method == "dual" and largest > CAPACITIES[-1]:
        raise OptionError(
            f"Texel {int(counts.argmax())} sees {largest} views; the dual holds "
            f'{CAPACITIES[-1]}. Use method="auto" or "primal".'
        )
    limit = {
        "auto": min(int(VIEWS_PER_COEFFICIENT * (degree + 1) ** 2), AUTO_CAPACITY),
        "primal": 0,
        "dual": CAPACITIES[-1],
    }[method]
    few = (counts > 0) & (counts <= limit)
    held = int(counts[few].max(initial=0))
    groups: list[SolverGroup] = []
    _append(groups, few, "dual", next(size for size in CAPACITIES if size >= held))
    _append(groups, counts > limit, "primal", 0)
    return groups


def _append(groups: list[SolverGroup], mask: np.ndarray, method: Method, capacity: int) -> None:
    texels = np.flatnonzero(mask).astype(np.uint32)
    if texels.size:
        selection = owned(mi.UInt32, texels)
        groups.append(SolverGroup(selection=selection, method=method, capacity=capacity))
