"""Credible intervals: the shortest interval with a given probability."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.posterior.quadrature import QuadratureAxis
from svu_mi.statistics.texel_blocks import BLOCK, texel_offset

LEVEL = 0.9  # default probability of an interval
SUBSAMPLE = 4096  # number of texels that summaries sample


def subsample(texels: np.ndarray, most: int = SUBSAMPLE) -> np.ndarray:
    """Return at most ``most`` texels, evenly spaced."""
    count = min(len(texels), most)
    return np.asarray(texels[np.arange(count) * len(texels) // max(count, 1)])


def shortest_interval(
    masses: Any, parts: QuadratureAxis, count: int, level: float, *, divided: bool = False
) -> tuple[Any, Any]:
    """Return both ends, (count,) Floats, of the shortest interval of probability ``level``.

    Args:
        masses: unnormalised masses of the parts (layout: ``texel_blocks``).
        parts: the parts.
        count: number of texels.
        level: minimum probability.
        divided: whether an interval may end within a part, of uniform density.
    """
    number = dr.opaque(mi.UInt32, parts.count)
    place = texel_offset(dr.arange(mi.UInt32, count), number)
    low, high = (to_drjit(mi.Float, ends) for ends in parts.ends)
    width = to_drjit(mi.Float, (parts.high - parts.low) * divided)

    def mass(part: Any, active: Any = True) -> Any:
        return dr.gather(mi.Float, masses, place + part * BLOCK, active)

    def add(part: Any, total: Any) -> tuple[Any, Any]:
        return part + 1, total + mass(part)

    zero = dr.zeros(mi.Float, count)
    (total,) = fold(0, number, add, zero)
    # With rounding errors, the sum of all parts may be less than the total.
    wanted = total * dr.minimum(dr.opaque(mi.Float, level), 1 - 1e-6)

    def move(first: Any, end: Any, held: Any, best: Any, a: Any, b: Any) -> tuple[Any, ...]:
        """Append a part to a run of too little mass; else keep the shorter one and drop a part."""
        enough, last = held >= wanted, dr.maximum(end, 1) - 1
        left, right = dr.gather(mi.Float, low, first), dr.gather(mi.Float, high, last)
        # Cut the part at an end whose density is lower by the mass that is not wanted.
        cuts = [dr.clip((held - wanted) / dr.maximum(mass(part), 1e-30), 0, 1)
                * dr.gather(mi.Float, width, part) for part in (first, last)]  # fmt: skip
        left += dr.select(cuts[0] > cuts[1], cuts[0], 0)
        right -= dr.select(cuts[0] > cuts[1], 0, cuts[1])
        better = enough & (right - left < best)
        best = dr.select(better, right - left, best)
        a, b = dr.select(better, left, a), dr.select(better, right, b)
        held += dr.select(enough, -mass(first), mass(end, ~enough & (end < number)))
        step = mi.UInt32(1)
        return (dr.select(enough, first + step, first), dr.select(enough, end, end + step),
                held, best, a, b)  # fmt: skip

    index = dr.zeros(mi.UInt32, count)
    *_, a, b = dr.while_loop(
        (index, index, zero, dr.full(mi.Float, dr.inf, count), zero, zero + 1),
        lambda first, end, *_: (first < number) & (end <= number),
        move,
    )
    dr.eval(a, b)
    return a, b
