"""One bit per lane and number (view, cell), in words that lie next to each other by lane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

WORD = 32


@dataclass(frozen=True)
class Bits:
    """N bits for each of S lanes.

    Attributes:
        words: (ceil(N / 32) S,) UInt32: bit n % 32 of word (n // 32) S + s is that of number n
            and lane s.
        stride: S, an opaque UInt32.
    """

    words: Any
    stride: Any

    @staticmethod
    def clear(numbers: int, lanes: int) -> Bits:
        """Return bits that are all 0; room for at least one number."""
        words = -(-max(numbers, 1) // WORD)
        return Bits(dr.zeros(mi.UInt32, words * lanes), dr.opaque(mi.UInt32, lanes))

    def set(self, number: Any, lane: Any, active: Any) -> None:
        """Set bits that are 0, each of them once."""
        bit, place = mi.UInt32(1) << (number % WORD), (number // WORD) * self.stride + lane
        dr.scatter_add(self.words, bit, place, active, dr.ReduceMode.NoConflicts)

    def test(self, number: Any, lane: Any) -> Any:
        """Return whether bits are set, as a Bool."""
        word = dr.gather(mi.UInt32, self.words, (number // WORD) * self.stride + lane)
        return ((word >> (number % WORD)) & 1) != 0
