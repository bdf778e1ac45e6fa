"""Values of texels in blocks of 16: a packet of lanes finds all it reads in a few pages.

N rows of S values are laid out as (ceil(S / 16), N, 16). By rows of S values, a packet would
read from N pages, which takes five times as long.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.local_memory import scatter_strided

BLOCK = 16


def size(rows: int, count: int) -> int:
    """Return how many values N rows of S texels take."""
    return -(-count // BLOCK) * rows * BLOCK


def start(lane: Any, rows: Any) -> Any:
    """Return where the first of a texel's values is; the next is ``BLOCK`` further on."""
    return (lane // BLOCK) * (rows * BLOCK) + lane % BLOCK


def scattered(kind: Any, columns: list[Any], count: int, beside: Any = ()) -> Any:
    """Write the values of all lanes and evaluate them, with ``beside`` in the same kernel."""
    target = cleared(kind, len(columns), count)
    place = start(dr.arange(mi.UInt32, count), len(columns))
    target = scatter_strided(target, columns, place, mi.UInt32(BLOCK))
    dr.eval(target, beside)
    return target


def cleared(kind: Any, rows: int, count: int) -> Any:
    """Return memory for N rows of S values; only the last block is cleared."""
    values = dr.empty(kind, size(rows, count))
    if count % BLOCK:
        last = dr.opaque(mi.UInt32, size(rows, count) - rows * BLOCK)
        place = last + dr.arange(mi.UInt32, rows * BLOCK)
        dr.scatter(values, dr.zeros(kind), place, mode=dr.ReduceMode.NoConflicts)
        dr.eval(values)
    return values


def in_blocks(kind: Any, table: np.ndarray) -> Any:
    """Lay values (N, S) out as an array of ``kind``."""
    padded = np.pad(table, ((0, 0), (0, -table.shape[1] % BLOCK)))
    return to_drjit(kind, np.moveaxis(padded.reshape(len(table), -1, BLOCK), 1, 0).ravel())


def rows_of(values: Any, rows: int, count: int) -> np.ndarray:
    """Return (N, S), the inverse of ``in_blocks``."""
    blocks = values.numpy().reshape(-1, rows, BLOCK)
    return np.moveaxis(blocks, 1, 0).reshape(rows, -1)[:, :count]


def taken(values: Any, rows: int, lanes: Any) -> Any:
    """Return the values of some texels, in blocks, in the order of ``lanes`` (UInt32)."""
    count = dr.width(lanes)
    if not count:
        return type(values)()
    place = dr.arange(mi.UInt32, size(rows, count))
    lane, row = _lane_and_row(place, rows)
    held = lane < dr.opaque(mi.UInt32, count)
    source = start(dr.gather(mi.UInt32, lanes, lane, held), dr.opaque(mi.UInt32, rows))
    found = dr.gather(type(values), values, source + row * BLOCK, held)
    dr.eval(found)
    return found


def put(values: Any, rows: int, lanes: Any, others: Any) -> Any:
    """Return values of which those of some texels are others', which ``taken`` is the order of."""
    count = dr.width(lanes)
    if not count:
        return values
    place = dr.arange(mi.UInt32, size(rows, count))
    lane, row = _lane_and_row(place, rows)
    held = lane < dr.opaque(mi.UInt32, count)
    target = start(dr.gather(mi.UInt32, lanes, lane, held), dr.opaque(mi.UInt32, rows))
    result = type(values)(values)
    dr.scatter(result, others, target + row * BLOCK, held, dr.ReduceMode.NoConflicts)
    dr.eval(result)
    return result


def _lane_and_row(place: Any, rows: int) -> tuple[Any, Any]:
    """Return which texel, and which of its values, stands at a place."""
    block = dr.opaque(mi.UInt32, rows * BLOCK)
    return place // block * BLOCK + place % BLOCK, place % block // BLOCK


class Reader:
    """Reads N rows of values of the texels ``lane``, of S; by default all in order."""

    def __init__(self, values: Any, rows: int, count: int, lane: Any | None = None) -> None:
        self._values = values
        lane = dr.arange(mi.UInt32, count) if lane is None else lane
        self._start = start(lane, dr.opaque(mi.UInt32, rows))

    def read(self, row: Any) -> Any:
        """Return a row's value of every texel."""
        return dr.gather(type(self._values), self._values, self._start + row * BLOCK)
