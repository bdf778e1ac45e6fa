"""Bits: what was set is found again, and nothing else."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from svu_mi.interop import owned
from svu_mi.visibility.bits import Bits

LANES = 21


@pytest.mark.parametrize("numbers", [1, 31, 32, 33, 100])
def test_what_is_set_is_found_again(numbers: int) -> None:
    chosen = np.random.default_rng(numbers).random((numbers, LANES)) < 0.5
    table, lane = owned(mi.Bool, chosen.ravel()), dr.arange(mi.UInt32, LANES)
    bits = Bits.clear(numbers, LANES)

    def body(number: mi.UInt32) -> tuple[mi.UInt32]:
        bits.set(number, lane, dr.gather(mi.Bool, table, number * LANES + lane))
        return (number + 1,)

    last = dr.opaque(mi.UInt32, numbers)
    dr.while_loop(state=(dr.zeros(mi.UInt32, LANES),), cond=lambda n: n < last, body=body)
    dr.eval(bits)
    for number in range(numbers):
        found = bits.test(dr.opaque(mi.UInt32, number), lane)
        np.testing.assert_array_equal(found.numpy(), chosen[number])
