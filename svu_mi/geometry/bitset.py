"""Bit sets: N bits per kernel lane, such as one for each view or light cell."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit

WORD = 32


@dataclass(frozen=True)
class Bits:
    """N bits for each of S lanes.

    Attributes:
        words: (ceil(N / 32) S,) UInt32: bit n % 32 of word (n // 32) S + s is bit n of lane s.
        stride, last: Opaque UInt32, S and N - 1.
    """

    words: Any
    stride: Any
    last: Any

    @staticmethod
    def clear(numbers: int, lanes: int) -> "Bits":
        """Return zeros: ``numbers`` bits, at least one, for each of ``lanes`` lanes."""
        numbers = max(numbers, 1)
        words = -(-numbers // WORD)
        return Bits(
            dr.zeros(mi.UInt32, words * lanes),
            dr.opaque(mi.UInt32, lanes), dr.opaque(mi.UInt32, numbers - 1),
        )  # fmt: skip

    def set(self, number: Any, lane: Any, active: Any) -> None:
        """Set bit ``number`` of each active lane to 1; the bit must be 0 before."""
        bit, place = mi.UInt32(1) << (number % WORD), (number // WORD) * self.stride + lane
        dr.scatter_add(self.words, bit, place, active, dr.ReduceMode.NoConflicts)

    def push(self, word: Any, number: Any, lane: Any, value: Any) -> Any:
        """Write bit ``number``, in ascending order; return ``word`` for the next call."""
        place = number % WORD
        word = dr.select(place == 0, 0, word) | dr.select(value, mi.UInt32(1) << place, 0)
        full = (place == WORD - 1) | (number == self.last)
        target = (number // WORD) * self.stride + lane
        dr.scatter(self.words, word, target, full, dr.ReduceMode.NoConflicts)
        return word

    def at(self, lanes: Any) -> "Bits":
        """Return the bits of selected lanes, given by their indices (UInt32)."""
        if not dr.width(lanes):
            return Bits(mi.UInt32(), dr.opaque(mi.UInt32, 0), self.last)
        words = dr.width(self.words) // max(int(self.stride[0]), 1)
        count = dr.opaque(mi.UInt32, dr.width(lanes))  # a literal would recompile the kernel
        place = dr.arange(mi.UInt32, words * dr.width(lanes))
        taken = dr.gather(mi.UInt32, lanes, place % count) + place // count * self.stride
        return Bits(dr.gather(mi.UInt32, self.words, taken), count, self.last)

    def without(self, groups: Sequence[np.ndarray]) -> "Bits":
        """Return all S lanes once for each group, with the group's bits set to 0.

        Lane g S + s is lane s without the bits in ``groups[g]``.
        """
        rows = self.words.numpy().reshape(-1, max(int(self.stride[0]), 1))
        kept = np.full((len(rows), len(groups), 1), 2**WORD - 1, np.uint32)
        for group, numbers in enumerate(groups):
            bits = np.uint32(1) << (numbers % WORD).astype(np.uint32)
            np.bitwise_and.at(kept[:, group, 0], numbers // WORD, ~bits)
        words = (rows[:, None] & kept).reshape(len(rows), -1)
        stride = dr.opaque(mi.UInt32, words.shape[1])
        return Bits(to_drjit(mi.UInt32, words.ravel()), stride, self.last)

    def count(self) -> np.ndarray:
        """Return the number of set bits of each lane, (S,) int64."""
        lanes = int(self.stride[0])
        rows = dr.opaque(mi.UInt32, dr.width(self.words) // max(lanes, 1))
        lane = dr.arange(mi.UInt32, lanes)

        def add(row: Any, total: Any) -> tuple[Any, Any]:
            word = dr.gather(mi.UInt32, self.words, row * self.stride + lane)
            return row + 1, total + dr.popcnt(word)

        (total,) = fold(0, rows, add, dr.zeros(mi.UInt32, lanes))
        return np.asarray(total.numpy(), np.int64)

    def test(self, number: Any, lane: Any) -> Any:
        """Return bit ``number`` of each ``lane``, as Bool."""
        word = dr.gather(mi.UInt32, self.words, (number // WORD) * self.stride + lane)
        return ((word >> (number % WORD)) & 1) != 0

    def several(self, start: Any, end: Any, lane: Any) -> Any:
        """Return bits ``start`` to ``end`` - 1, 1 to 32 of them, of each ``lane``, as a UInt32."""
        row, shift = start // WORD, start % WORD
        rows = row, dr.minimum(row + 1, self.last // WORD)
        low, high = (dr.gather(mi.UInt32, self.words, k * self.stride + lane) for k in rows)
        bits = (low >> shift) | ((high << 1) << (WORD - 1 - shift))
        return bits & (mi.UInt32(2**WORD - 1) >> (WORD - (end - start)))
