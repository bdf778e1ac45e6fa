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


def in_order(chosen: np.ndarray) -> Bits:
    """Push a table (N, S) of bits, as a loop over numbers does."""
    numbers, lanes = chosen.shape
    table, lane = owned(mi.Bool, chosen.ravel()), dr.arange(mi.UInt32, lanes)
    bits, count = Bits.clear(numbers, lanes), dr.opaque(mi.UInt32, lanes)

    def body(number: mi.UInt32, word: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        value = dr.gather(mi.Bool, table, number * count + lane)
        return number + 1, bits.push(word, number, lane, value)

    last = dr.opaque(mi.UInt32, numbers)
    garbage = dr.full(mi.UInt32, 0xDEADBEEF, lanes)  # of the word before the first
    dr.while_loop(state=(mi.UInt32(0), garbage), cond=lambda n, _: n < last, body=body)
    dr.eval(bits)
    return bits


def table_of(bits: Bits, numbers: int, lanes: int) -> np.ndarray:
    lane = dr.arange(mi.UInt32, lanes)
    return np.array([bits.test(dr.opaque(mi.UInt32, n), lane).numpy() for n in range(numbers)])


def random_table(numbers: int, lanes: int = LANES) -> np.ndarray:
    return np.random.default_rng(40289 + numbers + lanes).random((numbers, lanes)) < 0.5


@pytest.mark.parametrize("numbers", [1, 31, 32, 33, 64, 100])
def test_what_is_pushed_in_order_is_found_again(numbers: int) -> None:
    """Also the last word, which is not full; and all of it is what ``set`` would have made."""
    chosen = random_table(numbers)
    bits = in_order(chosen)
    np.testing.assert_array_equal(table_of(bits, numbers, LANES), chosen)
    rows = np.pad(chosen, ((0, -numbers % 32), (0, 0))).reshape(-1, 32, LANES)
    words = (rows.astype(np.uint64) << np.arange(32, dtype=np.uint64)[:, None]).sum(axis=1)
    np.testing.assert_array_equal(bits.words.numpy(), words.ravel().astype(np.uint32))


@pytest.mark.parametrize("numbers", [1, 33, 100])
def test_bits_of_some_lanes_in_any_order_and_more_than_once(numbers: int) -> None:
    chosen = random_table(numbers)
    for lanes in ([20, 0, 3, 3, 7], [5], list(range(LANES)) * 2):
        some = in_order(chosen).at(owned(mi.UInt32, np.array(lanes, np.uint32)))
        found = table_of(some, numbers, len(lanes))
        np.testing.assert_array_equal(found, chosen[:, lanes])


@pytest.mark.parametrize("numbers", [1, 32, 100])
def test_joined_bits_stand_one_after_the_other(numbers: int) -> None:
    first, second = random_table(numbers), random_table(numbers, 9)
    both = in_order(first).joined(in_order(second))
    found = table_of(both, numbers, LANES + 9)
    np.testing.assert_array_equal(found, np.concatenate([first, second], axis=1))
    lanes = np.array([LANES + 8, 0, LANES])
    some = table_of(both.at(owned(mi.UInt32, lanes.astype(np.uint32))), numbers, 3)
    np.testing.assert_array_equal(some, found[:, lanes])
